"""The driver with the simulated controller: real sockets, the real client in its process."""

import contextlib
import logging
import math
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.robots import RobotConfig, make_robot_from_config
from lerobot.utils.errors import DeviceNotConnectedError
from tests.robots.conftest import free_address, wait_until

from lerobot_uca.errors import UserError
from lerobot_uca.robots.ur5e import rtde_client
from lerobot_uca.robots.ur5e.channel import ArmStoppedError, Note, State, decode
from lerobot_uca.robots.ur5e.clipping_report import ClippingReport
from lerobot_uca.robots.ur5e.config_ur5e_follower import UR5eFollowerConfig
from lerobot_uca.robots.ur5e.dashboard import Dashboard
from lerobot_uca.robots.ur5e.gripper import RobotiqGripper
from lerobot_uca.robots.ur5e.kinematics import flange_pose, pose_from_vector, pose_to_vector, rotation_matrix
from lerobot_uca.robots.ur5e.sim.controller import Controller
from lerobot_uca.robots.ur5e.sim.gripper import CLOSED_COUNT, OPEN_COUNT
from lerobot_uca.robots.ur5e.sim.robot import Command, IdealArm, Runtime
from lerobot_uca.robots.ur5e.ur5e_follower import GRIPPER_KEY, JOINT_KEYS, TCP_KEYS, UR5eFollower

pytest.importorskip("rtde_control", reason="the extra ur5e is not installed")

HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])


def make_robot(controller, tmp_path, **settings) -> UR5eFollower:
    config = UR5eFollowerConfig(ip=controller.address, calibration_dir=tmp_path, **settings)
    return make_robot_from_config(config)


@pytest.fixture
def robot(controller, tmp_path):
    robot = make_robot(controller, tmp_path)
    robot.connect()
    yield robot
    robot.disconnect()


def action_at(q, gripper=0.0) -> dict:
    return {**dict(zip(JOINT_KEYS, q, strict=True)), GRIPPER_KEY: gripper}


def stands_still(controller) -> bool:
    return np.abs(controller.robot.arm.qd).max() < 1e-6


def speed(controller) -> float:
    return np.abs(controller.robot.arm.qd).max()


def keep_setpoints(controller) -> list[list[float]]:
    """Every target that the controller's `servoj` is given from now on: free of this machine's own pauses."""
    setpoints = []
    receive = controller.robot.receive

    def keep(values):
        if values["input_int_register_0"] == Command.SERVO_J:
            setpoints.append([values[f"input_double_register_{joint}"] for joint in range(6)])
        receive(values)

    controller.robot.receive = keep
    return setpoints


def fastest(setpoints, robot) -> float:
    """The largest velocity of a joint's setpoints [rad/s]."""
    return np.abs(np.diff(setpoints, axis=0)).max() * robot.config.servo_rate


def stream(robot, velocity, seconds=2.0, rate=30.0):
    """Joint targets that move at a velocity; the last one."""
    q = np.array([robot.get_observation()[key] for key in JOINT_KEYS])
    gripper = {} if robot.config.gripper == "none" else {GRIPPER_KEY: 0.0}
    for _ in range(round(seconds * rate)):
        q = q + velocity / rate
        robot.send_action({**dict(zip(JOINT_KEYS, q, strict=True)), **gripper})
        time.sleep(1 / rate)
    return q


def keep_moving(robot):
    """Start a motion in the background; the error that ends it arrives in the list."""
    errors = []

    def run():
        try:
            stream(robot, 0.3, seconds=30)
        except (UserError, DeviceNotConnectedError) as error:
            errors.append(error)

    threading.Thread(target=run, daemon=True).start()
    return errors


def test_lerobot_makes_the_robot_and_knows_its_features_while_disconnected(tmp_path):
    config = RobotConfig.get_choice_class("ur5e_follower")(ip="127.0.0.1", calibration_dir=tmp_path)
    robot = make_robot_from_config(config)
    assert isinstance(robot, UR5eFollower)
    assert robot.observation_features == robot.action_features == dict.fromkeys((*JOINT_KEYS, GRIPPER_KEY), float)
    assert not robot.is_connected
    config = UR5eFollowerConfig(ip="127.0.0.1", action="tcp", gripper="none", calibration_dir=tmp_path)
    assert list(make_robot_from_config(config).action_features) == list(TCP_KEYS)


def test_actions_are_carried_out(controller, robot):
    observation = robot.get_observation()
    np.testing.assert_allclose([observation[key] for key in JOINT_KEYS], HOME, atol=1e-6)
    assert observation[GRIPPER_KEY] == 0
    target = HOME + 0.05
    commanded = robot.send_action(action_at(torch.tensor(target).unbind(), gripper=torch.tensor(0.5)))  # as replay does
    np.testing.assert_allclose([commanded[key] for key in JOINT_KEYS], target, atol=1e-6)
    assert commanded[GRIPPER_KEY] == pytest.approx(0.5, abs=1 / 227)
    wait_until(lambda: np.abs(controller.robot.arm.q - target).max() < 1e-3)
    wait_until(lambda: abs(robot.get_observation()[GRIPPER_KEY] - commanded[GRIPPER_KEY]) < 0.01)


