"""The preprocessor step that makes a policy's cloud from depth images, the same in training and on the robot.

Letters: B samples, O observation steps, H, W height and width of an image, N points.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, override

import numpy as np
import torch
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import RobotObservation
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry
from torch import Tensor

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.point_clouds.calibration import CalibrationError
from lerobot_uca.point_clouds.depth import DepthError, DepthToCloud
from lerobot_uca.point_clouds.recipe import CALIBRATION_VARIABLE, SIMULATED, CloudRecipe, installed_calibrations

logger = logging.getLogger(__name__)


@dataclass
@ProcessorStepRegistry.register(name="depth_to_cloud_processor")
class DepthToCloudProcessorStep(ObservationProcessorStep):
    """Replaces depth images by the cloud that they show. An observation that holds the cloud already stays as it is.

    Depth images (1, H, W) or with further dimensions before, such as (B, 1, H, W) of a live uint16 frame and
    (B, O, 1, H, W) of a batch from a dataset, become clouds (N, 3), (B, N, 3) or (B, O, N, 3) float32 [m].

    The cameras are where this installation's calibrations say they are and otherwise where they were in training; the
    step says how far that is apart.

    Args:
        recipe: how clouds were made in training, a `CloudRecipe` as a dictionary; None if the policy was trained on
            clouds of unknown origin. Then the step does nothing.
    """

    recipe: dict[str, Any] | None = None
    _present: CloudRecipe | None = field(default=None, init=False, repr=False, compare=False)
    _make: DepthToCloud | None = field(default=None, init=False, repr=False, compare=False)

    def install(self, folder: str | None = None) -> None:
        """Take this installation's calibrations; at the first depth image at the latest.

        Args:
            folder: of calibrations; by default $LEROBOT_UCA_CALIBRATION.

        Raises:
            UserError: if a camera is not calibrated, or if something cannot be right.
        """
        self._use(lambda trained: _installed(trained, folder))

    def keep(self) -> None:
        """Let the cameras be where the recipe says: what comes is the data of its training.

        Raises:
            UserError: as `install`.
        """
        self._use(lambda trained: trained)

    def _use(self, present: Callable[[CloudRecipe], CloudRecipe]) -> None:
        if self.recipe is None:
            return
        try:
            self._present = present(CloudRecipe.from_dict(self.recipe))
            self._make = self._present.make()
        except CalibrationError as error:
            raise UserError(str(error)) from error

    @override
    def observation(self, observation: RobotObservation) -> RobotObservation:
        if self.recipe is None or OBS_POINT_CLOUD in observation:
            return observation
        if self._present is None:
            self.install()
        recipe = self._present
        assert recipe is not None
        missing = [key for key in recipe.keys if key not in observation]
        if missing:
            raise UserError(
                f"The policy makes its cloud from {', '.join(recipe.keys)}: {', '.join(missing)} is missing, got "
                f"{', '.join(observation) or 'nothing'}. The camera needs use_depth: true."
            )
        rest = {key: value for key, value in observation.items() if key not in recipe.keys}
        return {**rest, OBS_POINT_CLOUD: self._clouds([observation[key] for key in recipe.keys])}

    def _clouds(self, images: list[Any]) -> Tensor:
        """Images (..., 1, H, W), one a camera, to clouds (..., N, 3) on the device that the images are on."""
        arrays = [_as_array(image) for image in images]
        leading = arrays[0].shape[:-3]
        frames = [array.reshape(-1, *array.shape[-3:]) for array in arrays]
        try:
            assert self._make is not None
            clouds = [self._make(views) for views in zip(*frames, strict=True)]
        except DepthError as error:
            raise UserError(str(error)) from error
        made = torch.from_numpy(np.stack(clouds).reshape(*leading, *clouds[0].shape))
        return made.to(images[0].device) if isinstance(images[0], Tensor) else made

    @override
    def get_config(self) -> dict[str, Any]:
        return {"recipe": self.recipe}

    @override
    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        observations = features[PipelineFeatureType.OBSERVATION]
        if self.recipe is None or OBS_POINT_CLOUD in observations:
            return features
        recipe = CloudRecipe.from_dict(self.recipe)
        rest = {key: feature for key, feature in observations.items() if key not in recipe.keys}
        cloud = PolicyFeature(FeatureType.STATE, (recipe.n_points, 3))
        return {**features, PipelineFeatureType.OBSERVATION: {**rest, OBS_POINT_CLOUD: cloud}}


def _installed(trained: CloudRecipe, folder: str | None) -> CloudRecipe:
    """The recipe with this installation's calibrations, if it has some, and a line about what differs."""
    calibrations = installed_calibrations(folder)
    if calibrations is not None:
        present = trained.with_calibrations(calibrations)
        differences = trained.differences(present)
        if differences:
            logger.warning("Compared with the policy's training, %s.", "; ".join(differences))
        return present
    for source in trained.sources:
        calibration = source.calibration
        if calibration.method != SIMULATED:
            logger.warning(
                "Camera '%s': the calibration of the policy's training is used (%s). %s names a folder of others.",
                calibration.camera.name,
                calibration.date or "no date",
                CALIBRATION_VARIABLE,
            )
    return trained


def _as_array(image: Any) -> np.ndarray:
    if isinstance(image, Tensor):
        image = (image.float() if image.dtype is torch.bfloat16 else image).detach().cpu().numpy()  # NumPy has none
    array = np.asarray(image)
    return array[None] if array.ndim == 2 else array
