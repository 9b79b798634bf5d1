"""Statistics of the episodes chosen for a training, and a check that their data is finite.

`masks` are the features to look at and, for each, the feature that says which of its points are valid, if there is one.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow.dataset
import torch
from lerobot.datasets.compute_stats import aggregate_feature_stats
from numpy.typing import NDArray
from torch import Tensor

from lerobot_uca.data.batched_dataset import BatchedDataset, Columns
from lerobot_uca.errors import UserError

MAX_LISTED = 30
"""Episodes that an error message lists."""
QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)

Masks = Mapping[str, str | None]
Statistics = dict[str, dict[str, NDArray[Any]]]


def chosen_statistics(dataset: Any, masks: Masks) -> Statistics:
    """Statistics of a LeRobot dataset's chosen episodes, for each feature that has some.

    LeRobot's are those of all episodes, and count invalid points.
    """
    stats: Statistics = dataset.meta.stats or {}
    if dataset.episodes is not None and stats:
        of_episodes = _episode_statistics(dataset, masks).values()
        grouped = {key: [each[key] for each in of_episodes if key in each] for key in masks}
        stats = {key: aggregate_feature_stats(each) for key, each in grouped.items() if each}
    columns = _columns(dataset)
    for key, mask in masks.items():
        if mask is not None and columns is not None and key in stats:
            valid = columns.tensors[mask].flatten(1).bool()
            stats = {**stats, key: _point_statistics(columns.tensors[key][valid].numpy())}
    return {key: stats[key] for key in masks if key in stats}


def check_finite(dataset: Any, masks: Masks) -> None:
    """Raise a `UserError` that names episode and frame if a value of the chosen episodes is NaN or infinite.

    A cloud without valid points is refused, too, if the dataset is read in batches. Otherwise the statistics are
    checked, and rows only to name the frame.
    """
    columns = _columns(dataset)
    if columns is None:
        for episode, stats in _episode_statistics(dataset, masks).items():
            for key, of_key in stats.items():
                if not all(np.isfinite(each).all() for each in of_key.values()):
                    frame = _first_bad_frame(dataset, key, episode)
                    place = "or its statistics" if frame is None else f"frame {frame}"
                    raise UserError(
                        f"'{key}' must be finite, got NaN or infinite values in episode {episode}, {place}. "
                        + _without([episode], dataset)
                    )
        return
    for key, mask in masks.items():
        values = columns.tensors[key]
        valid = torch.ones(len(values), 1) if mask is None else columns.tensors[mask].flatten(1)
        empty = (~valid.bool().any(dim=1)).nonzero().flatten()
        if len(empty):
            raise UserError(
                f"'{mask}' must call some points of '{key}' valid, got none in " + _place(columns, empty, dataset)
            )
        chunks = zip(values.split(1024), valid.split(1024), strict=True)
        rows = torch.cat([_bad(*chunk).any(dim=1) for chunk in chunks]).nonzero().flatten()
        if len(rows):
            first = int(rows[0])
            bad = _bad(values[first : first + 1], valid[first : first + 1])
            raise UserError(
                f"'{key}' must be finite, got {int(bad.sum())} of {bad.numel()} values NaN or infinite in "
                + _place(columns, rows, dataset)
            )


def _first_bad_frame(dataset: Any, key: str, episode: int) -> int | None:
    for row in dataset.hf_dataset.select_columns([key, "episode_index", "frame_index"]):
        if int(row["episode_index"]) == episode and not torch.isfinite(torch.as_tensor(row[key])).all():
            return int(row["frame_index"])
    return None


def _bad(values: Tensor, valid: Tensor) -> Tensor:
    """Rows (R, ...) of values, and which of their points are valid (R, N) or (R, 1), to what is bad, (R, values)."""
    bad = ~torch.isfinite(values).reshape(len(values), valid.shape[1], -1)
    return (bad & valid.bool()[..., None]).flatten(1)


def _place(columns: Columns, rows: Tensor, dataset: Any) -> str:
    episodes = columns.tensors["episode_index"][rows].unique().tolist()
    frame, episode = (int(columns.tensors[f"{name}_index"][rows[0]]) for name in ("frame", "episode"))
    more = f" and in {len(rows) - 1} more frames, of the episodes {episodes[:MAX_LISTED]}" if len(rows) > 1 else ""
    return f"episode {episode}, frame {frame}{more}. {_without(episodes, dataset)}"


def _without(episodes: list[int], dataset: Any) -> str:
    """A sentence that says how to train without some episodes."""
    chosen = range(dataset.meta.total_episodes) if dataset.episodes is None else dataset.episodes
    others = [episode for episode in chosen if episode not in set(episodes)]
    option = str(others).replace(" ", "") if len(others) <= MAX_LISTED else "[...]"
    return f"--dataset.episodes={option} leaves these episodes out."


def _columns(dataset: Any) -> Columns | None:
    return dataset.columns() if isinstance(dataset, BatchedDataset) else None


def _episode_statistics(dataset: Any, masks: Masks) -> dict[int, Statistics]:
    """The statistics of each chosen episode, from the files beside the episodes' other metadata."""
    source = pyarrow.dataset.dataset(dataset.meta.root / "meta" / "episodes", format="parquet")
    paths = {name: name.split("/")[1:] for name in source.schema.names if name.startswith("stats/")}
    wanted = {name: path for name, path in paths.items() if path[0] in masks}
    chosen = None if dataset.episodes is None else set(dataset.episodes)
    result: dict[int, Statistics] = {}
    for row in source.to_table(columns=["episode_index", *wanted]).to_pylist():
        if chosen is None or row["episode_index"] in chosen:
            stats = result.setdefault(row["episode_index"], {})
            for name, (key, statistic) in wanted.items():
                if row[name] is not None:
                    stats.setdefault(key, {})[statistic] = np.asarray(row[name]).reshape(-1)
    return result


def _point_statistics(points: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Statistics of points (P, C), per channel, under LeRobot's names."""
    points = points.astype(np.float64)
    stats = {name: getattr(np, name)(points, axis=0) for name in ("min", "max", "mean", "std")}
    quantiles = zip(QUANTILES, np.quantile(points, QUANTILES, axis=0), strict=True)
    return {**stats, **{f"q{quantile * 100:02.0f}": values for quantile, values in quantiles}}
