"""Clouds in files: DP3's zarr, and folders of PLY or NPZ files."""

import csv
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.data.sources.source import ACTION, Frame, Source
from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.geometry import Crop

ZARR_KEYS = ("data/point_cloud", "data/state", "data/action", "meta/episode_ends")


@dataclass
class ZarrSource(Source):
    """Data as DP3 stores them: data/point_cloud, data/state, data/action by step, and meta/episode_ends."""

    path: Path
    crop: Crop | None = None
    task: str = ""
    colour: bool = False

    @cached_property
    def _group(self) -> Any:
        try:
            import zarr
        except ImportError as error:
            raise UserError("DP3's data need zarr: pip install 'lerobot_policy_uca_flow[convert]'.") from error
        try:
            group: Any = zarr.open_group(str(self.path), mode="r")
            missing = [key for key in ZARR_KEYS if key not in group or isinstance(group[key], zarr.Group)]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"'{self.path}' cannot be read as zarr: {' '.join(str(error).split())}") from error
        if missing:
            found = ", ".join(sorted(f"{name}/{key}" for name, part in group.groups() for key in part)) or "nothing"
            raise UserError(
                f"'{self.path}' must hold {', '.join(ZARR_KEYS)}; {', '.join(missing)} is missing, got {found}."
            )
        shapes = {key: group[key].shape for key in ZARR_KEYS}
        kinds = {key: group[key].dtype for key in ZARR_KEYS}
        if wrong := [key for key in ZARR_KEYS if kinds[key].kind not in "fiub" or not shapes[key]]:
            raise UserError(f"'{self.path}': {wrong[0]} must hold real numbers, got {kinds[wrong[0]]}.")
        ends = self._read(group, ZARR_KEYS[3])
        if ends.ndim != 1 or kinds[ZARR_KEYS[3]].kind not in "iu":
            raise UserError(
                f"'{self.path}': meta/episode_ends must be whole numbers (episodes,), got {ends.dtype} {ends.shape}."
            )
        for key in ZARR_KEYS[1:3]:
            if len(shapes[key]) > 2:
                raise UserError(f"'{self.path}': {key} must have shape (steps, numbers), got {shapes[key]}.")
        lengths = {key: shapes[key][0] for key in ZARR_KEYS[:3]}
        shape, ends = shapes[ZARR_KEYS[0]], ends.astype(np.int64)
        if len({*lengths.values(), int(ends[-1]) if len(ends) else 0}) != 1 or np.any(np.diff(ends, prepend=0) <= 0):
            raise UserError(f"'{self.path}': meta/episode_ends must rise to the number of steps {lengths}, got {ends}.")
        if len(shape) != 3 or shape[2] < 3:
            raise UserError(f"'{self.path}': data/point_cloud must have shape (steps, N, 3 or more), got {shape}.")
        return group

    @property
    def episodes(self) -> Sequence[int]:
        """The episodes' numbers, from 0."""
        return range(self._group[ZARR_KEYS[3]].shape[0])

    def frames(self, episode: int) -> Iterator[Frame]:
        """The steps of one episode, which is read as a whole."""
        ends = self._read(self._group, ZARR_KEYS[3])
        steps = slice(int(ends[episode - 1]) if episode else 0, int(ends[episode]))
        columns = [self._read(self._group, key, steps).astype(np.float32) for key in ZARR_KEYS[:3]]
        for cloud, state, action in zip(*columns, strict=True):
            yield Frame(*self._cropped(cloud), np.atleast_1d(state), np.atleast_1d(action), self.task)

    def _read(self, group: Any, key: str, steps: slice = slice(None)) -> NDArray[Any]:
        try:
            return np.asarray(group[key][steps])
        except (OSError, RuntimeError, TypeError, ValueError) as error:  # of a damaged chunk, each codec its own
            raise UserError(f"'{self.path}': {key} cannot be read: {' '.join(str(error).split())}") from error

    @property
    def cloud_size(self) -> int:
        """The number of points of each cloud."""
        return self._group[ZARR_KEYS[0]].shape[1]

    def left_out(self) -> list[str]:
        """Arrays that are not kept, and colours."""
        kept = {key.partition("/")[2] for key in ZARR_KEYS[:3]}
        has_colours = self._group[ZARR_KEYS[0]].shape[2] > 3
        colours = ["colours of data/point_cloud"] if has_colours and not self.colour else []
        return [f"data/{key}" for key in self._group["data"] if key not in kept] + colours


