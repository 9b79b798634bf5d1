"""The paper's way to condition and its two ablations: one interface, one size."""

import pytest
import torch
from torch import Tensor

from lerobot_uca.networks.conditioning import CONDITIONING
from lerobot_uca.networks.transformer import ConditionActionTransformer

every_conditioning = pytest.mark.parametrize("conditioning", CONDITIONING)


def make(conditioning: str, **changes: int) -> ConditionActionTransformer:
    """A network whose weights are all random; some start at zero."""
    torch.manual_seed(0)
    sizes = {"horizon": 4, "n_actions": 3, "n_obs_steps": 2, "n_obs_features": 5, "dim": 16, "n_layers": 2}
    sizes |= {"n_heads": 2, "n_timestep_tokens": 2, "n_interval_tokens": 3}
    network = CONDITIONING[conditioning](**{**sizes, **changes}).double()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return network


def make_inputs() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    double = {"dtype": torch.float64, "requires_grad": True}
    return (
        torch.randn(1, 4, 3, **double),
        torch.rand(1, **double),
        torch.rand(1, **double),
        torch.randn(1, 2, 5, **double),
    )


@every_conditioning
def test_every_condition_and_every_action_step_reaches_the_output(conditioning):
    network, inputs = make(conditioning), make_inputs()
    u = network(*inputs)
    assert u.shape == (1, 4, 3)
    for step in range(4):
        for gradient in torch.autograd.grad(u[:, step].sum(), inputs, retain_graph=True):
            assert (gradient != 0).all()


@every_conditioning
def test_forward_mode_derivative_equals_finite_differences(conditioning):
    network = make(conditioning)
    z, t, h, o = (tensor.detach() for tensor in make_inputs())
    tangent, one, step = torch.randn_like(z), torch.ones_like(t), 1e-6
    _, derivative = torch.func.jvp(lambda z, t, h: network(z, t, h, o), (z, t, h), (tangent, one, one))
    later = network(z + step * tangent, t + step, h + step, o)
    earlier = network(z - step * tangent, t - step, h - step, o)
    torch.testing.assert_close(derivative, (later - earlier) / (2 * step), rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("dim", [128, 256])
@pytest.mark.parametrize("n_layers", [2, 4, 8])
def test_ablations_have_the_methods_size(dim, n_layers):
    """The sizes agree to 1 %, at the default sizes and others."""
    sizes = {"n_obs_features": 128, "n_actions": 4, "n_timestep_tokens": 4, "n_interval_tokens": 4, "n_heads": 4}
    counts = {
        name: sum(parameter.numel() for parameter in make(name, **sizes, dim=dim, n_layers=n_layers).parameters())
        for name in CONDITIONING
    }
    for name, count in counts.items():
        assert count == pytest.approx(counts["unified"], rel=0.01), name


@pytest.mark.parametrize("conditioning", ["cross_attention", "adaln"])
def test_ablations_keep_the_conditions_as_they_are(conditioning):
    """The blocks read the same conditions in every layer, whatever the actions are."""
    network, seen = make(conditioning, n_layers=3), []
    for block in network.blocks:
        block.register_forward_hook(lambda _, inputs, __: seen.append(inputs[1]))
    network(*make_inputs())
    assert len(seen) == 3
    assert all(torch.equal(condition, seen[0]) for condition in seen)
