"""The UR5e as a LeRobot robot."""

import logging
import math
import os
import time
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.cameras import make_cameras_from_configs
from lerobot.lerobot_types import RobotAction, RobotObservation
from lerobot.robots import Robot
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from lerobot_uca.errors import UserError
from lerobot_uca.robots.camera_check import check_cameras
from lerobot_uca.robots.realsense import connect
from lerobot_uca.robots.ur5e.channel import ArmStoppedError, Settings, State, Target
from lerobot_uca.robots.ur5e.clipping_report import ClippingReport
from lerobot_uca.robots.ur5e.config_ur5e_follower import UR5eFollowerConfig
from lerobot_uca.robots.ur5e.dashboard import check_controller
from lerobot_uca.robots.ur5e.gripper import RobotiqGripper
from lerobot_uca.robots.ur5e.kinematics import (
    JOINTS,
    Array,
    flange_pose,
    inverse_kinematics,
    pose_from_vector,
    pose_to_vector,
    turned_inside,
)
from lerobot_uca.robots.ur5e.limits import clip_target
from lerobot_uca.robots.ur5e.rtde_process import RtdeProcess

# LeRobot's rollout hands a policy what ends in `.pos`, and nothing else.
JOINT_KEYS = tuple(f"{joint}.pos" for joint in JOINTS)
TCP_KEYS = tuple(f"tcp_{axis}.pos" for axis in ("x", "y", "z", "rx", "ry", "rz"))
GRIPPER_KEY = "gripper.pos"
PICTURES_WITHIN = 0.3  # [s], after a suspension
ARM_TELLS_WITHIN = 0.2
"""[s] An emergency stop takes the gripper's power, too; where that is noticed first, the arm's reason follows."""

STOP_COMES_WITHIN = 3.0
"""[s] The longest step of a control_rate, and a busy computer's pause."""
STOP_COMES_EARLY = 0.05  # [s], for the way that messages take

MEANT_IN_RADIANS = 2 * math.pi + 1.0
MEANT_IN_METRES = 2.0  # the arm reaches 0.85 m
GRIPPER_RANGE = (-1.5, 2.5)
"""A policy that has learned anything stays about 0 to 1 (0.5 to 1.6 after 50 steps, `ur5e_small`). Noise leaves it, and
percents do."""

STANDS = 1e-2  # [rad/s], and no more
ARRIVED = 3e-3  # [rad], between the first target and where the arm is measured
SETTLING = 0.4  # [s], after which an arm whose setpoint is at the first target is as near as it gets

logger = logging.getLogger(__name__)


