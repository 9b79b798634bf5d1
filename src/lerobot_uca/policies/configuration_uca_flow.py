"""Configuration of UCA-Flow."""

from dataclasses import dataclass
from typing import override

from lerobot.configs import PreTrainedConfig

from lerobot_uca.bounds import within
from lerobot_uca.errors import UserError
from lerobot_uca.networks.conditioning import CONDITIONING
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig
from lerobot_uca.registry import register


@register(PreTrainedConfig, "uca_flow")
@dataclass
class UCAFlowConfig(PointCloudPolicyConfig):
    """Configuration of `UCAFlowPolicy`. See `PointCloudPolicyConfig` for horizons, encoder and training recipe.

    The paper states none of the following values but conditioning and dual_pass; each says where it comes from.
    """

    # Width D of the tokens. With 256 there are 3.5 million parameters, half of Simple DP3's; 128 gives
    # a quarter of them; docs/results.md was measured with it.
    dim: int = within(256, least=2, most=8192)
    # Transformer blocks.
    n_layers: int = within(4, least=1, most=128)
    # Attention heads.
    n_heads: int = within(4, least=1, most=128)
    # Timestep tokens N_t; as many as there are action tokens, not tuned.
    n_timestep_tokens: int = within(4, least=1, most=1024)
    # Interval tokens N_h; likewise.
    n_interval_tokens: int = within(4, least=1, most=1024)

    # Path from conditions to actions: unified (the paper's method), cross_attention or adaln (its ablations, of the
    # same size).
    conditioning: str = "unified"
    # What computes the actions: openvino, openvino_bfloat16 or onnxruntime (on a CPU; elsewhere it is PyTorch), eager
    # (PyTorch) or compile (torch.compile, on a GPU with CUDA graphs); docs/inference.md compares them.
    inference: str = "openvino"

    # Supervise the instantaneous velocity v as well (the paper's method); false is its ablation.
    dual_pass: bool = True
    # The gamma of the adaptive weight 1 / (||error||^2 + c)^(1 - gamma); with 0.5 and 0.001 it is MP1's.
    gamma: float = within(0.5, least=0, most=1)
    # See gamma.
    c: float = within(1e-3, above=0)
    # t and r are two draws from sigmoid(N(interval_mean, interval_std^2)); MP1's values. They rarely draw the whole
    # interval [0, 1], which is what one step needs: a wider distribution got further in short trainings
    # (docs/recipe.md).
    interval_mean: float = within(-0.4, least=-10, most=10)
    # See interval_mean.
    interval_std: float = within(1.0, above=0, most=10)

    @override
    def validate_sizes(self) -> None:
        super().validate_sizes()
        if self.dim % 2 or self.dim % self.n_heads:
            raise UserError(f"policy.dim must be even and a multiple of n_heads = {self.n_heads}, got {self.dim}.")
        if self.conditioning not in CONDITIONING:
            raise UserError(f"policy.conditioning must be one of {', '.join(CONDITIONING)}, got '{self.conditioning}'.")
