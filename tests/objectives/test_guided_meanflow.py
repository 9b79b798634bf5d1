"""MP1's objective, in float64 and without training."""

import pytest
import torch
from tests.test_meanflow import MEAN, STD, gaussian_average_velocity, gaussian_velocity
from torch import Tensor

from lerobot_uca.networks.unet1d import IntervalUNet, UNetOutput
from lerobot_uca.objectives.guided_meanflow import (
    dispersive_loss,
    guided_meanflow_losses,
    guided_target,
    one_step_sample,
)

B, T, A = 6, 4, 3


@pytest.fixture
def network() -> IntervalUNet:
    sizes = {"n_actions": A, "n_obs_steps": 2, "n_obs_features": 5, "time_dim": 8}
    return IntervalUNet(**sizes, widths=(8, 16), n_blocks=1, kernel_size=3, n_groups=4).double()


@pytest.fixture
def sample() -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """z, t, r, o and v; the first two samples have r = t."""
    z, v = torch.randn(2, B, T, A, dtype=torch.float64)
    t = 0.2 + 0.8 * torch.rand(B, dtype=torch.float64)
    r = torch.where(torch.arange(B) < 2, t, t * torch.rand(B, dtype=torch.float64))
    return z, t, r, torch.randn(B, 2, 5, dtype=torch.float64), v


def gaussian_network(z: Tensor, t: Tensor, r: Tensor, o: Tensor) -> UNetOutput:
    return UNetOutput(gaussian_average_velocity(z, t, t - r, o), [z, z])


@pytest.mark.parametrize("n_instants", [0, 2])
def test_target_equals_finite_differences_along_the_guided_path(network, sample, n_instants):
    z, t, r, o, v = sample
    step = 1e-6
    guided = 2 * v - network(z, t, t, o).actions
    later = network(z + step * guided, t + step, r, o).actions
    earlier = network(z - step * guided, t - step, r, o).actions
    expected = guided - (t - r)[:, None, None] * (later - earlier) / (2 * step)
    target = guided_target(network, z, t, r, o, v=v, n_instants=n_instants)
    torch.testing.assert_close(target, expected, rtol=1e-6, atol=1e-7)
    assert not target.requires_grad


def test_target_of_the_analytic_gaussian_flow_is_its_average_velocity(sample):
    z, t, r, o, _ = sample
    v = gaussian_velocity(z, t[:, None, None])
    target = guided_target(gaussian_network, z, t, r, o, v=v, n_instants=2)
    torch.testing.assert_close(target, gaussian_average_velocity(z, t, t - r, o), rtol=0, atol=1e-13)


def test_one_step_turns_noise_into_data():
    e = torch.randn(1000, 1, 1, dtype=torch.float64)
    torch.testing.assert_close(one_step_sample(gaussian_network, e, torch.empty(len(e), 0)), MEAN + STD * e)


def test_the_error_is_weighted_without_gradient():
    """The guided target at u = 0 is 2 (e - x), of which e and x are known."""
    x = torch.randn(B, T, A)
    scale = torch.zeros((), requires_grad=True)
    torch.manual_seed(0)
    network = lambda z, *_: UNetOutput(scale * torch.ones_like(z), [z, z])  # noqa: E731
    mask = torch.ones(B, T, dtype=torch.bool)
    losses = guided_meanflow_losses(network, x, torch.empty(B, 0), mask, c=1e-3, interval_mean=-0.4, interval_std=1.0)
    torch.manual_seed(0)
    torch.randn(2, B)  # the intervals
    target = 2 * (torch.randn_like(x) - x)
    error = target.square().mean(dim=(1, 2))
    torch.testing.assert_close(losses.u, error / (error + 1e-3).sqrt())
    (gradient,) = torch.autograd.grad(losses.u.sum(), scale)
    torch.testing.assert_close(gradient, (-2 * target.mean(dim=(1, 2)) / (error + 1e-3).sqrt()).sum())


def test_dispersive_loss_written_out():
    features = torch.randn(5, 3, 2, dtype=torch.float64)
    distances = [[(a - b).square().sum().item() for a in features] for b in features]
    largest = max(map(max, distances))
    expected = torch.tensor(distances, dtype=torch.float64).div(-largest).exp().mean().log()
    torch.testing.assert_close(dispersive_loss(features), expected)


def test_dispersive_loss_is_lower_the_further_features_are_apart():
    same, paired, spread = torch.tensor([[5.0, 5, 5, 5], [0, 0, 1, 1], [0, 1 / 3, 2 / 3, 1]]).double()[..., None]
    assert dispersive_loss(same) == 0
    corners = torch.eye(4).double()
    assert dispersive_loss(corners) < dispersive_loss(paired) < dispersive_loss(spread) < 0
    same.requires_grad_()
    (gradient,) = torch.autograd.grad(dispersive_loss(same), same)
    assert gradient.isfinite().all()


@pytest.mark.parametrize("batch_size", [1, 2, 5])
def test_any_batch_size_gives_one_finite_loss_a_sample(network, batch_size):
    network = network.float()
    x, o = torch.randn(batch_size, T, A), torch.randn(batch_size, 2, 5)
    mask = torch.ones(batch_size, T, dtype=torch.bool)
    losses = guided_meanflow_losses(network, x, o, mask, c=1e-3, interval_mean=-0.4, interval_std=1.0)
    for loss in losses:
        assert loss.shape == (batch_size,)
        assert loss.isfinite().all()
    sum(loss.mean() for loss in losses).backward()
    assert all(parameter.grad.isfinite().all() for parameter in network.parameters())
