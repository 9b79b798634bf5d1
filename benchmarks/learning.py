"""Train and evaluate a configuration on a task: a row of a CSV file for each seed.

python benchmarks/learning.py results.csv --task=dial-turn --steps=600 --seeds 1 2
python benchmarks/learning.py results.csv --task=dial-turn --seeds 1 2 --name=fast -- --policy.optimizer_lr=1e-3
python benchmarks/learning.py results.csv --env=adroit_pointcloud --expert=door.npz --task=door --steps=1200 --seeds 1

What follows `--` goes to lerobot-train. Missing demonstrations are collected. Evaluation is lerobot-eval's, with its
seeds, but without videos. An existing row is not repeated, so a killed comparison continues where it was.
"""

import argparse
import csv
import logging
import shutil
import subprocess
import sys
import time
from pathlib import Path

import torch
from common import PROVENANCE, provenance, read_rows
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env, make_env_pre_post_processors
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.scripts.lerobot_eval import eval_policy_all
from lerobot.utils.random_utils import set_seed

OUTPUT = Path("outputs/learning")
IDENTITY = ("name", "task", "steps", "training_seed", "first_eval_seed", "episodes", "arguments")
MEASURED = ("success_percent", "training_minutes", "evaluation_minutes")


def main() -> None:
    """Add the rows that are missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="CSV file to add rows to")
    parser.add_argument("--env", default="metaworld_pointcloud")
    parser.add_argument("--task", required=True)
    parser.add_argument("--expert", help="who demonstrates, as for lerobot-uca-collect")
    parser.add_argument("--name", default="small", help="what the rows call this configuration")
    parser.add_argument("--config", default="configs/uca_flow_small.yaml")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2], help="seeds of training")
    parser.add_argument("--n_episodes", type=int, default=50)
    parser.add_argument("--first_eval_seed", type=int, default=1000, help="seed of the first evaluation episode")
    end = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    args = parser.parse_args(sys.argv[1:end])
    for_training = sys.argv[end + 1 :]
    logging.disable(logging.INFO)
    for seed in args.seeds:
        values = (args.name, args.task, args.steps, seed, args.first_eval_seed, args.n_episodes)
        row = dict(zip(IDENTITY, (*map(str, values), " ".join([args.config, *for_training])), strict=True))
        if any(row.items() <= known.items() for known in read_rows(args.results)):
            print("there:", row)
            continue
        dataset = collect(args.env, args.task, args.expert)
        training = OUTPUT / f"{args.task}-{args.name}-{args.steps}-{seed}"
        start = time.monotonic()
        checkpoint = train(args.config, dataset, training, [f"--steps={args.steps}", f"--seed={seed}", *for_training])
        trained = time.monotonic()
        env_config = EnvConfig.get_choice_class(args.env)(task=args.task)
        success = evaluate(checkpoint, env_config, args.n_episodes, args.first_eval_seed)
        minutes = ((trained - start) / 60, (time.monotonic() - trained) / 60)
        row |= dict(zip(MEASURED, (f"{success:.0f}", *(f"{value:.1f}" for value in minutes)), strict=True))
        row |= provenance()
        add(args.results, row)
        print(row, flush=True)


def collect(env: str, task: str, expert: str | None) -> Path:
    """Ten demonstrations, made if they are not there."""
    dataset = OUTPUT / "datasets" / task
    if not dataset.exists():
        arguments = [f"--env.type={env}", f"--env.task={task}", f"--repo_id=local/{task}", f"--root={dataset}"]
        run("lerobot-uca-collect", *arguments, *([f"--expert={expert}"] if expert else []))
    return dataset


def train(config: str, dataset: Path, training: Path, arguments: list[str]) -> Path:
    """The checkpoint of a new training."""
    shutil.rmtree(training, ignore_errors=True)
    source = [f"--dataset.repo_id=local/{dataset.name}", f"--dataset.root={dataset}", f"--output_dir={training}"]
    run("lerobot-train", f"--config_path={config}", *source, *arguments)
    return training / "checkpoints" / "last" / "pretrained_model"


def evaluate(checkpoint: Path, env_config: EnvConfig, n_episodes: int, first_seed: int) -> float:
    """The success rate [%] of a policy."""
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    set_seed(first_seed)
    policy = make_policy(config, env_cfg=env_config).eval()
    envs = make_env(env_config, n_envs=2, use_async_envs=True)
    try:
        with torch.no_grad():
            info = eval_policy_all(
                envs,
                policy,
                *make_env_pre_post_processors(env_cfg=env_config, policy_cfg=config),
                *make_pre_post_processors(config, pretrained_path=str(checkpoint)),
                n_episodes=n_episodes,
                start_seed=first_seed,
            )
    finally:
        for tasks in envs.values():
            for env in tasks.values():
                env.close()
    return float(info["overall"]["pc_success"])


def run(program: str, *arguments: str) -> None:
    """Run a command of this environment; end if it fails."""
    if subprocess.run([Path(sys.executable).with_name(program), *arguments], check=False).returncode:
        sys.exit(f"error: {program} failed")


def add(path: Path, row: dict[str, str]) -> None:
    """Write the rows of a CSV file and one more, whole or not at all."""
    unfinished = path.with_suffix(".unfinished")
    with unfinished.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*IDENTITY, *MEASURED, *PROVENANCE], lineterminator="\n")
        writer.writeheader()
        writer.writerows([*read_rows(path), row])
    unfinished.replace(path)


if __name__ == "__main__":
    main()
