"""The simulated controller's state: registers, the uploaded program's cycle, safety, the arm.

The program is never interpreted: whatever text is uploaded, what runs is the cycle that ur_rtde's script has. A client
writes a command into input register 0, the program reports in output register 0.
"""

import logging
import math
import threading
import time
from collections.abc import Callable
from enum import IntEnum
from typing import Protocol

import numpy as np

from lerobot_uca.robots.ur5e.kinematics import flange_pose, jacobian, pose_to_vector
from lerobot_uca.robots.ur5e.sim.motion import JOINT_RANGE, MAX_VELOCITY, Array, Motion, Move, Servo, Speed
from lerobot_uca.robots.ur5e.sim.protocol import Value

CYCLE = 0.002  # [s]
HOME = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0)  # [rad], where simulated arms begin: the tool points down
UNLOCK_DELAY = 5.0  # [s] after a protective stop

logger = logging.getLogger(__name__)


class Runtime(IntEnum):
    """`runtime_state`: of the program."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class Safety(IntEnum):
    """`safety_mode`."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    SAFEGUARD_STOP = 5
    ROBOT_EMERGENCY_STOP = 7


SAFETY_BITS = {
    Safety.NORMAL: 1 << 0,
    Safety.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    Safety.SAFEGUARD_STOP: 1 << 4 | 1 << 10,
    Safety.ROBOT_EMERGENCY_STOP: 0b11 << 6,
}


class Command(IntEnum):
    """Those of ur_rtde's commands that this controller carries out."""

    NONE = 0
    MOVE_J = 1
    SPEED_J = 9
    SERVO_J = 11
    SPEED_STOP = 15
    SERVO_STOP = 16
    PROTECTIVE_STOP = 31
    STOP_J = 34
    SET_WATCHDOG = 35
    STOP_SCRIPT = 255


# Applied in every cycle and not acknowledged.
REALTIME_COMMANDS = {6, Command.SPEED_J, 10, Command.SERVO_J, 24, 25, 26, 27, 38, 58, *range(66, 72)}
READY, DONE = 1, 2  # output register 0


class Arm(Protocol):
    """The arm that the controller moves."""

    @property
    def q(self) -> Array:
        """(6,) [rad]."""
        ...

    @property
    def qd(self) -> Array:
        """(6,) [rad/s]."""
        ...

    def follow(self, target_q: Array, dt: float) -> None:
        """Move for one cycle towards where the controller wants the joints."""
        ...


class IdealArm:
    """Joints that are where they should be."""

    def __init__(self, q: tuple[float, ...] = HOME) -> None:
        self.q: Array = np.array(q)
        self.qd: Array = np.zeros(6)

    def follow(self, target_q: Array, dt: float) -> None:
        """Be there."""
        self.qd = (target_q - self.q) / dt
        self.q = target_q.copy()