def test_a_stream_is_followed_within_the_tracking_error_of_its_lags(controller, robot):
    """Interpolation, limits and servoj lag behind by known times; nothing else is lost."""
    velocity, config, errors = 0.3, robot.config, []
    for _ in range(25):
        last = stream(robot, velocity, seconds=0.067)
        errors.append(np.abs(last - controller.robot.arm.q).max())
    lag = 1 / 30 + velocity / (2 * config.max_acceleration) + config.servo_lookahead  # [s]
    assert np.median(errors) < velocity * (lag + 0.1)  # of a single one, this machine may have more
    wait_until(lambda: np.abs(last - controller.robot.arm.q).max() < 2e-3)


def test_the_first_action_is_eased_to_and_far_ones_are_clipped_and_said(controller, robot, caplog):
    setpoints = keep_setpoints(controller)
    target = HOME + np.array([0.6, 0, 0, 0, 0, 0])
    robot.send_action(action_at(target))
    assert fastest(setpoints, robot) < robot.config.ease_velocity * 1.05
    assert np.abs(controller.robot.arm.q - target).max() < 4e-3
    assert "0.60 rad away (shoulder_pan): easing there" in caplog.text
    commanded = robot.send_action(action_at(target + 1.0))
    step = np.array([commanded[key] for key in JOINT_KEYS]) - target
    assert 0 < step.max() <= robot.config.max_step
    assert "1 targets were clipped, by up to" in caplog.text


def test_the_way_to_the_first_action_is_as_slow_as_the_arm_may_be(controller, tmp_path):
    with make_robot(controller, tmp_path, max_velocity=0.05, gripper="none") as robot:
        setpoints = keep_setpoints(controller)
        target = HOME + np.array([0.1, -0.05, 0, 0, 0, 0])
        robot.send_action(dict(zip(JOINT_KEYS, target, strict=True)))
        assert np.abs(controller.robot.arm.q - target).max() < 4e-3
    assert fastest(setpoints, robot) < 0.05 * 1.05
    way = (np.array(setpoints) - HOME)[:, :2]
    np.testing.assert_allclose(way[:, 1], -way[:, 0] / 2, atol=5e-3)  # straight; after a pause each joint catches up


EASING = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever runs these tests may ignore it
from pathlib import Path
from lerobot_uca.robots.ur5e.config_ur5e_follower import UR5eFollowerConfig
from lerobot_uca.robots.ur5e.ur5e_follower import JOINT_KEYS, UR5eFollower
config = UR5eFollowerConfig(ip=sys.argv[1], gripper="none", stop_after=0.5, calibration_dir=Path(sys.argv[2]))
with UR5eFollower(config) as robot:
    start = robot.get_observation()
    robot.send_action({**start, "shoulder_pan.pos": 3.0})  # 12 s away
"""


@pytest.mark.parametrize("how", [signal.SIGSTOP, signal.SIGKILL, signal.SIGINT], ids=["suspended", "killed", "Ctrl-C"])
def test_a_driver_that_stops_on_the_way_to_the_first_action_stops_the_arm(controller, tmp_path, how):
    driver = subprocess.Popen(
        [sys.executable, "-c", EASING, controller.address, str(tmp_path)], stderr=subprocess.DEVNULL
    )
    wait_until(lambda: speed(controller) > 0.1)
    driver.send_signal(how)
    wait_until(lambda: stands_still(controller))
    time.sleep(0.2)
    assert stands_still(controller)
    assert controller.robot.arm.q[0] < 2.0
    driver.kill()
    driver.wait(10)


STREAMING = """
import sys, time
from pathlib import Path
from lerobot_uca.robots.ur5e.config_ur5e_follower import UR5eFollowerConfig
from lerobot_uca.robots.ur5e.ur5e_follower import UR5eFollower
config = UR5eFollowerConfig(ip=sys.argv[1], gripper="none", stop_after=0.5, calibration_dir=Path(sys.argv[2]))
with UR5eFollower(config) as robot:
    start = robot.get_observation()
    robot.send_action(start)
    while True:
        robot.send_action({**start, "shoulder_pan.pos": 6.0})
        time.sleep(1 / 30)
"""


def test_a_driver_that_goes_on_after_a_suspension_eases_in(controller, tmp_path):
    """What it reads first is seconds old, from when the arm still moved."""
    driver = subprocess.Popen(
        [sys.executable, "-c", STREAMING, controller.address, str(tmp_path)], stderr=subprocess.DEVNULL
    )
    try:
        wait_until(lambda: speed(controller) > 0.5)
        driver.send_signal(signal.SIGSTOP)
        wait_until(lambda: stands_still(controller))
        time.sleep(2.5)  # longer than the watchdog and the heartbeat wait, and the channel is full
        assert controller.robot.runtime == Runtime.PLAYING
        setpoints = keep_setpoints(controller)
        driver.send_signal(signal.SIGCONT)
        wait_until(lambda: len(setpoints) > 125)
        assert np.abs(np.diff(setpoints, axis=0)).max() * 125 < 0.6  # ease_velocity is 0.25, max_velocity 1
        assert setpoints[-1][0] > setpoints[0][0]
    finally:
        driver.kill()
        driver.wait(10)


def test_a_note_waits_for_a_driver_that_does_not_read():
    """And the servo loop does not wait for it."""
    ours, theirs = socket.socketpair()
    channel = rtde_client.Channel(theirs.detach())
    state = State(0.0, 0.0, *[(0.0,) * 6] * 4, is_servoing=False, has_arrived=True)
    for _ in range(10_000):
        channel.send(state)
    began = time.monotonic()
    channel.send(Note("The arm has stopped."))
    channel.send(state)
    assert time.monotonic() - began < 0.5
    ours.settimeout(1)
    for line in ours.makefile("rb"):
        if isinstance(decode(line), Note):
            break
        channel.send(state)


BROKEN_WITHIN_A_COMMAND = """
import os, sys
from lerobot_uca.robots.ur5e.channel import Settings
from lerobot_uca.robots.ur5e.limits import JointLimits
from lerobot_uca.robots.ur5e.rtde_client import ServoLoop

