"""The baselines' U-Net, at the sizes that were measured with the baselines' own code."""

import pytest
import torch
from torch import nn

from lerobot_uca.networks.unet1d import Convolution, IntervalUNet, TimeUNet

TINY = {"n_actions": 3, "n_obs_steps": 2, "n_obs_features": 5, "time_dim": 8, "kernel_size": 3, "n_groups": 4}
INPUTS = {TimeUNet: 1, IntervalUNet: 2}


@pytest.mark.parametrize("kind", INPUTS)
@pytest.mark.parametrize(("widths", "n_blocks"), [((8,), 1), ((8, 16), 2), ((8, 16, 24), 1)])
def test_every_time_observation_and_action_step_reaches_the_output(kind, widths, n_blocks):
    network = kind(**TINY, widths=widths, n_blocks=n_blocks).double()
    z, o = torch.randn(1, 4, 3, dtype=torch.float64), torch.randn(1, 2, 5, dtype=torch.float64)
    times = [torch.rand(1, dtype=torch.float64) for _ in range(INPUTS[kind])]
    inputs = [tensor.requires_grad_() for tensor in (z, *times, o)]
    output = network(*inputs)
    actions = output if kind is TimeUNet else output.actions
    assert actions.shape == (1, 4, 3)
    for step in range(4):
        for gradient in torch.autograd.grad(actions[:, step].sum(), inputs, retain_graph=True):
            assert (gradient != 0).all()


@pytest.mark.parametrize("length", range(1, 9))
@pytest.mark.parametrize(("taps", "stride"), [(5, 1), (3, 1), (3, 2), (5, 2), (1, 1)])
def test_in_training_a_convolution_is_pytorchs(length, taps, stride):
    layer = Convolution(2, 3, taps, stride=stride, padding=taps // 2).double()
    x = torch.randn(4, 2, length, dtype=torch.float64, requires_grad=True)
    direction = torch.randn_like(x)
    results = []
    for mode in (layer.train, layer.eval):
        y, tangent = torch.func.jvp(mode(), (x,), (direction,))
        results.append((y, tangent, *torch.autograd.grad(y.square().sum(), (x, *layer.parameters()))))
    torch.testing.assert_close(*results)


def test_levels_are_the_features_of_the_way_down():
    levels = IntervalUNet(**TINY, widths=(8, 16, 24), n_blocks=1)(
        torch.randn(2, 4, 3), torch.rand(2), torch.rand(2), torch.randn(2, 2, 5)
    ).levels
    assert [tuple(level.shape) for level in levels] == [(2, 8, 4), (2, 16, 2), (2, 24, 1)]


def test_times_are_told_apart():
    network = IntervalUNet(**TINY, widths=(8,), n_blocks=1)
    z, o, t, r = torch.randn(1, 4, 3), torch.randn(1, 2, 5), torch.tensor([0.8]), torch.tensor([0.3])
    assert not torch.allclose(network(z, t, r, o).actions, network(z, r, t, o).actions)


def n_parameters(network: nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


# Millions of parameters of the baselines' code, encoder included, state 9 and action 4.
# FlowPolicy's and MP1's U-Nets hold an MLP of 4-512-512-512-1 that nothing calls; ours do not.
ENCODER = 63_872
UNCALLED = 5 * 512 + 2 * 513 * 512 + 513
FULL = {"widths": (512, 1024, 2048), "n_blocks": 2}
SIMPLE = {"widths": (128, 256, 384), "n_blocks": 1}


@pytest.mark.parametrize(
    ("kind", "size", "uncalled", "measured"),
    [
        pytest.param(TimeUNet, FULL, 0, 255.1, id="dp3"),
        pytest.param(TimeUNet, SIMPLE, 0, 7.4, id="simple_dp3"),
        pytest.param(TimeUNet, FULL, UNCALLED, 255.7, id="flow"),
        pytest.param(IntervalUNet, FULL, UNCALLED, 255.8, id="mp1"),
    ],
)
def test_full_size_is_the_baselines(kind, size, uncalled, measured):
    with torch.device("meta"):
        network = kind(**size, n_actions=4, n_obs_steps=2, n_obs_features=128, time_dim=128, kernel_size=5, n_groups=8)
    assert round((n_parameters(network) + ENCODER + uncalled) / 1e6, 1) == measured
