"""The base of this package's processor steps that change values, and no feature's name or shape."""

from dataclasses import asdict
from typing import Any, override

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import ProcessorStep


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