class Control:
    def __init__(self, real):
        self.isConnected, self.isProgramRunning = real.isConnected, real.isProgramRunning

    def kickWatchdog(self):
        raise RuntimeError("End of file")

limits = JointLimits((-6.0,) * 6, (6.0,) * 6, 1.0, 10.0, 0.1)
settings = Settings(sys.argv[1], os.getppid(), limits, 125.0, 0.1, 300.0, 0.2)
loop = ServoLoop(settings, type("Channel", (), {"receive": list, "send": lambda self, message: None})())
loop._control = Control(loop._control)
try:
    loop.run()
except Exception as error:
    print(type(error).__name__, error, flush=True)
os._exit(0)
"""


def test_a_connection_that_breaks_within_a_command_is_lost_too(controller):
    """The client then raises what its sockets say, once in some hundred times: here it always does."""
    command = [sys.executable, "-c", BROKEN_WITHIN_A_COMMAND, controller.address]
    output = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    assert f"ArmStoppedError The connection to {controller.address} is lost (End of file)." in output


class HeldArm(IdealArm):
    """An arm that leans on something."""

    def follow(self, target_q, dt):
        super().follow(np.minimum(target_q, HOME + 0.02), dt)


def test_an_arm_that_something_holds_goes_on_and_it_is_said(tmp_path, caplog):
    """As at a drawer's end, where a recording saves an episode and the arm pauses."""
    with Controller(HeldArm(), address=free_address()) as controller:
        robot = make_robot(controller, tmp_path, gripper="none")
        with robot:
            robot.send_action(dict(zip(JOINT_KEYS, HOME + np.eye(6)[2] * 0.05, strict=True)))
    assert "The arm is held 0.030 rad away from the first target (elbow)." in caplog.text


def test_velocity_is_limited_whatever_is_asked(controller, robot):
    robot.send_action(action_at(HOME))
    setpoints = keep_setpoints(controller)
    for step in range(45):  # LeRobot's rollout returns to its start in a fixed time, whatever the distance
        robot.send_action(action_at(HOME + np.array([0.2 * step, 0, 0, 0, 0, 0]).clip(max=1.5)))
        time.sleep(1 / 30)
    assert fastest(setpoints, robot) < robot.config.max_velocity * (1 + 1e-9)
    assert not controller.robot.stop_reason


def test_joint_range_holds(controller, tmp_path):
    lower, upper = tuple(HOME - 0.1), tuple(HOME + 0.1)
    robot = make_robot(controller, tmp_path, lower=lower, upper=upper)
    with robot:
        commanded = robot.send_action(action_at(HOME + 0.3))
        np.testing.assert_allclose([commanded[key] for key in JOINT_KEYS], upper)


@pytest.mark.parametrize("tool_length", [0.0, 0.2])
def test_tcp_actions_move_the_tool_in_the_base_frame(tool_length, tmp_path):
    with (
        Controller(address=free_address(), tool_length=tool_length) as controller,
        make_robot(controller, tmp_path, action="tcp", gripper="none") as robot,
    ):
        start = robot.get_observation()
        tool = np.eye(4)
        tool[2, 3] = tool_length
        np.testing.assert_allclose(pose_from_vector(list(start.values())), flange_pose(HOME) @ tool, atol=1e-6)
        tilted = pose_from_vector(list(start.values()))
        tilted[:3, :3] = tilted[:3, :3] @ rotation_matrix(np.array([0.1, 0.05, 0.2]))
        tilted[2, 3] -= 0.03
        target = dict(zip(start, pose_to_vector(tilted, near=list(start.values())), strict=True))
        commanded = robot.send_action(target)
        np.testing.assert_allclose(list(commanded.values()), list(target.values()), atol=1e-4)
        wait_until(lambda: np.allclose(list(robot.get_observation().values()), list(target.values()), atol=1e-3))
        held = robot.send_action({**target, "tcp_x.pos": 1.5})  # out of reach
        np.testing.assert_allclose(list(held.values()), list(commanded.values()), atol=2e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tcp_rx.pos": 127.2}, r"in radians, no longer than 2 pi, got 127.\d. Degrees?"),
        ({"tcp_x.pos": -400.0}, r"in metres, within 2 of the base, got 400.\d. Millimetres?"),
    ],
)
def test_tcp_actions_in_other_units_are_refused(controller, tmp_path, change, message):
    with make_robot(controller, tmp_path, action="tcp", gripper="none") as robot:
        start = robot.get_observation()
        with pytest.raises(ArmStoppedError, match=message):
            robot.send_action({**start, **change})
        np.testing.assert_allclose(controller.robot.arm.q, HOME)


def test_a_tool_that_points_down_is_written_alike_in_each_connection(tmp_path):
    """The controller's own vector changes its sign where the angle passes pi."""
    written = []
    for tilt in (-0.003, 0.003):
        arm = IdealArm((*HOME[:3], HOME[3] + tilt, *HOME[4:]))
        with (
            Controller(arm, address=free_address()) as controller,
            make_robot(controller, tmp_path, action="tcp", gripper="none") as robot,
        ):
            written.append(list(robot.get_observation().values()))
    np.testing.assert_allclose(written[0], written[1], atol=0.02)


