"""Milliseconds from a depth frame to the moved setpoint at the controller, by stage.

    observe        the driver's: the arm's state and the newest frame, 640 x 480, of a camera in another process
    cloud, policy  1024 points, the network of ur5e_small, which sees 256 of them; weights do not change the time
    send_action    checked, clipped, sent to the process that talks to the arm
    channel        until a setpoint that differs has come to the controller, by way of the servo loop

The simulated controller with an ideal arm is in this process, the driver's client in its own, as with a real arm. A
camera's exposure and transfer are not in it: a real one's are its own, the simulated one's are ray casting.

    python benchmarks/ur5e_latency.py
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from common import make_observation, make_policy, print_provenance

from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.point_clouds.depth import DepthToCloud, DepthView
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.robots.ur5e.config_ur5e_follower import UR5eFollowerConfig
from lerobot_uca.robots.ur5e.sim.config_simulated_camera import SimulatedCameraConfig
from lerobot_uca.robots.ur5e.sim.controller import Controller
from lerobot_uca.robots.ur5e.sim.scene_service import simulated_camera
from lerobot_uca.robots.ur5e.ur5e_follower import JOINT_KEYS, UR5eFollower

CROP = Crop((-0.8, -0.45, 0.005), (-0.2, 0.35, 0.5))
N_POINTS = 1024
STAGES = ("observe", "cloud", "policy", "send_action", "channel")
TURN = "input_double_register_5"  # of the setpoint's wrist 3


def main() -> None:
    """Print the median and the 99th percentile of each stage, and its share of the whole."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", type=int, default=300)
    parser.add_argument("--inference", default="openvino_bfloat16", help="as ur5e_small has it [%(default)s]")
    parser.add_argument("--ip", default="127.0.0.9")
    parser.add_argument("--camera-ip", default="127.0.0.10")
    options = parser.parse_args()
    print_provenance()
    with (
        tempfile.TemporaryDirectory() as folder,
        world(options.camera_ip),
        Controller(address=options.ip) as controller,
    ):
        camera = SimulatedCameraConfig(ip=options.camera_ip, fps=5, width=640, height=480)  # slow: rays cost the core
        config = UR5eFollowerConfig(
            ip=options.ip, gripper="none", calibration_dir=Path(folder), cameras={"top": camera}
        )
        with UR5eFollower(config) as robot:
            rows = measure(robot, controller, options.calls, options.inference)
    whole = rows.sum(axis=1)
    total = np.median(whole)
    for name, column in zip((*STAGES, "whole"), [*rows.T, whole], strict=True):
        median, late = np.percentile(column, (50, 99))
        print(f"{name:>12} {median:8.2f} ms median {late:8.2f} ms p99 {median / total:8.0%} of the whole")


@contextmanager
def world(ip: str) -> Iterator[None]:
    """A process that serves a camera."""
    program = Path(sys.executable).with_name("lerobot-uca-ur5e-sim")
    process = subprocess.Popen([program, f"--ip={ip}"], stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        assert any("serves" in line for line in process.stderr)
        yield
    finally:
        process.terminate()
        process.communicate()


def measure(robot: UR5eFollower, controller: Controller, n_calls: int, inference: str) -> np.ndarray:
    """Milliseconds, a row for each call and a column for each stage."""
    to_cloud = DepthToCloud([DepthView(simulated_camera(640, 480))], CROP, N_POINTS)
    policy = make_policy(
        cloud_points=N_POINTS, n_points=256, dim=128, inference=inference, obs_stride=2, horizon=16, n_action_steps=1
    )
    observed = robot.get_observation()
    observation = {key: observed[key] for key in JOINT_KEYS}
    robot.send_action(observation)  # eases in
    any_observation = make_observation(cloud_points=N_POINTS)
    rng, rows = np.random.default_rng(0), []
    for call in range(n_calls):
        start = time.perf_counter()
        image = robot.get_observation()["top_depth"]
        observed_at = time.perf_counter()
        cloud = torch.from_numpy(to_cloud([image]))[None]
        seen = time.perf_counter()
        with torch.inference_mode():
            policy.select_action({**any_observation, OBS_POINT_CLOUD: cloud})
        thought = time.perf_counter()
        before = controller.robot.inputs[TURN]
        robot.send_action({**observation, JOINT_KEYS[-1]: observation[JOINT_KEYS[-1]] + (0.02 if call % 2 else -0.02)})
        sent = time.perf_counter()
        while controller.robot.inputs[TURN] == before:
            time.sleep(1e-4)
        arrived = time.perf_counter()
        rows.append(np.diff([start, observed_at, seen, thought, sent, arrived]) * 1000)
        # The arm comes to rest, so that the next setpoint that moves is the next action's, which comes anywhere between
        # two of the servo loop's ticks.
        time.sleep(0.3 + rng.uniform(0, 1 / robot.config.servo_rate))
    return np.array(rows)


if __name__ == "__main__":
    main()
