"""The baselines' network: a one-dimensional U-Net over the horizon (DP3, Simple DP3, FlowPolicy, MP1).

Letters: B samples, T horizon, A action dimensions, O observation steps, F observation features, C channels,
K dimensions of the condition.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple, override

import torch
from torch import Tensor, nn
from torch.nn import functional


class StepEmbedding(nn.Module):
    """The baselines' embedding of a time or diffusion step: sines and cosines, followed by an MLP."""

    frequencies: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        half = dim // 2
        frequencies = torch.exp(-math.log(10_000) * torch.arange(half) / (half - 1))
        self.register_buffer("frequencies", frequencies, persistent=False)
        self.mlp = nn.Sequential(nn.Linear(dim, 4 * dim), nn.Mish(), nn.Linear(4 * dim, dim))

    def forward(self, t: Tensor) -> Tensor:
        """(B,) to (B, dim)."""
        angles = t[:, None] * self.frequencies
        return self.mlp(torch.cat([angles.sin(), angles.cos()], dim=-1))


class Convolution(nn.Conv1d):
    """A convolution that is trained as a product of matrices, without the taps that meet nothing but padding.

    The horizon is four steps, two at the second level and one at the third, where of five taps four meet padding. A
    training step takes half as long (`benchmarks/baseline_step.py`). Inference keeps PyTorch's convolution: it is what
    the baselines' code calls, and what the engines have kernels for.
    """

    @override
    def forward(self, x: Tensor) -> Tensor:
        """(B, C_in, T) to (B, C_out, (T + 2 padding - K) / stride + 1) with K taps."""
        if not self.training:
            return super().forward(x)
        assert not isinstance(self.padding, str)
        (n_taps,), (stride,), (padding,), n_in = self.kernel_size, self.stride, self.padding, x.shape[-1]
        n_out = (n_in + 2 * padding - n_taps) // stride + 1
        # Output i reads input i * stride + tap - padding.
        first, end = max(0, padding - (n_out - 1) * stride), min(n_taps, padding + n_in)
        x = functional.pad(x, (padding - first, (n_out - 1) * stride + end - padding - n_in))
        windows = x.unfold(2, end - first, stride).transpose(1, 2).flatten(2)  # (B, n_out, C_in * taps)
        return functional.linear(windows, self.weight[:, :, first:end].flatten(1), self.bias).transpose(1, 2)


