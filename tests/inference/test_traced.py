"""OpenVINO and ONNX Runtime compute what PyTorch computes, always with the network's present weights."""

import copy
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import openvino
import pytest
import torch
from onnxruntime.capi import onnxruntime_pybind11_state as onnxruntime_errors
from torch import nn

from lerobot_uca.inference.onnxruntime_function import OnnxFunction
from lerobot_uca.inference.openvino_function import BFloat16Function, OpenVinoFunction
from lerobot_uca.inference.traced import to_onnx
from lerobot_uca.networks.transformer import UnifiedTransformer

every_runtime = pytest.mark.parametrize("runtime", [OpenVinoFunction, OnnxFunction])


def call(network: nn.Module, *inputs: torch.Tensor) -> tuple[torch.Tensor]:
    return (network(*inputs),)


def make_network(n_out: int = 4) -> nn.Module:
    return nn.Sequential(nn.Linear(3, 16), nn.LayerNorm(16), nn.GELU(), nn.Linear(16, n_out)).eval()


@pytest.mark.parametrize("batch_size", [1, 3, 64])
@pytest.mark.parametrize(
    ("runtime", "tolerance"), [(OpenVinoFunction, 1e-5), (OnnxFunction, 1e-5), (BFloat16Function, 0.05)]
)
def test_a_transformer_gives_the_same_numbers(runtime, tolerance, batch_size, caplog):
    sizes = {"horizon": 4, "n_actions": 4, "n_obs_steps": 2, "n_obs_features": 8, "n_timestep_tokens": 2}
    network = UnifiedTransformer(**sizes, dim=64, n_layers=3, n_heads=4, n_interval_tokens=2).eval()
    z, o, ones = torch.randn(batch_size, 4, 4), torch.randn(batch_size, 2, 8), torch.ones(batch_size)
    with torch.no_grad():
        (computed,) = runtime(call)(network, z, ones, ones, o)
        torch.testing.assert_close(computed, network(z, ones, ones, o), atol=tolerance, rtol=0)
    assert not caplog.records  # PyTorch did not step in


@every_runtime
def test_where_a_runtime_goes_wrong_pytorch_steps_in(runtime, monkeypatch, caplog):
    monkeypatch.setattr(runtime, "tolerance", -1.0)  # nothing is close enough
    network, function, x = make_network(), runtime(call), torch.randn(2, 3)
    for _ in range(2):
        with torch.no_grad():
            assert torch.equal(function(network, x)[0], network(x))
    assert [record.getMessage() for record in caplog.records] == [
        f"{runtime.runtime} computes something else than PyTorch on this machine; PyTorch is used."
    ]


@every_runtime
def test_where_a_runtime_fails_pytorch_steps_in(runtime, monkeypatch, caplog):
    def fail(*_):
        raise onnxruntime_errors.NotImplemented("no such instruction")

    monkeypatch.setattr(runtime, "open", fail)
    network, x = make_network(), torch.randn(2, 3)
    with torch.no_grad():
        assert torch.equal(runtime(call)(network, x)[0], network(x))
    assert caplog.messages == [f"{runtime.runtime} failed (no such instruction); PyTorch is used."]


@every_runtime
def test_diverged_weights_are_not_blamed_on_the_runtime(runtime, caplog):
    network = make_network()
    with torch.no_grad():
        network[0].weight.fill_(torch.nan)
    (result,) = runtime(call)(network, torch.randn(2, 3))
    assert result.isnan().all()
    assert not caplog.messages


@every_runtime
def test_pytorch_steps_in_with_float32_under_autocast(runtime, monkeypatch):
    monkeypatch.setattr(runtime, "tolerance", -1.0)
    network, x = make_network(), torch.randn(2, 3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        (result,) = runtime(call)(network, x)
    assert torch.equal(result, network(x))


@pytest.mark.skipif(
    "BF16" not in openvino.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES"),
    reason="the processor has no bfloat16 instructions",
)
def test_bfloat16_rounds_but_computes_the_same():
    network, x = make_network(), torch.randn(2, 3)
    with torch.no_grad():
        error = (BFloat16Function(call)(network, x)[0] - network(x)).abs().max()
    assert 1e-4 < error < 0.05


def test_rounding_counts_against_the_range_of_actions_not_against_small_ones():
    """As those of a policy that holds still: bfloat16 moves an action by 0.4 % of [-1, 1], and this one by 14 %."""
    function = BFloat16Function(call)
    assert function._is_close(torch.tensor([0.057]), torch.tensor([0.05]))
    assert not function._is_close(torch.tensor([1.1]), torch.tensor([1.0]))


@every_runtime
def test_results_are_not_overwritten_by_the_next_call(runtime):
    network, function = make_network(), runtime(call)
    (first,) = function(network, torch.zeros(1, 3))
    kept = first.clone()
    function(network, torch.ones(1, 3))
    assert torch.equal(first, kept)


def test_threads_follow_the_work(monkeypatch):
    asked = []
    monkeypatch.setattr(
        OnnxFunction, "open", lambda self, model, shapes, n_threads: asked.append(n_threads) or self.run
    )
    monkeypatch.setattr(OnnxFunction, "run", lambda self, inputs: (network(*inputs),), raising=False)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 4)
    network = nn.Linear(1000, 900, bias=False).eval()  # as many weights as one thread has
    for batch_size in (1, 2, 64):
        OnnxFunction(call)(network, torch.zeros(batch_size, 1000))
    assert asked == [1, 2, 4]


