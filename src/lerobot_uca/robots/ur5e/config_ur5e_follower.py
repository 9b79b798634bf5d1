"""Configuration of `--robot.type=ur5e_follower`."""

import math
import re
from dataclasses import dataclass, field

from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig

from lerobot_uca.errors import UserError
from lerobot_uca.registry import register
from lerobot_uca.robots.ur5e.kinematics import JOINTS
from lerobot_uca.robots.ur5e.limits import JointLimits

ACTIONS = ("joints", "tcp")
GRIPPERS = ("robotiq", "none")
N_JOINTS = len(JOINTS)


@register(RobotConfig, "ur5e_follower")
@dataclass(kw_only=True)
class UR5eFollowerConfig(RobotConfig):
    """A UR5e (e-Series, PolyScope 5) with a Robotiq gripper and cameras.

    Attributes:
        ip: the controller's address.
        action: what actions and states are. `joints`: six angles [rad]; `tcp`: the tool centre point's pose in the
            controller's base frame, position [m] and rotation vector [rad]. The gripper's position comes with both.
        tool_rotation: a rotation vector [rad] that the tool's first one of a connection is written close to, with
            action=tcp. Of a tool that points down there are two as long, and the controller's jumps from one to the
            other. Choose one near the middle of the task's: a tool that points down and turns by less than half a turn
            from (pi, 0, 0) has no jump.
        gripper: `robotiq` (its URCap's socket) or `none`.
        cameras: LeRobot's; one with `use_depth` gives `<name>_depth` too.
        control_rate: at which actions come [Hz]: the command's --dataset.fps or --fps.
        servo_rate: of the servo loop [Hz], which interpolates between actions.
        servo_lookahead: of `servoj` [s]: more is smoother and slower.
        servo_gain: of `servoj`: more is stiffer.
        max_velocity: of each joint [rad/s].
        max_acceleration: of each joint [rad/s^2].
        max_step: of each joint from one action to the next [rad].
        lower, upper: the joint range [rad]. Narrow it to keep the arm off the table, walls and itself.
        ease_velocity: at which the arm goes to the first action's pose, and to the first after a pause [rad/s].
        stop_after: how long the arm holds its last target without a new action before it stops [s].
    """

    ip: str
    action: str = "joints"
    tool_rotation: tuple[float, ...] = (math.pi, 0.0, 0.0)
    gripper: str = "robotiq"
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    control_rate: float = 30.0
    servo_rate: float = 125.0
    servo_lookahead: float = 0.1
    servo_gain: float = 300.0
    max_velocity: float = 1.0
    max_acceleration: float = 5.0
    max_step: float = 0.2
    lower: tuple[float, ...] = (-2 * math.pi, -2 * math.pi, -math.pi, -2 * math.pi, -2 * math.pi, -2 * math.pi)
    upper: tuple[float, ...] = (2 * math.pi, 2 * math.pi, math.pi, 2 * math.pi, 2 * math.pi, 2 * math.pi)
    ease_velocity: float = 0.25
    stop_after: float = 2.0

    @property
    def limits(self) -> JointLimits:
        """The limits that hold for every caller."""
        return JointLimits(
            lower=tuple(self.lower),
            upper=tuple(self.upper),
            velocity=self.max_velocity,
            acceleration=self.max_acceleration,
            step=self.max_step,
        )

    def check(self) -> None:
        """Raise a `UserError` for a value that cannot be. The robot calls it, since draccus would hide the message."""
        if not re.fullmatch(r"[\w.-]+", self.ip):
            raise UserError(
                f"robot.ip is an address without a port, such as 192.168.1.10 (the ports are fixed), got '{self.ip}'."
            )
        for name, valid in (("action", ACTIONS), ("gripper", GRIPPERS)):
            if (value := getattr(self, name)) not in valid:
                raise UserError(f"robot.{name} is one of {', '.join(valid)}, got '{value}'.")
        for name, (least, most) in RANGES.items():
            if not least <= (number := getattr(self, name)) <= most:
                raise UserError(f"robot.{name} lies in {least:g} to {most:g}, got {number:g}.")
        for name in ("lower", "upper"):
            angles = getattr(self, name)
            if len(angles) != N_JOINTS or not all(abs(angle) <= 2 * math.pi + 1e-6 for angle in angles):
                raise UserError(f"robot.{name} holds six angles [rad] within 2 pi of zero, got {list(angles)}.")
        if len(self.tool_rotation) != 3 or not 0 < math.dist(self.tool_rotation, (0, 0, 0)) <= 2 * math.pi + 1e-6:
            raise UserError(
                f"robot.tool_rotation holds a rotation vector [rad], of up to 2 pi, got {list(self.tool_rotation)}."
            )
        if any(lower >= upper for lower, upper in zip(self.lower, self.upper, strict=True)):
            raise UserError(f"robot.lower lies below robot.upper, got {list(self.lower)} and {list(self.upper)}.")


RANGES = {
    "control_rate": (1, 500),
    "servo_rate": (20, 500),
    "servo_lookahead": (0.03, 0.2),  # what URScript takes
    "servo_gain": (100, 2000),
    "max_velocity": (0.01, math.pi),  # what a UR5e can do
    "max_acceleration": (0.1, 40),
    "max_step": (0.001, 1),
    "ease_velocity": (0.01, 1),
    "stop_after": (0.5, 60),
}
