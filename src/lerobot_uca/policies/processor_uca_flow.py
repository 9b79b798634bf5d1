"""Pre- and postprocessing of UCA-Flow: LeRobot's own, with min-max normalisation."""

from typing import Any

from lerobot.lerobot_types import PolicyAction
from lerobot.processor import PolicyProcessorPipeline, make_default_pre_post_processors
from torch import Tensor

from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig


def make_uca_flow_pre_post_processors(
    config: UCAFlowConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]:
    """LeRobot's default pipelines: rename, batch, move, normalise; and back."""
    return make_default_pre_post_processors(config, dataset_stats)
