"""A Robotiq gripper behind its URCap's socket on the controller, port 63352."""

import contextlib
import logging
import socket
import threading
import time

from lerobot_uca.errors import UserError
from lerobot_uca.robots.ur5e.channel import ArmStoppedError

PORT = 63352
TIMEOUT = 2.0  # [s]
ANSWERS_WITHIN = 0.5  # [s], after a suspension, in which what was heard last has become old
ACTIVATION_TIMEOUT = 10.0  # [s]; the fingers move through their whole range meanwhile
RESET, ACTIVE = 0, 3  # of STA
HEALTH_PERIOD = 0.1  # [s]
OPEN_COUNT, CLOSED_COUNT = 3, 230  # where a 2F-85's fingers end, of 0 to 255

logger = logging.getLogger(__name__)


class RobotiqGripper:
    """Positions in [0, 1]: 0 open, 1 closed. Its answers take milliseconds, so a thread of its own waits for them."""

    def __init__(self, ip: str) -> None:
        try:
            self._connection = socket.create_connection((ip, PORT), timeout=TIMEOUT)
        except OSError as error:
            raise UserError(
                f"No gripper answers at {ip}:{PORT} ({error.strerror or error}): is Robotiq's URCap installed? An arm "
                "without a gripper has --robot.gripper=none."
            ) from None
        self._lock = threading.Lock()
        self._failure: str | None = None
        self._position, self._heard_at = 0.0, time.monotonic()
        self._requested: int | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gripper", daemon=True)
        try:
            self._activate()
            self._position = self._read_position()
        except OSError as error:
            self._connection.close()
            what = f"did not answer within {TIMEOUT:.0f} s" if isinstance(error, TimeoutError) else "hung up"
            raise UserError(
                f"The gripper's URCap at {ip}:{PORT} takes connections but {what}: see its page on the pendant."
            ) from None
        except BaseException:
            self._connection.close()
            raise
        self._thread.start()

    def _ask(self, request: str) -> str:
        self._connection.sendall(f"{request}\n".encode("ascii"))
        return self._connection.recv(1024).decode("ascii", errors="replace").strip()

    def _get(self, name: str) -> int:
        answer = self._ask(f"GET {name}")
        if not answer.removeprefix(f"{name} ").isdigit():
            raise ArmStoppedError(f"The gripper has no value for {name} ('{answer}'): emergency stop, or not wired.")
        return int(answer.removeprefix(f"{name} "))

    def _activate(self) -> None:
        if self._get("STA") != ACTIVE:
            logger.info("The gripper is activated: its fingers open and close once.")
            for request in ("SET ACT 0", "SET ATR 0"):
                self._ask(request)
            self._wait_for(RESET, "reset itself")  # or it would miss that it is activated
            self._ask("SET ACT 1")
            self._wait_for(ACTIVE, "become active")
        self._check_health()

    def _wait_for(self, status: int, what: str) -> None:
        deadline = time.monotonic() + ACTIVATION_TIMEOUT
        while self._get("STA") != status:
            if time.monotonic() > deadline:
                raise UserError(f"The gripper did not {what} within {ACTIVATION_TIMEOUT:.0f} s.")
            time.sleep(0.05)

    def _check_health(self) -> None:
        if fault := self._get("FLT"):
            raise ArmStoppedError(
                f"The gripper reports fault {fault}: see Robotiq's manual, and reset it on the pendant."
            )
        if self._get("STA") != ACTIVE:
            raise ArmStoppedError("The gripper is not active any longer: see its page on the pendant.")

    def _read_position(self) -> float:
        share = (self._get("POS") - OPEN_COUNT) / (CLOSED_COUNT - OPEN_COUNT)
        return min(max(share, 0.0), 1.0)

    def _run(self) -> None:
        sent: int | None = None
        checked_at = time.monotonic()
        try:
            while not self._closing.is_set():
                if time.monotonic() - checked_at > HEALTH_PERIOD:
                    self._check_health()
                    checked_at = time.monotonic()
                with self._lock:
                    requested = self._requested
                if requested != sent:
                    self._ask(f"SET POS {requested} SPE 255 FOR 50 GTO 1")
                    sent = requested
                position = self._read_position()
                with self._lock:
                    self._position, self._heard_at = position, time.monotonic()
                self._closing.wait(0.005)
            self._ask("SET GTO 0")  # or they would go on to where they were sent
        except (OSError, ArmStoppedError) as error:
            why = str(error) if isinstance(error, ArmStoppedError) else f"The gripper no longer answers ({error})."
            with self._lock:
                self._failure = why

    @property
    def position(self) -> float:
        """Measured. Raises `ArmStoppedError` where the gripper no longer answers."""
        until = time.monotonic() + ANSWERS_WITHIN
        while self._failure is None and self._is_old and time.monotonic() < until:
            time.sleep(0.005)
        with self._lock:
            if self._failure is not None or self._is_old:
                raise ArmStoppedError(self._failure or "The gripper no longer answers.")
            return self._position

    @property
    def _is_old(self) -> bool:
        return time.monotonic() - self._heard_at > TIMEOUT

    def request(self, position: float) -> float:
        """Go to a position; what is commanded is returned: the nearest that the gripper can tell apart."""
        share = min(max(position, 0.0), 1.0)
        count = round(OPEN_COUNT + share * (CLOSED_COUNT - OPEN_COUNT))
        with self._lock:
            self._requested = count
        return (count - OPEN_COUNT) / (CLOSED_COUNT - OPEN_COUNT)

    def close(self) -> None:
        """The fingers stop where they are; hang up."""
        self._closing.set()
        self._thread.join(TIMEOUT)
        with contextlib.suppress(OSError):
            self._connection.close()
