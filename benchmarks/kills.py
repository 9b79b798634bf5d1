"""Kills commands at random moments with `kill -9`, and starts them again.

    python benchmarks/kills.py --kills=20
    python benchmarks/kills.py --what=collect --kills=5
    python benchmarks/kills.py --what=convert --kills=5
    python benchmarks/kills.py --what=benchmark --kills=10

training: a small one, once without a stop and once with kills, also while it writes a checkpoint, and resumed after
each. The last checkpoints' weights, averages, AdamW's moments and random states are compared bit for bit.
collect, convert: after each kill the dataset's folder is absent and all worker processes have ended; a last run, not
killed, leaves the same frames as the one before the kills, and nothing beside them.
benchmark: a run of tiny cells, once without a stop and once with kills, started again after each. After each kill all
processes have ended, and no file of a finished cell was written again; in the end the rows of all episodes are equal.
"""

import argparse
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import psutil
import torch
import yaml
from common import print_provenance
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors.torch import load_file

from lerobot_uca.protocol.folder import RunFolder
from lerobot_uca.protocol.rows import Row

FILES = (
    "pretrained_model/model.safetensors",
    "training_state/optimizer_state.safetensors",
    "training_state/rng_state.safetensors",
)

SETTING = {
    "description": "as small as can be",
    "batch_size": 4,
    "lengths": {"metaworld": {"steps": 60, "evaluations": 3}},
    "demonstrations": 1,
    "interim_episodes": 1,
    "final_episodes": 2,
    "policy": {"device": "cpu", "n_points": 16, "inference": "eager", "dim": 16, "n_layers": 1, "n_heads": 2},
}
"""Of the benchmark's cells."""


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


def collect_command(root: Path) -> list[str]:
    """Two episodes of a task, by two worker processes."""
    program = str(Path(sys.executable).with_name("lerobot-uca-collect"))
    env = ("--env.type=metaworld_pointcloud", "--env.task=drawer-close,door-lock", "--env.n_points=32")
    return [program, *env, "--repo_id=local/killed", f"--root={root}", "--n_episodes=1"]


def convert_command(root: Path) -> list[str]:
    """The clouds of another dataset, sampled by two worker processes."""
    program = str(Path(sys.executable).with_name("lerobot-uca-convert"))
    options = ("--repo_id=local/killed", "--n_points=16", "--num_workers=2")
    return [program, f"--source={root.parents[1] / 'data'}", f"--root={root}", *options]


def frames(root: Path) -> list[dict[str, torch.Tensor]]:
    """All frames of a dataset."""
    dataset = LeRobotDataset("local/killed", root=root)
    return [{key: value for key, value in frame.items() if key != "task"} for frame in dataset]


class Kills:
    """Kills of a command and all that has started it, counted."""

    def __init__(self) -> None:
        self.n, self.n_children, self.n_orphans = 0, 0, 0

    def run(self, command: list[str], seconds: float) -> bool:
        """Start a command and kill it after so many seconds. Returns False if it ended before."""
        process = psutil.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        try:
            returncode = process.wait(timeout=seconds)
        except psutil.TimeoutExpired:
            children = process.children(recursive=True)
            process.kill()
            process.wait()
            self.n += 1
            self.n_children += len(children)
            self.n_orphans += len(psutil.wait_procs(children, timeout=60)[1])
            return True
        if returncode:
            raise SystemExit(f"{shlex.join(command)} ended with exit code {returncode}.")
        return False

    def __str__(self) -> str:
        return f"its processes at the {self.n} kills: {self.n_children}; of them alive a minute later: {self.n_orphans}"


