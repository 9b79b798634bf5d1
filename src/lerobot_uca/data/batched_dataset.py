"""Batched reading of LeRobot datasets without cameras, which stock LeRobot 0.6.1 decodes row by row.

PyTorch's DataLoader asks a dataset for a whole batch if it has `__getitems__`. LeRobotDataset lacks it, so each
sample costs a full-row decode for every delta query: 15 to 70 ms for two clouds of 512 points. The subclass here
decodes all columns once into contiguous tensors and then gathers windows from them; the samples equal those of stock
reading bit for bit. Datasets with images, videos or language columns, and datasets above 4 GiB, are read as before.
"""

from collections.abc import Sequence
from typing import Any, override

import numpy as np
import pyarrow as pa
import torch
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_uca.errors import UserError, reported

MAX_BYTES = 4 * 2**30
"""Datasets whose decoded columns would be larger are read as before."""

Sample = dict[str, Tensor | str]


class Columns:
    """All rows of a dataset, decoded: one contiguous tensor a feature.

    Args:
        reader: a loaded reader without camera features.
    """

    def __init__(self, reader: DatasetReader) -> None:
        table = reader.hf_dataset.with_format("arrow")[:]
        example = reader.hf_dataset[0]
        self.source = reader.hf_dataset
        for key in example:
            if table.column(key).null_count:
                raise UserError(
                    f"'{key}' must have a value in each row of the dataset's Parquet files, got none in some."
                )
        self.tensors = {key: _decode(table.column(key), example[key]) for key in example}
        self.tasks = list(reader._meta.tasks.index)
        episodes = reader._meta.episodes
        self.episode_start = torch.tensor(episodes["dataset_from_index"])
        self.episode_end = torch.tensor(episodes["dataset_to_index"])
        self._check_order()
        self.row_of_frame = torch.full((int(self.episode_end.max()),), -1)
        self.row_of_frame[self.tensors["index"]] = torch.arange(len(self.tensors["index"]))

    def _check_order(self) -> None:
        """Stock reading takes the rows as they are, this one by their index: they must be in its order."""
        index = self.tensors["index"]
        episodes = self.tensors["episode_index"].unique().tolist()
        start, end = self.episode_start.tolist(), self.episode_end.tolist()
        expected = torch.cat([torch.arange(start[each], end[each]) for each in episodes])
        if not torch.equal(index, expected):
            n_same = min(len(index), len(expected))
            row = [*(index[:n_same] != expected[:n_same]).nonzero().flatten().tolist(), n_same][0]
            raise UserError(
                f"The dataset's rows must be in the order of their index, one for each frame of their episodes; "
                f"row {row} is another one."
            )

    def samples(self, reader: DatasetReader, rows: Sequence[int]) -> list[Sample]:
        """The same as `reader.get_item` for each row."""
        n_rows = len(self.tensors["index"])
        row = torch.as_tensor(rows)
        if len(row) and (int(row.min()) < -n_rows or int(row.max()) >= n_rows):
            raise IndexError(f"Rows must lie in [0, {n_rows}), got {int(row.min())} to {int(row.max())}.")
        row = row % n_rows
        frame, episode = self.tensors["index"][row][:, None], self.tensors["episode_index"][row]
        start, end = self.episode_start[episode][:, None], self.episode_end[episode][:, None]
        batch, padding = {}, {}
        for key, tensor in self.tensors.items():
            deltas = (reader.delta_indices or {}).get(key)
            if deltas is None:
                batch[key] = tensor[row]
            else:
                wanted = frame + torch.tensor(deltas)
                batch[key] = tensor[self.row_of_frame[wanted.clamp(start, end - 1)]]
                padding[f"{key}_is_pad"] = (wanted < start) | (wanted >= end)
        tasks = [self.tasks[task] for task in batch["task_index"].tolist()]
        columns = {key: tensor.unbind() for key, tensor in {**batch, **padding}.items()} | {"task": tasks}
        return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def _decode(column: pa.ChunkedArray, example: Tensor) -> Tensor:
    values = column.combine_chunks()
    while isinstance(values, pa.ExtensionArray | pa.ListArray | pa.FixedSizeListArray):
        values = values.storage if isinstance(values, pa.ExtensionArray) else values.flatten()
    array = values.to_numpy(zero_copy_only=False).reshape(len(column), *example.shape)
    return torch.tensor(array, dtype=example.dtype)  # a copy: Arrow's memory is read-only


class BatchedDataset(LeRobotDataset):
    """A LeRobot dataset that reads a whole batch at once where it can (`is_batched`), and as before where it cannot."""

    _decoded: Columns | None = None

    def __getitems__(self, indices: Sequence[int]) -> list[Any]:
        """Samples of a batch of indices, equal to [self[i] for i in indices]."""
        columns = self.columns()
        if columns is None:
            return [self[int(index)] for index in indices]
        return columns.samples(self._ensure_reader(), indices)

    @override
    def __getstate__(self) -> dict[str, Any]:
        """Decode before the dataset is sent to a DataLoader's workers: PyTorch lets them share the tensors' memory."""
        self.columns()
        return self.__dict__.copy()

    @property
    def is_batched(self) -> bool:
        """Whether all columns are numbers and fit into memory, and nothing is being written."""
        if self.writer is not None and not self._is_finalized:
            return False
        if self.meta.camera_keys or self.meta.has_language_columns:
            return False
        n_bytes = 0
        for feature in self.meta.features.values():
            try:
                n_bytes += int(np.prod(feature["shape"])) * np.dtype(feature["dtype"]).itemsize
            except TypeError:  # text and other values that are not numbers
                return False
        return n_bytes * self.num_frames <= MAX_BYTES

    def columns(self) -> Columns | None:
        """All rows of the chosen episodes, made at the first call, or None if the dataset must be read as before."""
        if not self.is_batched:
            return None
        reader = self._ensure_reader()
        with reported(f"Dataset '{self.repo_id}' cannot be read"):
            if reader.hf_dataset is None:
                reader.load_and_activate()
            if self._decoded is None or self._decoded.source is not reader.hf_dataset:
                self._decoded = Columns(reader)
        return self._decoded
