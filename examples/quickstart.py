"""Make an evaluated policy from nothing: the public commands, in order, each printed so that it can be repeated.

Complete results are reused; remove outputs/quickstart to start over.
"""

import argparse
import json
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

TASK = "drawer-close"
N_EPISODES = 50
OUTPUT = Path("outputs/quickstart")
DATASET, TRAINING, EVALUATION = OUTPUT / "dataset", OUTPUT / "training", OUTPUT / "evaluation"
CHECKPOINT = TRAINING / "checkpoints" / "last" / "pretrained_model"
PICTURE = OUTPUT / "prediction.png"
ENVIRONMENT = f"--env.type=metaworld_pointcloud --env.task={TASK}"


class Step(NamedTuple):
    """A command, its duration on two cores, its output, and the file that exists when it is complete."""

    command: str
    takes: str
    output: Path
    complete: Path


STEPS = (
    Step(
        f"lerobot-uca-collect {ENVIRONMENT} --repo_id=local/{TASK} --root={DATASET}",
        "about 15 seconds",
        DATASET,
        DATASET / "meta" / "info.json",
    ),
    Step(
        f"lerobot-train --config_path=uca_flow_small --dataset.repo_id=local/{TASK} "
        f"--dataset.root={DATASET} --output_dir={TRAINING}",
        "about 70 seconds; longer without bfloat16 instructions",
        TRAINING,
        CHECKPOINT / "model.safetensors",
    ),
    Step(
        f"lerobot-eval --policy.path={CHECKPOINT} {ENVIRONMENT} --eval.n_episodes={N_EPISODES} --eval.batch_size=2 "
        f"--output_dir={EVALUATION}",
        "about 30 seconds",
        EVALUATION,
        EVALUATION / "eval_info.json",
    ),
    Step(
        f"python examples/draw_prediction.py --checkpoint={CHECKPOINT} --task={TASK} --output={PICTURE}",
        "about 10 seconds",
        PICTURE,
        PICTURE,
    ),
)


def main() -> None:
    """Run the steps that are not complete, then report."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    print(f"UCA-Flow quickstart: Meta-World's {TASK}. To repeat a command: source .venv/bin/activate")
    for index, step in enumerate(STEPS):
        print(f"\n$ {step.command}")
        if step.complete.exists():
            print(f"  (complete: {step.complete})")
            continue
        print(f"  ({step.takes})", flush=True)
        for outdated in STEPS[index:]:  # remains of a killed run, and results of older inputs
            remove(outdated.output)
        run(step.command)
    report()


def remove(path: Path) -> None:
    """Remove a file or folder if it is there."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def run(command: str) -> None:
    """Run a command of this interpreter's environment, whether or not it is activated."""
    program, *arguments = shlex.split(command)
    start = time.monotonic()
    result = subprocess.run([Path(sys.executable).with_name(program), *arguments], check=False)
    if result.returncode:
        sys.exit(f"error: the command above ended with exit code {result.returncode}")
    print(f"  (took {time.monotonic() - start:.0f} s)")


def report() -> None:
    """Print the result as a table."""
    overall = json.loads((EVALUATION / "eval_info.json").read_text())["overall"]
    rows = {
        "task": f"Meta-World {TASK}",
        "success": f"{overall['pc_success']:.0f} % of {overall['n_episodes']} episodes",
        "evaluation": f"{overall['eval_ep_s']:.1f} s an episode",
        "video": f"{overall['video_paths'][0]} and {len(overall['video_paths']) - 1} more",
        "picture": str(PICTURE),
        "checkpoint": str(CHECKPOINT),
    }
    width = max(map(len, rows))
    print("\n" + "\n".join(f"{name:>{width}}  {value}" for name, value in rows.items()))


if __name__ == "__main__":
    main()
