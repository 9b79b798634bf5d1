"""Evaluation episodes by lerobot-eval's loop and by the benchmark's, on the same seeds with the same noise, in one run.

python benchmarks/evaluation.py outputs/dial-turn/training/checkpoints/last/pretrained_model --task=dial-turn

Both use two processes: LeRobot's loop steps two environments, each in its own, and plans in a third; the benchmark's
runs half of the episodes in each. Rates are episodes a minute, starting the processes included; the ratio is to
LeRobot's with videos of ten episodes, as lerobot-eval makes them. Successes must be equal.
"""

import argparse
import logging
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from common import print_provenance
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env
from lerobot.scripts.lerobot_eval import eval_policy_all
from torch import Tensor

from lerobot_uca.protocol.evaluation import Episode, PolicyPlan, run_episodes

N_PROCESSES = 2
FIRST_SEED = 20_000_000


def main() -> None:
    """Print a row for each way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--env", default="metaworld_pointcloud")
    parser.add_argument("--task", required=True)
    parser.add_argument("--n_episodes", type=int, default=20)
    args = parser.parse_args()
    logging.disable(logging.INFO)
    torch.set_num_threads(1)
    env_config = EnvConfig.get_choice_class(args.env)(task=args.task)
    seeds = range(FIRST_SEED, FIRST_SEED + args.n_episodes)
    ways: dict[str, Callable[[], dict[int, bool]]] = {
        "lerobot-eval": lambda: by_lerobot(args.checkpoint, env_config, seeds, n_videos=10),
        "lerobot-eval, no videos": lambda: by_lerobot(args.checkpoint, env_config, seeds, n_videos=0),
        "benchmark": lambda: by_benchmark(args.checkpoint, env_config, seeds),
    }
    print_provenance()
    print(f"{'':>24}{'minutes':>9}{'episodes/min':>14}{'ratio':>7}{'successes':>11}")
    slowest, expected = None, None
    for name, way in ways.items():
        begin = time.perf_counter()
        successes = way()
        minutes = (time.perf_counter() - begin) / 60
        slowest, expected = slowest or minutes, expected or successes
        row = (minutes, len(seeds) / minutes, slowest / minutes, sum(successes.values()))
        print(f"{name:>24}" + "{:9.2f}{:14.1f}{:7.2f}{:11d}".format(*row), flush=True)
        different = [seed for seed in seeds if successes[seed] != expected[seed]]
        if different:
            print(f"{'':>24} other successes than lerobot-eval in episodes {different}")


def by_lerobot(checkpoint: Path, env_config: Any, seeds: range, *, n_videos: int) -> dict[int, bool]:
    """LeRobot's loop, with the noise that each of our episodes draws."""
    plan = PolicyPlan.from_checkpoint(checkpoint)
    _draw_as_ours(plan.policy, seeds)
    envs = make_env(env_config, n_envs=N_PROCESSES, use_async_envs=True)
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        info = eval_policy_all(
            envs,
            plan.policy,
            *(same, same),
            *(plan.preprocess, plan.postprocess),
            n_episodes=len(seeds),
            start_seed=seeds.start,
            max_episodes_rendered=n_videos,
            videos_dir=Path(folder),
        )
        for tasks in envs.values():
            for env in tasks.values():
                env.close()
    successes = [success for task in info["per_task"] for success in task["metrics"]["successes"]]
    return dict(zip(seeds, map(bool, successes), strict=True))


def _draw_as_ours(policy: Any, seeds: range) -> None:
    config, reset, select_action = policy.config, policy.reset, policy.select_action
    generators: list[torch.Generator] = []
    waiting, n_calls = list(seeds), 0

    def reset_and_seed() -> None:
        nonlocal n_calls
        n_calls = 0
        batch = [waiting.pop(0) for _ in range(min(N_PROCESSES, len(waiting)))]
        generators[:] = [torch.Generator().manual_seed(seed) for seed in batch]
        reset()

    def select_with_noise(batch: dict[str, Tensor]) -> Tensor:
        nonlocal n_calls
        n_calls += 1
        if (n_calls - 1) % config.n_action_steps:
            return select_action(batch)
        shape = (config.horizon, config.n_actions)
        return select_action(batch, noise=torch.stack([torch.randn(shape, generator=each) for each in generators]))

    policy.reset, policy.select_action = reset_and_seed, select_with_noise


def by_benchmark(checkpoint: Path, env_config: Any, seeds: range) -> dict[int, bool]:
    """The benchmark's loop, as two cells run side by side."""
    with ProcessPoolExecutor(N_PROCESSES, mp_context=get_context("spawn")) as pool:
        parts = [seeds[index::N_PROCESSES] for index in range(N_PROCESSES)]
        results = pool.map(_run_part, *zip(*((checkpoint, env_config, part) for part in parts), strict=True))
        return {episode.seed: episode.success for episodes in results for episode in episodes}


def _run_part(checkpoint: Path, env_config: Any, seeds: range) -> list[Episode]:
    torch.set_num_threads(1)
    plan = PolicyPlan.from_checkpoint(checkpoint)
    env_config.n_points = plan.config.n_points or env_config.n_points
    return list(run_episodes(env_config.env_factory(env_config.task), plan.config, plan, seeds, n_envs=10))


def same(values: Any) -> Any:
    """An environment's processing: none."""
    return values


if __name__ == "__main__":
    main()
