"""Kills a training at random moments, also while it writes a checkpoint, and resumes it each time.

    python benchmarks/kills.py --kills=20

It makes a small random dataset, trains once without a stop and once with `kill -9` at random moments, and compares the
last checkpoints' weights, averages, AdamW's moments and random states bit for bit.
"""

import argparse
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors.torch import load_file

import lerobot_policy_uca_flow  # noqa: F401 (shortens torchcodec's page of warnings)

FILES = (
    "pretrained_model/model.safetensors",
    "training_state/optimizer_state.safetensors",
    "training_state/rng_state.safetensors",
)


def write_dataset(root: Path) -> None:
    """Three episodes of random numbers."""
    shapes = {"observation.point_cloud": (32, 3), "observation.state": (9,), "action": (4,)}
    features = {key: {"dtype": "float32", "shape": shape, "names": None} for key, shape in shapes.items()}
    dataset = LeRobotDataset.create("local/kills", fps=10, features=features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for _ in range(3):
        for _ in range(20):
            frame = {key: rng.normal(size=shape).astype(np.float32) for key, shape in shapes.items()}
            dataset.add_frame({**frame, "task": "none"})
        dataset.save_episode()
    dataset.finalize()


def command(data: Path, output: Path, steps: int) -> list[str]:
    """Go on from the last checkpoint if there is one."""
    last = output / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    program = str(Path(sys.executable).with_name("lerobot-train"))
    if last.exists():
        return [program, f"--config_path={last}", "--resume=true"]
    return [
        *(program, "--policy.type=uca_flow", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.dim=16"),
        *("--policy.n_layers=1", "--policy.n_heads=2", "--batch_size=8", f"--steps={steps}", "--save_freq=2"),
        *("--dataset.repo_id=local/kills", f"--dataset.root={data}", f"--output_dir={output}"),
    ]


def is_writing(output: Path) -> bool:
    """Whether a checkpoint is being written."""
    return any(output.glob("checkpoints/.*.unfinished-*"))


def train_with_kills(data: Path, output: Path, steps: int, n_kills: int, rng: np.random.Generator) -> tuple[int, int]:
    """The kills and, of them, those while a checkpoint was written."""
    killed = killed_writing = 0
    while True:
        if not (output / "checkpoints" / "last").exists():  # killed before the first one: LeRobot wants a new folder
            shutil.rmtree(output, ignore_errors=True)
        process = subprocess.Popen(command(data, output, steps), stderr=subprocess.PIPE, stdout=subprocess.DEVNULL)
        assert process.stderr is not None
        wanted, seen = int(rng.integers(1, 9)), 0
        for line in process.stderr:
            seen += b"Checkpoint policy after step" in line
            if killed < n_kills and seen >= wanted:
                time.sleep(rng.random() * 0.05)  # a moment within or after the writing
                killed += 1
                killed_writing += is_writing(output)
                process.kill()
                break
        if process.wait() == 0:
            return killed, killed_writing
        if process.returncode != -signal.SIGKILL:
            raise SystemExit(f"The training ended with exit code {process.returncode}.")


def main() -> None:
    """Print what was killed and what came out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_dataset(folder / "data")
        subprocess.run(command(folder / "data", folder / "unbroken", args.steps), check=True, capture_output=True)
        rng = np.random.default_rng(args.seed)
        kills = train_with_kills(folder / "data", folder / "killed", args.steps, args.kills, rng)
        print(f"{kills[0]} kills, {kills[1]} of them while a checkpoint was written")
        last = Path("checkpoints", "last")
        for file in FILES:
            one, other = (load_file(folder / run / last / file) for run in ("unbroken", "killed"))
            print(f"{file}: {'equal' if all(torch.equal(one[key], other[key]) for key in one) else 'DIFFERENT'}")


if __name__ == "__main__":
    main()
