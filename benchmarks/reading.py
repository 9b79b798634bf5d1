"""Milliseconds to read one sample of a LeRobot dataset: stock reading against batched, one process, same indices.

python benchmarks/reading.py                      # 10 episodes x 200 frames x 512 points, as Meta-World demonstrations
python benchmarks/reading.py --size=dp3           # 40 episodes x 400 frames x 1024 points, as DP3's real-world data

A sample is a training window: two clouds, two states, four actions. The dataset is made of random numbers in a
temporary folder.
"""

import argparse
import resource
import tempfile
import time
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from common import print_provenance
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.utils import SuppressProgressBars
from torch.utils.data import DataLoader, Dataset

from lerobot_uca.data.batched_dataset import BatchedDataset
from lerobot_uca.features import OBS_POINT_CLOUD

FPS, BATCH_SIZE = 80, 128
SIZES = {"tiny": (2, 200, 32), "metaworld": (10, 200, 512), "dp3": (40, 400, 1024)}
"""Episodes, frames of each, points of each."""
WINDOWS = {
    OBS_POINT_CLOUD: [-1 / FPS, 0],
    "observation.state": [-1 / FPS, 0],
    "action": [-1 / FPS, 0, 1 / FPS, 2 / FPS],
}


def main() -> None:
    """Print times and ratios for each number of workers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", choices=SIZES, default="metaworld")
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 2], help="worker processes of the loader")
    args = parser.parse_args()
    n_episodes, length, n_points = SIZES[args.size]
    print_provenance()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "data"
        write(root, n_episodes, length, n_points)
        indices = np.random.default_rng(0).permutation(n_episodes * length).tolist()
        print(f"{n_episodes} episodes x {length} frames x {n_points} points, batches of {BATCH_SIZE}")
        for n_workers in args.workers:
            stock = measure(open_dataset(LeRobotDataset, root), indices, n_workers, n_batches=2)
            ours = measure(open_dataset(BatchedDataset, root), indices, n_workers, n_batches=len(indices) // BATCH_SIZE)
            print(
                f"{n_workers} workers: stock {stock[1]:7.3f} ms a sample, first batch {stock[0]:5.1f} s; "
                f"batched {ours[1]:6.3f} ms a sample, first batch {ours[0]:5.1f} s; ratio {stock[1] / ours[1]:.0f}"
            )
        print(f"peak memory of this process {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")


def measure(dataset: Dataset[Any], indices: list[int], n_workers: int, n_batches: int) -> tuple[float, float]:
    """Seconds to the first batch and, after it, milliseconds a sample (median over the batches without workers)."""
    loader = DataLoader(
        dataset,
        BATCH_SIZE,
        sampler=indices,
        num_workers=n_workers,
        multiprocessing_context="spawn" if n_workers else None,
    )
    start = time.perf_counter()
    batches = iter(loader)
    next(batches)
    first = time.perf_counter() - start
    times = list(seconds_each(islice(batches, n_batches - 1)))
    # With workers, batches arrive in bursts: only their mean says something.
    typical = np.mean(times) if n_workers else np.median(times)
    return first, 1e3 * float(typical) / BATCH_SIZE


def seconds_each(batches: Iterable[Any]) -> Iterator[float]:
    """Seconds until each batch arrives."""
    start = time.perf_counter()
    for _ in batches:
        now = time.perf_counter()
        yield now - start
        start = now


def open_dataset(kind: type[LeRobotDataset], root: Path) -> LeRobotDataset:
    """The dataset as training opens it."""
    return kind("benchmark/random", root=root, delta_timestamps=WINDOWS)


def write(root: Path, n_episodes: int, length: int, n_points: int) -> None:
    """A dataset of random numbers."""
    rng = np.random.default_rng(0)
    features: dict[str, dict[str, Any]] = {
        OBS_POINT_CLOUD: {"dtype": "float32", "shape": (n_points, 3), "names": None},
        "observation.state": {"dtype": "float32", "shape": (9,), "names": None},
        "action": {"dtype": "float32", "shape": (4,), "names": None},
    }
    dataset = LeRobotDataset.create("benchmark/random", fps=FPS, features=features, root=root, use_videos=False)
    for _ in range(n_episodes):
        for _ in range(length):
            frame = {key: rng.random(feature["shape"], dtype=np.float32) for key, feature in features.items()}
            dataset.add_frame({**frame, "task": "none"})
        with SuppressProgressBars():
            dataset.save_episode()
    dataset.finalize()


if __name__ == "__main__":
    main()
