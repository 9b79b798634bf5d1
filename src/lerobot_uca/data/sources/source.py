"""The base of all sources of recorded clouds.

A source is light to send to another process and opens its files there. Letters: L steps, N points.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from textwrap import shorten
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.errors import UserError
from lerobot_uca.features import POINT_CLOUD
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.point_clouds.recipe import CloudRecipe

ACTION, STATE = "action", "observation.state"


class Frame(NamedTuple):
    """One step as it was recorded."""

    points: NDArray[np.float32]  # (any number, 3) [m], or 6 with RGB; inside the crop; of depth the sampled ones
    n_points: int  # inside the crop
    invalid: float  # share of pixels without depth, or of points that are not finite or missing
    n_missing: int  # points at (0, 0, 0), which stand for missing ones
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
    def episodes(self) -> Sequence[int]:
        """The episodes' numbers."""

    @abstractmethod
    def frames(self, episode: int) -> Iterator[Frame]:
        """The steps of one episode, each read when it is asked for where the source allows it."""

    def choose(self, episodes: Sequence[int] | None) -> Sequence[int]:
        """The same episodes; all for None.

        Raises:
            UserError: if they are not different ones of the source's.
        """
        chosen = self.episodes if episodes is None else episodes
        if not chosen or not set(chosen) <= set(self.episodes) or len(set(chosen)) < len(chosen):
            raise UserError(f"episodes must be different ones {self.valid}, got {[*chosen]}.")
        return chosen

    @property
    def valid(self) -> str:
        """The episodes' numbers in words."""
        numbers = [*self.episodes]
        if numbers and numbers == [*range(numbers[0], numbers[0] + len(numbers))]:
            return f"from {numbers[0]} to {numbers[-1]}"
        return f"among {shorten(', '.join(map(str, numbers)), 100, placeholder=' ...') or 'none'}"

    def seen(self, episode: int, frame: int) -> str:
        """The part of the scene that the crop covers in one step, in a line."""
        uncropped: Source = replace(self, crop=None)  # type: ignore[type-var]
        points = next(islice(uncropped.frames(episode), frame, None)).points[:, :3]
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

    @property
    def observation(self) -> str:
        """Which of the environments' observations the clouds are: with the robot in them, if nothing else is known."""
        return POINT_CLOUD

    def names(self, _: str) -> list[str] | None:
        """The names of a feature's numbers, if the source knows them."""
        return None

    @property
    def cloud_size(self) -> int | None:
        """The number of points of each recorded cloud, if all have the same."""
        return None

    def left_out(self) -> list[str]:
        """The parts of the source that are not kept."""
        return []

    def _cropped(self, points: NDArray[Any]) -> tuple[NDArray[np.float32], int, float, int]:
        """Of points (N, 3 or more) the good ones inside the crop, their number, the share of bad ones, and the missing.

        Bad are those that are not finite, and those at (0, 0, 0): cameras, and the baselines' Adroit, write that where
        there is none.

        Raises:
            UserError: if their colours are wanted and they have none.
        """
        n_channels = 6 if self.colour else 3
        if points.shape[1] < n_channels:
            raise UserError(
                f"--colour=true needs points with RGB after xyz, (N, 6), got {points.shape} in '{self.path}'."
            )
        wanted = np.asarray(points, dtype=np.float32)[:, :n_channels]
        is_missing = ~wanted[:, :3].any(axis=1)
        good = np.asarray(np.all(np.isfinite(wanted), axis=1)) & ~is_missing
        xyz = np.where(good[:, None], wanted[:, :3], np.inf)
        inside = good if self.crop is None else good & self.crop.contains(xyz)
        return wanted[inside], int(inside.sum()), 1 - float(good.mean()) if len(good) else 1.0, int(is_missing.sum())
