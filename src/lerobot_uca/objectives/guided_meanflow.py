"""MP1's objective: MeanFlow with a guided target, and a loss that keeps the features of different samples apart.

x, e, t, r, z, v and u as in `lerobot_uca.meanflow` (t = 1 is noise), but the network is given r, not the interval h.
Letters: B samples, T horizon, A action dimensions.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_uca.meanflow import sample_intervals
from lerobot_uca.networks.unet1d import UNetOutput
from lerobot_uca.objectives.mean_square import mean_square

IntervalNetwork = Callable[[Tensor, Tensor, Tensor, Tensor], UNetOutput]
"""z (B, T, A), t (B,), r (B,), o (B, ...) to the average velocity u (B, T, A) and features of the network's levels."""

N_DISPERSED_LEVELS = 2  # of the way down, the first ones


class Losses(NamedTuple):
    """The losses of each sample, (B,): the weighted error of u, and the batch's dispersive loss, the same for all."""

    u: Tensor
    dispersive: Tensor


def guided_meanflow_losses(
    network: IntervalNetwork, x: Tensor, o: Tensor, mask: Tensor, *, c: float, interval_mean: float, interval_std: float
) -> Losses:
    """The error D^2 / sg(D^2 + c)^(1/2), D^2 the mean square of u less its guided target, and the dispersive loss.

    Args:
        x: (B, T, A) expert actions, normalised. o: (B, ...). mask: (B, T), True for steps that count.
        c, interval_mean, interval_std: see `lerobot_uca.meanflow`.
    """
    t, h, n = sample_intervals(len(x), x.device, mean=interval_mean, std=interval_std)
    e = torch.randn_like(x)
    z = (1 - t[:, None, None]) * x + t[:, None, None] * e
    target = guided_target(network, z, t, t - h, o, v=e - x, n_instants=n)
    torch.clear_autocast_cache()  # of weights converted without a graph: PyTorch 2.7 would take them below, untrained
    u, levels = network(z, t, t - h, o)
    error = mean_square(u - target, mask)
    dispersive = torch.stack([dispersive_loss(features) for features in levels[:N_DISPERSED_LEVELS]]).sum()
    return Losses(error / (error.detach() + c).sqrt(), dispersive.expand(len(x)))


@torch.no_grad()
def guided_target(
    network: IntervalNetwork, z: Tensor, t: Tensor, r: Tensor, o: Tensor, *, v: Tensor, n_instants: int
) -> Tensor:
    """The target of u(z, t, r): v^ - (t - r) du/dt with the guided velocity v^ = 2 v - u(z, t, t), (B, T, A).

    MP1's paper calls this classifier-free guidance. In its code, and so here, u keeps its condition o.

    du/dt is taken along the path that v^ shows, with r fixed: a Jacobian-vector product with the tangent (v^, 1, 0) in
    (z, t, r). The first n_instants samples have r = t and need none.
    """
    guided = 2 * v - network(z, t, t, o).actions
    n = slice(n_instants, None)
    _, du_dt = torch.func.jvp(  # type: ignore[misc]  # a third value comes only with has_aux
        lambda z, t: network(z, t, r[n], o[n]).actions, (z[n], t[n]), (guided[n].to(z.dtype), torch.ones_like(t[n]))
    )
    return torch.cat([guided[:n_instants], guided[n] - (t - r)[n, None, None] * du_dt])


def dispersive_loss(features: Tensor) -> Tensor:
    """Log of the mean over all pairs of exp(-D / max D), D the squared distance; each is paired with itself as well.

    Args:
        features: (B, ...).
    """
    with torch.autocast(features.device.type, enabled=False):
        flat = features.flatten(1).to(torch.promote_types(features.dtype, torch.float32))
        flat = flat - flat.mean(dim=0)  # which changes no distance, and leaves less to round
        squares = flat.square().sum(dim=-1)
        distances = (squares[:, None] + squares - 2 * flat @ flat.mT).clamp(min=0)
    return torch.exp(-distances / distances.max().clamp(min=torch.finfo(distances.dtype).tiny)).mean().log()


def one_step_sample(network: IntervalNetwork, noise: Tensor, o: Tensor) -> Tensor:
    """Actions (B, T, A) from noise in one call: z_1 - u(z_1, 1, 0)."""
    t = torch.ones(len(noise), device=noise.device, dtype=noise.dtype)
    return noise - network(noise, t, torch.zeros_like(t), o).actions
