"""DP3's objective: the loop around diffusers' scheduler, against the formulas written out."""

import math
from itertools import pairwise

import pytest
import torch

from lerobot_uca.objectives.diffusion import ddim_sample, diffusion_loss, make_scheduler

K = 100
MEAN, STD = 0.2, 0.1  # of the data; inside [-1, 1], to which predictions are clipped


def make_signal() -> torch.Tensor:
    """alpha-bar after each step, the share of the data in the variance: squared cosine, beta at most 0.999."""
    level = [math.cos((k / K + 0.008) / 1.008 * math.pi / 2) ** 2 for k in range(K + 1)]
    betas = [min(1 - after / before, 0.999) for before, after in pairwise(level)]
    return torch.cumprod(1 - torch.tensor(betas, dtype=torch.float64), dim=0)


SIGNAL = make_signal()


def posterior_mean(z: torch.Tensor, k: torch.Tensor, o: torch.Tensor) -> torch.Tensor:
    """The best prediction of x ~ N(MEAN, STD^2) from z = sqrt(a) x + sqrt(1 - a) e."""
    a = SIGNAL[k][:, None, None]
    gain = a.sqrt() * STD**2 / (a * STD**2 + 1 - a)
    return MEAN + gain * (z - a.sqrt() * MEAN)


@pytest.mark.parametrize("n_steps", [2, 10])
def test_sampling_is_ddim(n_steps):
    """Clean actions are predicted and clipped; each step goes to the noise level before, without new noise."""

    def network(z, k, o):
        calls.append(k.tolist())
        return 3 * torch.tanh(z + k[:, None, None] / K) + o

    calls = []
    noise, o = torch.randn(2, 4, 3, dtype=torch.float64), torch.randn(2, 1, 1, dtype=torch.float64)
    z = noise
    steps = [i * (K // n_steps) for i in reversed(range(n_steps))]
    for k in steps:
        a, a_before = SIGNAL[k].item(), SIGNAL[k - K // n_steps].item() if k else 1.0
        predicted = network(z, torch.tensor([k, k]), o)
        e = (z - math.sqrt(a) * predicted) / math.sqrt(1 - a)
        z = math.sqrt(a_before) * predicted.clamp(-1, 1) + math.sqrt(1 - a_before) * e
    expected_calls, calls = calls, []
    actions = ddim_sample(network, make_scheduler(K), noise, o, n_steps=n_steps)
    torch.testing.assert_close(actions, z, rtol=1e-4, atol=1e-4)  # the scheduler's noise levels are float32
    assert calls == expected_calls == [[k, k] for k in steps]


@pytest.mark.parametrize(("n_steps", "least"), [(2, 0), (10, 0.6), (50, 0.85), (K, 0.9)])
def test_the_best_prediction_turns_noise_into_data(n_steps, least):
    """Fewer steps give less of its spread."""
    noise = torch.randn(20_000, 1, 1, dtype=torch.float64)
    x = ddim_sample(posterior_mean, make_scheduler(K), noise, torch.empty(20_000, 0), n_steps=n_steps)
    assert x.mean() == pytest.approx(MEAN, abs=0.005 if n_steps > 2 else 0.01)
    assert least * STD < x.std() < 1.1 * STD


def test_the_loss_is_smallest_at_the_best_prediction():
    x = MEAN + STD * torch.randn(4000, 1, 1)
    o, mask = torch.empty(len(x), 0), torch.ones(len(x), 1, dtype=torch.bool)

    def loss(offset: float) -> float:
        torch.manual_seed(0)
        network = lambda z, k, o: posterior_mean(z, k, o) + offset  # noqa: E731
        return diffusion_loss(network, make_scheduler(K), x, o, mask).mean().item()

    assert loss(0) < min(loss(0.05), loss(-0.05))
    assert loss(0) < STD**2  # it sees something of x


def test_all_steps_are_trained():
    seen = set()

    def network(z, k, o):
        seen.update(k.tolist())
        return z

    x = torch.zeros(3000, 1, 1)
    diffusion_loss(network, make_scheduler(K), x, torch.empty(3000, 0), torch.ones(3000, 1, dtype=torch.bool))
    assert seen == set(range(K))
