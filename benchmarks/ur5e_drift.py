"""A 30 Hz stream of actions through the driver, for as long as given: is the rate held, does anything drift or grow?

The loop is LeRobot's: observe, act, sleep for what is left of the period. The arm is the simulated controller's ideal
one, in this process; the driver's client has its own. All joints swing by 0.1 rad, every ten seconds.

    python benchmarks/ur5e_drift.py --minutes=60
"""

import argparse
import math
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
from common import print_provenance
from lerobot.utils.robot_utils import precise_sleep

from lerobot_uca.robots.ur5e.config_ur5e_follower import UR5eFollowerConfig
from lerobot_uca.robots.ur5e.sim.controller import Controller
from lerobot_uca.robots.ur5e.sim.robot import HOME
from lerobot_uca.robots.ur5e.ur5e_follower import JOINT_KEYS, UR5eFollower

RATE = 30.0  # [Hz]
SWING, PERIOD = 0.1, 10.0  # [rad], [s]


def main() -> None:
    """Print a line for each tenth of the time, from the first to the last alike."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--ip", default="127.0.0.8")
    options = parser.parse_args()
    print_provenance()
    print(
        "   until   actions   rate [Hz]   late [%]   error median, max [mrad]   cycles [Hz]   memory [MB]", flush=True
    )
    with tempfile.TemporaryDirectory() as folder, Controller(address=options.ip) as controller:
        config = UR5eFollowerConfig(ip=options.ip, gripper="none", calibration_dir=Path(folder))
        with UR5eFollower(config) as robot:
            for part in range(1, 11):
                print(
                    f"{part * options.minutes / 10:6.1f} min {run(robot, controller, options.minutes * 6)}", flush=True
                )


def run(robot: UR5eFollower, controller: Controller, seconds: float) -> str:
    """Stream for some seconds; the figures of the line."""
    errors, n_late, n_cycles = [], 0, controller.robot.n_cycles
    began = now = time.perf_counter()
    n = round(seconds * RATE)
    for tick in range(n):
        q = np.array(HOME) + SWING * math.sin(2 * math.pi * tick / RATE / PERIOD)
        measured = robot.get_observation()
        errors.append(np.abs(q - [measured[key] for key in JOINT_KEYS]).max())
        robot.send_action(dict(zip(JOINT_KEYS, q.tolist(), strict=True)))
        left = 1 / RATE - (time.perf_counter() - now)
        n_late += left < 0
        precise_sleep(max(left, 0.0))
        now = time.perf_counter()
    lasted = now - began
    processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
    memory = sum(process.memory_info().rss for process in processes) / 2**20
    return (
        f"{n:9d} {n / lasted:11.3f} {n_late / n:10.2%} {1e3 * np.median(errors):18.1f} {1e3 * max(errors):6.1f} "
        f"{(controller.robot.n_cycles - n_cycles) / lasted:14.1f} {memory:13.1f}"
    )


if __name__ == "__main__":
    main()
