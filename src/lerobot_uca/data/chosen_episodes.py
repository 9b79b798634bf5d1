"""Statistics of the episodes chosen for a training, and a check that their data is finite.

`masks` are the features to look at and, for each, the feature that says which of its points are valid, if there is one.
"""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow.dataset
import torch
from lerobot.datasets.compute_stats import RunningQuantileStats, aggregate_feature_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from numpy.typing import NDArray
from torch import Tensor

from lerobot_uca.data.batched_dataset import BatchedDataset, Columns
from lerobot_uca.errors import UserError

logger = logging.getLogger(__name__)

MAX_LISTED = 30
"""Episodes that an error message lists."""
CHUNK = 1024
"""Rows that are looked at together."""

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
    for key, mask in masks.items():
        if mask is not None and key in stats and _is_streamed(dataset):
            logger.warning("The dataset is streamed: invalid points of '%s' count in its normalisation.", key)
        elif mask is not None and key in stats:
            running = RunningQuantileStats()
            for rows in _rows(dataset, key, mask):
                running.update(rows.values[rows.valid].double().numpy())
            stats = {**stats, key: running.get_statistics()}
    return {key: stats[key] for key in masks if key in stats}


def check_finite(dataset: Any, masks: Masks, wanted: Sequence[int] | None = None) -> None:
    """Raise a `UserError` that names episode and frame if a value of the dataset's episodes is NaN or infinite.

    A cloud without valid points is refused, too. A feature without a mask of a dataset that is not read in batches, and
    all of one that is streamed, is checked by its statistics, and its rows only to name the frame.

    Args:
        dataset: of the episodes to train on, or of those held out.
        masks: see above.
        wanted: the episodes that the user has asked for, of which both are parts; None for all.
    """
    asked_for = range(dataset.meta.total_episodes) if wanted is None else wanted
    for key, mask in masks.items():
        if _is_streamed(dataset) or (mask is None and _columns(dataset) is None):
            _check_statistics(dataset, key, asked_for)
        else:
            _check_rows(dataset, key, mask, asked_for)


def _is_streamed(dataset: Any) -> bool:
    return not isinstance(dataset, LeRobotDataset)


class _Rows(NamedTuple):
    """R rows of a feature."""

    values: Tensor  # (R, ...)
    valid: Tensor  # (R, N) bool, or (R, 1) if all counts
    places: list[tuple[int, int]]  # episode and frame


def _rows(dataset: Any, key: str, mask: str | None) -> Iterator[_Rows]:
    columns = _columns(dataset)
    names = [key, *([mask] if mask else []), "episode_index", "frame_index"]
    if columns is not None:
        chunks = zip(*(columns.tensors[name].split(CHUNK) for name in names), strict=True)
        batches: Iterable[dict[str, Any]] = (dict(zip(names, each, strict=True)) for each in chunks)
    else:
        batches = dataset.hf_dataset.select_columns(names).with_format("numpy").iter(batch_size=CHUNK)
    for batch in batches:
        values = torch.as_tensor(np.asarray(batch[key]))
        valid = torch.as_tensor(np.asarray(batch[mask])) if mask else torch.ones(len(values), 1)
        episodes, frames = (np.asarray(batch[name]).tolist() for name in names[-2:])
        yield _Rows(values, valid.flatten(1).bool(), list(zip(episodes, frames, strict=True)))


def _check_rows(dataset: Any, key: str, mask: str | None, wanted: Sequence[int]) -> None:
    empty: list[tuple[int, int]] = []
    bad: list[tuple[int, int]] = []
    n_bad = 0  # values of the first of these rows
    for rows in _rows(dataset, key, mask):
        is_bad = _bad(rows.values, rows.valid)
        empty += [rows.places[row] for row in (~rows.valid.any(dim=1)).nonzero().flatten().tolist()]
        found = is_bad.any(dim=1).nonzero().flatten().tolist()
        n_bad = n_bad if bad or not found else int(is_bad[found[0]].sum())
        bad += [rows.places[row] for row in found]
    if empty:
        raise UserError(f"'{mask}' must call some points of '{key}' valid, got none in {_place(empty, wanted)}")
    if bad:
        n_values = int(np.prod(rows.values.shape[1:]))
        raise UserError(
            f"'{key}' must be finite, got {n_bad} of {n_values} values NaN or infinite in {_place(bad, wanted)}"
        )


def _check_statistics(dataset: Any, key: str, wanted: Sequence[int]) -> None:
    for episode, stats in _episode_statistics(dataset, {key: None}).items():
        if not all(np.isfinite(each).all() for of_key in stats.values() for each in of_key.values()):
            frame = _first_bad_frame(dataset, key, episode)
            place = "or its statistics" if frame is None else f"frame {frame}"
            raise UserError(
                f"'{key}' must be finite, got NaN or infinite values in episode {episode}, {place}. "
                + _without([episode], wanted)
            )


def _first_bad_frame(dataset: Any, key: str, episode: int) -> int | None:
    for row in dataset.hf_dataset.select_columns([key, "episode_index", "frame_index"]):
        if int(row["episode_index"]) == episode and not torch.isfinite(torch.as_tensor(row[key])).all():
            return int(row["frame_index"])
    return None


def _bad(values: Tensor, valid: Tensor) -> Tensor:
    """Rows (R, ...) of values, and which of their points are valid (R, N) or (R, 1), to what is bad, (R, values)."""
    bad = ~torch.isfinite(values).reshape(len(values), valid.shape[1], -1)
    return (bad & valid[..., None]).flatten(1)


def _place(places: list[tuple[int, int]], wanted: Sequence[int]) -> str:
    episodes = sorted({episode for episode, _ in places})
    more = f" and in {len(places) - 1} more frames, of the episodes {episodes[:MAX_LISTED]}" if len(places) > 1 else ""
    return f"episode {places[0][0]}, frame {places[0][1]}{more}. {_without(episodes, wanted)}"


def _without(episodes: list[int], wanted: Sequence[int]) -> str:
    """A sentence that says how to train without some of the episodes that were asked for."""
    others = [episode for episode in wanted if episode not in set(episodes)]
    if not others:
        return "No episode is left without them."
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
