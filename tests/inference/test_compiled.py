"""Beyond what is tested with whole policies."""

import threading

import pytest
import torch
from tests.builders import make_config
from tests.fake_cuda import moved
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


def test_cuda_graphs_belong_to_one_thread(monkeypatch, caplog):
    monkeypatch.setattr(CompiledFunction, "_are_graphs_taken", False)
    monkeypatch.setattr(CompiledFunction, "_of_thread", threading.local())
    function, compiled_in = CompiledFunction(call), []

    def compiled(*arguments):  # stands for what a GPU would record
        compiled_in.append(threading.current_thread().name)
        assert not torch.is_inference_mode_enabled()
        return call(*arguments)

    function._compiled = compiled
    x, results = moved(torch.ones(2)), []
    network = nn.Identity().eval()
    with torch.inference_mode():
        results += function(network, x)
    other = threading.Thread(target=lambda: results.extend(function(network, x) + function(network, x)), name="other")
    other.start()
    other.join()
    assert [result.tolist() for result in results] == [[1, 1]] * 3
    assert compiled_in == ["MainThread"]
    (line,) = caplog.messages
    assert line.startswith("policy.inference=compile: PyTorch keeps CUDA graphs for the thread")


@pytest.mark.parametrize(
    ("inference", "device", "engine"),
    [("openvino", "cpu", "openvino"), ("openvino", "cuda:0", "eager"), ("compile", "cuda", "compile")],
)
def test_the_engine_is_what_computes_on_the_device(inference, device, engine):
    config = make_config(inference=inference)
    config.device = device
    assert config.engine == engine
