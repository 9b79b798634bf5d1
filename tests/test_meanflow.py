"""The method's mathematics, in float64 and without training."""

import pytest
import torch
from torch import Tensor, nn

from lerobot_uca.meanflow import Intervals, adaptive_l2, dual_pass, meanflow_losses, one_step_sample, sample_intervals
from lerobot_uca.networks.transformer import UnifiedTransformer

B, T, A, N_OBS, F = 6, 4, 3, 2, 5


@pytest.fixture
def network() -> UnifiedTransformer:
    torch.manual_seed(0)
    sizes = {"horizon": T, "n_actions": A, "n_obs_steps": N_OBS, "n_obs_features": F}
    return UnifiedTransformer(**sizes, dim=16, n_layers=2, n_heads=2, n_timestep_tokens=2, n_interval_tokens=2).double()


@pytest.fixture
def sample() -> tuple[Tensor, Intervals, Tensor, Tensor]:
    torch.manual_seed(1)
    x, e = torch.randn(2, B, T, A, dtype=torch.float64)
    t, h = torch.rand(B, dtype=torch.float64), torch.rand(B, dtype=torch.float64)
    n = B // 2
    h = torch.where(torch.arange(B) < n, 0, h * t)
    z = (1 - t[:, None, None]) * x + t[:, None, None] * e
    return z, Intervals(t, h, n), torch.randn(B, N_OBS, F, dtype=torch.float64), e - x


MEAN, STD = 1.5, 0.5


def gaussian_velocity(z: Tensor, t: Tensor) -> Tensor:
    """v for data from N(MEAN, STD^2) and noise from N(0, 1): dz/dt along the flow that scales and shifts z."""
    variance = (1 - t) ** 2 * STD**2 + t**2
    return -MEAN + (t - (1 - t) * STD**2) / variance * (z - (1 - t) * MEAN)


def gaussian_average_velocity(z: Tensor, t: Tensor, h: Tensor, o: Tensor) -> Tensor:
    """u for the same: (z_t - z_r) / h with z_r on the flow through z_t."""
    t, h = t[:, None, None], h[:, None, None]
    sigma_t, sigma_r = (((1 - s) ** 2 * STD**2 + s**2).sqrt() for s in (t, t - h))
    z_r = (1 - t + h) * MEAN + sigma_r / sigma_t * (z - (1 - t) * MEAN)
    instant = h == 0
    average = (z - z_r) / torch.where(instant, 1, h)
    return torch.where(instant, gaussian_velocity(z, t), average)


def test_derivative_along_the_path_equals_finite_differences(network, sample):
    z, intervals, o, target = sample
    t, h, n = intervals
    v = network(z, t, torch.zeros_like(h), o)
    step = 1e-6
    later = network(z + step * v, t + step, h + step, o)
    earlier = network(z - step * v, t - step, h - step, o)
    expected = network(z, t, h, o) + h[:, None, None] * (later - earlier) / (2 * step)
    V = dual_pass(network, z, intervals, o, target=target).V
    torch.testing.assert_close(V[n:], expected[n:], rtol=1e-7, atol=1e-8)


def test_identity_holds_on_the_analytic_gaussian_flow(sample):
    z, intervals, o, target = sample
    V, v = dual_pass(gaussian_average_velocity, z, intervals, o, target=target)
    exact = gaussian_velocity(z, intervals.t[:, None, None])
    torch.testing.assert_close(v, exact, rtol=0, atol=1e-14)
    torch.testing.assert_close(V, exact, rtol=0, atol=1e-13)
    u = gaussian_average_velocity(z, *intervals[:2], o)
    wrong_sign = 2 * u - V
    assert (wrong_sign - exact)[intervals.n_instants :].abs().max() > 0.1


