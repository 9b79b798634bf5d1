"""The driver's side of the process that talks to the arm."""

import contextlib
import importlib.util
import logging
import math
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable

from lerobot_uca.errors import UserError
from lerobot_uca.robots.ur5e.channel import (
    ArmStoppedError,
    Failure,
    Message,
    Note,
    Settings,
    State,
    Stop,
    Target,
    decode,
    encode,
)

START_TIMEOUT = 20.0  # [s]
HEARTBEAT_TIMEOUT = 1.5  # [s]
FRESH = 0.1  # [s]; a driver that was suspended finds older states, of an arm that has stopped since
STOP_TIMEOUT = 3.0  # [s]

logger = logging.getLogger(__name__)


class RtdeProcess:
    """Starts the client, hears its heartbeat, hands it targets, and makes sure that it ends."""

    def __init__(self, settings: Settings) -> None:
        if importlib.util.find_spec("rtde_control") is None:
            raise UserError(
                "The UR5e needs the package ur-rtde, which is not installed. It comes with the extra 'ur5e': "
                "pip install 'lerobot_policy_uca_flow[ur5e]'"
            )
        self._changed = threading.Condition()
        self._state: State | None = None
        self._failure: str | None = None
        self._socket, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603
                # -P: of the working directory, a recording's perhaps, nothing is imported
                [sys.executable, "-P", "-m", "lerobot_uca.robots.ur5e.rtde_client", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # ur_rtde prints on both; what matters comes as messages
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # a terminal's Ctrl-C goes to this process alone
            )
        self._reader = threading.Thread(target=self._read, name="ur5e-heartbeat", daemon=True)
        self._reader.start()
        self._send(settings)
        try:
            self.wait_for(lambda _: True, START_TIMEOUT, f"An answer from {settings.ip}")
        except BaseException:
            try:
                self.stop("The connection was given up.")
            finally:  # also where a second Ctrl-C comes: nothing has moved
                self.kill()
            raise

    def _read(self) -> None:
        with contextlib.suppress(OSError):  # a killed process resets the connection
            for line in self._socket.makefile("rb"):
                self._take(decode(line))
        code = self._process.wait()
        with self._changed:
            if self._failure is None:
                died_of = signal.Signals(-code).name if code < 0 else f"code {code}"
                self._failure = f"The process that talks to the arm has ended ({died_of}); the arm stands still."
            self._changed.notify_all()

    def _take(self, message: Message) -> None:
        with self._changed:
            if isinstance(message, State):
                self._state = message
            elif isinstance(message, Failure):
                self._failure = message.text
            self._changed.notify_all()
        if isinstance(message, Note):
            logger.warning(message.text)

    def wait_for(self, condition: Callable[[State], bool], timeout: float, what: str) -> State:
        """The first state that meets a condition. Raises `ArmStoppedError` where none does or the arm stops.

        Args:
            condition: of the state.
            timeout: [s].
            what: is waited for, for the message.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._failure or (self._state and condition(self._state)), timeout):
                raise ArmStoppedError(f"{what} did not come within {timeout:.0f} s.")
            self._raise_failure()
            assert self._state is not None  # a condition was met by one
            return self._state

    def state(self) -> State:
        """The newest, which a busy computer may have to be waited for.

        Raises `ArmStoppedError` where the arm has stopped or nothing has been heard for a while.
        """
        with self._changed:
            is_fresh = self._changed.wait_for(lambda: self._failure or self._age < FRESH, HEARTBEAT_TIMEOUT)
            self._raise_failure()
            assert self._state is not None  # the constructor waits for one
            if is_fresh:
                return self._state
            # Whoever asks from now on is told this, not that the process was killed.
            self._failure = f"The process that talks to the arm has not been heard for {self._age:.1f} s and was ended."
        self.kill()  # the controller's watchdog then ends its program
        raise ArmStoppedError(self._failure)

    @property
    def _age(self) -> float:
        return math.inf if self._state is None else time.monotonic() - self._state.made_at

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise ArmStoppedError(self._failure)

    def failure_within(self, seconds: float) -> str | None:
        """Why the arm has stopped, if it has or does so within some seconds."""
        with self._changed:
            self._changed.wait_for(lambda: self._failure is not None, seconds)
            return self._failure

    @property
    def is_alive(self) -> bool:
        """Whether the arm takes commands."""
        return self._failure is None

    def send(self, target: Target) -> None:
        """The arm's next target."""
        self._send(target)

    def _send(self, message: Settings | Target) -> None:
        try:
            self._socket.sendall(encode(message))
        except OSError:
            with self._changed:
                self._changed.wait_for(lambda: self._failure is not None, 1.0)
                self._raise_failure()

    def stop(self, reason: str) -> None:
        """The arm brakes, its program ends, the process ends. Whoever still uses it is told the reason."""
        with self._changed:
            self._failure = self._failure or reason
        with contextlib.suppress(OSError):  # it has ended by itself
            self._socket.sendall(encode(Stop()))
        try:
            self._process.wait(STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            logger.warning("The process that talks to the arm did not end by itself.")
        self.kill()

    def kill(self) -> None:
        """End the process at once. The arm stays at its last setpoint; its watchdog ends the program."""
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()
        self._process.wait()
        self._reader.join(1.0)
        self._socket.close()