def kill_writer(make: Callable[[Path], list[str]], folder: Path, n_kills: int, rng: np.random.Generator) -> None:
    """Print what `n_kills` kills of a command that writes one dataset leave."""
    begin = time.monotonic()
    subprocess.run(make(folder / "unbroken" / "data"), check=True, capture_output=True)
    seconds = time.monotonic() - begin
    kills, root, absent, killed_writing = Kills(), folder / "killed" / "data", 0, 0
    while kills.n < n_kills:
        begin = time.monotonic()
        if kills.run(make(root), seconds * (0.3 + 0.7 * rng.random())):
            killed_writing += any(root.parent.glob(".*.unfinished-*"))
            absent += not root.exists()
        else:
            seconds = time.monotonic() - begin  # the machine is less busy than it was
        shutil.rmtree(root, ignore_errors=True)
    subprocess.run(make(root), check=True, capture_output=True)
    left = sorted(path.name for path in root.parent.iterdir())
    pairs = zip(frames(folder / "unbroken" / "data"), frames(root), strict=True)
    equal = all(torch.equal(one[key], other[key]) for one, other in pairs for key in one)
    print(f"{n_kills} kills, {killed_writing} of them while the dataset was written; without a folder: {absent}")
    print(kills)
    print(f"left by the last run: {', '.join(left)}; its frames: {'equal' if equal else 'DIFFERENT'}")


def benchmark_command(setting: Path, output: Path, n_cells: int) -> list[str]:
    """Demonstrations, trainings and evaluations of a task with several seeds, one after the other."""
    program = str(Path(sys.executable).with_name("lerobot-uca-benchmark"))
    cells = ("--tasks=drawer-close", f"--seeds={','.join(map(str, range(n_cells)))}", "--parallel=1")
    return [program, "run", *cells, f"--setting={setting}", f"--output={output}"]


def rows(output: Path) -> list[Row]:
    """The results of all episodes, without the milliseconds that they took."""
    return [row._replace(ms=0) for row in RunFolder.open(output).read() if isinstance(row, Row)]


def finished_files(output: Path) -> dict[Path, int]:
    """When each file of each finished cell was written [ns]."""
    cells = [path.parent for path in output.glob("cells/*/*/*/*/cell.json")]
    return {path: path.lstat().st_mtime_ns for cell in cells for path in cell.rglob("*") if path.is_file()}


def kill_benchmark(folder: Path, n_kills: int, rng: np.random.Generator) -> None:
    """Print what a run that is killed `n_kills` times leaves."""
    setting, n_cells = folder / "tiny.yaml", 2 + n_kills // 2
    setting.write_text(yaml.safe_dump(SETTING))
    unbroken, killed = folder / "unbroken", folder / "killed"
    begin = time.monotonic()
    subprocess.run(benchmark_command(setting, unbroken, n_cells), check=True, capture_output=True)
    seconds = (time.monotonic() - begin) / n_cells
    kills, seen = Kills(), [finished_files(killed)]
    while kills.n < n_kills and kills.run(benchmark_command(setting, killed, n_cells), seconds * rng.random()):
        seen.append(finished_files(killed))
    n_finished = sum(path.name == "cell.json" for path in seen[-1])
    subprocess.run(benchmark_command(setting, killed, n_cells), check=True, capture_output=True)
    seen.append(finished_files(killed))
    changed = {path for old, new in pairwise(seen) for path in old if new.get(path) != old[path]}
    print(f"{kills.n} kills of a run of {n_cells} cells, {n_finished} of them finished at the last kill")
    print(kills)
    print(f"files of finished cells that were written again or removed: {len(changed)} of {len(seen[-1])}")
    equal = rows(unbroken) == rows(killed)
    print(f"{len(rows(killed))} episodes: {'equal' if equal else 'DIFFERENT'}")


def main() -> None:
    """Print what was killed and what came out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--what", choices=("training", "collect", "convert", "benchmark"), default="training")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    print_provenance()
    with tempfile.TemporaryDirectory() as name:
        folder, rng = Path(name), np.random.default_rng(args.seed)
        if args.what == "benchmark":
            kill_benchmark(folder, args.kills, rng)
            return
        write_dataset(folder / "data")
        if args.what != "training":
            commands = {"collect": collect_command, "convert": convert_command}
            kill_writer(commands[args.what], folder, args.kills, rng)
            return
        subprocess.run(command(folder / "data", folder / "unbroken", args.steps), check=True, capture_output=True)
        kills = train_with_kills(folder / "data", folder / "killed", args.steps, args.kills, rng)
        print(f"{kills[0]} kills, {kills[1]} of them while a checkpoint was written")
        last = Path("checkpoints", "last")
        for file in FILES:
            one, other = (load_file(folder / run / last / file) for run in ("unbroken", "killed"))
            print(f"{file}: {'equal' if all(torch.equal(one[key], other[key]) for key in one) else 'DIFFERENT'}")


if __name__ == "__main__":
    main()
