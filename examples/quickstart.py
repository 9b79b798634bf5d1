"""From nothing to an evaluated policy: the public commands, in order, each printed so that it can be repeated.

What is complete is reused; remove outputs/quickstart to start over.
"""

import json
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

TASK = "drawer-close"
N_EPISODES = 50
OUTPUT = Path("outputs/quickstart")
DATASET, TRAINING, EVALUATION = OUTPUT / "dataset", OUTPUT / "training", OUTPUT / "evaluation"
CHECKPOINT = TRAINING / "checkpoints" / "last" / "pretrained_model"
PICTURE = OUTPUT / "prediction.png"
ENVIRONMENT = f"--env.type=metaworld_pointcloud --env.task={TASK}"


def main() -> None:
    """Collect, train, evaluate, draw, report."""
    OUTPUT.mkdir(parents=True, exist_ok=True)
    print(f"UCA-Flow quickstart: {TASK}. Everything goes to {OUTPUT}.")
    run(
        f"lerobot-uca-collect {ENVIRONMENT} --repo_id=local/{TASK} --root={DATASET}",
        complete=DATASET / "meta" / "info.json",
    )
    run(
        f"lerobot-train --config_path=configs/uca_flow_small.yaml --dataset.repo_id=local/{TASK} "
        f"--dataset.root={DATASET} --output_dir={TRAINING}",
        complete=CHECKPOINT / "model.safetensors",
        start_over=TRAINING,
    )
    run(
        f"lerobot-eval --policy.path={CHECKPOINT} {ENVIRONMENT} --eval.n_episodes={N_EPISODES} --eval.batch_size=2 "
        f"--output_dir={EVALUATION}",
        complete=EVALUATION / "eval_info.json",
    )
    run(
        f"python examples/draw_prediction.py --checkpoint={CHECKPOINT} --task={TASK} --output={PICTURE}",
        complete=PICTURE,
    )
    report()


def run(command: str, *, complete: Path, start_over: Path | None = None) -> None:
    """Run a command unless the file it ends with is there. `start_over` is removed first if it was left half-done."""
    print(f"\n$ {command}", flush=True)
    if complete.exists():
        print(f"  (complete: {complete})")
        return
    if start_over is not None:
        shutil.rmtree(start_over, ignore_errors=True)
    program, *arguments = shlex.split(command)
    start = time.monotonic()
    # The commands of this interpreter's environment, whether or not it is activated.
    result = subprocess.run([Path(sys.executable).with_name(program), *arguments], check=False)
    if result.returncode:
        sys.exit(f"error: the command above ended with exit code {result.returncode}")
    print(f"  ({time.monotonic() - start:.0f} s)")


def report() -> None:
    """Print the result as a table."""
    overall = json.loads((EVALUATION / "eval_info.json").read_text())["overall"]
    rows = {
        "task": f"Meta-World {TASK}",
        "success": f"{overall['pc_success']:.0f} % of {overall['n_episodes']} episodes",
        "evaluation": f"{overall['eval_ep_s']:.1f} s an episode",
        "videos": str(Path(overall["video_paths"][0]).parent),
        "picture": str(PICTURE),
    }
    width = max(map(len, rows))
    print("\n" + "\n".join(f"{name:>{width}}  {value}" for name, value in rows.items()))


if __name__ == "__main__":
    main()
