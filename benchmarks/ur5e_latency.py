"""Milliseconds from a depth frame to the moved setpoint at the controller, by stage: frame, cloud, policy, channel.

The simulated controller with an ideal arm is in this process, the driver's client in its own, as with a real arm. The
camera's own time (exposure, transfer) is not in it: here a frame is there at once. Weights do not change the time.

    python benchmarks/ur5e_latency.py
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from common import make_observation, make_policy, print_provenance

from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.point_clouds.cameras import DepthCamera
from lerobot_uca.point_clouds.depth import DepthToCloud, DepthView, to_millimetres
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.robots.ur5e.config_ur5e_follower import UR5eFollowerConfig
from lerobot_uca.robots.ur5e.sim.controller import Controller
from lerobot_uca.robots.ur5e.sim.scene import Scene
from lerobot_uca.robots.ur5e.sim.scene_service import simulated_camera
from lerobot_uca.robots.ur5e.ur5e_follower import JOINT_KEYS, UR5eFollower

CROP = Crop((-0.8, -0.45, 0.005), (-0.2, 0.35, 0.5))
N_POINTS = 1024
STAGES = ("cloud", "policy", "send_action", "channel")
TURN = "input_double_register_5"  # of the setpoint's wrist 3


def main() -> None:
    """Print the median and the 99th percentile of each stage, and its share of the whole."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", type=int, default=300)
    parser.add_argument("--inference", default="openvino")
    parser.add_argument("--ip", default="127.0.0.9")
    options = parser.parse_args()
    print_provenance()
    with tempfile.TemporaryDirectory() as folder, Controller(address=options.ip) as controller:
        config = UR5eFollowerConfig(ip=options.ip, gripper="none", calibration_dir=Path(folder))
        with UR5eFollower(config) as robot:
            rows = measure(robot, controller, options.calls, options.inference)
    whole = rows.sum(axis=1)
    total = np.median(whole)
    for name, column in zip((*STAGES, "whole"), [*rows.T, whole], strict=True):
        median, late = np.percentile(column, (50, 99))
        print(f"{name:>12} {median:8.2f} ms median {late:8.2f} ms p99 {median / total:8.0%} of the whole")


def measure(robot: UR5eFollower, controller: Controller, n_calls: int, inference: str) -> np.ndarray:
    """Milliseconds, a row for each call: cloud, policy, send_action, channel."""
    scene, camera = Scene(), simulated_camera(640, 480)
    image = to_millimetres(DepthCamera(camera).capture(scene.model, scene.data))
    to_cloud = DepthToCloud([DepthView(camera)], CROP, N_POINTS)
    policy = make_policy(
        cloud_points=N_POINTS, dim=128, inference=inference, obs_stride=2, horizon=16, n_action_steps=1
    )
    observation = robot.get_observation()
    robot.send_action(observation)  # eases in
    any_observation = make_observation(cloud_points=N_POINTS)
    rows = []
    for call in range(n_calls):
        start = time.perf_counter()
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
        rows.append(np.diff([start, seen, thought, sent, arrived]) * 1000)
        time.sleep(0.3)  # the arm comes to rest, so that the next setpoint that moves is the next action's
    return np.array(rows)


if __name__ == "__main__":
    main()