def test_without_actions_the_arm_holds_then_stops_and_eases_in_again(controller, tmp_path, caplog):
    robot = make_robot(controller, tmp_path, stop_after=1.0)
    with robot:
        robot.send_action(action_at(HOME + 0.02))
        wait_until(lambda: "the arm has stopped" in caplog.text)
        wait_until(lambda: stands_still(controller))
        assert controller.robot.runtime == Runtime.PLAYING
        robot.send_action(action_at(HOME))
        wait_until(lambda: np.abs(controller.robot.arm.q - HOME).max() < 1e-3)


STOPS = {
    "protective stop": lambda controller: controller.robot.protective_stop("a collision"),
    "emergency stop": lambda controller: controller.robot.emergency_stop(),
    "safeguard stop": lambda controller: controller.robot.safeguard_stop(),
    "program": lambda controller: controller.robot.stop_program(),
    "no data|connection": lambda controller: setattr(controller.network, "is_silent", True),
    "connection|ended": lambda controller: controller.vanish(),
}


@pytest.mark.parametrize(
    ("line", "fault"), STOPS.items(), ids=["protective", "emergency", "safeguard", "program", "silent", "gone"]
)
def test_a_fault_ends_standing_still_and_in_one_line(controller, robot, line, fault):
    errors = keep_moving(robot)
    wait_until(lambda: speed(controller) > 0.1)
    with controller.robot.lock:
        fault(controller)
    wait_until(lambda: errors)
    wait_until(lambda: stands_still(controller))
    (error,) = errors
    assert isinstance(error, ArmStoppedError)
    assert "\n" not in str(error)
    assert any(each in str(error).lower() for each in line.split("|")), error
    with pytest.raises(ArmStoppedError):
        robot.get_observation()


def test_a_paused_program_is_ended_and_does_not_go_on_by_itself(controller, robot, tmp_path):
    errors = keep_moving(robot)
    wait_until(lambda: speed(controller) > 0.1)
    with controller.robot.lock:
        controller.robot.safeguard_stop()
        assert controller.robot.runtime == Runtime.PAUSED
    wait_until(lambda: errors)
    wait_until(lambda: controller.robot.runtime == Runtime.STOPPED)
    stood = controller.robot.arm.q
    with controller.robot.lock:
        controller.robot.leave_guarded_area()
    with make_robot(controller, tmp_path):
        np.testing.assert_array_equal(controller.robot.arm.q, stood)


def test_a_program_that_is_paused_after_its_stop_was_told_is_ended_too(controller, robot):
    errors = keep_moving(robot)
    wait_until(lambda: speed(controller) > 0.1)

    was_paused = threading.Event()

    def pause():
        with controller.robot.lock:
            if controller.robot.runtime == Runtime.PLAYING:
                controller.robot.runtime = Runtime.PAUSED
                was_paused.set()

    with controller.robot.lock:
        controller.robot.safeguard_stop()
        controller.robot.runtime = Runtime.PLAYING
    threading.Timer(0.03, pause).start()
    wait_until(lambda: errors)
    wait_until(lambda: controller.robot.runtime == Runtime.STOPPED)
    if not was_paused.is_set():
        pytest.skip("the program had ended before it was paused: this machine is slow")


def test_a_program_that_somebody_paused_is_refused(controller, tmp_path):
    controller.robot.runtime = Runtime.PAUSED
    with pytest.raises(UserError, match=r"already \(PAUSED .*another client or the pendant holds the arm"):
        make_robot(controller, tmp_path).connect()


def test_late_data_hold_the_setpoint_which_then_goes_on(controller, robot):
    keep_moving(robot)
    wait_until(lambda: speed(controller) > 0.1)
    controller.network.is_silent = True
    wait_until(lambda: has_braked(robot))
    assert robot._arm.state().is_servoing
    controller.network.is_silent = False
    wait_until(lambda: speed(controller) > 0.1)


def test_after_a_silence_of_the_network_the_arm_keeps_its_limits(controller, tmp_path):
    """What was commanded meanwhile has not come: going on from there would be a jump."""
    robot = make_robot(controller, tmp_path, max_velocity=0.35, max_acceleration=1.0)
    with robot:
        keep_moving(robot)
        wait_until(lambda: speed(controller) > 0.2)
        setpoints = keep_setpoints(controller)
        controller.network.is_silent = True
        wait_until(lambda: has_braked(robot))
        controller.network.is_silent = False
        n_before = len(setpoints)
        wait_until(lambda: speed(controller) > 0.2 and len(setpoints) > n_before + 50)
        assert fastest(setpoints, robot) < 1.02 * 0.35


class SlowedArm(IdealArm):
    """An arm whose controller scales its speed down, as the pendant's slider does."""

    def follow(self, target_q, dt):
        super().follow(self.q + np.clip(target_q - self.q, -0.05 * dt, 0.05 * dt), dt)


def test_an_arm_that_does_not_follow_is_not_led_on(tmp_path):
    """Let go, it would make up for all of it as fast as it can."""
    with Controller(SlowedArm(), address=free_address()) as controller:
        robot = make_robot(controller, tmp_path, gripper="none")
        with robot:
            robot.send_action(dict(zip(JOINT_KEYS, HOME, strict=True)))
            with pytest.raises(ArmStoppedError, match=r"does not follow, it is 0\.1\d rad behind: the speed slider"):
                stream(robot, 0.3, seconds=4)


