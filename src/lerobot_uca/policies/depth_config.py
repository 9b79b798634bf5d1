"""Options for a policy's cloud from a dataset's depth images, and the recipe that they become."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_uca.bounds import check_bounds, within
from lerobot_uca.errors import UserError
from lerobot_uca.features import EXTRINSICS, INTRINSICS, OBS_POINT_CLOUD, find_point_cloud
from lerobot_uca.point_clouds.calibration import Calibration, CalibrationError
from lerobot_uca.point_clouds.recipe import (
    RECIPE_INFO,
    SIMULATED,
    CloudRecipe,
    Features,
    camera_of,
    depth_keys,
    installed_calibrations,
    optional_crop,
    recipe_for,
)

logger = logging.getLogger(__name__)

DEFAULT_POINTS = 512


@dataclass
class DepthConfig:
    """Training from depth images, and running on a robot that has them. Metres, in the robot's base frame."""

    # Lowest corner of the crop: points outside do not belong to the cloud. lerobot-uca-view helps to choose it.
    crop_low: tuple[float, float, float] | None = None
    # Highest corner of the crop.
    crop_high: tuple[float, float, float] | None = None
    # Points of the cloud. policy.n_points may look at fewer of them.
    n_points: int = within(DEFAULT_POINTS, least=1, most=100_000)
    # Folder of the cameras' calibrations, in training and on the robot; by default $LEROBOT_UCA_CALIBRATION.
    calibration: str | None = None
    # The recipe of training's clouds; written by training, not for users.
    recipe: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        self._of_data: dict[str, Calibration] = {}  # by camera; of this process's training, and not saved

    @property
    def is_settled(self) -> bool:
        """Whether the recipe is that of a training in this process, whose clouds are to be made by it as it is."""
        return bool(self._of_data)

    def know_calibrations(self, recorded: Mapping[str, Calibration]) -> None:
        """Take note of those that a training's data hold, by camera, before it is settled.

        A folder that is named counts before them.
        """
        self._of_data = dict(recorded)

    def keep_calibrations(self) -> None:
        """Keep the recipe's: the data are those that it was made for, or clouds, which need none of this machine's."""
        self._of_data = _calibrations(self.recipe)

    def settle(self, features: Features) -> CloudRecipe | None:
        """The recipe for a dataset's features, which the configuration keeps; None if it has clouds of unknown origin.

        LeRobot asks for it more than once in a training: the calibrations remain those of the first time.

        Raises:
            UserError: if depth images need a calibration or a crop that is not there, or if another recipe is kept.
        """
        check_bounds(self, "policy.depth")
        try:
            recipe = self._recipe_for(features)
            if recipe is not None:
                self._take(recipe, is_told=self.recipe is not None and find_point_cloud(features) is not None)
        except CalibrationError as error:
            raise UserError(str(error)) from error
        self.calibration = None  # a path of this machine; the recipe holds what was in it
        return recipe

    def add_statistics(self, stats: dict[str, dict[str, Any]]) -> None:
        """Give a dataset of depth images the statistics of the clouds made from them: the crop's corners.

        LeRobot hands the same dictionary to the normaliser, which passes what has no statistics as it is. So does a
        training that starts from a checkpoint: there, too, they have to be in the dataset's.
        """
        if self.recipe is not None and find_point_cloud(stats) is None:
            low, high = self.recipe["crop"]
            stats[OBS_POINT_CLOUD] = {"min": np.array(low, np.float32), "max": np.array(high, np.float32)}

    def _recipe_for(self, features: Features) -> CloudRecipe | None:
        kept = CloudRecipe.from_dict(self.recipe) if self.recipe is not None else None
        cloud_key = find_point_cloud(features)
        if cloud_key is not None:
            made_with = (features[cloud_key].get("info") or {}).get(RECIPE_INFO)
            return _further(kept, CloudRecipe.from_dict(made_with) if made_with else None)
        keys = depth_keys(features)
        if not keys:
            return kept
        crop = kept.crop if kept else optional_crop(self.crop_low, self.crop_high)
        recipe = recipe_for(
            features,
            None if crop is None else (crop.low, crop.high),
            kept.n_points if kept else self.n_points,
            self._calibrations_of({camera_of(key) for key in keys}, features),
        )
        if kept is not None:
            _say_differences(kept, recipe)
        return recipe

    def _calibrations_of(self, cameras: set[str], features: Features) -> Mapping[str, Calibration]:
        if self.calibration:
            return installed_calibrations(self.calibration) or {}
        if cameras <= self._of_data.keys():
            return self._of_data
        unread = [
            name for name in cameras - self._of_data.keys() if {INTRINSICS + name, EXTRINSICS + name} <= features.keys()
        ]
        if unread:
            raise CalibrationError(
                f"The dataset holds the calibration of camera '{unread[0]}', which lerobot-train and "
                "lerobot-uca-convert read. Use one of these, or name a folder with policy.depth.calibration."
            )
        of_checkpoint = _calibrations(self.recipe)
        known = {**(installed_calibrations() or {}), **self._of_data}
        for name in cameras & of_checkpoint.keys() - known.keys():
            if of_checkpoint[name].method != SIMULATED:
                logger.warning(
                    "Camera '%s': the calibration of the checkpoint's training is used for this data, too (%s).",
                    *(name, of_checkpoint[name].date or "no date"),
                )
        return {**of_checkpoint, **known}

    def _take(self, recipe: CloudRecipe, *, is_told: bool) -> None:
        """Hold what counts, and say which options do not, unless that has been told."""
        crop = optional_crop(self.crop_low, self.crop_high)
        ignored = [] if crop in (None, recipe.crop) else ["policy.depth.crop_low and crop_high"]
        ignored += [] if self.n_points in (DEFAULT_POINTS, recipe.n_points) else ["policy.depth.n_points"]
        if ignored and not is_told:
            logger.warning(
                "Clouds are as they have been made before, %d points of the crop %s to %s: %s do not count.",
                *(recipe.n_points, list(recipe.crop.low), list(recipe.crop.high), " and ".join(ignored)),
            )
        if crop is not None:
            self.crop_low, self.crop_high = recipe.crop.low, recipe.crop.high
        self.n_points, self.recipe = recipe.n_points, recipe.as_dict()
        self._of_data = _calibrations(self.recipe)


