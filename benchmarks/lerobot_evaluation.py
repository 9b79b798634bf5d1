"""Evaluation episodes by lerobot-eval's loop, as JSON: {"seconds": ..., "successes": {seed: success}}.

python benchmarks/lerobot_evaluation.py CHECKPOINT --task=dial-turn --videos=10

For `evaluation.py`, which runs it for today's package and for an earlier commit's: it needs nothing but LeRobot and
the package's registered types. Each episode draws its noise from a generator seeded as the episode is.
"""

import argparse
import json
import logging
import tempfile
import time
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.scripts.lerobot_eval import eval_policy_all
from torch import Tensor

import lerobot_policy_uca_flow  # noqa: F401  (registers policies and environments)

N_ENVS = 2
"""Environments at once, each in its process: one a core."""


def main() -> None:
    """Print the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--env", default="metaworld_pointcloud")
    parser.add_argument("--task", required=True)
    parser.add_argument("--first_seed", type=int, default=20_000_000)
    parser.add_argument("--n_episodes", type=int, default=50)
    parser.add_argument("--videos", type=int, default=10, help="episodes of which lerobot-eval makes videos")
    args = parser.parse_args()
    logging.disable(logging.INFO)
    torch.set_num_threads(1)
    seeds = range(args.first_seed, args.first_seed + args.n_episodes)
    with redirect_stdout(None):
        result = evaluate(args.checkpoint, EnvConfig.get_choice_class(args.env)(task=args.task), seeds, args.videos)
    print(json.dumps(result))


def evaluate(checkpoint: Path, env_config: Any, seeds: range, n_videos: int) -> dict[str, Any]:
    """Seconds without loading Python's modules, and the success of each episode."""
    begin = time.perf_counter()
    config: Any = PreTrainedConfig.from_pretrained(checkpoint)
    config.inference = "eager"
    if hasattr(config, "observation"):  # not in the versions that --before compares with
        env_config.observation = config.observation
    policy_class: Any = get_policy_class(config.type)
    policy = policy_class.from_pretrained(checkpoint, config=config).eval()
    draw_by_episode(policy, seeds)
    envs = make_env(env_config, n_envs=N_ENVS, use_async_envs=True)
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        info = eval_policy_all(
            envs,
            policy,
            *(same, same),
            *make_pre_post_processors(config, pretrained_path=str(checkpoint)),
            n_episodes=len(seeds),
            start_seed=seeds.start,
            max_episodes_rendered=n_videos,
            videos_dir=Path(folder),
        )
    for tasks in envs.values():
        for env in tasks.values():
            env.close()
    successes = [bool(success) for task in info["per_task"] for success in task["metrics"]["successes"]]
    return {
        "seconds": time.perf_counter() - begin,
        "successes": dict(zip(seeds, successes, strict=True)),
    }


def draw_by_episode(policy: Any, seeds: range) -> None:
    """Let a policy draw an episode's noise from the episode's own generator, as the benchmark does."""
    config, reset, select_action = policy.config, policy.reset, policy.select_action
    generators: list[torch.Generator] = []
    waiting, n_calls = list(seeds), 0

    def reset_and_seed() -> None:
        nonlocal n_calls
        n_calls = 0
        batch, waiting[:] = waiting[:N_ENVS], waiting[N_ENVS:]
        batch += range(seeds.stop, seeds.stop + N_ENVS - len(batch))  # LeRobot runs all environments, also at the end
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


def same(values: Any) -> Any:
    """An environment's processing: none."""
    return values


if __name__ == "__main__":
    main()