class Robot:
    """All state that the servers share. Whoever reads or writes it holds the lock.

    Args:
        arm: what moves.
        tool_length: from the flange to the tool centre point [m], as if set on the pendant.
        clock: gives seconds.
    """

    def __init__(self, arm: Arm, tool_length: float = 0.0, clock: Callable[[], float] = time.monotonic) -> None:
        self.lock = threading.RLock()
        self._tool_length = tool_length
        self.arm, self.clock = arm, clock
        self.speed_slider = 1.0  # as it is shown; the arm's motion does not depend on it
        self.inputs: dict[str, Value] = {}
        self.outputs: dict[str, Value] = {"output_double_register_0": CYCLE}  # what getStepTime reads
        self.runtime, self.safety = Runtime.STOPPED, Safety.NORMAL
        self.target_q: Array = arm.q.copy()
        self.target_qd: Array = np.zeros(6)
        self.stop_reason = ""
        self.n_cycles = 0
        self._motion: Motion = Speed(np.zeros(6), 1.0)
        self._executing: Motion | None = None
        self._acknowledged = False
        self._stopped_at = -math.inf
        self._watchdog: float | None = None  # [s]
        self._last_packet = clock()
        self._operation = 0

    # The program.

    def start_program(self) -> None:
        """Start a program whose script has arrived whole. A stopped arm starts none."""
        if self.safety == Safety.NORMAL:
            self.runtime = Runtime.PLAYING
            self._executing, self._acknowledged, self._watchdog = None, False, None
            self._motion = Speed(np.zeros(6), 4.0)
            self.outputs["output_int_register_0"] = READY
            self._write_progress(running=False)

    def stop_program(self) -> None:
        """The arm brakes."""
        self.runtime = Runtime.STOPPED
        self._motion, self._executing = Speed(np.zeros(6), 10.0), None
        self._write_progress(running=False)

    def receive(self, values: dict[str, Value]) -> None:
        """A client's packet."""
        self.inputs.update(values)
        self._last_packet = self.clock()

    def cycle(self) -> None:
        """Two milliseconds of the controller."""
        self.n_cycles += 1
        if self.runtime == Runtime.PLAYING:
            self._run_program()
        if self.safety == Safety.NORMAL:
            q, qd = self._motion.step(self.target_q, self.target_qd, CYCLE)
            if reason := _violation(q, qd):
                self.protective_stop(reason)
            else:
                self.target_q, self.target_qd = q, qd
        self.arm.follow(self.target_q, CYCLE)

    def _run_program(self) -> None:
        if self._watchdog is not None and self.clock() - self._last_packet > self._watchdog:
            logger.warning("Watchdog: no packet for %.0f ms, the program stops.", self._watchdog * 1000)
            self.stop_program()
            return
        if self._executing is not None:
            if not self._executing.is_done:
                return  # a blocking command reads no register meanwhile
            self._executing, self._acknowledged = None, True
            self.outputs["output_int_register_0"] = DONE
        command = self._int(0)
        if command == Command.NONE:
            self._acknowledged = False
            self.outputs["output_int_register_0"] = READY
        elif command == Command.STOP_SCRIPT:
            self.stop_program()
        elif command in REALTIME_COMMANDS:
            self._apply(command)
            self.outputs["output_int_register_0"] = READY
        elif not self._acknowledged:
            self._execute(command)
        if isinstance(self._motion, Move) and self._motion.is_done:
            self._write_progress(running=False)

    def _apply(self, command: int) -> None:
        if command == Command.SERVO_J:
            self._motion = Servo(self._doubles(0, 6), lookahead=self._double(9), gain=self._double(10))
        elif command == Command.SPEED_J:
            self._motion = Speed(self._doubles(0, 6), self._double(6))

    def _execute(self, command: int) -> None:
        blocking: Motion | None = None
        if command == Command.MOVE_J:
            move = Move(self._doubles(0, 6), speed=self._double(6), acceleration=self._double(7))
            self._motion = move
            self._write_progress(running=True)
            blocking = None if self._int(1) else move
        elif command in {Command.SERVO_STOP, Command.SPEED_STOP, Command.STOP_J}:
            blocking = self._motion = Speed(np.zeros(6), self._double(0))
        elif command == Command.SET_WATCHDOG:
            self._watchdog = 1 / max(self._double(0), 1e-3)
        elif command == Command.PROTECTIVE_STOP:
            self.protective_stop("the program asked for it")
        else:
            logger.debug("Command %d is acknowledged and does nothing here.", command)
        if blocking is None:
            self._acknowledged = True
            self.outputs["output_int_register_0"] = DONE
        else:
            self._executing = blocking

    def _write_progress(self, *, running: bool) -> None:
        """Write an asynchronous move's progress, for `getAsyncOperationProgress`."""
        if running:
            self._operation = (self._operation + 1) % 128
        count = (int(self.outputs.get("output_int_register_2", 0)) >> 16) + 1 & 127  # type: ignore[arg-type]
        self.outputs["output_int_register_2"] = self._operation << 24 | count << 16 | (32768 if running else 0)

    # Safety.

    def protective_stop(self, reason: str) -> None:
        """The joints stand still at once, the program is gone."""
        self._stop(Safety.PROTECTIVE_STOP, reason)

    def emergency_stop(self) -> None:
        """Stop as if somebody had pressed the button."""
        self._stop(Safety.ROBOT_EMERGENCY_STOP, "emergency stop")

    def safeguard_stop(self) -> None:
        """Stop as if somebody had stepped into the guarded area: the program is paused, not gone."""
        was_playing = self.runtime == Runtime.PLAYING
        self._stop(Safety.SAFEGUARD_STOP, "somebody is in the guarded area")
        if was_playing:
            self.runtime = Runtime.PAUSED

    def leave_guarded_area(self) -> None:
        """A paused program goes on, to its last target."""
        self.safety = Safety.NORMAL
        if self.runtime == Runtime.PAUSED:
            self.runtime = Runtime.PLAYING

    def _stop(self, safety: Safety, reason: str) -> None:
        logger.warning("%s: %s.", safety.name, reason)
        self.stop_program()
        self.safety, self.stop_reason, self._stopped_at = safety, reason, self.clock()
        self.target_q, self.target_qd = self.arm.q.copy(), np.zeros(6)

    def unlock(self) -> bool:
        """Whether a protective stop could be unlocked."""
        if self.safety == Safety.PROTECTIVE_STOP and self.clock() - self._stopped_at < UNLOCK_DELAY:
            return False
        if self.safety == Safety.PROTECTIVE_STOP:
            self.safety = Safety.NORMAL
        return True

    def arm_was_moved(self) -> None:
        """Somebody has put a simulated arm elsewhere: it stays there."""
        self.target_q, self.target_qd = self.arm.q.copy(), np.zeros(6)
        self._motion = Speed(np.zeros(6), 4.0)

    # Registers.

    def _int(self, index: int) -> int:
        return int(self.inputs.get(f"input_int_register_{index}", 0))  # type: ignore[arg-type]

    def _double(self, index: int) -> float:
        return float(self.inputs.get(f"input_double_register_{index}", 0.0))  # type: ignore[arg-type]

    def _doubles(self, start: int, n: int) -> Array:
        return np.array([self._double(start + offset) for offset in range(n)])

    def variables(self) -> dict[str, Value]:
        """Values of RTDE's output variables. Those that are not here are zero."""
        is_normal, is_playing = self.safety == Safety.NORMAL, self.runtime == Runtime.PLAYING
        tool = flange_pose(self.arm.q)
        reach = tool[:3, 2] * self._tool_length  # along the flange's axis
        tool[:3, 3] += reach
        tcp = tuple(pose_to_vector(tool))
        speed = jacobian(self.arm.q) @ self.arm.qd
        tcp_speed = (*(speed[:3] + np.cross(speed[3:], reach)), *speed[3:])
        return {
            **self.outputs,
            "timestamp": self.n_cycles * CYCLE,
            "target_q": tuple(self.target_q),
            "target_qd": tuple(self.target_qd),
            "actual_q": tuple(self.arm.q),
            "actual_qd": tuple(self.arm.qd),
            "actual_TCP_pose": tcp,
            "actual_TCP_speed": tcp_speed,
            "target_TCP_pose": tcp,
            "target_TCP_speed": tcp_speed,
            "joint_temperatures": (30.0,) * 6,
            "robot_mode": 7,
            "joint_mode": (253,) * 6,
            "safety_mode": int(self.safety),
            "speed_scaling": 1.0 if is_normal else 0.0,
            "target_speed_fraction": self.speed_slider,
            "runtime_state": int(self.runtime),
            "robot_status_bits": 0b11 if is_playing else 0b1,
            "safety_status_bits": SAFETY_BITS[self.safety],
        }


def _violation(q: Array, qd: Array) -> str:
    """The reason why the safety system stops an arm that is to go there; empty if it does not."""
    if not (np.isfinite(q).all() and np.isfinite(qd).all()):
        return "a joint target is not a number"
    if np.abs(qd).max() > MAX_VELOCITY * 1.001:
        return f"joint {np.abs(qd).argmax()} is to move at {np.abs(qd).max():.2f} rad/s, above {MAX_VELOCITY:.2f}"
    if np.abs(q).max() > JOINT_RANGE:
        return f"joint {np.abs(q).argmax()} is to move to {q[np.abs(q).argmax()]:.2f} rad, outside its range"
    return ""