def has_braked(robot) -> bool:
    before = robot._arm.state().setpoint
    time.sleep(0.05)
    return robot._arm.state().setpoint == before


def test_a_client_that_hangs_is_noticed_and_ended(controller, robot):
    keep_moving(robot)
    wait_until(lambda: speed(controller) > 0.1)
    client = robot._arm._process
    os.kill(client.pid, signal.SIGSTOP)
    with pytest.raises(ArmStoppedError, match=r"has not been heard for 1\.\d s and was ended"):
        wait_until(lambda: robot.get_observation() is None)
    assert client.wait(5) == -signal.SIGKILL
    wait_until(lambda: controller.robot.runtime == Runtime.STOPPED)
    wait_until(lambda: stands_still(controller))


@pytest.mark.parametrize(("fault", "size"), [("latency", 0.05), ("drop", 0.1)])
def test_a_bad_network_is_ridden_out_and_ends_standing_still(controller, robot, fault, size):
    """Late packets move the arm late. Where ur_rtde waits for an answer that is lost, the watchdog ends the program."""
    setattr(controller.network, fault, size)
    last = stream(robot, 0.3, seconds=1.0)
    wait_until(lambda: np.abs(last - controller.robot.arm.q).max() < 2e-3)
    keep_moving(robot)
    wait_until(lambda: speed(controller) > 0.1)
    robot.disconnect()
    wait_until(lambda: controller.robot.runtime == Runtime.STOPPED)
    wait_until(lambda: stands_still(controller))
    assert not controller.robot.stop_reason


def test_disconnecting_stops_a_moving_arm_and_frees_it(controller, robot, tmp_path):
    keep_moving(robot)
    wait_until(lambda: speed(controller) > 0.1)
    robot.disconnect()
    wait_until(lambda: stands_still(controller))
    assert controller.robot.runtime == Runtime.STOPPED
    with make_robot(controller, tmp_path) as again:
        assert again.is_connected


PARENT = """
import os, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from lerobot_uca.robots.ur5e.channel import Settings, Target
from lerobot_uca.robots.ur5e.limits import JointLimits
from lerobot_uca.robots.ur5e.rtde_process import RtdeProcess
limits = JointLimits(lower=(-6.0,) * 6, upper=(6.0,) * 6, velocity=1.0, acceleration=5.0, step=0.2)
arm = RtdeProcess(Settings(sys.argv[1], os.getpid(), limits, servo_rate=125, lookahead=0.1, gain=300, stop_after=2))
q = arm.state().q
if os.fork() == 0:  # as data loaders do: this one keeps the channel open and must not keep the arm going
    time.sleep(60)
while arm.state():
    q = tuple(angle + 0.01 for angle in q)
    arm.send(Target(q, 1 / 30, begins=True))
    print(arm._process.pid, flush=True)
    time.sleep(1 / 30)
"""


KILLS = {"driver": signal.SIGKILL, "client": signal.SIGKILL, "driver by Ctrl-C": signal.SIGINT}


@pytest.mark.parametrize("victim", KILLS)
def test_a_killed_process_leaves_the_arm_standing_still(controller, tmp_path, victim):
    program = [sys.executable, "-c", PARENT, controller.address]
    with (tmp_path / "errors").open("w") as errors:
        parent = subprocess.Popen(program, stdout=subprocess.PIPE, stderr=errors, text=True, start_new_session=True)
    client = int(parent.stdout.readline())
    wait_until(lambda: speed(controller) > 0.1)
    os.kill(client if victim == "client" else parent.pid, KILLS[victim])
    wait_until(lambda: controller.robot.runtime == Runtime.STOPPED, 6)  # the watchdog's second, on a busy machine
    wait_until(lambda: stands_still(controller))
    assert not controller.robot.stop_reason
    parent.wait(20)
    if victim == "client":
        assert "has ended (SIGKILL); the arm stands still" in (tmp_path / "errors").read_text()
    wait_until(lambda: not is_running(client))
    os.killpg(parent.pid, signal.SIGKILL)  # the forked one
    parent.stdout.close()


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


BAD_ACTIONS = {
    "nan": ({JOINT_KEYS[1]: math.nan}, "finite numbers, got others for shoulder_lift.pos"),
    "infinite": ({GRIPPER_KEY: math.inf}, "got others for gripper.pos"),
    "degrees": ({JOINT_KEYS[0]: 90.0}, "radians.*got 90.0. Degrees?"),
    "percent": ({GRIPPER_KEY: 3.0}, r"in 0 .open. to 1 .closed., got 3. Another scale?"),
    "nothing": ({JOINT_KEYS[0]: None}, "values are numbers, one for each name"),
    "two numbers": ({JOINT_KEYS[0]: np.zeros(2)}, "values are numbers, one for each name"),
    "another robot": ({"elbow_flex.pos": 0.0}, "unknown: elbow_flex.pos"),
}


@pytest.mark.parametrize(("change", "message"), BAD_ACTIONS.values(), ids=BAD_ACTIONS)
def test_bad_actions_are_refused_and_move_nothing(controller, robot, change, message):
    with pytest.raises(ArmStoppedError, match=rf"{message}.* The arm was stopped\."):
        robot.send_action({**action_at(HOME), **change})
    with pytest.raises(ArmStoppedError, match=message):  # whatever comes after, as LeRobot's way back to its start
        robot.send_action(action_at(HOME + 0.1))
    np.testing.assert_allclose(controller.robot.arm.q, HOME)


