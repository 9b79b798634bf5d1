"""Batched reading gives what stock reading gives, bit for bit and key for key."""

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tests.conftest import N_ACTIONS, write_dataset
from torch.utils.data import DataLoader, Subset, default_collate

from lerobot_uca.data import reading
from lerobot_uca.features import OBS_POINT_CLOUD

WINDOWS = {
    OBS_POINT_CLOUD: [-1 / 80, 0],
    "observation.state": [-1 / 80, 0],
    "action": [-1 / 80, 0, 1 / 80, 2 / 80],
}


def open_dataset(root, **options):
    return LeRobotDataset("test/random", root=root, **options)


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


@pytest.mark.parametrize("num_workers", [0, 2])
def test_a_dataloader_reads_the_same(dataset_root, num_workers):
    dataset = open_dataset(dataset_root, delta_timestamps=WINDOWS)
    context = "spawn" if num_workers else None
    loader = DataLoader(dataset, batch_size=5, num_workers=num_workers, multiprocessing_context=context)
    stock = [
        default_collate([dataset[i] for i in range(n, min(n + 5, len(dataset)))]) for n in range(0, len(dataset), 5)
    ]
    for got, expected in zip(loader, stock, strict=True):
        assert_equal_batches(got, expected)


def test_subsets_read_the_same(dataset_root):
    """LeRobot evaluates the held-out loss on a Subset."""
    dataset = open_dataset(dataset_root, delta_timestamps=WINDOWS)
    subset = Subset(dataset, [3, 1, 20])
    for got, index in zip(subset.__getitems__([0, 1, 2]), [3, 1, 20], strict=True):
        assert_equal_batches(got, dataset[index])


def test_sent_to_workers_the_columns_are_shared_not_copied(dataset_root):
    dataset = open_dataset(dataset_root)
    columns = dataset.__getstate__()["_decoded_columns"]
    assert all(tensor.is_shared() for tensor in columns.tensors.values())


def test_rows_that_do_not_exist(dataset_root):
    dataset = open_dataset(dataset_root)
    with pytest.raises(IndexError):
        dataset.__getitems__([0, len(dataset)])
    assert_equal_batches(dataset.__getitems__([-1])[0], dataset[-1])


def test_a_dataset_above_the_size_limit_is_read_as_before(dataset_root, monkeypatch):
    monkeypatch.setattr(reading, "MAX_BYTES", 100)
    dataset = open_dataset(dataset_root, delta_timestamps=WINDOWS)
    assert_equal_batches(dataset.__getitems__([4])[0], dataset[4])
    assert dataset.__dict__["_decoded_columns"] is None


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
    dataset = LeRobotDataset("test/images", root=tmp_path / "d")
    assert_equal_batches(dataset.__getitems__([2])[0], dataset[2])
    assert dataset.__dict__["_decoded_columns"] is None


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


def test_switch(monkeypatch):
    monkeypatch.setenv(reading.SWITCH, "0")
    assert not reading.install()
    monkeypatch.delenv(reading.SWITCH)
    assert reading.install()
    monkeypatch.setattr(reading.lerobot, "__version__", "0.7.0")
    assert not reading.install()
