"""Milliseconds from a normalised observation to a chunk of actions, by stage, beside the machine's floor.

python benchmarks/inference.py > benchmarks/results/inference.csv
python benchmarks/inference.py --computed_by eager openvino compile        # torch.compile needs a C++ compiler
python benchmarks/inference.py --device=cuda --computed_by eager compile   # with CUDA graphs

Each frame is encoded once, when it arrives: 'encode' is the newest frame's, 'generate' the actions from the features of
a window. 'plan' is a whole call of the policy, both in one, with its checks. Beside each median stands how many times
the floor it is, and beside plan's the 99th percentile. The floor is the larger of two times: floating-point operations,
counted by PyTorch, over the measured peak of a matrix product with all threads, and bytes of weights over the measured
rate of reading memory. (A small network's weights stay in the cache, from where they come faster; the small network's
single sample is computed in one thread.) The peak is float32's, also beside bfloat16's times.
"""

import argparse
import csv
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

import lerobot_policy_uca_flow  # noqa: F401  (registers the policy)
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.inference.backends import BACKENDS, make_backend
from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy

N_STATES, N_ACTIONS, CLOUD_POINTS = 9, 4, 512
SIZES: dict[str, Any] = {"small": {"dim": 128, "n_points": 128}, "full": {"dim": 256, "n_points": 512}}
RUNTIMES = ["eager", "onnxruntime", "openvino", "openvino_bfloat16"]
STAGES = ("encode", "generate", "plan")
COLUMNS = (
    "configuration",
    "computed by",
    "batch",
    *(f"{stage}{unit}" for stage in STAGES for unit in ("", " / floor")),
)


def main() -> None:
    """Print a CSV table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch_sizes", type=int, nargs="+", default=[1, 2, 64])
    parser.add_argument("--calls", type=int, default=300, help="timed calls of each")
    parser.add_argument("--computed_by", nargs="+", default=RUNTIMES, choices=BACKENDS)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    peak, bandwidth = matrix_product_peak(args.device), reading_bandwidth(args.device)
    machine = f"{args.device}, {torch.get_num_threads()} threads, {peak / 1e9:.0f} GFLOP/s, {bandwidth / 1e9:.1f} GB/s"
    print(f"{machine}; times in ms, medians", file=sys.stderr)
    table = csv.writer(sys.stdout, lineterminator="\n")
    table.writerow([*COLUMNS, "plan p99"])
    for size in SIZES:
        for batch_size in args.batch_sizes:
            for name in args.computed_by:
                torch._dynamo.reset()  # it compiles a function for so many shapes and no more
                row = measure(make(size, name, args.device), batch_size, args.calls, peak, bandwidth)
                table.writerow([size, name, batch_size, *(f"{value:.3f}" for value in row)])
                sys.stdout.flush()


def make(size: str, computed_by: str, device: str = "cpu") -> UCAFlowPolicy:
    """An untrained policy: weights do not change the time."""
    features = {
        OBS_POINT_CLOUD: PolicyFeature(FeatureType.STATE, (CLOUD_POINTS, 3)),
        "observation.state": PolicyFeature(FeatureType.STATE, (N_STATES,)),
    }
    action = {"action": PolicyFeature(FeatureType.ACTION, (N_ACTIONS,))}
    config = UCAFlowConfig(
        device=device, input_features=features, output_features=action, inference=computed_by, **SIZES[size]
    )
    return UCAFlowPolicy(config).to(device).eval()


@torch.inference_mode()
def measure(policy: UCAFlowPolicy, batch_size: int, n_calls: int, peak: float, bandwidth: float) -> list[float]:
    """The numbers of a row: COLUMNS from 'encode' on, and plan's 99th percentile."""
    config, device = policy.config, policy.config.device
    observation = {
        OBS_POINT_CLOUD: torch.rand(batch_size, CLOUD_POINTS, 3, device=device),
        "observation.state": torch.rand(batch_size, N_STATES, device=device),
    }
    frame = (observation[OBS_POINT_CLOUD][:, None, : config.n_points], observation["observation.state"][:, None])
    noise = torch.randn(batch_size, config.horizon, config.n_actions, device=device)
    o = torch.randn(batch_size, config.n_obs_steps, config.n_obs_features, device=device)
    encoder, generator = policy.ema_model.encoder, policy.ema_model.generator

    def generate_one(generator: nn.Module, noise: Tensor, o: Tensor) -> tuple[Tensor]:
        return (policy.generate(generator, noise, o),)

    generate = make_backend(config.inference)(generate_one)
    milliseconds = (
        times(lambda: policy._encode_frames(encoder, *frame), n_calls, device),
        times(lambda: generate(generator, noise, o), n_calls, device),
        times(lambda: policy.predict_action_chunk(observation), n_calls, device),
    )
    floors = [
        1e3 * max(flops(function) / peak, n_bytes(network) / bandwidth)
        for function, network in (
            (lambda: encoder(*frame), encoder),
            (lambda: policy.generate(generator, noise, o), generator),
        )
    ]
    medians = [float(np.median(each)) for each in milliseconds]
    ratios = [median / floor for median, floor in zip(medians, [*floors, sum(floors)], strict=True)]
    pairs = zip(medians, ratios, strict=True)
    return [*(number for pair in pairs for number in pair), float(np.percentile(milliseconds[-1], 99))]


def times(function: Callable[[], Any], n_calls: int, device: str) -> list[float]:
    """Milliseconds of each call, after a few to warm up."""
    milliseconds = []
    for _ in range(n_calls + 10):
        start = time.perf_counter()
        function()
        if device != "cpu":
            torch.accelerator.synchronize()
        milliseconds.append(1e3 * (time.perf_counter() - start))
    return milliseconds[10:]


def flops(function: Callable[[], Any]) -> int:
    """Floating-point operations of a call."""
    with FlopCounterMode(display=False) as counter:
        function()
    return counter.get_total_flops()


def n_bytes(network: nn.Module) -> int:
    """Of the weights."""
    return sum(parameter.nbytes for parameter in network.parameters())


def matrix_product_peak(device: str, size: int = 2048) -> float:
    """The best rate of a square matrix product [FLOP/s]."""
    a, b = torch.randn(2, size, size, device=device)
    return 2 * size**3 / (min(times(lambda: a @ b, 10, device)) / 1e3)


def reading_bandwidth(device: str, n_megabytes: int = 256) -> float:
    """The best rate of reading memory [bytes/s]."""
    data = torch.ones(n_megabytes * 2**18, device=device)
    return data.nbytes / (min(times(data.sum, 10, device)) / 1e3)


if __name__ == "__main__":
    main()
