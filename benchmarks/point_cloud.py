"""Milliseconds of each stage from simulator to observation, and of the picture: medians over an episode's steps.

python benchmarks/point_cloud.py
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from lerobot_uca.envs.metaworld import MetaworldPointCloudEnv, ScriptedExpert
from lerobot_uca.envs.point_cloud import sample_farthest

TASKS = ("drawer-close", "dial-turn", "shelf-place", "hand-insert", "hammer")


def main() -> None:
    """Print one row a task."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=100, help="steps of the expert's episode to measure")
    n_steps = parser.parse_args().steps
    stages = ("simulate", "rays + crop", "sample 512", "observation", "picture")
    print(f"{'ms, median':16}" + "".join(f"{name:>13}" for name in (*stages, "points")))
    for task in TASKS:
        rows = measure(task, n_steps)
        print(
            f"{task:16}"
            + "".join(f"{value:13.2f}" for value in np.median(rows[:, :-1], axis=0))
            + f"{rows[:, -1].mean():13.0f}"
        )


def measure(task: str, n_steps: int) -> np.ndarray:
    """Times [ms] of the stages and the number of points inside the crop, (steps, 6)."""
    env, expert = MetaworldPointCloudEnv(task), ScriptedExpert(task)
    env.reset(seed=0)
    simulator, camera = env._simulator, env._cloud_camera
    rows = []
    for _ in range(n_steps):
        action = expert(env)
        simulate, (env.expert_observation, *_) = timed(simulator.step, action)
        rays, points = timed(camera.capture, simulator.model, simulator.data, env._markers())
        sample, _ = timed(sample_farthest, points, env.n_points)
        observe, _ = timed(env._observe)
        picture, _ = timed(env.render)
        rows.append([simulate, rays, sample, observe, picture, len(points)])
    return np.array(rows)


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Milliseconds a call takes, and its result."""
    start = time.perf_counter()
    result = function(*arguments)
    return 1e3 * (time.perf_counter() - start), result


if __name__ == "__main__":
    main()
