"""Milliseconds of a training step of each policy, and with PyTorch's own convolutions in the baselines' U-Nets.

python benchmarks/baseline_step.py                                # the sizes of the benchmark's setting `small`
python benchmarks/baseline_step.py --widths 512 1024 2048         # the papers' U-Net

Steps of the two kinds take turns. UCA-Flow has no convolutions: its ratio shows the noise. Weights and data are random;
the time does not depend on them.
"""

import argparse
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from common import make_batch, make_policy, timed, write_rows
from torch import nn

from lerobot_uca.networks.unet1d import Convolution
from lerobot_uca.policies.precision import has_bfloat16

SIMPLE_DP3 = (128, 256, 384)
"""Simple DP3's widths, to which the setting reduces the others'."""


def main() -> None:
    """Print a row for each policy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--widths", type=int, nargs="+", default=SIMPLE_DP3, help="of DP3, FlowPolicy and MP1")
    parser.add_argument("--batch_size", type=int, default=64)
    parser.add_argument("--n_points", type=int, default=128)
    parser.add_argument("--dtype", choices=["bfloat16", "float32"], help="default: bfloat16 if the device has it")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--steps", type=int, default=10)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    args.dtype = args.dtype or ("bfloat16" if has_bfloat16(args.device) else "float32")
    sizes: dict[str, dict[str, Any]] = {
        "uca_flow": {"dim": 128},
        **{policy: {"unet_widths": tuple(args.widths)} for policy in ("dp3", "flowpolicy", "mp1")},
        "simple_dp3": {"unet_widths": SIMPLE_DP3},
    }
    write_rows((row(policy, size, args) for policy, size in sizes.items()), device=args.device)


def row(policy_type: str, sizes: dict[str, Any], args: argparse.Namespace) -> dict[str, Any]:
    """The median of each kind of step, and how many times as long PyTorch's takes."""
    step = make_step(policy_type, sizes, args)
    kinds = Convolution.forward, nn.Conv1d.forward
    rounds = [[time_with(kind, step, args.device) for kind in kinds] for _ in range(args.steps + 2)]
    ours, pytorchs = np.median(rounds[2:], axis=0)
    return {
        "policy": policy_type,
        "batch_size": args.batch_size,
        "points": args.n_points,
        "widths": " ".join(map(str, sizes.get("unet_widths", ()))),
        "dtype": args.dtype,
        "threads": args.threads,
        "step_ms": f"{ours:.0f}",
        "with_pytorchs_convolutions_ms": f"{pytorchs:.0f}",
        "ratio": f"{pytorchs / ours:.2f}",
    }


def make_step(policy_type: str, sizes: dict[str, Any], args: argparse.Namespace) -> Callable[[], None]:
    """A whole step of a training: the loss, its gradient, the optimiser and the moving average."""
    policy = make_policy(policy_type, device=args.device, n_points=args.n_points, dtype=args.dtype, **sizes).train()
    batch = make_batch(policy, args.batch_size)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    dtype = getattr(torch, args.dtype)

    def step() -> None:
        with torch.autocast(args.device, dtype=dtype, enabled=dtype is not torch.float32):
            loss, _ = policy.forward(batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        policy.update()

    return step


def time_with(convolve: Callable[..., torch.Tensor], step: Callable[[], None], device: str) -> float:
    """Milliseconds of a step whose convolutions are computed so."""
    with patch.object(Convolution, "forward", convolve):
        return timed(step, device=device)[0]


if __name__ == "__main__":
    main()
