"""UCA-Flow's method: from noise to a chunk of actions in one step. Start reading here.

The paper's symbols (sections 3.1 and 3.4), used everywhere in this package:

    x   the expert's actions, (B, T, A): B samples, a horizon of T steps, A action dimensions
    e   Gaussian noise, like x
    t   time in [0, 1]: t = 1 is noise, t = 0 is data
    z   the noisy actions at time t, z = (1 - t) x + t e
    v   the instantaneous velocity of z, dz/dt = e - x
    r   an earlier time, r <= t
    h   the interval, h = t - r
    u   the average velocity over [r, t], so that z_r = z_t - h u
    o   what the network is conditioned on: features of the observations, (B, ...)

One network u(z, t, h, o) stands for both velocities, for u(z, t, 0, o) = v: over an interval of no length the average
is the instantaneous velocity. Over the whole interval it makes actions in one call: x = z_1 - u(z_1, 1, 1, o).
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

VelocityNetwork = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
"""u(z, t, h, o): z (B, T, A), t (B,), h (B,), o (B, ...) to (B, T, A)."""


class Intervals(NamedTuple):
    """An interval [r, t] for each sample of a batch. The first `n_instants` of them have length 0.

    Args:
        t: (B,), where the interval ends.
        h: (B,), its length t - r.
        n_instants: how many h are 0; they come first, and all others are at least 0.
    """

    t: Tensor
    h: Tensor
    n_instants: int


def sample_intervals(batch_size: int, device: torch.device | str, *, mean: float, std: float) -> Intervals:
    """Draw an interval for each sample.

    1. Two draws from a logit-normal distribution, sigmoid(N(mean, std^2)).
    2. t is the later one, r the earlier one.
    3. Half of the batch gets r = t. Batches are shuffled, so the first half is as good as a random one. (LeRobot's
       held-out loss is not shuffled, there it stays the first half; a batch of one sample has no instant.)
    """
    draws = torch.sigmoid(mean + std * torch.randn(2, batch_size, device=device))
    t, r = draws.amax(dim=0), draws.amin(dim=0)
    n_instants = batch_size // 2
    h = t - r
    h[:n_instants] = 0
    return Intervals(t, h, n_instants)


class Velocities(NamedTuple):
    """The two estimates that are compared with the target velocity e - x; each (B, T, A).

    Args:
        V: the composite velocity of the u branch, u + h sg(D_t u).
        v: the instantaneous velocity of the v branch; None without dual-pass supervision.
    """

    V: Tensor
    v: Tensor | None


def dual_pass(
    u_fn: VelocityNetwork, z: Tensor, intervals: Intervals, o: Tensor, *, target: Tensor, supervise_v: bool = True
) -> Velocities:
    """The network's two velocity views of z (paper section 3.4).

    The v branch is the network at h = 0, the u branch at h. Its derivative along the path,

        D_t u = grad_z u . sg(v) + du/dt + du/dh,

    is a Jacobian-vector product with the tangent (sg(v), 1, 1) in (z, t, h). Why this tangent: r stays where it is
    while t moves, so z moves with its velocity and both t and h = t - r grow at rate 1.

    The same losses for less work than two passes over the batch:

    - Where h = 0 both branches are the same and D_t u is multiplied by 0: those samples, half of the batch, pass once.
    - u does not need v, only its derivative does: one call makes both branches.
    - The derivative is a constant of the loss: it needs no graph to go back through.

    Args:
        target: e - x, the tangent of z when v is not supervised (then it is the plain MeanFlow objective, the paper's
            ablation '-DualPass').
        supervise_v: whether v is trained on all samples.
    """
    t, h, n = intervals
    batch = (z, t, h, o)
    if supervise_v:
        at_h_0 = (z[n:], t[n:], torch.zeros_like(h[n:]), o[n:])
        u, v_n = u_fn(*map(torch.cat, zip(batch, at_h_0, strict=True))).split([len(z), len(z) - n])
        v = torch.cat([u[:n], v_n])
        tangent = v_n.detach()
    else:
        u, v, tangent = u_fn(*batch), None, target[n:]
    ones = torch.ones_like(t[n:])
    forward_ad = torch.autograd.forward_ad
    with torch.no_grad(), forward_ad.dual_level():
        z_n, t_n, h_n = map(forward_ad.make_dual, (z[n:], t[n:], h[n:]), (tangent.to(z.dtype), ones, ones))
        D_t_u = forward_ad.unpack_dual(u_fn(z_n, t_n, h_n, o[n:])).tangent
    V = torch.cat([u[:n], u[n:] + h[n:, None, None] * D_t_u])
    return Velocities(V, v)


def adaptive_l2(error: Tensor, mask: Tensor, *, gamma: float, c: float) -> Tensor:
    """rho(error) = sg(1 / (||error||^2 + c)^(1 - gamma)) ||error||^2 for each sample, (B,).

    Args:
        error: (B, T, A); the norm runs over horizon and action dimensions.
        mask: (B, T), True for steps that count. Steps past an episode's end hold a repeated action.
        gamma, c: gamma = 1 is the plain squared error; smaller values give large errors less weight.
    """
    squared_norm = (error.square() * mask[..., None]).sum(dim=(1, 2))
    return squared_norm / (squared_norm.detach() + c) ** (1 - gamma)


class Losses(NamedTuple):
    """The loss of each sample, (B,): of the u branch and of the v branch (None without dual-pass supervision)."""

    u: Tensor
    v: Tensor | None


def meanflow_losses(
    u_fn: VelocityNetwork,
    x: Tensor,
    o: Tensor,
    mask: Tensor,
    *,
    gamma: float,
    c: float,
    interval_mean: float,
    interval_std: float,
    supervise_v: bool = True,
) -> Losses:
    """The training objective, rho(V - sg(e - x)) + rho(v - sg(e - x)), its two terms for each sample.

    Args:
        x: (B, T, A) expert actions, normalised. o: (B, ...). mask: (B, T), see `adaptive_l2`.
    """
    intervals = sample_intervals(len(x), x.device, mean=interval_mean, std=interval_std)
    e = torch.randn_like(x)
    t = intervals.t[:, None, None]
    z = (1 - t) * x + t * e
    target = e - x
    V, v = dual_pass(u_fn, z, intervals, o, target=target, supervise_v=supervise_v)
    return Losses(
        u=adaptive_l2(V - target, mask, gamma=gamma, c=c),
        v=None if v is None else adaptive_l2(v - target, mask, gamma=gamma, c=c),
    )


def one_step_sample(u_fn: VelocityNetwork, e: Tensor, o: Tensor) -> Tensor:
    """Actions (B, T, A) from noise e = z_1 in one call of the network: x = z_1 - u(z_1, 1, 1, o)."""
    ones = torch.ones(len(e), device=e.device, dtype=e.dtype)
    return e - u_fn(e, ones, ones, o)
