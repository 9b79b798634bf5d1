"""Milliseconds from a normalised observation to a chunk of actions on a CPU, by stage, beside the machine's floor.

python benchmarks/inference.py > benchmarks/results/inference.csv
python benchmarks/inference.py --compile         # torch.compile as well; needs a C++ compiler

Each frame is encoded once, when it arrives: 'encode' is the newest frame's. 'plan' is a whole call of the policy with
its checks; its 99th percentile is beside its median. The floor is the larger of two times: floating-point operations,
counted by PyTorch, over the measured peak of a matrix product, and bytes of weights over the measured rate of reading
memory. (A small network's weights stay in the cache, from where they come faster.)
"""

import argparse
import csv
import sys
import time
from collections.abc import Callable
from operator import call
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

import lerobot_policy_uca_flow  # noqa: F401  (registers the policy)
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy

N_STATES, N_ACTIONS, CLOUD_POINTS = 9, 4, 512
SIZES: dict[str, Any] = {"small": {"dim": 128, "n_points": 128}, "full": {"dim": 256, "n_points": 512}}
COLUMNS = ("configuration", "computed by", "batch", "encode", "generate", "plan", "plan p99", "floor", "plan / floor")


def main() -> None:
    """Print a CSV table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch_sizes", type=int, nargs="+", default=[1, 2, 64])
    parser.add_argument("--calls", type=int, default=300, help="timed calls of each")
    parser.add_argument("--compile", action="store_true", help="measure torch.compile as well")
    args = parser.parse_args()
    peak, bandwidth = matrix_product_peak(), reading_bandwidth()
    machine = f"{torch.get_num_threads()} threads, {peak / 1e9:.0f} GFLOP/s, {bandwidth / 1e9:.1f} GB/s"
    print(f"{machine}; times in ms, medians", file=sys.stderr)
    table = csv.writer(sys.stdout, lineterminator="\n")
    table.writerow(COLUMNS)
    for size in SIZES:
        for batch_size in args.batch_sizes:
            for name in ("eager", "onnxruntime", *(["torch.compile"] if args.compile else [])):
                row = measure(make(size, name), batch_size, args.calls, peak, bandwidth)
                table.writerow([size, name, batch_size, *(f"{value:.3f}" for value in row)])
                sys.stdout.flush()


def make(size: str, computed_by: str) -> UCAFlowPolicy:
    """An untrained policy: weights do not change the time."""
    features = {
        OBS_POINT_CLOUD: PolicyFeature(FeatureType.STATE, (CLOUD_POINTS, 3)),
        "observation.state": PolicyFeature(FeatureType.STATE, (N_STATES,)),
    }
    action = {"action": PolicyFeature(FeatureType.ACTION, (N_ACTIONS,))}
    is_compiled = computed_by == "torch.compile"
    config = UCAFlowConfig(
        device="cpu",
        input_features=features,
        output_features=action,
        inference="eager" if is_compiled else computed_by,
        **SIZES[size],
    )
    policy = UCAFlowPolicy(config).eval()
    if is_compiled:
        policy.ema_model.encoder.compile()
        policy.ema_model.generator.compile()
    return policy


@torch.inference_mode()
def measure(policy: UCAFlowPolicy, batch_size: int, n_calls: int, peak: float, bandwidth: float) -> list[float]:
    """The numbers of a row."""
    config = policy.config
    observation = {
        OBS_POINT_CLOUD: torch.rand(batch_size, CLOUD_POINTS, 3),
        "observation.state": torch.rand(batch_size, N_STATES),
    }
    inputs = (observation[OBS_POINT_CLOUD][:, None, : config.n_points], observation["observation.state"][:, None])
    noise = torch.randn(batch_size, config.horizon, config.n_actions)
    o = torch.randn(batch_size, config.n_obs_steps, config.n_obs_features)
    encoder, generator = policy.ema_model.encoder, policy.ema_model.generator
    encode = times(lambda: policy._compute(policy._encoder_function, encoder, *inputs), n_calls)
    generate = times(lambda: policy._compute(policy._generate_function, generator, noise, o), n_calls)
    plan = times(lambda: policy.predict_action_chunk(observation), n_calls)
    floor = sum(
        1e3 * max(flops(function, network, *arguments) / peak, n_bytes(network) / bandwidth)
        for function, network, arguments in ((call, encoder, inputs), (policy.generate, generator, (noise, o)))
    )
    medians = [float(np.median(milliseconds)) for milliseconds in (encode, generate, plan)]
    return [*medians, float(np.percentile(plan, 99)), floor, medians[-1] / floor]


def times(function: Callable[[], Any], n_calls: int) -> list[float]:
    """Milliseconds of each call, after a few to warm up."""
    milliseconds = []
    for _ in range(n_calls + 10):
        start = time.perf_counter()
        function()
        milliseconds.append(1e3 * (time.perf_counter() - start))
    return milliseconds[10:]


def flops(function: Callable[..., Tensor], network: nn.Module, *inputs: Tensor) -> int:
    """Floating-point operations of a call."""
    with FlopCounterMode(display=False) as counter:
        function(network, *inputs)
    return counter.get_total_flops()


def n_bytes(network: nn.Module) -> int:
    """Of the weights."""
    return sum(parameter.nbytes for parameter in network.parameters())


def matrix_product_peak(size: int = 2048) -> float:
    """The best rate of a square matrix product [FLOP/s]."""
    a, b = torch.randn(2, size, size)
    return 2 * size**3 / (min(times(lambda: a @ b, 10)) / 1e3)


def reading_bandwidth(n_megabytes: int = 256) -> float:
    """The best rate of reading memory [bytes/s]."""
    data = torch.ones(n_megabytes * 2**18)
    return data.nbytes / (min(times(data.sum, 10)) / 1e3)


if __name__ == "__main__":
    main()
