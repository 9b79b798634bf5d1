"""Embeddings of times in [0, 1]."""

import math

import torch
from torch import Tensor, nn

from lerobot_uca.networks.forward_mode import Linear


class TimeEmbedding(nn.Module):
    """phi(PE(t)): a sinusoidal embedding followed by an MLP.

    t is embedded as it is, in [0, 1]. Scaling it to [0, 1000], as diffusion models do, scales du/dt as well, and the
    Jacobian-vector product of the MeanFlow objective explodes.
    """

    frequencies: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        half = dim // 2
        self.register_buffer("frequencies", torch.exp(-math.log(10_000) * torch.arange(half) / half), persistent=False)
        self.mlp = nn.Sequential(Linear(2 * half, dim), nn.SiLU(), Linear(dim, dim))

    def forward(self, t: Tensor) -> Tensor:
        """(B,) to (B, dim)."""
        angles = t[:, None] * self.frequencies
        return self.mlp(torch.cat([angles.cos(), angles.sin()], dim=-1))
