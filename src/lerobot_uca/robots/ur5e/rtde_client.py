"""The process that talks to the arm. `RtdeProcess` starts it; it ends with the driver's process, whatever ends that.

ur_rtde runs only here. Its release 1.6.5 was measured to fail in these ways: it dies of a segmentation fault when
RTDE's stream breaks while the controller still accepts connections; `servoJ` answers True while the arm is stopped or
gone and takes targets that are not numbers or too few; its getters repeat the last values for ever. So this loop checks
connection, age of the data, program and safety before every command, sends checked targets only, and leaves at once,
without ur_rtde's own cleaning up, where something is wrong.
"""

import contextlib
import ctypes
import os
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np

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
from lerobot_uca.robots.ur5e.dashboard import stop_program
from lerobot_uca.robots.ur5e.kinematics import Array
from lerobot_uca.robots.ur5e.limits import Interpolator, is_followed
from lerobot_uca.robots.ur5e.real_time import prefer_this_thread

# [s] Without new data from the controller: first nothing is commanded, then this ends. A busy computer may well wait
# for half a second, and its arm stands still meanwhile.
FREEZE_AFTER, STALE_AFTER = 0.05, 1.0
PACKETS = 3  # that may be missing before that, where they come more slowly than that
SAFEGUARD_STOP = 5  # RTDE's safety_mode
STOPPED, PAUSED = 1, {3, 4, 5}  # RTDE's runtime_state; the latter are pausing, paused, resuming
PAUSES_WITHIN = 0.5  # [s]
NEXT_DATA = 0.05  # [s]
WATCHDOG_RATE = 1.0  # [Hz]: the controller ends the program of a client that has been silent for a second
FULL_SPEED = 0.99  # of the pendant's speed slider
ENDS_WITHIN = 5  # [s]
SET_DEATH_SIGNAL = 1  # of prctl
BRAKING = 4.0  # [m/s^2], of servoStop: ur_rtde's script stops the tool along its path


class Channel:
    """The driver's side of the process, without ever waiting for it."""

    def __init__(self, descriptor: int) -> None:
        self._socket = socket.socket(fileno=descriptor)
        self._received = b""
        self._unsent: deque[Message] = deque()

    def receive(self) -> list[Message]:
        """The messages that have come. A driver that is gone is a `Stop`."""
        self._socket.setblocking(False)
        try:
            while data := self._socket.recv(65536):
                self._received += data
            return [Stop()]
        except BlockingIOError:
            pass
        except OSError:
            return [Stop()]
        *lines, self._received = self._received.split(b"\n")
        return [decode(line) for line in lines]

    def receive_settings(self) -> Settings:
        """The first message; waits for it."""
        while True:
            for message in self.receive():
                if isinstance(message, Settings):
                    return message
                if isinstance(message, Stop):
                    sys.exit(0)
            time.sleep(0.005)

    def send(self, message: Message) -> None:
        """Where the driver does not read, a state is left out; anything else goes as soon as it does."""
        if not isinstance(message, State):
            self._unsent.append(message)
        self._socket.setblocking(False)
        self._send_unsent()
        if isinstance(message, State) and not self._unsent:
            with contextlib.suppress(OSError):
                self._socket.sendall(encode(message))

    def finish(self) -> None:
        """Wait for a moment for a driver that has not read all yet."""
        self._socket.settimeout(1)
        self._send_unsent()

    def _send_unsent(self) -> None:
        with contextlib.suppress(OSError):
            while self._unsent:
                self._socket.sendall(encode(self._unsent[0]))
                self._unsent.popleft()


