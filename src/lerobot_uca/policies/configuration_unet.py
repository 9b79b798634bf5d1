"""Configuration shared by the baselines: the size of the U-Net."""

from dataclasses import dataclass
from typing import Any, override

from lerobot_uca.bounds import within
from lerobot_uca.errors import UserError
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig


@dataclass
class UNetPolicyConfig(PointCloudPolicyConfig):
    """Configuration shared by the policies whose network is the baselines' U-Net, at the size of DP3's."""

    # Channels of the U-Net's levels; each level but the last halves the horizon.
    unet_widths: tuple[int, ...] = within((512, 1024, 2048), least=1, most=8192)
    # Residual blocks of a level and in the middle.
    unet_blocks: int = within(2, least=1, most=64)
    # Steps that a convolution sees.
    unet_kernel_size: int = within(5, least=1, most=255)
    # Groups of a group normalisation.
    unet_groups: int = within(8, least=1, most=8192)
    # Width of a time's embedding.
    time_dim: int = within(128, least=4, most=8192)

    @override
    def validate_sizes(self) -> None:
        super().validate_sizes()
        if any(width % self.unet_groups for width in self.unet_widths):
            raise UserError(
                f"policy.unet_widths must be multiples of unet_groups = {self.unet_groups}, "
                f"got {list(self.unet_widths)}."
            )
        if self.horizon % 2 ** (len(self.unet_widths) - 1):
            raise UserError(
                f"policy.horizon must be a multiple of {2 ** (len(self.unet_widths) - 1)}, for each of the "
                f"{len(self.unet_widths)} unet_widths but the last halves it, got {self.horizon}."
            )
        if self.unet_kernel_size % 2 == 0:
            raise UserError(f"policy.unet_kernel_size must be odd, got {self.unet_kernel_size}.")
        if self.time_dim % 2:
            raise UserError(f"policy.time_dim must be even, got {self.time_dim}.")

    @property
    def unet_sizes(self) -> dict[str, Any]:
        """The arguments of `TimeUNet` and `IntervalUNet`."""
        return {
            "n_actions": self.n_actions,
            "n_obs_steps": self.n_obs_steps,
            "n_obs_features": self.n_obs_features,
            "time_dim": self.time_dim,
            "widths": self.unet_widths,
            "n_blocks": self.unet_blocks,
            "kernel_size": self.unet_kernel_size,
            "n_groups": self.unet_groups,
        }