def test_one_step_turns_noise_into_data():
    e = torch.randn(100_000, 1, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    x = one_step_sample(gaussian_average_velocity, e, torch.empty(len(e), 0))
    torch.testing.assert_close(x, MEAN + STD * e)


def test_composite_velocity_equals_the_plain_two_pass_version(network, sample):
    """Passing instants through the network once instead of twice changes neither values nor gradients."""
    z, intervals, o, target = sample
    t, h, _ = intervals

    v = network(z, t, torch.zeros_like(h), o)
    u, D_t_u = torch.func.jvp(
        lambda z, t, h: network(z, t, h, o), (z, t, h), (v.detach(), torch.ones_like(t), torch.ones_like(h))
    )
    V = u + h[:, None, None] * D_t_u.detach()
    plain = torch.autograd.grad(((V - target) ** 2).sum() + ((v - target) ** 2).sum(), list(network.parameters()))

    ours = dual_pass(network, z, intervals, o, target=target)
    torch.testing.assert_close(ours.V, V)
    torch.testing.assert_close(ours.v, v)
    loss = ((ours.V - target) ** 2).sum() + ((ours.v - target) ** 2).sum()
    for got, expected in zip(torch.autograd.grad(loss, list(network.parameters())), plain, strict=True):
        torch.testing.assert_close(got, expected)


def test_gradients_stop_at_the_derivative_and_at_its_tangent(network, sample):
    z, intervals, o, target = sample
    t, h, n = intervals
    weight = torch.randn(B - n, T, A, dtype=torch.float64)
    V = dual_pass(network, z, intervals, o, target=target).V
    through_V = torch.autograd.grad((V[n:] * weight).sum(), list(network.parameters()))
    through_u = torch.autograd.grad((network(z, t, h, o)[n:] * weight).sum(), list(network.parameters()))
    for got, expected in zip(through_V, through_u, strict=True):
        torch.testing.assert_close(got, expected)


def test_without_dual_pass_the_tangent_is_the_sampled_velocity(network, sample):
    z, intervals, o, target = sample
    t, h, n = intervals
    V, v = dual_pass(network, z, intervals, o, target=target, supervise_v=False)
    assert v is None
    step = 1e-6
    later = network(z + step * target, t + step, h + step, o)
    earlier = network(z - step * target, t - step, h - step, o)
    expected = network(z, t, h, o) + h[:, None, None] * (later - earlier) / (2 * step)
    torch.testing.assert_close(V[n:], expected[n:], rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(V[:n], network(z, t, h, o)[:n])


def test_intervals_are_ordered_and_half_of_them_are_instants():
    torch.manual_seed(0)
    t, h, n = sample_intervals(4001, "cpu", mean=-0.4, std=1.0)
    assert n == 2000
    assert (h[:n] == 0).all()
    assert (h[n:] > 0).all()
    assert (h <= t).all()
    assert (t < 1).all()
    # The mean of each of the two draws, by quadrature of sigmoid over N(-0.4, 1).
    grid = torch.linspace(-8, 8, 10001, dtype=torch.float64)
    density = torch.distributions.Normal(0.0, 1.0).log_prob(grid).exp()
    mean = torch.trapezoid(torch.sigmoid(grid - 0.4) * density, grid)
    drawn = torch.cat([t[n:], (t - h)[n:]]).double().mean()
    assert abs(drawn - mean) < 0.01


def test_adaptive_weight_is_the_papers_and_carries_no_gradient():
    error = torch.randn(B, T, A, dtype=torch.float64, requires_grad=True)
    mask = torch.ones(B, T, dtype=torch.bool)
    squared = error.detach().square().sum(dim=(1, 2))
    weight = 1 / (squared + 1e-3) ** 0.5
    loss = adaptive_l2(error, mask, gamma=0.5, c=1e-3)
    torch.testing.assert_close(loss, weight * squared)
    (gradient,) = torch.autograd.grad(loss.sum(), error)
    torch.testing.assert_close(gradient, 2 * weight[:, None, None] * error.detach())


def test_padded_steps_do_not_count():
    error = torch.randn(B, T, A)
    mask = torch.ones(B, T, dtype=torch.bool)
    mask[:, -1] = False
    changed = error.clone()
    changed[:, -1] = 1e6
    torch.testing.assert_close(
        adaptive_l2(error, mask, gamma=0.5, c=1e-3), adaptive_l2(changed, mask, gamma=0.5, c=1e-3)
    )


@pytest.mark.parametrize("supervise_v", [True, False])
@pytest.mark.parametrize("batch_size", [1, 2, 5])
def test_any_batch_size_gives_one_finite_loss_a_sample(network, supervise_v, batch_size):
    network = network.float()
    losses = meanflow_losses(
        network,
        torch.randn(batch_size, T, A),
        torch.randn(batch_size, N_OBS, F),
        torch.ones(batch_size, T, dtype=torch.bool),
        gamma=0.5,
        c=1e-3,
        interval_mean=-0.4,
        interval_std=1.0,
        supervise_v=supervise_v,
    )
    for loss in losses if supervise_v else losses[:1]:
        assert loss.shape == (batch_size,)
        assert loss.isfinite().all()


def test_training_learns_to_sample_a_distribution_in_one_step():
    """A tiny network learns N(1.5, 0.5^2): predicting the mean would give no spread, copying the noise too much."""
    torch.manual_seed(0)

    class Tiny(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layers = nn.Sequential(nn.Linear(3, 64), nn.SiLU(), nn.Linear(64, 64), nn.SiLU(), nn.Linear(64, 1))

        def forward(self, z: Tensor, t: Tensor, h: Tensor, o: Tensor) -> Tensor:
            return self.layers(torch.stack([z[:, 0, 0], t, h], dim=1))[:, None]

    network = Tiny()
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 800)
    for _ in range(800):
        x = MEAN + STD * torch.randn(256, 1, 1)
        mask = torch.ones(256, 1, dtype=torch.bool)
        # gamma = 1: the squared error, whose minimum is the mean; wide intervals: [0, 1] itself must be learnt.
        settings = {"gamma": 1.0, "c": 1e-3, "interval_mean": 0.0, "interval_std": 2.0}
        losses = meanflow_losses(network, x, torch.zeros(256, 0), mask, **settings)
        optimizer.zero_grad()
        (losses.u + losses.v).mean().backward()
        optimizer.step()
        scheduler.step()
    with torch.no_grad():
        x = one_step_sample(network, torch.randn(20_000, 1, 1), torch.zeros(20_000, 0))
    assert x.mean() == pytest.approx(MEAN, abs=0.1)
    assert x.std() == pytest.approx(STD, abs=0.12)
