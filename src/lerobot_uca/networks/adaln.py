"""The ablation '-Unified/a': the conditions scale and shift the action tokens (AdaLN, as in DiT without its gates).

Letters as in `transformer`.
"""

import torch
from torch import Tensor, nn

from lerobot_uca.networks.forward_mode import LayerNorm, Linear
from lerobot_uca.networks.transformer import ConditionActionTransformer, SelfAttention


class AdaLNBlock(nn.Module):
    """A transformer block whose normalisations are scaled and shifted by the conditions.

    The feed-forward layer is half as wide as `Block`'s, which pays for the modulation: 12 D^2 weights as there.
    """

    def __init__(self, dim: int, n_heads: int) -> None:
        super().__init__()
        self.norm = LayerNorm(dim, elementwise_affine=False)
        self.attention = SelfAttention(dim, n_heads)
        self.feed_forward = nn.Sequential(Linear(dim, 2 * dim), nn.GELU(), Linear(2 * dim, dim))
        self.modulation = nn.Sequential(nn.SiLU(), Linear(dim, 4 * dim))
        for parameter in self.modulation.parameters():  # training starts from a plain transformer
            nn.init.zeros_(parameter)

    def forward(self, Y: Tensor, condition: Tensor) -> Tensor:
        """Y (B, T, D) and condition (B, D) to (B, T, D)."""
        scale_1, shift_1, scale_2, shift_2 = self.modulation(condition)[:, None].chunk(4, dim=-1)
        Y = Y + self.attention(self.norm(Y) * (1 + scale_1) + shift_1)
        return Y + self.feed_forward(self.norm(Y) * (1 + scale_2) + shift_2)


class AdaLNTransformer(ConditionActionTransformer):
    """Every block is modulated by the same vector, a weighted sum of the condition tokens, channel by channel."""

    block = AdaLNBlock

    def __init__(self, **sizes: int) -> None:
        super().__init__(**sizes)
        n_conditions = sizes["n_obs_steps"] + sizes["n_timestep_tokens"] + sizes["n_interval_tokens"]
        self.pooling = nn.Parameter(torch.randn(n_conditions, sizes["dim"]))

    def refine(self, P: Tensor, Y: Tensor) -> Tensor:
        """Action tokens alone go through the blocks."""
        condition = (self.pooling * P).sum(dim=1)
        for block in self.blocks:
            Y = block(Y, condition)
        return Y