@dataclass
class FolderSource(Source):
    """PLY or NPZ files, and a frames.csv that lists them in their order.

    Its columns: file, episode, state_* and action_* (in the order of the vectors), and task if it is not given.
    A PLY file holds vertices with x, y, z [m] and perhaps red, green, blue; an NPZ file an array 'points' (N, 3) [m],
    or (N, 6) with RGB after xyz.
    """

    path: Path
    crop: Crop | None = None
    task: str = ""
    colour: bool = False

    @cached_property
    def _rows(self) -> list[dict[str, str]]:
        file = self.path / "frames.csv"
        try:
            with file.open(newline="", encoding="utf-8-sig") as opened:  # spreadsheets write a mark at the beginning
                table = csv.DictReader(opened)
                rows, columns = list(table), list(table.fieldnames or ())
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise UserError(f"'{file}' cannot be read: {error}") from error
        if uneven := [number for number, row in enumerate(rows, 2) if None in row or None in row.values()]:
            raise UserError(f"'{file}' must have a value for each column in each row, row {uneven[0]} has not.")
        if twice := [name for name in columns if columns.count(name) > 1]:
            raise UserError(f"'{file}' must have each column once, got '{twice[0]}' twice.")
        if not rows:
            raise UserError(f"'{file}' must have a row for each frame, it has none.")
        vectors = [self._columns(columns, kind) for kind in ("state", "action")]
        if not {"file", "episode"} <= set(columns) or not all(vectors):
            got = ", ".join(columns) or "none"
            raise UserError(f"'{file}' must have the columns file, episode, state_*, action_*, got {got}.")
        return rows

    @staticmethod
    def _columns(columns: Sequence[str], kind: str) -> list[str]:
        return [name for name in columns if name.startswith(f"{kind}_")]

    @cached_property
    def _episodes(self) -> dict[int, list[dict[str, str]]]:
        by_name: dict[str, list[dict[str, str]]] = {}
        for row in self._rows:
            by_name.setdefault(row["episode"], []).append(row)
        return dict(zip(self._numbers(list(by_name)), by_name.values(), strict=True))

    def _numbers(self, names: Sequence[str]) -> Sequence[int]:
        whole = [name.removesuffix(".0") for name in names]
        if not all(name.isdecimal() for name in whole):
            return range(len(names))
        numbers = [int(name) for name in whole]
        if len(set(numbers)) < len(numbers):
            twice = [name for name, number in zip(names, numbers, strict=True) if numbers.count(number) > 1]
            raise UserError(
                f"'{self.path / 'frames.csv'}' must have one name for each episode, got {' and '.join(twice)}."
            )
        return numbers

    @property
    def episodes(self) -> Sequence[int]:
        """The episodes' numbers: those of their column or, where it holds others than whole numbers, from 0."""
        return list(self._episodes)

    def names(self, key: str) -> list[str] | None:
        """The columns' names without their prefix."""
        kind = "action" if key == ACTION else "state"
        return [name.removeprefix(f"{kind}_") for name in self._columns(list(self._rows[0]), kind)]

    def frames(self, episode: int) -> Iterator[Frame]:
        """The steps of one episode."""
        return map(self._frame, self._episodes[episode])

    def left_out(self) -> list[str]:
        """Columns that are not kept, and colours."""
        columns = list(self._rows[0])
        kept = {"file", "episode", "task", *self._columns(columns, "state"), *self._columns(columns, "action")}
        has_colours = False
        with suppress(UserError):  # of an episode that is not converted
            has_colours = not self.colour and self._points(self._rows[0]).shape[1] > 3
        return [f"column {name}" for name in columns if name not in kept] + ["the points' colours"] * has_colours

    def _frame(self, row: dict[str, str]) -> Frame:
        with self._reading(row):
            state, action = (
                np.array([float(row[name]) for name in self._columns(list(row), kind)], dtype=np.float32)
                for kind in ("state", "action")
            )
        return Frame(*self._cropped(self._points(row)), state, action, row.get("task") or self.task)

    def _points(self, row: dict[str, str]) -> NDArray[Any]:
        file = self.path / row["file"]
        reader = READERS.get(file.suffix.lower())
        if reader is None:
            raise UserError(f"'{file}' must be one of {', '.join(READERS)}.")
        with self._reading(row):
            points = reader(file)
        if points.ndim != 2 or points.shape[1] < 3:
            raise UserError(f"'{file}' must hold points (N, 3 or more), got shape {points.shape}.")
        return points

    @contextmanager
    def _reading(self, row: dict[str, str]) -> Iterator[None]:
        try:
            yield
        except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile, zlib.error) as error:
            reason = " ".join(str(error).split())
            raise UserError(f"'{self.path / row['file']}' (frames.csv) cannot be read: {reason}") from error


def _read_ply(file: Path) -> NDArray[Any]:
    try:
        from plyfile import PlyData, PlyParseError
    except ImportError as error:
        raise UserError("PLY files need plyfile: pip install 'lerobot_policy_uca_flow[convert]'.") from error
    try:
        vertices = PlyData.read(str(file))["vertex"]
    except PlyParseError as error:
        raise ValueError(str(error)) from error
    colours = [name for name in ("red", "green", "blue") if name in vertices]
    return np.stack([vertices[name].astype(np.float32) for name in ("x", "y", "z", *colours)], axis=1)


def _read_npz(file: Path) -> NDArray[Any]:
    with np.load(file, allow_pickle=False) as arrays:
        points: NDArray[Any] = arrays["points"]
    if points.dtype.kind not in "fiu":
        raise ValueError(f"'points' must be real numbers, got {points.dtype}")
    return points


READERS: dict[str, Callable[[Path], NDArray[Any]]] = {".ply": _read_ply, ".npz": _read_npz}
