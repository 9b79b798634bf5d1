"""Evaluation episodes by lerobot-eval, also of an earlier commit, and by the benchmark: the same, in one run.

python benchmarks/evaluation.py outputs/dial-turn/training/checkpoints/last/pretrained_model --task=dial-turn \
    --before=../at_232c5f6

All use two processes for simulation: LeRobot's loop steps an environment in each and plans in a third; the benchmark
runs half of the episodes in each. Seeds and noise are the same. Two times are given, each with its ratio to the first
row's: of the whole command, and after its modules are loaded, as in a cell, which evaluates six times.
"""

import argparse
import json
import logging
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import torch
from common import print_provenance
from lerobot.envs.configs import EnvConfig

from lerobot_uca.protocol.evaluation import PolicyPlan, run_episodes

N_PROCESSES = 2
FIRST_SEED = 20_000_000
BY_LEROBOT = Path(__file__).with_name("lerobot_evaluation.py").resolve()


class Timed(NamedTuple):
    """An evaluation's result."""

    whole: float  # [s]
    loaded: float  # [s], without loading Python's modules
    successes: dict[int, bool]


def main() -> None:
    """Print a row for each way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="that both commits can read")
    parser.add_argument("--env", default="metaworld_pointcloud")
    parser.add_argument("--task", required=True)
    parser.add_argument("--n_episodes", type=int, default=50)
    parser.add_argument("--before", type=Path, help="checkout of an earlier commit, with a .venv")
    args = parser.parse_args()
    print_provenance()
    print(f"{'':>26}{'seconds':>9}{'ratio':>7}{'loaded':>8}{'ratio':>7}{'successes':>11}")
    first: Timed | None = None
    ways = {"lerobot-eval": (Path(sys.executable), 10), "the same without videos": (Path(sys.executable), 0)}
    if args.before:
        at = args.before.absolute()
        print(f"before: at commit {git_commit(at)}")
        ways = {"before: lerobot-eval": (at / ".venv" / "bin" / "python", 10), **ways}
    for name, (python, n_videos) in ways.items():
        result = by_lerobot(args, python, n_videos)
        first = first or result
        show(name, result, first)
    assert first is not None
    show("benchmark", by_benchmark(args), first)


def show(name: str, result: Timed, first: Timed) -> None:
    """Print a row."""
    row = (result.whole, first.whole / result.whole, result.loaded, first.loaded / result.loaded)
    print(f"{name:>26}" + "{:9.1f}{:7.2f}{:8.1f}{:7.2f}".format(*row) + f"{sum(result.successes.values()):11d}")
    different = [seed for seed, success in result.successes.items() if success != first.successes[seed]]
    if different:
        print(f"{'':>26} {len(different)} other successes than in the first row: episodes {different}")
    sys.stdout.flush()


def by_lerobot(args: argparse.Namespace, python: Path, n_videos: int) -> Timed:
    """LeRobot's loop, in a process of some checkout's Python."""
    begin = time.perf_counter()
    options = [f"--{name}={getattr(args, name)}" for name in ("env", "task", "n_episodes")]
    command = [python, BY_LEROBOT, args.checkpoint, *options, f"--first_seed={FIRST_SEED}", f"--videos={n_videos}"]
    ended = subprocess.run(command, check=False, capture_output=True, text=True)
    if ended.returncode:
        sys.exit(ended.stderr)
    result = json.loads(ended.stdout.splitlines()[-1])
    successes = {int(seed): success for seed, success in result["successes"].items()}
    return Timed(time.perf_counter() - begin, result["seconds"], successes)


def by_benchmark(args: argparse.Namespace) -> Timed:
    """The benchmark's loop, as two cells run side by side."""
    begin = time.perf_counter()
    seeds = range(FIRST_SEED, FIRST_SEED + args.n_episodes)
    with ProcessPoolExecutor(N_PROCESSES, mp_context=get_context("spawn")) as pool:
        parts = [pool.submit(_run_part, args, seeds[index::N_PROCESSES]) for index in range(N_PROCESSES)]
        results = [part.result() for part in parts]
    successes = {seed: success for result in results for seed, success in result.successes.items()}
    return Timed(time.perf_counter() - begin, max(result.loaded for result in results), dict(sorted(successes.items())))


def _run_part(args: argparse.Namespace, seeds: range) -> Timed:
    begin = time.perf_counter()
    logging.disable(logging.INFO)
    torch.set_num_threads(1)
    plan = PolicyPlan.from_checkpoint(args.checkpoint)
    env_config: Any = EnvConfig.get_choice_class(args.env)(task=args.task)
    env_config.n_points = plan.config.n_points or env_config.n_points
    env_config.observation = plan.config.observation
    episodes = run_episodes(env_config.env_factory(args.task), plan.config, plan, seeds, n_envs=10)
    successes = {episode.seed: episode.success for episode in episodes}
    seconds = time.perf_counter() - begin
    return Timed(seconds, seconds, successes)


def git_commit(checkout: Path) -> str:
    """The commit that is checked out."""
    git = ["git", "-C", str(checkout), "describe", "--always", "--dirty=+"]
    return subprocess.run(git, check=True, capture_output=True, text=True).stdout.strip()


if __name__ == "__main__":
    main()
