"""The ablation '-Unified/c': action tokens read the conditions by cross-attention, the conditions do not change.

Letters as in `transformer`.
"""

from torch import Tensor, nn

from lerobot_uca.networks.forward_mode import LayerNorm, Linear, attention
from lerobot_uca.networks.transformer import ConditionActionTransformer, SelfAttention


class CrossAttention(nn.Module):
    """Multi-head attention of the action tokens to the condition tokens."""

    def __init__(self, dim: int, n_heads: int) -> None:
        super().__init__()
        self.n_heads = n_heads
        self.q = Linear(dim, dim)
        self.kv = Linear(dim, 2 * dim)
        self.out = Linear(dim, dim)

    def forward(self, Y: Tensor, P: Tensor) -> Tensor:
        """Y (B, T, D) and P (B, S, D) to (B, T, D)."""
        q = self.q(Y).unflatten(-1, (self.n_heads, -1)).transpose(1, 2)  # (B, heads, T, d)
        k, v = self.kv(P).unflatten(-1, (2, self.n_heads, -1)).permute(2, 0, 3, 1, 4)  # (B, heads, S, d)
        return self.out(attention(q, k, v).transpose(1, 2).flatten(-2))


class CrossAttentionBlock(nn.Module):
    """Self-attention among the actions, cross-attention to the conditions, feed-forward.

    The feed-forward layer is half as wide as `Block`'s, which pays for the cross-attention: 12 D^2 weights as there.
    """

    def __init__(self, dim: int, n_heads: int) -> None:
        super().__init__()
        self.norm = LayerNorm(dim)
        self.attention = SelfAttention(dim, n_heads)
        self.norm_actions, self.norm_conditions = LayerNorm(dim), LayerNorm(dim)
        self.cross_attention = CrossAttention(dim, n_heads)
        self.feed_forward = nn.Sequential(LayerNorm(dim), Linear(dim, 2 * dim), nn.GELU(), Linear(2 * dim, dim))

    def forward(self, Y: Tensor, P: Tensor) -> Tensor:
        """Y (B, T, D) and P (B, S, D) to (B, T, D)."""
        Y = Y + self.attention(self.norm(Y))
        Y = Y + self.cross_attention(self.norm_actions(Y), self.norm_conditions(P))
        return Y + self.feed_forward(Y)


class CrossAttentionTransformer(ConditionActionTransformer):
    """Every block reads the same condition tokens."""

    block = CrossAttentionBlock

    def refine(self, P: Tensor, Y: Tensor) -> Tensor:
        """Action tokens alone go through the blocks."""
        for block in self.blocks:
            Y = block(Y, P)
        return Y
