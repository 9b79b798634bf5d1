"""Configuration of MP1."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_uca.bounds import within
from lerobot_uca.policies.configuration_unet import UNetPolicyConfig
from lerobot_uca.registry import register


@register(PreTrainedConfig, "mp1")
@dataclass
class MP1Config(UNetPolicyConfig):
    """Configuration of `MP1Policy`."""

    # Weight of the dispersive loss.
    dispersive_weight: float = within(0.5, least=0)
    # The constant c of the adaptive weight 1 / (D^2 + c)^(1/2).
    c: float = within(1e-3, above=0)
    # t and r are two draws from sigmoid(N(interval_mean, interval_std^2)).
    interval_mean: float = within(-0.4, least=-10, most=10)
    # See interval_mean.
    interval_std: float = within(1.0, above=0, most=10)