def test_a_missing_name_is_said(robot):
    with pytest.raises(UserError, match=r"missing: elbow\.pos"):
        robot.send_action({key: 0.0 for key in robot.action_features if key != "elbow.pos"})


def test_a_bad_action_on_the_way_stops_the_arm(controller, robot):
    last = stream(robot, 0.3, seconds=1.0)
    with pytest.raises(ArmStoppedError, match="finite numbers"):
        robot.send_action({**action_at(last), JOINT_KEYS[3]: math.nan})
    wait_until(lambda: stands_still(controller))
    assert controller.robot.runtime == Runtime.STOPPED


BAD_SETTINGS = {
    "port": ({"ip": "10.0.0.1:30004"}, "address without a port"),
    "action": ({"action": "pose"}, "one of joints, tcp, got 'pose'"),
    "gripper": ({"gripper": "hand"}, "one of robotiq, none, got 'hand'"),
    "gain": ({"servo_gain": 5.0}, "servo_gain lies in 100 to 2000, got 5"),
    "velocity": ({"max_velocity": 9.0}, "max_velocity lies in 0.01 to 3.14159, got 9"),
    "nan": ({"max_step": math.nan}, "max_step lies in"),
    "five joints": ({"lower": (0.0,) * 5}, "six angles"),
    "degrees": ({"upper": (180.0,) * 6}, "six angles"),
    "a rotation of nothing": ({"tool_rotation": (0.0,) * 3}, "tool_rotation holds a rotation vector"),
    "reversed": ({"lower": (0.5,) * 6, "upper": (0.1,) * 6}, "lies below"),
}


@pytest.mark.parametrize(("settings", "message"), BAD_SETTINGS.values(), ids=BAD_SETTINGS)
def test_bad_settings_are_refused(tmp_path, settings, message):
    with pytest.raises(UserError, match=message):
        UR5eFollower(UR5eFollowerConfig(**{"ip": "127.0.0.1", "calibration_dir": tmp_path, **settings}))


def test_an_address_at_which_nothing_listens_is_said(tmp_path):
    robot = UR5eFollower(UR5eFollowerConfig(ip=free_address(), calibration_dir=tmp_path))
    with pytest.raises(UserError, match="refuses connections to port 29999"):
        robot.connect()


def test_an_address_that_never_answers_takes_the_seconds_that_are_said(tmp_path):
    """A listener whose queue is full drops what comes: a silent host without a network."""
    address = free_address()
    with socket.create_server((address, 29999), backlog=0), socket.create_connection((address, 29999)):
        robot = UR5eFollower(UR5eFollowerConfig(ip=address, calibration_dir=tmp_path))
        began = time.monotonic()
        with pytest.raises(UserError, match=r"\(?3 s"):
            robot.connect()
        assert 2.9 < time.monotonic() - began < 6  # a busy machine is late


def test_something_else_on_the_port_is_said(tmp_path):
    address = free_address()
    with socket.create_server((address, 29999)) as server:

        def answer():
            connection, _ = server.accept()
            with connection:
                connection.sendall(b"220 mail.example.org ESMTP\r\n")

        threading.Thread(target=answer, daemon=True).start()
        robot = UR5eFollower(UR5eFollowerConfig(ip=address, calibration_dir=tmp_path))
        with pytest.raises(UserError, match=r"not a dashboard server .*ESMTP"):
            robot.connect()


def test_polyscope_x_is_refused_with_the_reason(tmp_path):
    with (
        Controller(address=free_address(), has_dashboard=False) as controller,
        pytest.raises(UserError, match=r"PolyScope X\. It is not supported, because"),
    ):
        make_robot(controller, tmp_path).connect()


def test_an_arm_without_a_gripper_is_said(tmp_path):
    with Controller(address=free_address()) as controller:
        with pytest.raises(UserError, match=r"--robot\.gripper=none"):
            make_robot(controller, tmp_path).connect()
        assert controller.robot.runtime == Runtime.STOPPED
        with make_robot(controller, tmp_path, gripper="none") as robot:
            assert list(robot.get_observation()) == list(JOINT_KEYS)


def test_a_gripper_that_is_lost_stops_the_arm(controller, robot):
    errors = keep_moving(robot)
    wait_until(lambda: speed(controller) > 0.1)
    controller.gripper.get = lambda name: "?"
    with pytest.raises(ArmStoppedError, match=r"The gripper has no value for (POS|FLT|STA)"):
        wait_until(lambda: robot.get_observation() is None)
    wait_until(lambda: stands_still(controller))
    wait_until(lambda: errors)


@pytest.mark.parametrize(
    ("register", "value", "message"), [("FLT", 14, "reports fault 14"), ("STA", 0, "not active any")]
)
def test_a_gripper_that_drops_out_stops_the_arm(controller, robot, register, value, message):
    errors = keep_moving(robot)
    wait_until(lambda: speed(controller) > 0.1)
    registers = controller.gripper.get
    controller.gripper.get = lambda name: value if name == register else registers(name)
    with pytest.raises(ArmStoppedError, match=message):
        wait_until(lambda: robot.get_observation() is None)
    wait_until(lambda: stands_still(controller))
    wait_until(lambda: errors)