def _calibrations(recipe: Mapping[str, Any] | None) -> dict[str, Calibration]:
    """By camera."""
    sources = CloudRecipe.from_dict(recipe).sources if recipe is not None else ()
    return {camera_of(source.key): source.calibration for source in sources}


def _further(kept: CloudRecipe | None, made_with: CloudRecipe | None) -> CloudRecipe | None:
    """The recipe of a checkpoint that is trained on clouds: theirs, since the robot's must become the same."""
    if kept is None or made_with is None:
        if kept is not None:
            logger.warning("The dataset does not say how its clouds were made; the policy will make them as before.")
        return kept or made_with
    if kept.keys != made_with.keys:
        differences = [f"the dataset's clouds are made from {', '.join(made_with.keys)}, not {', '.join(kept.keys)}"]
    else:
        differences = kept.differences(made_with)
    if differences:
        logger.warning("The policy will make clouds as the dataset's were made: %s.", "; ".join(differences))
    return made_with


def _say_differences(kept: CloudRecipe, recipe: CloudRecipe) -> None:
    """A checkpoint goes on making clouds from the same images, and of data of another installation as that is."""
    if kept.keys != recipe.keys:
        raise CalibrationError(
            f"The checkpoint makes its cloud from {', '.join(kept.keys)}, the dataset has {', '.join(recipe.keys)}."
        )
    differences = kept.differences(recipe)
    if differences:
        logger.warning("Compared with the checkpoint's training, %s.", "; ".join(differences))