@every_runtime
def test_one_function_serves_all_shapes_and_keeps_the_latest_traces(runtime, caplog):
    network, function = make_network(), runtime(call)
    for shape in ((1, 3), (5, 3), (2, 7, 3), (1, 3), (6, 3), (7, 3), (8, 3)):
        x = torch.randn(shape)
        torch.testing.assert_close(function(network, x)[0], network(x).detach(), atol=1e-5, rtol=0)
    assert [shape for (shape,) in function._traces] == [(1, 3), (6, 3), (7, 3), (8, 3)]
    (line,) = caplog.messages  # of two shapes that took another's place
    assert "policy.n_points makes clouds uniform" in line


@every_runtime
def test_an_empty_batch_is_pytorchs(runtime):
    """It ends the process in OpenVINO and in ONNX Runtime."""
    network = make_network()
    (result,) = runtime(call)(network, torch.zeros(0, 3))
    assert result.shape == (0, 4)


@every_runtime
def test_two_networks_in_two_threads(runtime):
    """Each thread with a function of its own; all of them trace at the same time, several shapes."""
    networks = [make_network() for _ in range(2)]
    x = torch.randn(4, 3)

    def compute(network: nn.Module) -> list[torch.Tensor]:
        function = runtime(call)
        return [function(network, x[:size])[0] for _ in range(20) for size in (1, 2, 3, 4)]

    with ThreadPoolExecutor(2) as pool:
        results = list(pool.map(compute, networks))
    for network, computed in zip(networks, results, strict=True):
        for result in computed:
            torch.testing.assert_close(result, network(x[: len(result)]).detach(), atol=1e-5, rtol=0)


@every_runtime
def test_changed_weights_are_noticed(runtime):
    network, function, x = make_network(), runtime(call), torch.randn(2, 3)
    function(network, x)
    optimizer = torch.optim.SGD(network.parameters(), lr=1.0)
    network(x).square().sum().backward()
    other = make_network()

    def load() -> None:
        network.load_state_dict(other.state_dict())

    def average() -> None:
        with torch.no_grad():
            torch._foreach_lerp_(list(network.parameters()), list(make_network().parameters()), 0.5)

    def change_last() -> None:
        with torch.no_grad():
            network[-1].bias.add_(1)

    def change_in_the_middle() -> None:
        with torch.no_grad():
            network[1].weight.mul_(2)

    def replace_data() -> None:
        network[1].weight.data = torch.rand(16)

    def assign() -> None:
        network.load_state_dict(make_network().state_dict(), assign=True)

    def set_parameter() -> None:
        network[0].weight = nn.Parameter(torch.rand(16, 3))

    for change in (
        optimizer.step,
        load,
        average,
        change_last,
        change_in_the_middle,
        replace_data,
        replace_data,
        assign,
        set_parameter,
    ):
        (before,) = function(network, x)
        change()
        (after,) = function(network, x)
        assert not torch.allclose(after, before)
        torch.testing.assert_close(after, network(x).detach(), atol=1e-5, rtol=0)
    torch.testing.assert_close(function(other, x)[0], other(x).detach(), atol=1e-5, rtol=0)  # another network


@pytest.mark.parametrize("training", [True, False])
def test_tracing_leaves_the_networks_mode_alone(training):
    network = make_network().train(training)
    to_onnx(call, network, [(2, 3)], ["x"])
    assert all(module.training == training for module in network.modules())


@every_runtime
def test_pytorch_computes_while_a_network_is_trained(runtime):
    network, function, x = make_network().train(), runtime(call), torch.randn(2, 3)
    (result,) = function(network, x)
    assert result.requires_grad
    assert torch.equal(result, network(x))


@every_runtime
def test_tracing_knows_neither_autocast_nor_inference_mode(runtime):
    network, x = make_network(), torch.randn(2, 3)
    expected = network(x).detach()
    with torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16):
        torch.testing.assert_close(runtime(call)(network, x * 1)[0], expected, atol=1e-5, rtol=0)
    assert all(parameter.requires_grad and not parameter.is_inference() for parameter in network.parameters())


@every_runtime
def test_a_network_made_in_inference_mode(runtime):
    with torch.inference_mode():
        network, x = make_network(), torch.randn(2, 3)
        torch.testing.assert_close(runtime(call)(network, x)[0], network(x), atol=1e-5, rtol=0)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda function: pickle.loads(pickle.dumps(function))])
@every_runtime
def test_it_can_be_copied_and_sent(runtime, duplicate):
    network, function, x = make_network(), runtime(call), torch.randn(2, 3)
    assert torch.equal(duplicate(function)(network, x)[0], function(network, x)[0])


def test_openvino_reports_to_nobody():
    """OpenVINO by itself starts a process that sends usage data over the network."""
    code = "import sys, lerobot_uca.inference.openvino_function as f; assert sys.modules['openvino_telemetry'] is None"
    subprocess.run([sys.executable, "-c", code], check=True)
