"""Seconds of a training step by stage, and how far it is from the machine's floor.

python benchmarks/training_step.py                               # the small configuration
python benchmarks/training_step.py --dim=256 --n_points=512      # the default one

The floor is floating-point operations, counted by PyTorch, over the measured peak of a matrix product in the same
precision: those of the plain step (every point goes back through the encoder, every sample makes both passes, the last
layer computes all tokens; no products with tangents that are zero) and those this package's step is left with. Where
bfloat16 products run in tiles of their own (Intel's AMX), the peak is many times that of anything else a step does;
ONEDNN_MAX_CPU_ISA=AVX512_CORE_BF16 does without them. For comparison: Simple DP3's public code takes 1.03 s a step at
the same batch on two cores.
"""

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from common import make_batch, make_policy, matrix_product_peak, print_provenance, timed
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.modeling_base import PointCloudPolicy
from lerobot_uca.policies.precision import has_bfloat16


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dim", type=int, default=128)
    parser.add_argument("--n_points", type=int, default=128)
    parser.add_argument("--batch_size", type=int, default=128)
    parser.add_argument("--dtype", choices=["bfloat16", "float32"], help="default: bfloat16 if the device has it")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--steps", type=int, default=20)
    args = parser.parse_args()
    args.dtype = args.dtype or ("bfloat16" if has_bfloat16(args.device) else "float32")

    sizes = {"dim": args.dim, "n_points": args.n_points, "dtype": args.dtype}
    policy = make_policy(device=args.device, **sizes).train()
    batch = make_batch(policy, args.batch_size)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    dtype = getattr(torch, args.dtype)

    def forward() -> torch.Tensor:
        with torch.autocast(args.device, dtype=dtype, enabled=dtype is not torch.float32):
            return policy.forward(batch)[0]

    with torch.autocast(args.device, dtype=dtype, enabled=dtype is not torch.float32):
        plain_flops = count_flops(lambda: plain_step(policy, batch))
    flops = count_flops(lambda: forward().backward())
    rows = []
    for _ in range(args.steps + 2):
        optimizer.zero_grad()
        encode, _ = timed(lambda: encode_only(policy, batch, dtype), device=args.device)
        whole, loss = timed(forward, device=args.device)
        backward, _ = timed(loss.backward, device=args.device)
        step, _ = timed(lambda: (optimizer.step(), policy.update()), device=args.device)
        rows.append([encode, whole - encode, backward, step, whole + backward + step])
    stages = np.median(rows[2:], axis=0)
    peak = matrix_product_peak(dtype, args.device)
    print_provenance(args.device)
    print(f"batch {args.batch_size}, dim {args.dim}, {args.n_points} points, {args.dtype} on {args.device}, ", end="")
    print(f"{torch.get_num_threads()} threads; median of {args.steps} steps")
    names = ("encoder, forward", "two passes and JVP, forward", "backward", "optimiser and moving average", "step")
    for name, milliseconds in zip(names, stages, strict=True):
        print(f"{name:32}{milliseconds:9.1f} ms")
    for name, count in (("plain step", plain_flops), ("step made here", flops)):
        floor = 1e3 * count / peak
        print(f"{'floor, ' + name:32}{floor:9.1f} ms", end="   ")
        print(f"{count / 1e9:.1f} GFLOP at {peak / 1e9:.0f} GFLOP/s; the step takes {stages[-1] / floor:.1f} x")


def plain_step(policy: PointCloudPolicy, batch: dict[str, torch.Tensor]) -> None:
    """The matrix products of the method as the paper writes it down."""
    x = batch["action"]
    encoder: Any = policy.model.encoder
    network: Any = policy.model.generator
    per_point = encoder.points.per_point(batch[OBS_POINT_CLOUD][..., : policy.config.n_points, :])
    state = encoder.state(batch["observation.state"])
    o = torch.cat([encoder.points.project(per_point.amax(dim=-2)), state], dim=-1)
    t, instant = torch.ones(len(x), device=x.device), torch.zeros(len(x), device=x.device)

    def refine_all(P: torch.Tensor, Y: torch.Tensor) -> torch.Tensor:
        tokens = torch.cat([P, Y], dim=1)
        for block in network.blocks:
            tokens = block(tokens)
        return tokens[:, -Y.shape[1] :]

    network.refine = refine_all
    v = network(x, t, instant, o)
    u, _ = torch.func.jvp(lambda z, t, h: network(z, t, h, o), (x, t, t), (x, t, t))  # type: ignore[misc]
    del network.refine
    (u + v).mean().backward()


def count_flops(function: Callable[[], Any]) -> int:
    """Floating-point operations of matrix products."""
    with FlopCounter() as counter:
        function()
    return counter.total


class FlopCounter(TorchDispatchMode):
    """PyTorch's formulas without its FlopCounterMode, whose module hooks fail on tensors with a tangent."""

    total = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        if func._overloadpacket in flop_registry:
            self.total += flop_registry[func._overloadpacket](*args, **(kwargs or {}), out_val=result)
        return result


def encode_only(policy: PointCloudPolicy, batch: dict[str, torch.Tensor], dtype: torch.dtype) -> torch.Tensor:
    """The observation features, in the precision of the step."""
    with torch.autocast(str(batch["action"].device.type), dtype=dtype, enabled=dtype is not torch.float32):
        cloud = batch[OBS_POINT_CLOUD][..., : policy.config.n_points, :]
        return policy.model.encoder(cloud, batch["observation.state"])


if __name__ == "__main__":
    main()
