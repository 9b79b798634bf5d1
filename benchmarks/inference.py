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
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from common import SIZES, make_observation, make_policy, matrix_product_peak, reading_bandwidth, times, write_rows
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.inference.backends import BACKENDS, make_backend
from lerobot_uca.policies.modeling_base import PointCloudPolicy

RUNTIMES = ["eager", "onnxruntime", "openvino", "openvino_bfloat16"]
STAGES = ("encode", "generate", "plan")
MEASURED = (*(f"{stage}{unit}" for stage in STAGES for unit in ("", " / floor")), "plan p99")


def main() -> None:
    """Print a CSV table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch_sizes", type=int, nargs="+", default=[1, 2, 64])
    parser.add_argument("--calls", type=int, default=300, help="timed calls of each")
    parser.add_argument("--computed_by", nargs="+", default=RUNTIMES, choices=BACKENDS)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    peak, bandwidth = matrix_product_peak(device=args.device), reading_bandwidth(args.device)
    machine = f"{args.device}, {torch.get_num_threads()} threads, {peak / 1e9:.0f} GFLOP/s, {bandwidth / 1e9:.1f} GB/s"
    print(f"{machine}; times in ms, medians", file=sys.stderr)
    write_rows(rows(args, peak, bandwidth), device=args.device)


def rows(args: argparse.Namespace, peak: float, bandwidth: float) -> Iterator[dict[str, Any]]:
    """A row for each size, batch and backend."""
    for size, settings in SIZES.items():
        for batch_size in args.batch_sizes:
            for name in args.computed_by:
                torch._dynamo.reset()  # it compiles a function for so many shapes and no more
                policy = make_policy(inference=name, device=args.device, **settings)
                numbers = measure(policy, batch_size, args.calls, peak, bandwidth)
                measured = zip(MEASURED, (f"{number:.3f}" for number in numbers), strict=True)
                yield {"configuration": size, "computed by": name, "batch": batch_size, **dict(measured)}


@torch.inference_mode()
def measure(policy: PointCloudPolicy, batch_size: int, n_calls: int, peak: float, bandwidth: float) -> list[float]:
    """The numbers of a row, in the order of MEASURED."""
    config, device = policy.config, policy.config.device
    observation = make_observation(batch_size, device=device)
    frame = (observation[OBS_POINT_CLOUD][:, : config.n_points], observation["observation.state"])
    noise = torch.randn(batch_size, config.horizon, config.n_actions, device=device)
    o = torch.randn(batch_size, config.n_obs_steps, config.n_obs_features, device=device)
    encoder, generator = policy.ema_model.encoder, policy.ema_model.generator

    def generate_one(generator: nn.Module, noise: Tensor, o: Tensor) -> tuple[Tensor]:
        return (policy.generate(generator, noise, o),)

    generate = make_backend(config.inference)(generate_one)
    milliseconds = (
        times(lambda: policy._encode_frame(encoder, *frame), n_calls, device),
        times(lambda: generate(generator, noise, o), n_calls, device),
        times(lambda: policy.predict_action_chunk(observation), n_calls, device),
    )
    floors = [
        1e3 * max(flops(function) / peak, n_bytes(network) / bandwidth)
        for function, network in (
            (lambda: encoder(*(each[:, None] for each in frame)), encoder),
            (lambda: policy.generate(generator, noise, o), generator),
        )
    ]
    medians = [float(np.median(each)) for each in milliseconds]
    ratios = [median / floor for median, floor in zip(medians, [*floors, sum(floors)], strict=True)]
    pairs = zip(medians, ratios, strict=True)
    return [*(number for pair in pairs for number in pair), float(np.percentile(milliseconds[-1], 99))]


def flops(function: Callable[[], Any]) -> int:
    """Floating-point operations of a call."""
    with FlopCounterMode(display=False) as counter:
        function()
    return counter.get_total_flops()


def n_bytes(network: nn.Module) -> int:
    """The size of the weights."""
    return sum(parameter.nbytes for parameter in network.parameters())


if __name__ == "__main__":
    main()