def test_a_gripper_position_that_is_clipped_is_said(controller, robot, caplog):
    assert robot.send_action(action_at(HOME, gripper=1.2))[GRIPPER_KEY] == 1
    assert "The gripper's position 1.20 was clipped to 0 (open) to 1 (closed)." in caplog.messages


@pytest.mark.parametrize(("port", "line"), [(29999, "dashboard server of .* hung up"), (63352, "URCap at .* hung up")])
def test_a_connection_that_is_reset_is_one_line(tmp_path, port, line):
    """As a controller does that is starting."""
    address = free_address()

    def hang_up(server):
        connection, _ = server.accept()
        time.sleep(0.2)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.close()

    with contextlib.ExitStack() as stack:
        if port != 29999:
            stack.enter_context(Controller(address=address))
        server = stack.enter_context(socket.create_server((address, port)))
        threading.Thread(target=hang_up, args=[server], daemon=True).start()
        with pytest.raises(UserError, match=line):
            UR5eFollower(UR5eFollowerConfig(ip=address, calibration_dir=tmp_path)).connect()


def test_a_gripper_with_a_fault_is_refused(controller, tmp_path):
    controller.gripper.set("FLT", 5)
    with pytest.raises(UserError, match="reports fault 5"):
        make_robot(controller, tmp_path).connect()


@pytest.mark.parametrize(("status", "said"), [(1, "did not reset itself"), (0, "did not become active")])
def test_a_gripper_that_does_not_become_active_is_said(status, said, controller, tmp_path, monkeypatch):
    monkeypatch.setattr("lerobot_uca.robots.ur5e.gripper.ACTIVATION_TIMEOUT", 0.2)
    registers = controller.gripper.get
    controller.gripper.get = lambda name: status if name == "STA" else registers(name)
    with pytest.raises(UserError, match=said):
        make_robot(controller, tmp_path).connect()
    assert controller.robot.runtime == Runtime.STOPPED


def test_a_silent_urcap_is_said(tmp_path):
    with Controller(address=free_address()) as controller, socket.create_server((controller.address, 63352)):
        with pytest.raises(UserError, match=r"63352 takes connections but did not answer within 2 s"):
            make_robot(controller, tmp_path).connect()
        assert controller.robot.runtime == Runtime.STOPPED


def test_fingers_move_only_when_the_arm_is_at_the_first_action(controller, robot):
    mover = threading.Thread(target=robot.send_action, args=[action_at(HOME + 0.25, gripper=1.0)])
    mover.start()
    wait_until(lambda: speed(controller) > 0.1)
    assert controller.gripper.get("POS") == OPEN_COUNT
    mover.join()
    wait_until(lambda: controller.gripper.get("POS") == CLOSED_COUNT)


@pytest.fixture
def _slow_fingers(monkeypatch):
    """Which need 11 s to close: a busy machine may take half a second, in which fast ones do, until it disconnects."""
    for speed in ("SLOWEST", "FASTEST"):
        monkeypatch.setattr(f"lerobot_uca.robots.ur5e.sim.gripper.{speed}", 20.0)


@pytest.mark.usefixtures("_slow_fingers")
def test_disconnecting_stops_the_fingers(controller, tmp_path):
    with make_robot(controller, tmp_path) as robot:
        robot.send_action(action_at(HOME, gripper=1.0))
        wait_until(lambda: controller.gripper.get("POS") > OPEN_COUNT)
    stopped = controller.gripper.get("POS")
    assert stopped < CLOSED_COUNT
    time.sleep(0.3)
    assert controller.gripper.get("POS") == stopped


@pytest.mark.usefixtures("_slow_fingers")
def test_a_second_interrupt_stops_the_fingers_too(controller, tmp_path, monkeypatch):
    robot = make_robot(controller, tmp_path)
    robot.connect()
    robot.send_action(action_at(HOME, gripper=1.0))
    wait_until(lambda: controller.gripper.get("POS") > OPEN_COUNT)
    stop = robot._arm.stop

    def interrupted(reason):
        stop(reason)
        raise KeyboardInterrupt

    monkeypatch.setattr(robot._arm, "stop", interrupted)
    with pytest.raises(KeyboardInterrupt):
        robot.disconnect()
    stopped = controller.gripper.get("POS")
    assert stopped < CLOSED_COUNT
    time.sleep(0.3)
    assert controller.gripper.get("POS") == stopped
    assert not robot.is_connected


def test_a_gripper_is_activated_once_it_has_reset_itself(controller, monkeypatch):
    """Which takes a moment, before which it misses that it is activated."""
    status, ready_at, get = 1, math.inf, controller.gripper.get

    def slow_set(name, value):
        nonlocal status, ready_at
        if (name, value) == ("ACT", 0):
            ready_at = time.monotonic() + 0.2
        elif (name, value) == ("ACT", 1):
            status = 3 if time.monotonic() > ready_at else 0

    def slow_get(name):
        if name == "STA":
            return 0 if status == 1 and time.monotonic() > ready_at else status
        return get(name)

    monkeypatch.setattr(controller.gripper, "set", slow_set)
    monkeypatch.setattr(controller.gripper, "get", slow_get)
    RobotiqGripper(controller.address).close()
    assert status == 3


CONNECTING = """
import os, signal, sys
from lerobot_uca.robots.ur5e.channel import Settings
from lerobot_uca.robots.ur5e.limits import JointLimits
from lerobot_uca.robots.ur5e.rtde_process import RtdeProcess
signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever runs these tests may ignore it
limits = JointLimits((-6.0,) * 6, (6.0,) * 6, 1.0, 5.0, 0.2)
print("connects", flush=True)
RtdeProcess(Settings(sys.argv[1], os.getpid(), limits, 125, 0.1, 300, 2))
"""


