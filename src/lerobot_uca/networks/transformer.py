"""The Unified Condition-Action Transformer (paper sections 3.2 and 3.3).

Letters: B samples, T horizon, A action dimensions, O observation steps, F observation features, D token width,
S tokens of the sequence, P condition tokens, Y action tokens.
"""

from abc import abstractmethod
from typing import ClassVar

import torch
from torch import Tensor, nn

from lerobot_uca.networks.embeddings import TimeEmbedding
from lerobot_uca.networks.forward_mode import LayerNorm, Linear, attention


class SelfAttention(nn.Module):
    """Multi-head self-attention."""

    def __init__(self, dim: int, n_heads: int) -> None:
        super().__init__()
        self.n_heads = n_heads
        self.qkv = Linear(dim, 3 * dim)
        self.out = Linear(dim, dim)

    def forward(self, tokens: Tensor, n_out: int | None = None) -> Tensor:
        """The last n_out tokens (default: all) attend to all tokens: (B, S, D) to (B, n_out, D)."""
        qkv = self.qkv(tokens).unflatten(-1, (3, self.n_heads, -1))
        q, k, v = qkv.permute(2, 0, 3, 1, 4).contiguous()  # (B, heads, S, d); one copy instead of one for each product
        if n_out is not None:
            q = q[:, :, -n_out:]
        return self.out(attention(q, k, v).transpose(1, 2).flatten(-2))


class Block(nn.Module):
    """A pre-norm transformer block over the whole sequence."""

    def __init__(self, dim: int, n_heads: int) -> None:
        super().__init__()
        self.norm = LayerNorm(dim)
        self.attention = SelfAttention(dim, n_heads)
        self.feed_forward = nn.Sequential(LayerNorm(dim), Linear(dim, 4 * dim), nn.GELU(), Linear(4 * dim, dim))

    def forward(self, tokens: Tensor, n_out: int | None = None) -> Tensor:
        """The last n_out tokens (default: all) after the block: (B, S, D) to (B, n_out, D)."""
        attended = self.attention(self.norm(tokens), n_out)
        tokens = (tokens if n_out is None else tokens[:, -n_out:]) + attended
        return tokens + self.feed_forward(tokens)


class ConditionActionTransformer(nn.Module):
    """u(z, t, h, o) from condition tokens P = [c_1 .. c_O, tau_1 .. tau_Nt, eta_1 .. eta_Nh] and action tokens Y.

    P stands for observations, timestep and interval, Y for the noisy actions; the output head reads Y alone. A subclass
    says how P reaches Y (`refine`), the one thing in which UCA-Flow and its ablations differ.
    """

    block: ClassVar[type[nn.Module]]

    def __init__(
        self,
        *,
        horizon: int,
        n_actions: int,
        n_obs_steps: int,
        n_obs_features: int,
        dim: int,
        n_layers: int,
        n_heads: int,
        n_timestep_tokens: int,
        n_interval_tokens: int,
    ) -> None:
        super().__init__()
        self.embed_observation = Linear(n_obs_features, dim)
        self.embed_timestep = TimeEmbedding(dim)
        self.embed_interval = TimeEmbedding(dim)
        self.embed_action = Linear(n_actions, dim)
        self.observation_positions = nn.Parameter(0.02 * torch.randn(n_obs_steps, dim))
        self.timestep_biases = nn.Parameter(0.02 * torch.randn(n_timestep_tokens, dim))
        self.interval_biases = nn.Parameter(0.02 * torch.randn(n_interval_tokens, dim))
        self.action_positions = nn.Parameter(0.02 * torch.randn(horizon, dim))
        self.blocks = nn.ModuleList(self.block(dim, n_heads) for _ in range(n_layers))
        self.head = nn.Sequential(LayerNorm(dim), Linear(dim, n_actions))

    @abstractmethod
    def refine(self, P: Tensor, Y: Tensor) -> Tensor:
        """Action tokens (B, T, D) after all blocks, from condition tokens P (B, S, D) and action tokens Y (B, T, D)."""

    def forward(self, z: Tensor, t: Tensor, h: Tensor, o: Tensor) -> Tensor:
        """Z (B, T, A), t (B,), h (B,), o (B, O, F) to u (B, T, A)."""
        P = torch.cat(
            [
                self.embed_observation(o) + self.observation_positions,
                self.embed_timestep(t)[:, None] + self.timestep_biases,
                self.embed_interval(h)[:, None] + self.interval_biases,
            ],
            dim=1,
        )
        return self.head(self.refine(P, self.embed_action(z) + self.action_positions))


class UnifiedTransformer(ConditionActionTransformer):
    """Conditions and actions are tokens of one sequence [P, Y] and refine each other."""

    block = Block

    def refine(self, P: Tensor, Y: Tensor) -> Tensor:
        """All tokens go through the blocks; the last block computes the action tokens only."""
        tokens = torch.cat([P, Y], dim=1)
        *earlier, last = self.blocks
        for block in earlier:
            tokens = block(tokens)
        return last(tokens, n_out=Y.shape[1])  # the head does not read the others