class UR5eFollower(Robot):
    """Six joints, a gripper, cameras. The arm is driven by a process of its own, see `rtde_client`."""

    config_class = UR5eFollowerConfig
    name = "ur5e_follower"

    def __init__(self, config: UR5eFollowerConfig) -> None:
        config.check()
        super().__init__(config)
        self.config = config
        self.cameras: dict[str, Any] = make_cameras_from_configs(config.cameras)
        self._arm: RtdeProcess | None = None
        self._gripper: RobotiqGripper | None = None
        self._previous: Array = np.zeros(6)  # the last target [rad]
        self._sent_at = 0.0
        self._tcp_near: Array = np.zeros(6)
        self._clipping = ClippingReport()

    @cached_property
    def _keys(self) -> tuple[str, ...]:
        """The keys of states and actions alike."""
        keys = JOINT_KEYS if self.config.action == "joints" else TCP_KEYS
        return keys if self.config.gripper == "none" else (*keys, GRIPPER_KEY)

    @cached_property
    def observation_features(self) -> dict[str, type | tuple[int, ...]]:
        """Position keys and pictures, also while disconnected."""
        features: dict[str, type | tuple[int, ...]] = dict.fromkeys(self._keys, float)
        for name, camera in self.cameras.items():
            if getattr(camera, "use_rgb", True):
                features[name] = (camera.height, camera.width, 3)
            if getattr(camera, "use_depth", False):
                features[f"{name}_depth"] = (camera.height, camera.width, 1)
        return features

    @cached_property
    def action_features(self) -> dict[str, type]:
        """Position keys, also while disconnected."""
        return dict.fromkeys(self._keys, float)

    @property
    def is_connected(self) -> bool:
        """Whether `connect` has succeeded, until `disconnect`; an arm that has stopped says so when it is used."""
        return self._arm is not None

    @property
    def is_calibrated(self) -> bool:
        """The arm's encoders are absolute."""
        return True

    def calibrate(self) -> None:
        """The arm's encoders are absolute."""

    def configure(self) -> None:
        """Everything is given when the arm is connected."""

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Check the controller, start the arm's process, the gripper and the cameras. Nothing moves but the gripper."""
        del calibrate
        config = self.config
        check_controller(config.ip)
        settings = Settings(
            ip=config.ip,
            parent=os.getpid(),
            limits=config.limits,
            servo_rate=config.servo_rate,
            lookahead=config.servo_lookahead,
            gain=config.servo_gain,
            stop_after=config.stop_after,
        )
        self._arm = RtdeProcess(settings)
        try:
            self._tcp_near = np.array([0.0, 0.0, 0.0, *config.tool_rotation])
            if config.gripper == "robotiq":
                self._gripper = RobotiqGripper(config.ip)
            for name, camera in self.cameras.items():
                connect(name, camera)
            check_cameras(self.cameras)
        except BaseException:
            self.disconnect()
            raise
        logger.info("%s connected to %s.", self, config.ip)

    @check_if_not_connected
    def get_observation(self) -> RobotObservation:
        """Measured positions and the cameras' newest frames. Raises `ArmStoppedError`; the arm then stands still."""
        assert self._arm is not None
        state = self._arm.state()
        if self.config.action == "joints":
            values = np.array(state.q)
        else:
            values = self._tcp_near = pose_to_vector(pose_from_vector(state.tcp), near=self._tcp_near)
        observation: RobotObservation = dict(zip(self._keys, values.tolist(), strict=False))
        if self._gripper is not None:
            observation[GRIPPER_KEY] = self._gripper_position(self._gripper)
        for name, camera in self.cameras.items():
            try:
                if getattr(camera, "use_rgb", True):
                    observation[name] = _newest(camera.read_latest)
                if getattr(camera, "use_depth", False):
                    observation[f"{name}_depth"] = _newest(camera.read_latest_depth)
            except (TimeoutError, RuntimeError, ConnectionError) as error:
                raise self._stopped(f"Camera '{name}' gives no pictures ({error}); the arm was stopped.") from error
        return observation

    @check_if_not_connected
    def send_action(self, action: RobotAction) -> RobotAction:
        """Command the arm, and return what was really commanded.

        The first action, and the first one after a pause, is approached slowly, and the call returns when the arm is
        there; then the gripper follows. After that targets are clipped: to the joint range, in step and velocity.

        Raises:
            ArmStoppedError: the arm stands still, also because this action was refused: of a caller that sends such
                things, the next one may not be meant either (LeRobot's rollout would drive the arm to its start).
        """
        assert self._arm is not None
        state = self._arm.state()
        self._check_gripper()
        try:
            values = self._checked(action)
        except UserError as error:
            raise self._stopped(f"{error} The arm was stopped.") from None
        if state.is_servoing and state.has_arrived and self._is_stop_due:
            # A target for a moving arm would be left out, if the arm stops before it comes.
            state = self._arm.wait_for(lambda state: not state.is_servoing, STOP_COMES_WITHIN, "The arm's stop")
        if not state.is_servoing:
            self._previous = np.array(state.q)
        wanted = self._joint_target(values[:6], state)
        if state.is_servoing:
            elapsed = min(time.monotonic() - self._sent_at, self.config.stop_after)
            target = clip_target(wanted, self._previous, self.config.limits, max(elapsed, 1 / self.config.control_rate))
            self._clipping.note(wanted - target)
            self._send(target, begins=False)
        else:
            target = np.clip(wanted, self.config.lower, self.config.upper)
            self._clipping.note(wanted - target)
            self._ease(target)
        self._previous = target
        if self._gripper is not None:
            self._clipping.note_gripper(values[6])
        commanded_gripper = [] if self._gripper is None else [self._gripper.request(values[6])]
        commanded = target if self.config.action == "joints" else self._tcp_at(target, state)
        return dict(zip(self._keys, [*commanded.tolist(), *commanded_gripper], strict=True))

    def _send(self, target: Array, *, begins: bool, velocity: float = math.inf) -> None:
        assert self._arm is not None
        self._sent_at = time.monotonic()
        self._arm.send(Target(tuple(target.tolist()), 1 / self.config.control_rate, velocity, begins))

    @property
    def _is_stop_due(self) -> bool:
        """Whether the arm may have stopped since its last state, for want of actions."""
        due = self.config.stop_after + 1 / self.config.control_rate  # it holds a target for its duration first
        return time.monotonic() - self._sent_at >= due - STOP_COMES_EARLY

    def _check_gripper(self) -> None:
        """Stop the arm where its gripper has failed."""
        if self._gripper is not None:
            self._gripper_position(self._gripper)

    def _gripper_position(self, gripper: RobotiqGripper) -> float:
        assert self._arm is not None
        try:
            return gripper.position
        except ArmStoppedError as error:
            reason = self._arm.failure_within(ARM_TELLS_WITHIN) or f"{error} The arm was stopped."
            raise self._stopped(reason) from None

    def _stopped(self, reason: str) -> ArmStoppedError:
        """Stop the arm, and the error that says why; whatever is asked afterwards raises it, too."""
        assert self._arm is not None
        self._arm.stop(reason)
        return ArmStoppedError(reason)

    def _checked(self, action: RobotAction) -> Array:
        """The action's values in the order of the keys."""
        if set(action) != set(self._keys):
            missing, unknown = sorted(set(self._keys) - set(action)), sorted(set(action) - set(self._keys))
            raise UserError(
                f"An action of {self.name} has the names {', '.join(self._keys)}; missing: "
                f"{', '.join(missing) or '-'}; unknown: {', '.join(unknown) or '-'}. "
                "Is the dataset or the policy another robot's?"
            )
        try:  # replay hands over tensors without dimensions
            values = np.array([float(action[key]) for key in self._keys])
        except (TypeError, ValueError) as error:
            raise UserError(f"An action's values are numbers, one for each name ({error}).") from None
        if not np.isfinite(values).all():
            bad = ", ".join(key for key, value in zip(self._keys, values, strict=True) if not math.isfinite(value))
            raise UserError(f"An action's values are finite numbers, got others for {bad}.")
        self._check_units(values)
        return values

    def _check_units(self, values: Array) -> None:
        if self.config.action == "joints":
            if (largest := np.abs(values[:6]).max()) > MEANT_IN_RADIANS:
                raise UserError(
                    f"Joint actions are angles in radians, within 2 pi of zero, got {largest:.1f}. Degrees?"
                )
        else:
            if (angle := np.linalg.norm(values[3:6])) > MEANT_IN_RADIANS:
                raise UserError(f"A rotation vector is in radians, no longer than 2 pi, got {angle:.1f}. Degrees?")
            if (distance := np.linalg.norm(values[:3])) > MEANT_IN_METRES:
                raise UserError(
                    f"A position is in metres, within {MEANT_IN_METRES:g} of the base, got {distance:.1f}. Millimetres?"
                )
        if len(values) > 6 and not GRIPPER_RANGE[0] <= values[6] <= GRIPPER_RANGE[1]:
            raise UserError(f"The gripper's position lies in 0 (open) to 1 (closed), got {values[6]:g}. Another scale?")

    def _joint_target(self, values: Array, state: State) -> Array:
        """The joint angles (6,) that an action means."""
        if self.config.action == "joints":
            return values
        flange = pose_from_vector(values) @ np.linalg.inv(_tool(state))
        q = inverse_kinematics(flange, self._previous)
        if q is None:
            self._clipping.note_unreachable(values)
            return self._previous
        # Slowly it may turn the other way round. In a stream it would not be where the action says meanwhile.
        return q if state.is_servoing else turned_inside(q, self.config.lower, self.config.upper)

    def _tcp_at(self, q: Array, state: State) -> Array:
        return pose_to_vector(flange_pose(q) @ _tool(state), near=self._tcp_near)

    def _ease(self, target: Array) -> None:
        """Go to a target slowly and wait for it.

        Step by step, as if a policy went there: should this process be suspended or killed, so ends the way.
        """
        assert self._arm is not None
        config, start = self.config, self._previous
        speed, period = min(config.ease_velocity, config.max_velocity), 1 / config.control_rate
        distance = np.abs(target - start).max()
        n_steps = max(1, math.ceil(distance / speed / period))
        if distance > config.max_step:
            joint = JOINTS[int(np.abs(target - start).argmax())]
            seconds = n_steps * period
            logger.warning("The first target is %.2f rad away (%s): easing there in %.0f s.", distance, joint, seconds)
        for step in range(1, n_steps + 1):
            self._arm.state()  # raises where the arm has stopped
            self._check_gripper()
            self._send(start + step / n_steps * (target - start), begins=True, velocity=speed)
            time.sleep(period)

        settled_at = math.inf

        def is_there(state: State) -> bool:
            nonlocal settled_at
            if state.is_servoing and state.has_arrived:
                settled_at = min(settled_at, time.monotonic() + SETTLING)
            stands = state.is_servoing and np.abs(state.qd).max() < STANDS and _distance(state, target).max() < ARRIVED
            return stands or time.monotonic() > settled_at

        try:
            timeout = 5 + speed / config.max_acceleration
            away = _distance(self._arm.wait_for(is_there, timeout, "The pose of the first action"), target)
        except ArmStoppedError as error:
            raise self._stopped(str(error)) from None
        if away.max() > ARRIVED:
            joint = JOINTS[int(away.argmax())]
            logger.warning("The arm is held %.3f rad away from the first target (%s).", away.max(), joint)

    def disconnect(self) -> None:
        """The arm brakes and stands still, the fingers too; its program ends."""
        self._clipping.say()
        try:
            if self._arm is not None:
                self._arm.stop("The arm was disconnected.")
        finally:  # also where a second Ctrl-C comes meanwhile
            self._arm = None
            if self._gripper is not None:
                self._gripper.close()
                self._gripper = None
            for camera in self.cameras.values():
                if camera.is_connected:
                    camera.disconnect()


def _newest(read: Callable[[], Any]) -> Any:
    """A camera's newest frame. After a suspension (Ctrl-Z) it is old, and the next one takes a moment."""
    until = time.monotonic() + PICTURES_WITHIN
    while True:
        try:
            return read()
        except TimeoutError:
            if time.monotonic() > until:
                raise
            time.sleep(0.01)


def _distance(state: State, target: Array) -> Array:
    """How far each joint is from a target, (6,) [rad]."""
    distance: Array = np.abs(np.array(state.q) - target)
    return distance


def _tool(state: State) -> Array:
    """T_flange_tcp, (4, 4), as it is where the arm stands.

    So measured, it holds the tool's pose and this arm's own deviation from the nominal kinematics, exact where the arm
    is going as it gets there.
    """
    return np.linalg.inv(flange_pose(state.q)) @ pose_from_vector(state.tcp)