def has_ended(process: int) -> bool:
    """Also where nobody asks how."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2].startswith("Z")
    except FileNotFoundError:
        return True


def test_a_client_whose_driver_and_network_go_at_once_ends(controller, tmp_path):
    """ur_rtde would wait for five minutes for the controller's answer to the command to brake."""
    command = [sys.executable, "-c", STREAMING, controller.address, str(tmp_path)]
    driver = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    wait_until(lambda: speed(controller) > 0.5)
    (client,) = map(int, Path(f"/proc/{driver.pid}/task/{driver.pid}/children").read_text().split())
    driver.kill()
    controller.network.latency = 5.0  # what is commanded comes too late, and what it answers as well
    driver.wait(10)
    time.sleep(0.1)
    controller.vanish()
    wait_until(lambda: has_ended(client))


@pytest.mark.parametrize("ends", [[signal.SIGINT, signal.SIGINT], [signal.SIGKILL]])
def test_a_connection_that_is_given_up_starts_no_program_later(controller, ends):
    """However impatiently: ur_rtde waits for ever for a controller's first data."""
    controller.network.is_silent = True
    command = [sys.executable, "-c", CONNECTING, controller.address]
    driver = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert driver.stdout is not None
    driver.stdout.readline()
    children = Path(f"/proc/{driver.pid}/task/{driver.pid}/children")
    wait_until(lambda: children.read_text().strip())
    client = int(children.read_text())
    time.sleep(2)  # until it waits
    for each in ends:
        driver.send_signal(each)
        time.sleep(0.7)
    driver.wait(10)
    wait_until(lambda: has_ended(client))
    controller.network.is_silent = False
    assert controller.robot.runtime == Runtime.STOPPED


def test_a_speed_slider_below_its_end_is_said(controller, tmp_path, caplog):
    controller.robot.speed_slider = 0.5
    with make_robot(controller, tmp_path, gripper="none"):
        wait_until(lambda: "The pendant's speed slider is at 50%" in caplog.text)


def test_nothing_is_imported_from_the_working_directory(controller, tmp_path, monkeypatch):
    (tmp_path / "json.py").write_text("raise SystemExit(3)\n")
    monkeypatch.chdir(tmp_path)
    with make_robot(controller, tmp_path, gripper="none") as robot:
        assert robot.get_observation()


def test_a_firmware_that_was_not_tried_is_said_and_works(tmp_path, caplog):
    with (
        Controller(address=free_address(), firmware=(5, 19, 0, 1000)) as controller,
        make_robot(controller, tmp_path, gripper="none"),
    ):
        assert "PolyScope 5.19.0 has not been tried with this driver (tried: 5.12)" in caplog.text


def test_a_second_client_is_refused(controller, robot, tmp_path):
    with pytest.raises(UserError, match="another client or the pendant holds the arm"):
        make_robot(controller, tmp_path).connect()


def test_a_stopped_arm_is_refused(controller, tmp_path):
    with controller.robot.lock:
        controller.robot.protective_stop("a collision")
    with pytest.raises(UserError, match="safety status is PROTECTIVE_STOP"):
        make_robot(controller, tmp_path).connect()


def test_local_control_is_refused(controller, tmp_path):
    controller.dashboard.is_remote = False
    with pytest.raises(UserError, match="remote control"):
        make_robot(controller, tmp_path).connect()


@pytest.mark.parametrize(
    ("question", "answer", "message"),
    [
        ("robotmode", "Robotmode: IDLE", r"not ready \(robot mode IDLE\)"),
        ("PolyscopeVersion", "URSoftware 3.15.8.106339", r"PolyScope 3\.15\.8 is not supported"),
        ("safetystatus", "Safetystatus: RECOVERY", "safety status is RECOVERY"),
    ],
)
def test_a_controller_that_is_not_ready_is_refused(controller, tmp_path, monkeypatch, question, answer, message):
    ask = Dashboard.ask
    monkeypatch.setattr(Dashboard, "ask", lambda self, asked: answer if asked == question else ask(self, asked))
    with pytest.raises(UserError, match=message):
        make_robot(controller, tmp_path).connect()
    assert controller.robot.runtime == Runtime.STOPPED


def test_a_missing_client_names_the_extra(controller, tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"lerobot_policy_uca_flow\[ur5e\]"):
        make_robot(controller, tmp_path).connect()


def test_clipping_is_said_once_a_second(caplog, monkeypatch):
    caplog.set_level(logging.WARNING)
    report, now = ClippingReport(), 100.0
    monkeypatch.setattr("lerobot_uca.robots.ur5e.clipping_report.time.monotonic", lambda: now)
    for size in (0.1, 0.3, 0.2):
        report.note(np.array([0, size, 0, 0, 0, 0]))
        now += 0.4
    now += 0.4
    report.note(np.zeros(6))
    report.note(np.array([0, 0, 0.05, 0, 0, 0]))
    report.say()  # as disconnecting does
    assert caplog.messages == [
        "1 targets were clipped, by up to 0.100 rad (shoulder_lift).",
        "2 targets were clipped, by up to 0.300 rad (shoulder_lift).",
        "1 targets were clipped, by up to 0.050 rad (elbow).",
    ]
