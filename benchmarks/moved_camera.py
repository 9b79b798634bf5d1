"""Success of policies that see depth through a camera that is not where its calibration says it is, as CSV.

python benchmarks/moved_camera.py outputs/plain/checkpoints/last/pretrained_model \
    outputs/augmented/checkpoints/last/pretrained_model --task=drawer-close > moved_camera.csv

Each group of five episodes has an error of its own: the calibrated position is --mm off in a random direction and the
orientation --deg about a random axis. Groups and episodes are the same for all checkpoints, and without an error.
"""

import argparse
import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import write_rows
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from lerobot_uca.envs.configs import MetaworldPointCloudConfig
from lerobot_uca.point_clouds.geometry import as_pose
from lerobot_uca.point_clouds.recipe import CloudRecipe
from lerobot_uca.policies.processor_depth import DepthToCloudProcessorStep
from lerobot_uca.protocol.evaluation import PolicyPlan, run_episodes

GROUP = 5
FIRST_SEED = 1000  # lerobot-eval's


def main() -> None:
    """Write a row for each checkpoint without and with the error."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", type=Path, nargs="+", help="folders .../pretrained_model")
    parser.add_argument("--task", default="drawer-close", help="of Meta-World")
    parser.add_argument("--mm", type=float, default=10.0, help="error of the camera's position")
    parser.add_argument("--deg", type=float, default=1.0, help="error of its orientation")
    parser.add_argument("--n_episodes", type=int, default=50)
    args = parser.parse_args()
    logging.disable(logging.WARNING)
    torch.set_num_threads(1)
    env = MetaworldPointCloudConfig(task=args.task, observation="depth")
    env.validate()
    write_rows(
        row(checkpoint, env, error, args.n_episodes)
        for checkpoint in args.checkpoints
        for error in dict.fromkeys([(0.0, 0.0), (args.mm, args.deg)])
    )


def row(checkpoint: Path, env: Any, error: tuple[float, float], n_episodes: int) -> dict[str, Any]:
    """The result of one checkpoint with one size of error."""
    plan = PolicyPlan.from_checkpoint(checkpoint)
    options = plan.config.augmentation
    successes = list(episodes(plan, env, error, n_episodes))
    interval = binomtest(sum(successes), len(successes)).proportion_ci(method="wilson")
    return {
        "task": env.task,
        "augmentation": f"{1e3 * options.camera_shift:g} mm {options.camera_turn:g} deg" if options.is_on else "none",
        "error_mm": error[0],
        "error_deg": error[1],
        "episodes": len(successes),
        "success_percent": round(100 * float(np.mean(successes)), 1),
        "interval_95": f"{100 * interval.low:.0f} to {100 * interval.high:.0f}",
    }


def episodes(plan: PolicyPlan, env: Any, error: tuple[float, float], n_episodes: int) -> Iterator[bool]:
    """Whether each episode succeeds."""
    preprocess: Any = plan.preprocess
    steps = preprocess.steps
    place = next(index for index, step in enumerate(steps) if isinstance(step, DepthToCloudProcessorStep))
    trained = CloudRecipe.from_dict(steps[place].recipe)
    seeds = range(FIRST_SEED, FIRST_SEED + n_episodes)
    for first in seeds[::GROUP]:
        recipe = miscalibrated(trained, *error, np.random.default_rng(first))
        preprocess.steps = [*steps[:place], DepthToCloudProcessorStep(recipe.as_dict()), *steps[place + 1 :]]
        group = range(first, min(first + GROUP, seeds.stop))
        for episode in run_episodes(env.env_factory(env.task), plan.config, plan, group, n_envs=GROUP):
            yield episode.success


def miscalibrated(recipe: CloudRecipe, mm: float, deg: float, rng: np.random.Generator) -> CloudRecipe:
    """A recipe whose cameras' poses are wrong by so much, each in a direction of its own."""
    sources = []
    for source in recipe.sources:
        camera = source.calibration.camera
        X = np.array(camera.X_world_camera)
        direction, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        X[:3, 3] += mm / 1e3 * direction
        X[:3, :3] = Rotation.from_rotvec(deg * axis, degrees=True).as_matrix() @ X[:3, :3]
        moved = replace(camera, X_world_camera=as_pose(X))
        sources.append(replace(source, calibration=replace(source.calibration, camera=moved)))
    return replace(recipe, sources=tuple(sources))


if __name__ == "__main__":
    main()
