"""Configuration of Simple DP3."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_uca.bounds import within
from lerobot_uca.policies.configuration_dp3 import DP3Config
from lerobot_uca.registry import register


@register(PreTrainedConfig, "simple_dp3")
@dataclass
class SimpleDP3Config(DP3Config):
    """Configuration of `SimpleDP3Policy`: DP3 with a smaller U-Net."""

    # Channels of the U-Net's levels; each level but the last halves the horizon.
    unet_widths: tuple[int, ...] = within((128, 256, 384), least=1, most=8192)
    # Residual blocks of a level and in the middle.
    unet_blocks: int = within(1, least=1, most=64)
