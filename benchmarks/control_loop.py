"""Milliseconds of each stage of `lerobot-eval`'s loop, one environment: medians over an expert's episode.

python benchmarks/control_loop.py > benchmarks/results/control_loop.csv

The expert moves the robot, so that the scene is a task's; the policy, untrained, is asked for each step's action, too.
It plans in every third step ('plan') and takes the other actions from its queue ('queue', where the frame before a plan
is encoded). 'preprocess' and 'postprocess' are LeRobot's pipelines, which run in every step.
"""

import argparse
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import torch
from common import CLOUD_POINTS, N_ACTIONS, N_STATES, SIZES, make_policy, timed, write_rows
from lerobot.envs import preprocess_observation
from lerobot.policies import make_pre_post_processors

from lerobot_uca.envs.metaworld import MetaworldPointCloudEnv, ScriptedExpert
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.point_clouds.geometry import sample_farthest

TASKS = ("drawer-close", "dial-turn", "shelf-place", "hand-insert", "hammer")


def main() -> None:
    """Print a CSV table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=150, help="steps of the episode to measure")
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=TASKS)
    args = parser.parse_args()
    write_rows(rows(args.tasks, args.steps))


def rows(tasks: Iterable[str], n_steps: int) -> Iterator[dict[str, str]]:
    """A row for each configuration and task: median milliseconds of the stages."""
    for configuration, sizes in SIZES.items():
        for task in tasks:
            stages = measure(task, sizes, n_steps)
            medians = {name: f"{np.median(milliseconds):.2f}" for name, milliseconds in stages.items()}
            yield {"configuration": configuration, "task": task, **medians}


@torch.inference_mode()
def measure(task: str, sizes: dict[str, Any], n_steps: int) -> dict[str, list[float]]:
    """Times [ms] of each stage; 'step' is a whole one, on average over planning and queued steps."""
    env, expert = MetaworldPointCloudEnv(task, n_points=CLOUD_POINTS), ScriptedExpert(task)
    policy = make_policy(**sizes)
    preprocess, postprocess = make_pre_post_processors(policy.config, dataset_stats=unit_statistics())
    observation, _ = env.reset(seed=0)
    simulator, camera = env._simulator, env.observer.camera
    cast_alone = camera._caster.cast
    casts: list[float] = []

    def cast(*arguments: Any) -> Any:
        milliseconds, hits = timed(cast_alone, *arguments)
        casts.append(milliseconds)
        return hits

    camera._caster.cast = cast  # type: ignore[method-assign, assignment]
    names = ("simulate", "rays", "crop", "sample", "to tensors", "preprocess", "plan", "queue", "postprocess", "step")
    stages: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(n_steps + policy.config.n_action_steps):
        action = expert(env)
        plans = not policy._action_queue
        simulate, (env.expert_observation, *_) = timed(simulator.step, action)
        capture, points = timed(camera.capture, simulator.model, simulator.data, env._markers())
        sample, cloud = timed(sample_farthest, points, CLOUD_POINTS)
        observation = {"point_cloud": cloud[None], "agent_pos": observation["agent_pos"].reshape(1, -1)}
        to_tensors, batch = timed(preprocess_observation, observation)
        pre, batch = timed(preprocess, batch)
        act, normalised = timed(policy.select_action, batch)
        post, _ = timed(postprocess, normalised)
        row = (simulate, casts[-1], capture - casts[-1], sample, to_tensors, pre, act, act, post)
        for name, milliseconds in zip(names, row, strict=False):
            if name not in ("plan", "queue") or (name == "plan") == plans:
                stages[name].append(milliseconds)
        stages["step"].append(simulate + capture + sample + to_tensors + pre + act + post)
    warm_up = policy.config.n_action_steps
    return {name: milliseconds[1 if name == "plan" else warm_up :] for name, milliseconds in stages.items()}


def unit_statistics() -> dict[str, dict[str, torch.Tensor]]:
    """Statistics of a dataset that is normalised already."""
    return {
        key: {"min": -torch.ones(size), "max": torch.ones(size)}
        for key, size in ((OBS_POINT_CLOUD, 3), ("observation.state", N_STATES), ("action", N_ACTIONS))
    }


if __name__ == "__main__":
    main()
