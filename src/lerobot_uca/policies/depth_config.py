"""Options for a policy's cloud from a dataset's depth images, and the recipe that they become."""

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_uca.bounds import check_bounds, within
from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD, find_point_cloud
from lerobot_uca.point_clouds.calibration import CalibrationError
from lerobot_uca.point_clouds.recipe import (
    RECIPE_INFO,
    CloudRecipe,
    Features,
    depth_keys,
    installed_calibrations,
    recipe_for,
)

logger = logging.getLogger(__name__)


@dataclass
class DepthConfig:
    """Training from depth images, and running on a robot that has them. Metres, in the robot's base frame."""

    # Lowest corner of the crop: points outside do not belong to the cloud. lerobot-uca-view helps to choose it.
    crop_low: tuple[float, float, float] | None = None
    # Highest corner of the crop.
    crop_high: tuple[float, float, float] | None = None
    # Points of the cloud. policy.n_points may look at fewer of them.
    n_points: int = within(512, least=1, most=100_000)
    # Folder of the cameras' calibrations, in training and on the robot; by default $LEROBOT_UCA_CALIBRATION.
    calibration: str | None = None
    # The recipe of training's clouds; written by training, not for users.
    recipe: dict[str, Any] | None = None

    def settle(self, features: Features) -> CloudRecipe | None:
        """The recipe for a dataset's features, which the configuration keeps; None if it has clouds of unknown origin.

        Raises:
            UserError: if depth images need a calibration or a crop that is not there, or if another recipe is kept.
        """
        check_bounds(self, "policy.depth")
        try:
            recipe = self._recipe_for(features)
        except CalibrationError as error:
            raise UserError(str(error)) from error
        self.calibration = None  # a path of this machine; the recipe holds what was in it
        if recipe is not None:
            self.recipe = recipe.as_dict()
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
        recipe = recipe_for(features, self._crop(kept), kept.n_points if kept else self.n_points, self.calibration)
        if kept is not None:
            _check_same(kept, recipe)
        return recipe

    def _crop(self, kept: CloudRecipe | None) -> tuple[Any, Any] | None:
        if kept is not None:
            return kept.crop.low, kept.crop.high
        if self.crop_low is None or self.crop_high is None:
            return None
        return self.crop_low, self.crop_high


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


def _check_same(kept: CloudRecipe, recipe: CloudRecipe) -> None:
    """A checkpoint goes on making clouds as in its training, so its new data must be of the same installation."""
    if kept.keys != recipe.keys:
        raise CalibrationError(
            f"The checkpoint makes its cloud from {', '.join(kept.keys)}, the dataset has {', '.join(recipe.keys)}."
        )
    installed = installed_calibrations()
    uses = kept.with_calibrations(installed) if installed is not None else kept
    differences = uses.differences(recipe)
    if differences:
        raise CalibrationError(
            f"The checkpoint would make clouds as in its own installation, but in the dataset's {differences[0]}. Let "
            "LEROBOT_UCA_CALIBRATION name the dataset's calibrations, or convert it with lerobot-uca-convert first."
        )