class ServoLoop:
    """Streams setpoints to the arm at a constant rate and watches over it."""

    def __init__(self, settings: Settings, channel: Channel) -> None:
        from rtde_control import RTDEControlInterface
        from rtde_receive import RTDEReceiveInterface

        self._settings, self._channel = settings, channel
        self._period = 1 / settings.servo_rate
        self._receive: Any = RTDEReceiveInterface(settings.ip, settings.servo_rate)
        self._control: Any = RTDEControlInterface(settings.ip, settings.servo_rate)
        self._timestamp, self._changed_at = -1.0, time.monotonic()
        self._interpolator = Interpolator(np.array(self._receive.getActualQ()), settings.limits)
        self._is_servoing = False
        self._idle_since = self._last_turn = time.monotonic()
        self._holds_until: float | None = None
        if not self._control.setWatchdog(WATCHDOG_RATE):
            raise ArmStoppedError(f"The program on {settings.ip} did not take its watchdog; nothing has moved.")
        if (slider := self._receive.getTargetSpeedFraction()) < FULL_SPEED:
            channel.send(Note(f"The pendant's speed slider is at {slider:.0%}: below 100 % the arm falls behind."))

    def run(self) -> None:
        """Until the driver says stop or is gone. Raises `ArmStoppedError` where the arm cannot go on."""
        try:
            self._serve()
        except RuntimeError as error:  # ur_rtde's, in words of its sockets: it connects anew within a command
            raise ArmStoppedError(f"The connection to {self._settings.ip} is lost ({error}).") from error

    def _serve(self) -> None:
        due = time.monotonic()
        while True:
            self._check()
            for message in self._channel.receive():
                if isinstance(message, Stop):
                    return
                if isinstance(message, Target):
                    self._accept(message)
            if os.getppid() != self._settings.parent:  # a process forked by the driver may hold the channel open
                return
            self._command()
            self._channel.send(self._state())
            due = max(due + self._period, time.monotonic() - self._period)
            time.sleep(max(0.0, due - time.monotonic()))

    def _check(self) -> None:
        receive, ip = self._receive, self._settings.ip
        if not receive.isConnected() or not self._control.isConnected():
            raise ArmStoppedError(f"The connection to {ip} is lost (robot switched off, cable, network).")
        self._hear()
        if self._age > STALE_AFTER:
            time.sleep(NEXT_DATA)  # a process that was suspended has not read yet
            self._hear()
        if self._age > STALE_AFTER:
            raise ArmStoppedError(f"No data from {ip} for {self._age:.1f} s: the arm's state is unknown.")
        if receive.isEmergencyStopped():
            raise ArmStoppedError("Emergency stop: release the button, power on on the pendant, start again.")
        if receive.isProtectiveStopped():
            raise ArmStoppedError(
                "Protective stop: the arm met something or was to leave its limits. Find the cause, unlock it on the "
                "pendant (after 5 s), start again."
            )
        if receive.getSafetyMode() == SAFEGUARD_STOP:
            raise ArmStoppedError("Safeguard stop: leave the guarded area, reset it, start again.")
        if receive.getRuntimeState() in PAUSED:
            raise ArmStoppedError("The program on the controller was paused on the pendant.")
        if not self._control.isProgramRunning():
            raise ArmStoppedError(
                "The program on the controller was stopped: on the pendant, by another client, or by its watchdog, "
                "which had not heard from this computer for a second."
            )

    def _hear(self) -> None:
        if (timestamp := self._receive.getTimestamp()) != self._timestamp:
            self._timestamp, self._changed_at = timestamp, time.monotonic()

    def _check_again(self) -> None:
        """A command was refused: what has just happened comes with the next data."""
        time.sleep(NEXT_DATA)
        self._check()

    @property
    def _age(self) -> float:
        return time.monotonic() - self._changed_at

    def _accept(self, target: Target) -> None:
        q = np.array(target.q, dtype=np.float64)
        if q.shape != (6,) or not np.isfinite(q).all() or not (target.duration > 0 and target.velocity > 0):
            raise ArmStoppedError(f"A target has six finite angles, positive duration and velocity, got {target}.")
        if not self._is_servoing:
            if not target.begins:
                return
            self._interpolator.reset(np.array(self._receive.getActualQ()))
            self._is_servoing = True
        self._interpolator.set_target(q, target.duration, target.velocity)
        self._idle_since = time.monotonic() + target.duration

    def _command(self) -> None:
        idle = time.monotonic() - self._idle_since
        if self._is_servoing and self._interpolator.has_arrived and idle > self._settings.stop_after:
            self.brake()
            self._channel.send(Note(f"No action for {idle:.1f} s: the arm has stopped, the next action eases in."))
        if not self._is_servoing:
            self._last_turn = time.monotonic()
            self._control.kickWatchdog()
            return
        settings = self._settings
        q = self._next_setpoint()
        if q is None:
            return
        if not self._control.servoJ(q.tolist(), 0.0, 0.0, self._period, settings.lookahead, settings.gain):
            self._check_again()
            raise ArmStoppedError("The controller did not take a target: its program is not running.")

    def _next_setpoint(self) -> Array | None:
        """The next one (6,), within the limits also of where the controller is; None for none.

        What is commanded while the network is silent comes late or never, and nothing is commanded while this process
        is suspended. Going on from the last setpoint would be a jump. So nothing is commanded until data have come for
        a while: the first may have waited somewhere, or be read half. Then it goes on from where the controller stands.
        """
        settings = self._settings
        patience, now = max(FREEZE_AFTER, PACKETS * self._period), time.monotonic()
        if self._age > patience or now - self._last_turn > patience:
            self._holds_until = now + patience
        self._last_turn = now
        if self._holds_until is not None:
            if now < self._holds_until:
                return None
            self._holds_until = None
            q, qd = np.array(self._receive.getTargetQ()), np.array(self._receive.getTargetQd())
            self._interpolator.go_on_from(q, qd, settings.lookahead)
        q = self._interpolator.step(self._period)
        actual_q, actual_qd = np.array(self._receive.getActualQ()), np.array(self._receive.getActualQd())
        if not is_followed(q, self._interpolator.qd, actual_q, actual_qd, settings.lookahead + patience):
            raise ArmStoppedError(
                f"The arm does not follow, it is {np.abs(q - actual_q).max():.2f} rad behind: the speed slider below "
                "100 %, reduced mode, or something holds it."
            )
        return q

    def _state(self) -> State:
        receive = self._receive
        return State(
            made_at=time.monotonic(),
            timestamp=self._timestamp,
            q=receive.getActualQ(),
            qd=receive.getActualQd(),
            tcp=receive.getActualTCPPose(),
            setpoint=tuple(self._interpolator.q.tolist()),
            is_servoing=self._is_servoing,
            has_arrived=self._interpolator.has_arrived,
        )

    def brake(self) -> None:
        """Stand still, and stay so."""
        self._is_servoing = False
        if not self._control.servoStop(BRAKING):
            self._check_again()
            raise ArmStoppedError("The controller did not take the command to brake; its program was ended.")

    def end(self) -> None:
        """Brake and end the program, if the arm can still be reached; otherwise its own watchdog does."""
        receive, control = self._receive, self._control
        if not (receive.isConnected() and control.isConnected() and self._age < STALE_AFTER):
            return
        if receive.getRuntimeState() in PAUSED:
            stop_program(self._settings.ip)  # it obeys nobody else, and resumed would move to its last target
        elif control.isProgramRunning():
            try:
                self.brake()
            finally:
                control.stopScript()
                self._end_paused()

    def _end_paused(self) -> None:
        """A stop may be reported before the program is paused by it, which then does not obey the lines above."""
        until = time.monotonic() + PAUSES_WITHIN
        while time.monotonic() < until and self._receive.getRuntimeState() != STOPPED:
            if self._receive.getRuntimeState() in PAUSED:
                stop_program(self._settings.ip)
                return
            time.sleep(NEXT_DATA)


