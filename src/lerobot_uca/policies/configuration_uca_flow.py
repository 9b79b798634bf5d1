"""Configuration of UCA-Flow."""

from dataclasses import dataclass
from typing import override

from lerobot.configs import PreTrainedConfig

from lerobot_uca.errors import UserError
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig


@PreTrainedConfig.register_subclass("uca_flow")
@dataclass
class UCAFlowConfig(PointCloudPolicyConfig):
    """Configuration of `UCAFlowPolicy`. See `PointCloudPolicyConfig` for horizons, encoder and training recipe.

    The paper states none of the following values but dual_pass; each says where it comes from.

    Args:
        dim, n_layers, n_heads: width D of the tokens, transformer blocks, attention heads. 3.5 million parameters, half
            of Simple DP3's; a quarter of them, dim = 128, already solves Meta-World's easy tasks (README).
        n_timestep_tokens, n_interval_tokens: N_t and N_h; as many as there are action tokens, not tuned.
        dual_pass: supervise the instantaneous velocity v as well (the paper's method); false is its ablation.
        gamma, c: of the adaptive weight 1 / (||error||^2 + c)^(1 - gamma); with these values it is MP1's.
        interval_mean, interval_std: t and r are two draws from sigmoid(N(mean, std^2)); MP1's values. They rarely draw
            the whole interval [0, 1], which is what one step needs: a wider distribution learns faster in a short
            training (README; configs/uca_flow_small.yaml).
    """

    dim: int = 256
    n_layers: int = 4
    n_heads: int = 4
    n_timestep_tokens: int = 4
    n_interval_tokens: int = 4

    dual_pass: bool = True
    gamma: float = 0.5
    c: float = 1e-3
    interval_mean: float = -0.4
    interval_std: float = 1.0

    @override
    def validate_sizes(self) -> None:
        super().validate_sizes()
        for name in ("n_layers", "n_heads", "n_timestep_tokens", "n_interval_tokens"):
            if getattr(self, name) < 1:
                raise UserError(f"policy.{name} must be at least 1, got {getattr(self, name)}.")
        if self.dim < 2 or self.dim % 2 or self.dim % self.n_heads:
            raise UserError(f"policy.dim must be even and a multiple of n_heads = {self.n_heads}, got {self.dim}.")
