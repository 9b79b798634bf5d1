"""Configuration of FlowPolicy."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_uca.bounds import within
from lerobot_uca.policies.configuration_unet import UNetPolicyConfig
from lerobot_uca.registry import register


@register(PreTrainedConfig, "flowpolicy")
@dataclass
class FlowConfig(UNetPolicyConfig):
    """Configuration of `FlowPolicy`. Time runs from noise at 0 to data at 1."""

    # The earliest time, in training and at inference.
    t_min: float = within(0.01, above=0, below=1)
    # Distance of the two times that are compared.
    delta: float = within(0.01, above=0, below=1)
    # Segments of [0, 1], within each of which the flow is straight.
    n_segments: int = within(2, least=1, most=1000)
    # Weight of the velocities' difference.
    alpha: float = within(1e-5, least=0)


register(PreTrainedConfig, "flow")(FlowConfig)  # the type's name until 0.1: checkpoints that hold it still load
