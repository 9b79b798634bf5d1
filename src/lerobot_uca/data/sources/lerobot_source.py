"""LeRobot datasets with depth images or clouds."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.data.recorded_calibrations import recorded_calibrations
from lerobot_uca.data.sources.source import ACTION, STATE, Frame, Source
from lerobot_uca.errors import UserError, reported
from lerobot_uca.features import (
    EXTRINSICS,
    INTRINSICS,
    POINT_CLOUD,
    cloud_observation,
    find_point_cloud,
    valid_mask,
)
from lerobot_uca.point_clouds.depth import DepthError, is_valid
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.point_clouds.recipe import (
    RECIPE_INFO,
    CloudRecipe,
    camera_of,
    depth_keys,
    installed_calibrations,
    recipe_for,
)

LOST_RECIPE = "the recipe of the clouds, by which a policy makes them on a robot (with another crop they are others)"


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
    def _opened(self) -> tuple[Any, dict[str, Any]]:
        """The dataset without the pictures that no cloud is made of, and the features of the whole."""
        from lerobot.datasets.lerobot_dataset import LeRobotDataset  # slow to import

        with reported(f"'{self.path}' cannot be read"):
            dataset = LeRobotDataset(self.path.name, root=self.path)
        missing = [key for key in (STATE, ACTION) if key not in dataset.features]
        if missing:
            raise UserError(
                f"'{self.path}' must have {STATE} and {ACTION}; {', '.join(missing)} is missing, got "
                f"{', '.join(dataset.features)}."
            )
        features = dict(dataset.features)
        _leave_pictures_out(dataset)
        return dataset, features

    @property
    def _dataset(self) -> Any:
        return self._opened[0]

    @property
    def features(self) -> dict[str, Any]:
        """The dataset's features, as LeRobot describes them."""
        return self._opened[1]

    @property
    def episodes(self) -> Sequence[int]:
        """The episodes' numbers, from 0."""
        return range(self._dataset.num_episodes)

    @property
    def fps(self) -> int:
        """Steps a second."""
        return self._dataset.fps

    @property
    def recipe(self) -> CloudRecipe | None:
        """The recipe of the depth images, or the one that the dataset's clouds were made with."""
        if self.depth_recipe is not None or self._made_with is None:
            return self.depth_recipe
        crop, made_with = self.crop, self._made_with
        corners = np.array([made_with.crop.low, made_with.crop.high])
        return made_with if crop is None or crop.contains(corners).all() else None

    @property
    def observation(self) -> str:
        """As the dataset says; clouds of depth images show the robot."""
        return cloud_observation(self.features) if self.depth_recipe is None else POINT_CLOUD

    def names(self, key: str) -> list[str] | None:
        """The names of a feature's numbers."""
        return self.features[key].get("names")

    @property
    def has_depth(self) -> bool:
        """Whether there are depth images."""
        return bool(depth_keys(self.features))

    @property
    def has_clouds(self) -> bool:
        """Whether there are clouds."""
        return self._cloud_key is not None

    @property
    def cloud_size(self) -> int | None:
        """The number of points of each of its own clouds; None if they are made from depth."""
        return self._cloud_shape[0] if self.depth_recipe is None and self.has_clouds else None

    def make_clouds(
        self, corners: tuple[Any, Any] | None, n_points: int, folder: str | None, episodes: Sequence[int]
    ) -> None:
        """Make clouds from the depth images from now on.

        Args:
            corners: of the crop; None for that of a simulated camera.
            n_points: of a cloud.
            folder: of calibrations. Without one the dataset's own count, and then those of $LEROBOT_UCA_CALIBRATION.
            episodes: that are looked at, for which the dataset's own must hold.

        Raises:
            CalibrationError: if a calibration or the crop is missing.
            UserError: if colours are wanted, or the dataset's own calibration is that of a moving camera.
        """
        if self.colour:
            raise UserError("--colour=true needs points with colours: depth images have none.")
        calibrations = installed_calibrations(folder) or {}
        if not folder:
            calibrations |= recorded_calibrations(self._dataset, episodes)
        self.depth_recipe = recipe_for(self.features, corners, n_points, calibrations)

    def seen(self, episode: int, frame: int) -> str:
        """The part of the scene that the crop covers in one step, in a line."""
        if self.depth_recipe is None:
            return super().seen(episode, frame)
        item = next(self._items(episode, frame))
        return self._make.seen([item[key].numpy() for key in self.depth_recipe.keys])

    def left_out(self) -> list[str]:
        """Features that are neither state, action nor what the new clouds are made of, and a recipe that is lost."""
        kept = {STATE, ACTION}
        if self.depth_recipe is None:
            mask_key = valid_mask(self._cloud_key or "", self.features)
            kept |= {key for key in (self._cloud_key, self._rgb_key, mask_key) if key}
        else:
            cameras = [camera_of(key) for key in self.depth_recipe.keys]
            kept |= {*self.depth_recipe.keys, *(kind + each for kind in (INTRINSICS, EXTRINSICS) for each in cameras)}
        own = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
        lost = [LOST_RECIPE] if self.depth_recipe is None and self._made_with and self.recipe is None else []
        has_colours = self.depth_recipe is None and not self.colour and self._cloud_shape[-1] > 3
        colours = [f"colours of {self._cloud_key}"] * has_colours
        return [key for key in self.features if key not in kept | own] + colours + lost

    def frames(self, episode: int) -> Iterator[Frame]:
        """The steps of one episode."""
        return map(self._frame, self._items(episode))

    def _items(self, episode: int, first: int = 0) -> Iterator[dict[str, Any]]:
        """The steps of one episode as LeRobot gives them, from one on."""
        row = self._dataset.meta.episodes[episode]
        for frame in range(first, row["dataset_to_index"] - row["dataset_from_index"]):
            with reported(f"Frame {frame} of episode {episode} of '{self.path}' cannot be read"):
                item = self._dataset[row["dataset_from_index"] + frame]
            yield item

    @cached_property
    def _cloud_key(self) -> str | None:
        return find_point_cloud(self.features)

    @property
    def _cloud_shape(self) -> tuple[int, ...]:
        return tuple(self.features[self._cloud_key]["shape"]) if self._cloud_key else (0, 0)

    @cached_property
    def _made_with(self) -> CloudRecipe | None:
        """The recipe by which the dataset's clouds were made, if they were."""
        info = self.features[self._cloud_key].get("info") or {} if self._cloud_key else {}
        return CloudRecipe.from_dict(info[RECIPE_INFO]) if info.get(RECIPE_INFO) else None

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

    def _from_depth(self, item: dict[str, Any]) -> tuple[NDArray[np.float32], int, float, int]:
        assert self.depth_recipe is not None
        images = [item[key].numpy() for key in self.depth_recipe.keys]
        try:
            candidates, n_points = self._make.candidates(images), self._make.n_inside(images)
            valid = [is_valid(view, image).mean() for view, image in zip(self._make.views, images, strict=True)]
        except DepthError as error:
            raise UserError(str(error)) from error
        return candidates, n_points, 1 - float(np.mean(valid)), 0

    def _from_cloud(self, item: dict[str, Any]) -> tuple[NDArray[np.float32], int, float, int]:
        if self._cloud_key is None:
            raise UserError(f"'{self.path}' has neither depth nor a point cloud, got {', '.join(self.features)}.")
        cloud = item[self._cloud_key].numpy()
        if self._rgb_key is not None:
            cloud = np.concatenate([cloud, item[self._rgb_key].numpy()], axis=-1)
        mask_key = valid_mask(self._cloud_key, item)
        mask = None if mask_key is None else item[mask_key]
        return self._cropped(cloud if mask is None else cloud[mask.numpy().astype(bool)])


def _leave_pictures_out(dataset: Any) -> None:
    """Do not decode what is no depth: it would take most of the time, and may be damaged."""
    unused = set(dataset.meta.camera_keys) - set(depth_keys(dataset.features))
    images = sorted(unused & set(dataset.meta.image_keys))
    for key in unused:
        del dataset.meta.info.features[key]
    dataset.reader.hf_dataset = dataset.hf_dataset.remove_columns(images)
