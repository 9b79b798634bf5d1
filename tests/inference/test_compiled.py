"""Beyond what is tested with whole policies."""

import torch
from torch import nn

from lerobot_uca.inference.compiled import CompiledFunction


def call(network: nn.Module, *inputs: torch.Tensor) -> tuple[torch.Tensor]:
    return (network(*inputs),)


def without_compiler() -> CompiledFunction:
    torch._dynamo.reset()
    function = CompiledFunction(call)
    function._compiled = torch.compile(call, backend="eager", fullgraph=True, dynamic=False)
    return function


def test_more_shapes_than_pytorch_compiles():
    network, function = nn.Linear(3, 2).eval(), without_compiler()
    for batch_size in range(1, 12):
        x = torch.randn(batch_size, 3)
        torch.testing.assert_close(function(network, x)[0], network(x))


def test_results_are_not_overwritten_by_the_next_call():
    function, network = without_compiler(), nn.Identity().eval()
    x = torch.zeros(2)
    (first,) = function(network, x)
    x.fill_(1)  # as a CUDA graph does with what it returned
    assert torch.equal(first, torch.zeros(2))