class ConvBlock(nn.Sequential):
    """Convolution over time, group normalisation, Mish: (B, C_in, T) to (B, C_out, T)."""

    def __init__(self, n_in: int, n_out: int, kernel_size: int, n_groups: int) -> None:
        super().__init__(
            Convolution(n_in, n_out, kernel_size, padding=kernel_size // 2), nn.GroupNorm(n_groups, n_out), nn.Mish()
        )


class ResidualBlock(nn.Module):
    """Two convolutions; the condition scales and shifts each channel between them (FiLM)."""

    def __init__(self, n_in: int, n_out: int, n_conditions: int, kernel_size: int, n_groups: int) -> None:
        super().__init__()
        self.first = ConvBlock(n_in, n_out, kernel_size, n_groups)
        self.film = nn.Sequential(nn.Mish(), nn.Linear(n_conditions, 2 * n_out))
        self.second = ConvBlock(n_out, n_out, kernel_size, n_groups)
        self.skip = Convolution(n_in, n_out, 1) if n_in != n_out else nn.Identity()

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """X (B, C_in, T) and condition (B, K) to (B, C_out, T)."""
        scale, bias = self.film(condition)[..., None].chunk(2, dim=1)
        return self.second(scale * self.first(x) + bias) + self.skip(x)


class Stage(nn.ModuleList):
    """Residual blocks one after another, all with the same condition."""

    def __init__(
        self, n_blocks: int, n_in: int, n_out: int, *, n_conditions: int, kernel_size: int, n_groups: int
    ) -> None:
        super().__init__(
            ResidualBlock(n_in if i == 0 else n_out, n_out, n_conditions, kernel_size, n_groups)
            for i in range(n_blocks)
        )

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """X (B, C_in, T) and condition (B, K) to (B, C_out, T)."""
        for block in self:
            x = block(x, condition)
        return x


class UNetOutput(NamedTuple):
    """Actions (B, T, A) and, for each level of the way down, its features (B, C, T / 2^level)."""

    actions: Tensor
    levels: list[Tensor]


class UNet1d(nn.Module):
    """Actions from noisy actions and a vector of conditions; the classes below make that vector.

    Args:
        widths: channels of each level. Each level but the last halves the horizon.
        n_blocks: residual blocks of a level and in the middle.
    """

    def __init__(
        self,
        *,
        n_actions: int,
        n_conditions: int,
        widths: Sequence[int],
        n_blocks: int,
        kernel_size: int,
        n_groups: int,
    ) -> None:
        super().__init__()
        block = {"n_conditions": n_conditions, "kernel_size": kernel_size, "n_groups": n_groups}
        n_in = (n_actions, *widths[:-1])
        self.down = nn.ModuleList(Stage(n_blocks, a, b, **block) for a, b in zip(n_in, widths, strict=True))
        self.downsample = nn.ModuleList(Convolution(n, n, 3, stride=2, padding=1) for n in widths[:-1])
        self.middle = Stage(n_blocks, widths[-1], widths[-1], **block)
        # Each stage up also reads the features of the way down, hence twice the channels.
        self.up = nn.ModuleList(Stage(n_blocks, 2 * b, a, **block) for a, b in reversed(list(pairwise(widths))))
        self.upsample = nn.ModuleList(nn.ConvTranspose1d(n, n, 4, stride=2, padding=1) for n in reversed(widths[:-1]))
        self.head = nn.Sequential(
            ConvBlock(widths[0], widths[0], kernel_size, n_groups), Convolution(widths[0], n_actions, 1)
        )

    def forward(self, z: Tensor, condition: Tensor) -> UNetOutput:
        """Z (B, T, A) and condition (B, K); T must be a multiple of 2^(levels - 1)."""
        x = z.transpose(1, 2)
        levels = []
        for i, stage in enumerate(self.down):
            x = stage(x, condition)
            levels.append(x)
            if i < len(self.downsample):
                x = self.downsample[i](x)
        x = self.middle(x, condition)
        # The first level's features are not read on the way up, as in the baselines.
        for stage, upsample, level in zip(self.up, self.upsample, reversed(levels[1:]), strict=True):
            x = upsample(stage(torch.cat([x, level], dim=1), condition))
        return UNetOutput(self.head(x).transpose(1, 2), levels)


class TimeUNet(nn.Module):
    """A U-Net conditioned on one time and the observations: DP3, Simple DP3, FlowPolicy."""

    def __init__(self, *, time_dim: int, n_obs_features: int, n_obs_steps: int, **sizes: Any) -> None:
        super().__init__()
        self.embed_t = StepEmbedding(time_dim)
        self.unet = UNet1d(n_conditions=time_dim + n_obs_steps * n_obs_features, **sizes)

    def forward(self, z: Tensor, t: Tensor, o: Tensor) -> Tensor:
        """Z (B, T, A), t (B,) and o (B, O, F) to (B, T, A)."""
        return self.unet(z, torch.cat([self.embed_t(t), o.flatten(1)], dim=1)).actions


class IntervalUNet(nn.Module):
    """A U-Net conditioned on two times and the observations: MP1."""

    def __init__(self, *, time_dim: int, n_obs_features: int, n_obs_steps: int, **sizes: Any) -> None:
        super().__init__()
        self.embed_t = StepEmbedding(time_dim)
        self.embed_r = StepEmbedding(time_dim)
        self.unet = UNet1d(n_conditions=time_dim + n_obs_steps * n_obs_features, **sizes)

    def forward(self, z: Tensor, t: Tensor, r: Tensor, o: Tensor) -> UNetOutput:
        """Z (B, T, A), t (B,), r (B,) and o (B, O, F) to actions (B, T, A) and the features of the levels."""
        return self.unet(z, torch.cat([self.embed_t(t) + self.embed_r(r), o.flatten(1)], dim=1))
