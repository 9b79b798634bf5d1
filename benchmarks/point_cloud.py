"""Milliseconds of an environment's step, of the stages of its observation, and of the picture: medians of an episode.

python benchmarks/point_cloud.py --expert='../shared/adroit_experts/{task}.npz'
"""

import argparse

import numpy as np
from common import print_provenance, timed
from lerobot.envs import make_env_config

from lerobot_uca.envs.configs import PointCloudEnvConfig
from lerobot_uca.envs.experts.expert import Expert
from lerobot_uca.point_clouds.geometry import sample_farthest

TASKS = {
    "metaworld_pointcloud": ("drawer-close", "dial-turn", "shelf-place", "hand-insert", "hammer"),
    "adroit_pointcloud": ("hammer", "door", "pen", "relocate"),
}
STAGES = ("step", "rays + crop", "sample", "observation", "picture", "fewest points")


def main() -> None:
    """Print one row a task."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100, help="steps of the episode to measure")
    parser.add_argument("--expert", help="who acts in Adroit, as for lerobot-uca-collect; random actions by default")
    args = parser.parse_args()
    print_provenance()
    print(f"{'ms, median':34}" + "".join(f"{name:>14}" for name in STAGES))
    for kind, tasks in TASKS.items():
        for task in tasks:
            config = make_env_config(kind, task=task)
            rows = measure(config, task, expert_of(config, task, args.expert), args.steps)
            times, n_points = np.median(rows[:, :-1], axis=0), rows[:, -1].min()
            name = f"{kind.removesuffix('_pointcloud')} {task}, {config.n_points} points"
            print(f"{name:34}" + "".join(f"{value:14.2f}" for value in times) + f"{n_points:14.0f}")


def expert_of(config: PointCloudEnvConfig, task: str, adroits: str | None) -> Expert:
    """Meta-World's own, the given one for Adroit, or one that acts at random."""
    if config.type == "adroit_pointcloud" and adroits is None:
        return lambda env: env.action_space.sample()
    return next(config.attempts(task, adroits if config.type == "adroit_pointcloud" else None, 0)).expert()


def measure(config: PointCloudEnvConfig, task: str, expert: Expert, n_steps: int) -> np.ndarray:
    """Times [ms] of the stages and the number of points inside the crop, (steps, 6)."""
    env = config.env_factory(task)()
    env.action_space.seed(0)
    env.reset(seed=0)
    rows = []
    for _ in range(n_steps):
        step, _ = timed(env.step, expert(env))
        simulator = env._simulator
        rays, points = timed(env.observer.camera.capture, simulator.model, simulator.data, env._markers())
        sample, _ = timed(sample_farthest, points, env.n_points)
        observe, _ = timed(env.observe)
        picture, _ = timed(env.render)
        rows.append([step, rays, sample, observe, picture, len(points)])
    return np.array(rows)


if __name__ == "__main__":
    main()
