"""Configuration of FlowPolicy."""

from dataclasses import dataclass
from typing import override

from lerobot.configs import PreTrainedConfig

from lerobot_uca.errors import UserError
from lerobot_uca.policies.configuration_unet import UNetPolicyConfig
from lerobot_uca.registry import register


@register(PreTrainedConfig, "flowpolicy")
@dataclass
class FlowConfig(UNetPolicyConfig):
    """Configuration of `FlowPolicy`. Time runs from noise at 0 to data at 1."""

    # The earliest time, in training and at inference.
    t_min: float = 0.01
    # Distance of the two times that are compared.
    delta: float = 0.01
    # Segments of [0, 1], within each of which the flow is straight.
    n_segments: int = 2
    # Weight of the velocities' difference.
    alpha: float = 1e-5

    @override
    def validate_sizes(self) -> None:
        super().validate_sizes()
        for name in ("t_min", "delta"):
            if not 0 < getattr(self, name) < 1:
                raise UserError(f"policy.{name} must be between 0 and 1, got {getattr(self, name)}.")
        if self.n_segments < 1:
            raise UserError(f"policy.n_segments must be at least 1, got {self.n_segments}.")


register(PreTrainedConfig, "flow")(FlowConfig)  # the type's name until 0.1: checkpoints that hold it still load
