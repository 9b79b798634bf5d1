"""FlowPolicy's objective: consistency flow matching. Two times on one line predict the same end of their segment.

Time runs the other way than in the rest of this package: t = 0 is noise, t = 1 is data, z = (1 - t) e + t x, and the
velocity v points from noise to actions. Letters: B samples, T horizon, A action dimensions.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from lerobot_uca.objectives.mean_square import mean_square

TIME_SCALE = 99  # the network is given 99 t

VelocityNetwork = Callable[[Tensor, Tensor, Tensor], Tensor]
"""v(z, 99 t, o): z (B, T, A), 99 t (B,), o (B, ...) to (B, T, A)."""


def consistency_flow_loss(
    network: VelocityNetwork,
    x: Tensor,
    o: Tensor,
    mask: Tensor,
    *,
    t_min: float,
    delta: float,
    n_segments: int,
    alpha: float,
) -> Tensor:
    """The disagreement of two neighbouring times t < r, ||f_t - f_r||^2 + alpha ||v_t - v_r||^2 as means, (B,).

    f = z + (end - time) v is where the segment that holds t ends; at r = 1 that is x itself, the one place where the
    actions come in. FlowPolicy's paper compares with averaged weights; its code, and so this, trains both sides.

    Args:
        x: (B, T, A) expert actions, normalised. o: (B, ...). mask: (B, T), True for steps that count.
        t_min: t is uniform in [t_min, 1].
        delta: r = min(t + delta, 1).
        n_segments: of equal length.
        alpha: weight of the velocities' difference, which does not count within 1.01 delta of the segment's end.
    """
    e = torch.randn_like(x)
    t = t_min + (1 - t_min) * torch.rand(len(x), device=x.device, dtype=x.dtype)
    r = (t + delta).clamp(max=1)
    end = (t * n_segments).ceil() / n_segments

    def predict(time: Tensor) -> tuple[Tensor, Tensor]:
        z = torch.lerp(e, x, time[:, None, None])
        v = network(z, TIME_SCALE * time, o)
        return z + (end - time)[:, None, None] * v, v

    f_t, v_t = predict(t)
    f_r, v_r = predict(r)
    f_r = torch.where((r < 1)[:, None, None], f_r, x)
    far_from_end = end - t > 1.01 * delta
    return mean_square(f_t - f_r, mask) + alpha * far_from_end * mean_square(v_t - v_r, mask)


def one_euler_step(network: VelocityNetwork, noise: Tensor, o: Tensor, *, t_min: float) -> Tensor:
    """Actions (B, T, A) from noise in one call: the velocity at t_min, followed for one whole unit of time."""
    t = torch.full((len(noise),), t_min, device=noise.device)
    return noise + network(noise, TIME_SCALE * t, o)
