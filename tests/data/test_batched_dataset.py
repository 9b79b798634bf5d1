"""Batched reading gives what stock reading gives, bit for bit and key for key."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets import EpisodeAwareSampler, compute_sampler_state
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tests.builders import N_ACTIONS, write_dataset
from torch.utils.data import DataLoader, Subset, default_collate

from lerobot_uca.data import batched_dataset
from lerobot_uca.data.batched_dataset import BatchedDataset
from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD

WINDOWS = {
    OBS_POINT_CLOUD: [-1 / 80, 0],
    "observation.state": [-1 / 80, 0],
    "action": [-1 / 80, 0, 1 / 80, 2 / 80],
}


def open_dataset(root, **options):
    return BatchedDataset("test/random", root=root, **options)


def assert_equal_batches(got, expected):
    assert list(got) == list(expected)
    for key, value in expected.items():
        if isinstance(value, torch.Tensor):
            assert got[key].dtype == value.dtype, key
            assert torch.equal(got[key], value), key
        else:
            assert got[key] == value, key


@pytest.mark.parametrize("episodes", [None, [1], [0, 2]])
@pytest.mark.parametrize("windows", [None, WINDOWS])
def test_every_sample_equals_stock_reading(dataset_root, episodes, windows):
    dataset = open_dataset(dataset_root, episodes=episodes, delta_timestamps=windows)
    indices = list(range(len(dataset)))
    stock = [dataset[index] for index in indices]
    batched = dataset.__getitems__(indices)
    for got, expected in zip(batched, stock, strict=True):
        assert_equal_batches(got, expected)
    assert_equal_batches(default_collate(batched), default_collate(stock))


def test_a_dataloader_reads_the_same(dataset_root):
    dataset = open_dataset(dataset_root, delta_timestamps=WINDOWS)
    stock = [
        default_collate([dataset[i] for i in range(n, min(n + 5, len(dataset)))]) for n in range(0, len(dataset), 5)
    ]
    for got, expected in zip(DataLoader(dataset, batch_size=5), stock, strict=True):
        assert_equal_batches(got, expected)


WORKERS = """
import sys
import torch
from torch.utils.data import DataLoader, default_collate, get_worker_info

def collate(samples):
    # Runs in a worker. Nothing registers the plugin there: the dataset itself must bring batched reading along.
    dataset = get_worker_info().dataset
    columns = dataset._decoded
    batched = hasattr(type(dataset), "__getitems__") and columns is not None
    shared = all(tensor.is_shared() for tensor in columns.tensors.values())
    return default_collate(samples), batched, shared

if __name__ == "__main__":
    from lerobot_uca.data.batched_dataset import BatchedDataset

    root, context = sys.argv[1:]
    windows = {"observation.point_cloud": [-1 / 80, 0], "action": [0, 1 / 80]}
    dataset = BatchedDataset("test/random", root=root, delta_timestamps=windows)
    loader = DataLoader(dataset, batch_size=5, num_workers=2, multiprocessing_context=context, collate_fn=collate)
    for n, (batch, batched, shared) in enumerate(loader):
        assert batched
        assert shared or context == "fork"  # a forked worker decodes for itself
        stock = default_collate([dataset[i] for i in range(5 * n, min(5 * n + 5, len(dataset)))])
        assert all(torch.equal(batch[key], stock[key]) for key in stock if key != "task")
    print("read", n + 1)
