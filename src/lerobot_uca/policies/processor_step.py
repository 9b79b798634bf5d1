"""The base of this package's processor steps that change values, and no feature's name or shape."""

from dataclasses import asdict
from typing import Any, override

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep
from torch import Tensor

from lerobot_uca.features import OBS_POINT_CLOUD


def training_clouds(transition: EnvTransition) -> Tensor | None:
    """The clouds (B, O, N, C) of a batch of training, which steps may change; None for what is to stay as it is.

    Training's are windows, with actions, and gradients are computed: not so in an evaluation, a validation or on a
    robot. Single frames, as of a dataset without LeRobot's delta_timestamps, are not training's either.
    """
    cloud = (transition.get(TransitionKey.OBSERVATION) or {}).get(OBS_POINT_CLOUD)
    has_action = transition.get(TransitionKey.ACTION) is not None
    return cloud if has_action and torch.is_grad_enabled() and cloud is not None and cloud.ndim == 4 else None


class SameFeaturesStep(ProcessorStep):
    """A dataclass whose fields are what a checkpoint keeps of it."""

    @override
    def get_config(self) -> dict[str, Any]:
        return asdict(self)

    @override
    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features
