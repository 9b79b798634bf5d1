"""Sources of recorded clouds: LeRobot datasets with depth or clouds, DP3's zarr, folders of PLY or NPZ files.

A source is light to send to another process and opens its files there. Letters: L steps, N points.
"""

import csv
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.data.recorded_calibrations import EXTRINSICS, INTRINSICS, recorded_calibrations
from lerobot_uca.errors import UserError
from lerobot_uca.features import VALID_MASK_SUFFIX, find_point_cloud
from lerobot_uca.point_clouds.depth import DepthError, is_valid
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.point_clouds.recipe import RECIPE_INFO, CloudRecipe, camera_of, recipe_for

ZARR_KEYS = ("data/point_cloud", "data/state", "data/action", "meta/episode_ends")
ACTION, STATE = "action", "observation.state"


class Frame(NamedTuple):
    """One step as it was recorded."""

    points: NDArray[np.float32]  # (any number, 3) [m], or 6 with RGB; inside the crop; of depth the sampled ones
    n_points: int  # inside the crop
    invalid: float  # share of pixels without depth, or of points that are not finite
    state: NDArray[np.float32]  # (S,)
    action: NDArray[np.float32]  # (A,)
    task: str


class Source(ABC):
    """Recorded episodes."""

    path: Path
    crop: Crop | None
    colour: bool

    def __getstate__(self) -> dict[str, Any]:
        """Without what has been opened: another process opens it itself."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}  # type: ignore[attr-defined]

    @property
    @abstractmethod
    def n_episodes(self) -> int:
        """The number of episodes."""

    @abstractmethod
    def frames(self, episode: int) -> list[Frame]:
        """The steps of one episode."""

    def seen(self, episode: int, frame: int) -> str:
        """The part of the scene that the crop covers in one step, in a line."""
        points = replace(self, crop=None).frames(episode)[frame].points[:, :3]  # type: ignore[type-var]
        if len(points) == 0:
            return "The cloud has no finite point"
        low, high = (np.round(np.percentile(points, share, axis=0), 3).tolist() for share in (1, 99))
        crop = f"the crop is {self.crop.low} to {self.crop.high} m" if self.crop else "there is no crop"
        return f"The cloud has {len(points)} finite points from {low} to {high} m; {crop}"

    @property
    def fps(self) -> int | None:
        """Steps a second, if the source knows it."""
        return None

    @property
    def recipe(self) -> CloudRecipe | None:
        """The recipe by which clouds are made from depth images, if they are."""
        return None

    def names(self, _: str) -> list[str] | None:
        """The names of a feature's numbers, if the source knows them."""
        return None

    def left_out(self) -> list[str]:
        """The parts of the source that are not kept."""
        return []

    def _cropped(self, points: NDArray[Any]) -> tuple[NDArray[np.float32], int, float]:
        """The finite points inside the crop, of (N, 3 or more), their number, and the share that is not finite.

        Raises:
            UserError: if their colours are wanted and they have none.
        """
        n_channels = 6 if self.colour else 3
        if points.shape[1] < n_channels:
            raise UserError(
                f"--colour=true needs points with RGB after xyz, (N, 6), got {points.shape} in '{self.path}'."
            )
        wanted = np.asarray(points, dtype=np.float32)[:, :n_channels]
        finite = np.asarray(np.all(np.isfinite(wanted), axis=1))
        xyz = np.where(finite[:, None], wanted[:, :3], np.inf)
        inside = finite if self.crop is None else finite & self.crop.contains(xyz)
        return wanted[inside], int(inside.sum()), 1 - float(finite.mean()) if len(finite) else 1.0


