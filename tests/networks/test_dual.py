"""The layers' derivatives are right: forwards, backwards, and backwards through forwards."""

import pytest
import torch
from torch import nn
from torch.autograd import forward_ad
from torch.nn.functional import linear

from lerobot_uca.networks.dual import LayerNorm, Linear

LAYERS = {
    "Linear": lambda: Linear(6, 4),
    "Linear without bias": lambda: Linear(6, 4, bias=False),
    "LayerNorm": lambda: LayerNorm(6),
    "LayerNorm over two dimensions": lambda: LayerNorm((5, 6)),
    "LayerNorm without weights": lambda: LayerNorm(6, elementwise_affine=False),
}


@pytest.fixture(params=LAYERS)
def layer(request):
    layer = LAYERS[request.param]().double()
    for parameter in layer.parameters():
        nn.init.normal_(parameter)
    return layer


def plain(layer, x):
    """The layer in operations that PyTorch differentiates rightly as often as one likes, which its LayerNorm is not."""
    if isinstance(layer, Linear):
        return linear(x, layer.weight, layer.bias)
    dims = tuple(range(-len(layer.normalized_shape), 0))
    n = (x - x.mean(dims, keepdim=True)) / torch.sqrt(x.var(dims, correction=0, keepdim=True) + layer.eps)
    return n if layer.weight is None else n * layer.weight + layer.bias


def inputs():
    return torch.randn(2, 5, 6, dtype=torch.float64), torch.randn(2, 5, 6, dtype=torch.float64)


def dual_numbers(function, x, x_tangent):
    with torch.no_grad(), forward_ad.dual_level():
        result = forward_ad.unpack_dual(function(forward_ad.make_dual(x, x_tangent)))
        return result.primal, result.tangent


def functional(function, x, x_tangent):
    return torch.func.jvp(function, (x,), (x_tangent,))


@pytest.mark.parametrize("jvp", [dual_numbers, functional])
def test_value_and_tangent(layer, jvp):
    x, tangent = inputs()
    for got, expected in zip(jvp(layer, x, tangent), functional(lambda x: plain(layer, x), x, tangent), strict=True):
        torch.testing.assert_close(got, expected)


def test_the_tangent_is_a_directional_derivative(layer):
    x, tangent = inputs()
    epsilon = 1e-6
    expected = (layer(x + epsilon * tangent) - layer(x - epsilon * tangent)) / (2 * epsilon)
    torch.testing.assert_close(dual_numbers(layer, x, tangent)[1], expected, atol=1e-7, rtol=1e-6)


def test_gradients_of_value_and_tangent(layer):
    x, tangent = inputs()
    x.requires_grad_()
    gradients = []
    for function in (layer, lambda x: plain(layer, x)):
        y, y_tangent = functional(function, x, tangent)
        loss = y.sin().sum() + y_tangent.cos().sum()
        gradients.append(torch.autograd.grad(loss, [x, *layer.parameters()]))
    for got, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(got, expected)


def test_autocast_reaches_value_and_tangent():
    x = torch.randn(2, 6)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        value, tangent = dual_numbers(Linear(6, 4), x, x)
    assert value.dtype == tangent.dtype == torch.bfloat16
