"""The layers' derivatives are right: forwards, backwards, and backwards through forwards."""

import pytest
import torch
from torch import nn
from torch.autograd import forward_ad
from torch.nn.functional import linear

from lerobot_uca.networks.forward_mode import LayerNorm, Linear, attention

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


def of_attention(function):
    """`attention` as a function of one tensor, all of whose parts have a tangent."""
    return lambda x: function(x[0, :, :2, :3], x[0, :, 2:, :3], x[1, :, 1:4, 2:6])


def plain_attention(q, k, v):
    return torch.softmax(q @ k.transpose(-2, -1) / q.shape[-1] ** 0.5, dim=-1) @ v


@pytest.mark.parametrize("jvp", [dual_numbers, functional])
def test_value_and_tangent_of_attention(jvp):
    x, tangent = torch.randn(2, 2, 4, 5, 6, dtype=torch.float64)
    expected = functional(of_attention(plain_attention), x, tangent)
    for got, want in zip(jvp(of_attention(attention), x, tangent), expected, strict=True):
        torch.testing.assert_close(got, want)


def test_the_tangent_of_attention_is_a_directional_derivative():
    x, tangent = torch.randn(2, 2, 4, 5, 6, dtype=torch.float64)
    f, epsilon = of_attention(attention), 1e-6
    expected = (f(x + epsilon * tangent) - f(x - epsilon * tangent)) / (2 * epsilon)
    torch.testing.assert_close(dual_numbers(f, x, tangent)[1], expected, atol=1e-7, rtol=1e-6)


def test_gradients_of_value_and_tangent_of_attention():
    x, tangent = torch.randn(2, 2, 4, 5, 6, dtype=torch.float64)
    x.requires_grad_()
    gradients = []
    for function in (attention, plain_attention):
        y, y_tangent = functional(of_attention(function), x, tangent)
        gradients += torch.autograd.grad(y.sin().sum() + y_tangent.cos().sum(), x)
    torch.testing.assert_close(*gradients)


def test_normalisations_in_float32_as_a_gpus_autocast_computes_them(monkeypatch):
    softmax, layer_norm = torch.softmax, torch.native_layer_norm
    monkeypatch.setattr(torch, "softmax", lambda x, dim: softmax(x.float(), dim=dim))
    monkeypatch.setattr(torch, "native_layer_norm", lambda x, *rest: layer_norm(x.float(), *rest))
    x = torch.randn(2, 4, 5, 6)
    layer = nn.Sequential(LayerNorm(6), Linear(6, 6))

    def f(x):
        y = layer(x)
        return attention(y, y, y)

    expected = functional(f, x, x)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        for got, want in zip(dual_numbers(f, x.bfloat16(), x.bfloat16()), expected, strict=True):
            torch.testing.assert_close(got.float(), want, atol=0.05, rtol=0)


def test_bfloat16_with_float32_weights():
    layer, x = LayerNorm(6), torch.randn(5, 6)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        for got, want in zip(dual_numbers(layer, x.bfloat16(), x.bfloat16()), functional(layer, x, x), strict=True):
            assert got.dtype is torch.bfloat16
            torch.testing.assert_close(got.float(), want, atol=0.05, rtol=0)


def test_autocast_reaches_value_and_tangent():
    x = torch.randn(2, 6)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        value, tangent = dual_numbers(Linear(6, 4), x, x)
    assert value.dtype == tangent.dtype == torch.bfloat16