@dataclass
class LeRobotSource(Source):
    """A LeRobot dataset with depth images, as video or as TIFF, or with clouds under this or another plugin's key.

    Args:
        path: its folder.
        crop: for clouds; depth is cropped by its recipe.
        colour: whether clouds keep their colours, RGB after xyz.
        depth_recipe: how clouds are made from depth; None takes the dataset's own clouds.
    """

    path: Path
    crop: Crop | None = None
    colour: bool = False
    depth_recipe: CloudRecipe | None = None

    @cached_property
    def _dataset(self) -> Any:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset  # slow to import

        return LeRobotDataset(self.path.name, root=self.path)

    @property
    def features(self) -> dict[str, Any]:
        """The dataset's features, as LeRobot describes them."""
        return self._dataset.features

    @property
    def n_episodes(self) -> int:
        """The number of episodes."""
        return self._dataset.num_episodes

    @property
    def fps(self) -> int:
        """Steps a second."""
        return self._dataset.fps

    @property
    def recipe(self) -> CloudRecipe | None:
        """The recipe of the depth images, or the one that the dataset's clouds were made with."""
        if self.depth_recipe is None and self._cloud_key is not None:
            made_with = (self.features[self._cloud_key].get("info") or {}).get(RECIPE_INFO)
            return CloudRecipe.from_dict(made_with) if made_with and self.crop is None else None
        return self.depth_recipe

    def names(self, key: str) -> list[str] | None:
        """The names of a feature's numbers."""
        return self.features[key].get("names")

    def make_clouds(self, corners: tuple[Any, Any] | None, n_points: int, folder: str | None) -> None:
        """Make clouds from the depth images from now on.

        Args:
            corners: of the crop; None for that of a simulated camera.
            n_points: of a cloud.
            folder: of calibrations. Without one the dataset's own count, and then those of $LEROBOT_UCA_CALIBRATION.

        Raises:
            CalibrationError: if a calibration or the crop is missing.
        """
        recorded = {} if folder else recorded_calibrations(self._dataset)
        self.depth_recipe = recipe_for(self.features, corners, n_points, folder, recorded)

    def seen(self, episode: int, frame: int) -> str:
        """The part of the scene that the crop covers in one step, in a line."""
        if self.depth_recipe is None:
            return super().seen(episode, frame)
        item = self._dataset[self._dataset.meta.episodes[episode]["dataset_from_index"] + frame]
        return self._make.seen([item[key].numpy() for key in self.depth_recipe.keys])

    def left_out(self) -> list[str]:
        """Features that are neither cloud, depth, state nor action."""
        kept = {STATE, ACTION, self._cloud_key, self._rgb_key}
        if self.depth_recipe is not None:
            cameras = [camera_of(key) for key in self.depth_recipe.keys]
            kept |= {*self.depth_recipe.keys, *(kind + each for kind in (INTRINSICS, EXTRINSICS) for each in cameras)}
        own = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
        return [key for key in self.features if key not in kept | own]

    def frames(self, episode: int) -> list[Frame]:
        """The steps of one episode."""
        row = self._dataset.meta.episodes[episode]
        items = (self._dataset[index] for index in range(row["dataset_from_index"], row["dataset_to_index"]))
        return [self._frame(item) for item in items]

    @cached_property
    def _cloud_key(self) -> str | None:
        return find_point_cloud(self.features)

    @cached_property
    def _rgb_key(self) -> str | None:
        """The colours' feature, where they are not in the cloud's and are wanted."""
        key = (self._cloud_key or "").removesuffix(".xyz") + ".rgb"
        return key if self.colour and key in self.features else None

    @cached_property
    def _make(self) -> Any:
        return self.depth_recipe.make() if self.depth_recipe else None

    def _frame(self, item: dict[str, Any]) -> Frame:
        seen = self._from_depth(item) if self._make else self._from_cloud(item)
        state, action = (np.atleast_1d(item[key].numpy()).astype(np.float32) for key in (STATE, ACTION))
        return Frame(*seen, state, action, item["task"])

    def _from_depth(self, item: dict[str, Any]) -> tuple[NDArray[np.float32], int, float]:
        assert self.depth_recipe is not None
        images = [item[key].numpy() for key in self.depth_recipe.keys]
        try:
            candidates, n_points = self._make.candidates(images), len(self._make.points(images))
            valid = [is_valid(view, image).mean() for view, image in zip(self._make.views, images, strict=True)]
        except DepthError as error:
            raise UserError(str(error)) from error
        return candidates, n_points, 1 - float(np.mean(valid))

    def _from_cloud(self, item: dict[str, Any]) -> tuple[NDArray[np.float32], int, float]:
        if self._cloud_key is None:
            raise UserError(f"'{self.path}' has neither depth nor a point cloud, got {', '.join(self.features)}.")
        cloud = item[self._cloud_key].numpy()
        if self._rgb_key is not None:
            cloud = np.concatenate([cloud, item[self._rgb_key].numpy()], axis=-1)
        mask = item.get(self._cloud_key.removesuffix(".xyz") + VALID_MASK_SUFFIX)
        return self._cropped(cloud if mask is None else cloud[mask.numpy().astype(bool)])


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
            missing = [key for key in ZARR_KEYS if key not in group]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"'{self.path}' cannot be read as zarr: {' '.join(str(error).split())}") from error
        if missing:
            found = ", ".join(sorted(f"{name}/{key}" for name, part in group.groups() for key in part)) or "nothing"
            raise UserError(
                f"'{self.path}' must hold {', '.join(ZARR_KEYS)}; {', '.join(missing)} is missing, got {found}."
            )
        lengths = {key: group[key].shape[0] for key in ZARR_KEYS[:3]}
        ends = np.asarray(group[ZARR_KEYS[3]])
        shape = group[ZARR_KEYS[0]].shape
        if len({*lengths.values(), int(ends[-1]) if len(ends) else 0}) != 1 or np.any(np.diff(ends, prepend=0) <= 0):
            raise UserError(f"'{self.path}': meta/episode_ends must rise to the number of steps {lengths}, got {ends}.")
        if len(shape) != 3 or shape[2] < 3:
            raise UserError(f"'{self.path}': data/point_cloud must have shape (steps, N, 3 or more), got {shape}.")
        return group

    @property
    def n_episodes(self) -> int:
        """The number of episodes."""
        return self._group[ZARR_KEYS[3]].shape[0]

    def frames(self, episode: int) -> list[Frame]:
        """The steps of one episode."""
        ends = np.asarray(self._group[ZARR_KEYS[3]])
        steps = slice(int(ends[episode - 1]) if episode else 0, int(ends[episode]))
        columns = [np.asarray(self._group[key][steps], dtype=np.float32) for key in ZARR_KEYS[:3]]
        return [
            Frame(*self._cropped(cloud), np.atleast_1d(state), np.atleast_1d(action), self.task)
            for cloud, state, action in zip(*columns, strict=True)
        ]

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
            with file.open(newline="", encoding="utf-8") as opened:
                rows = list(csv.DictReader(opened))
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f"'{file}' cannot be read: {error}") from error
        columns = list(rows[0]) if rows else []
        vectors = [self._columns(columns, kind) for kind in ("state", "action")]
        if not {"file", "episode"} <= set(columns) or not all(vectors):
            got = ", ".join(columns) or "none"
            raise UserError(f"'{file}' must have the columns file, episode, state_*, action_*, got {got}.")
        return rows

    @staticmethod
    def _columns(columns: Sequence[str], kind: str) -> list[str]:
        return [name for name in columns if name.startswith(f"{kind}_")]

    @cached_property
    def _episodes(self) -> list[list[dict[str, str]]]:
        by_name: dict[str, list[dict[str, str]]] = {}
        for row in self._rows:
            by_name.setdefault(row["episode"], []).append(row)
        return list(by_name.values())

    @property
    def n_episodes(self) -> int:
        """The number of episodes."""
        return len(self._episodes)

    def names(self, key: str) -> list[str] | None:
        """The columns' names without their prefix."""
        kind = "action" if key == ACTION else "state"
        return [name.removeprefix(f"{kind}_") for name in self._columns(list(self._rows[0]), kind)]

    def frames(self, episode: int) -> list[Frame]:
        """The steps of one episode."""
        return [self._frame(row) for row in self._episodes[episode]]

    def _frame(self, row: dict[str, str]) -> Frame:
        file = self.path / row["file"]
        reader = READERS.get(file.suffix.lower())
        if reader is None:
            raise UserError(f"'{file}' must be one of {', '.join(READERS)}.")
        try:
            points = reader(file)
            state, action = (
                np.array([float(row[name]) for name in self._columns(list(row), kind)], dtype=np.float32)
                for kind in ("state", "action")
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"'{file}' (frames.csv) cannot be read: {' '.join(str(error).split())}") from error
        if points.ndim != 2 or points.shape[1] < 3:
            raise UserError(f"'{file}' must hold points (N, 3 or more), got shape {points.shape}.")
        return Frame(*self._cropped(points), state, action, row.get("task") or self.task)


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
        return arrays["points"]


READERS: dict[str, Callable[[Path], NDArray[Any]]] = {".ply": _read_ply, ".npz": _read_npz}


def find_source(path: Path, crop: Crop | None, task: str, *, colour: bool = False) -> Source:
    """The source of a path, by what lies in it.

    Raises:
        UserError: if its kind is unknown.
    """
    if (path / "meta" / "info.json").is_file():
        return LeRobotSource(path, crop, colour)
    if (path / ".zgroup").is_file() or (path / "zarr.json").is_file() or path.suffix == ".zarr":
        return ZarrSource(path, crop, task, colour)
    if (path / "frames.csv").is_file():
        return FolderSource(path, crop, task, colour)
    raise UserError(
        f"'{path}' must be a LeRobot dataset (meta/info.json), a zarr of DP3's layout, or a folder with a frames.csv."
    )