"""


@pytest.mark.parametrize("context", ["spawn", "fork"])
def test_workers_read_in_batches_too(dataset_root, tmp_path, context):
    script = tmp_path / "workers.py"
    script.write_text(WORKERS)
    command = [sys.executable, str(script), str(dataset_root), context]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-3000:]
    assert "read 8" in result.stdout


def test_a_held_out_split_and_resumed_order_read_the_same(dataset_root):
    """lerobot-train makes them so: episodes of a split, and a sampler that starts in the middle of an epoch."""
    for episodes in ([0, 1], [2]):
        dataset = open_dataset(dataset_root, episodes=episodes, delta_timestamps=WINDOWS)
        sampler = EpisodeAwareSampler(
            dataset.meta.episodes["dataset_from_index"],
            dataset.meta.episodes["dataset_to_index"],
            episode_indices_to_use=dataset.episodes,
            shuffle=True,
            seed=0,
            absolute_to_relative_idx=dataset.absolute_to_relative_idx,
        )
        sampler.load_state_dict(compute_sampler_state(2, len(sampler), 4, 1))
        indices = list(sampler)
        assert len(indices) == len(sampler) - 8
        for got, index in zip(dataset.__getitems__(indices), indices, strict=True):
            assert_equal_batches(got, dataset[index])


def test_subsets_read_the_same(dataset_root):
    """LeRobot evaluates the held-out loss on a Subset."""
    dataset = open_dataset(dataset_root, delta_timestamps=WINDOWS)
    subset = Subset(dataset, [3, 1, 20])
    for got, index in zip(subset.__getitems__([0, 1, 2]), [3, 1, 20], strict=True):
        assert_equal_batches(got, dataset[index])


def test_rows_that_do_not_exist(dataset_root):
    dataset = open_dataset(dataset_root)
    with pytest.raises(IndexError):
        dataset.__getitems__([0, len(dataset)])
    assert_equal_batches(dataset.__getitems__([-1])[0], dataset[-1])


def test_a_dataset_above_the_size_limit_is_read_as_before(dataset_root, monkeypatch):
    monkeypatch.setattr(batched_dataset, "MAX_BYTES", 100)
    dataset = open_dataset(dataset_root, delta_timestamps=WINDOWS)
    assert_equal_batches(dataset.__getitems__([4])[0], dataset[4])
    assert dataset._decoded is None


def test_image_datasets_are_read_as_before(tmp_path):
    import numpy as np

    features = {
        "observation.images.top": {"dtype": "image", "shape": (8, 8, 3), "names": ["height", "width", "channels"]},
        "action": {"dtype": "float32", "shape": (N_ACTIONS,), "names": None},
    }
    dataset = LeRobotDataset.create("test/images", fps=10, features=features, root=tmp_path / "d", use_videos=False)
    for _ in range(4):
        picture = np.random.default_rng(0).integers(0, 255, (8, 8, 3), dtype=np.uint8)
        dataset.add_frame(
            {"observation.images.top": picture, "action": np.zeros(N_ACTIONS, np.float32), "task": "look"}
        )
    dataset.save_episode()
    dataset.finalize()
    dataset = BatchedDataset("test/images", root=tmp_path / "d")
    assert_equal_batches(dataset.__getitems__([2])[0], dataset[2])
    assert dataset._decoded is None


def test_other_number_types_keep_their_values(tmp_path):
    features = {
        "observation.state": {"dtype": "float32", "shape": (1,), "names": None},
        "action": {"dtype": "float32", "shape": (2,), "names": None},
        "observation.grid": {"dtype": "float32", "shape": (2, 3, 4), "names": None},
    }
    write_dataset(tmp_path / "d", features=features)
    dataset = open_dataset(tmp_path / "d", delta_timestamps={"observation.grid": [-1 / 80, 0]})
    for index in (0, 5, len(dataset) - 1):
        assert_equal_batches(dataset.__getitems__([index])[0], dataset[index])


# Datasets that are not whole -----------------------------------------------------------------------------------------


def rewrite(root: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    for file in (root / "data").glob("**/*.parquet"):
        pq.write_table(change(pq.read_table(file)), file)


def test_a_missing_column_is_named(dataset_root, tmp_path):
    root = shutil.copytree(dataset_root, tmp_path / "data")
    rewrite(root, lambda table: table.drop_columns(["observation.state"]))
    with pytest.raises(UserError, match=r"'observation.state' must have a value in each row"):
        open_dataset(root).__getitems__([0])


@pytest.mark.parametrize(
    ("change", "row"),
    [
        (lambda table: table.take([1, 0, *range(2, len(table))]), 0),
        (lambda table: table.take([*range(5), *range(6, len(table))]), 5),
        (lambda table: table.slice(0, len(table) - 1), 38),
    ],
)
def test_rows_out_of_order_and_missing_rows_are_refused(dataset_root, tmp_path, change, row):
    root = shutil.copytree(dataset_root, tmp_path / "data")
    rewrite(root, change)
    with pytest.raises(UserError, match=f"must be in the order of their index, .* row {row} is another one"):
        open_dataset(root).__getitems__([0])