@contextlib.contextmanager
def killed_with(parent: int) -> Iterator[None]:
    """Let this process be killed when the one that started it ends, where the system can do that (Linux)."""
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl is None:
        yield
        return
    prctl(SET_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(0)
    yield
    prctl(SET_DEATH_SIGNAL, 0)


def main() -> None:
    """Runs until the driver stops it."""
    prefer_this_thread()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the driver, which then stops the arm in order
    channel = Channel(int(sys.argv[1]))
    loop = None
    failure: Failure | None = None
    try:
        settings = channel.receive_settings()
        # ur_rtde waits for ever for the first data, and would then start its program for nobody.
        with killed_with(settings.parent):
            loop = ServoLoop(settings, channel)
        loop.run()
    except ArmStoppedError as error:
        failure = Failure(str(error))
    except Exception as error:  # noqa: BLE001  (ur_rtde's own errors are RuntimeErrors of any text)
        failure = Failure(f"{type(error).__name__}: {error}")
    finally:
        if failure is not None:
            channel.send(failure)
        if loop is not None:
            signal.alarm(ENDS_WITHIN)  # kills this process: ur_rtde would wait for an answer for five minutes
            with contextlib.suppress(Exception):
                loop.end()
        channel.finish()
        os._exit(0)  # ur_rtde's threads and destructors may hang or crash


if __name__ == "__main__":
    main()
