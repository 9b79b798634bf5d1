"""FlowPolicy's objective on a flow whose lines are straight and known: x = MEAN + STD e. Here t = 0 is noise."""

import pytest
import torch
from torch import Tensor

from lerobot_uca.objectives.consistency_flow import consistency_flow_loss, one_euler_step

MEAN, STD = 1.5, 0.5
SETTINGS = {"t_min": 0.01, "delta": 0.01, "n_segments": 2, "alpha": 1e-5}


def straight_velocity(z: Tensor, scaled_t: Tensor, o: Tensor) -> Tensor:
    """X - e of the line through z, for x = MEAN + STD e."""
    t = scaled_t[:, None, None] / 99
    e = (z - t * MEAN) / (1 - t + t * STD)
    return MEAN + (STD - 1) * e


def loss(network, x: Tensor, **changes: float) -> Tensor:
    o, mask = torch.empty(len(x), 0), torch.ones(x.shape[:2], dtype=torch.bool)
    return consistency_flow_loss(network, x, o, mask, **{**SETTINGS, **changes})


def lines(n: int) -> Tensor:
    """Data on the lines that start at the noise which the loss draws next."""
    torch.manual_seed(0)
    x = MEAN + STD * torch.randn(n, 4, 3, dtype=torch.float64)
    torch.manual_seed(0)
    return x


def test_the_straight_flow_has_no_loss_and_no_other_has():
    assert loss(straight_velocity, lines(500)).max() < 1e-25
    assert loss(lambda *inputs: -straight_velocity(*inputs), lines(500)).min() > 1e-6


def test_one_step_turns_noise_into_data():
    """The step starts at t_min with noise that belongs to 0, as in the code of FlowPolicy: 1 % off."""
    noise = torch.randn(100_000, 1, 1, dtype=torch.float64)
    x = one_euler_step(straight_velocity, noise, torch.empty(len(noise), 0), t_min=0.01)
    assert x.mean() == pytest.approx(MEAN, abs=0.02)
    assert x.std() == pytest.approx(STD, rel=0.02)


def test_the_loss_written_out_for_one_line():
    """z = (1 - t) e + t x and f = z + (end - time) v for a velocity that depends on the time."""
    seen = []

    def network(z, scaled_t, o):
        seen.append((z, scaled_t / 99))
        return torch.sin(z) + scaled_t[:, None, None] / 99

    x = torch.randn(2000, 4, 3, dtype=torch.float64)
    torch.manual_seed(0)
    e = torch.randn_like(x)
    torch.manual_seed(0)
    got = loss(network, x, alpha=0.3)
    (z_t, t), (z_r, r) = seen
    assert t.min() >= 0.01
    assert 0.98 < t.max() <= 1
    torch.testing.assert_close(r, (t + 0.01).clamp(max=1))
    end = torch.where(t <= 0.5, 0.5, 1.0).double()
    line = lambda s: (1 - s[:, None, None]) * e + s[:, None, None] * x  # noqa: E731
    torch.testing.assert_close(z_t, line(t))
    torch.testing.assert_close(z_r, line(r))
    v_t, v_r = (torch.sin(z) + s[:, None, None] for z, s in ((z_t, t), (z_r, r)))
    f_t, f_r = z_t + (end - t)[:, None, None] * v_t, z_r + (end - r)[:, None, None] * v_r
    f_r[r == 1] = x[r == 1]
    far = (end - t > 0.0101).double()
    assert 0 < (r == 1).sum() < 50
    assert 0 < (far == 0).sum() < 100
    expected = (f_t - f_r).square().mean(dim=(1, 2)) + 0.3 * far * (v_t - v_r).square().mean(dim=(1, 2))
    torch.testing.assert_close(got, expected)


def test_gradients_go_through_both_times():
    """The later time has no stop-gradient, unlike in FlowPolicy's paper."""
    scale = torch.ones(2, requires_grad=True)
    calls = iter(scale)
    x = torch.randn(50, 4, 3)
    loss(lambda z, *_: next(calls) * torch.sin(z), x).sum().backward()
    assert (scale.grad != 0).all()
