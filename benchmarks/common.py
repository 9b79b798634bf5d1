"""Shared by the benchmarks: untrained policies, a timer, the machine's peaks, and rows that say how they were made."""

import csv
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TextIO

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_policy_config
from lerobot.policies.factory import get_policy_class
from torch import Tensor

import lerobot_policy_uca_flow  # noqa: F401  (registers policies and environments)
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.modeling_base import PointCloudPolicy
from lerobot_uca.protocol.record import COLUMNS, columns

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"
CLOUD_POINTS, N_STATES, N_ACTIONS = 512, 9, 4
"""Meta-World's shapes."""
SIZES: dict[str, dict[str, Any]] = {"small": {"dim": 128, "n_points": 128}, "full": {"dim": 256, "n_points": 512}}
"""UCA-Flow in the small configuration and at its default size."""
OMP = "OMP_NUM_THREADS"


def make_policy(policy_type: str = "uca_flow", cloud_points: int = CLOUD_POINTS, **settings: Any) -> PointCloudPolicy:
    """An untrained policy in eval mode for Meta-World's shapes: weights do not change the time."""
    config = make_policy_config(
        policy_type,
        input_features={
            OBS_POINT_CLOUD: PolicyFeature(FeatureType.STATE, (cloud_points, 3)),
            "observation.state": PolicyFeature(FeatureType.STATE, (N_STATES,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (N_ACTIONS,))},
        **{"device": "cpu", **settings},
    )
    return get_policy_class(policy_type)(config).to(config.device).eval()


def make_observation(batch_size: int = 1, cloud_points: int = CLOUD_POINTS, device: str = "cpu") -> dict[str, Tensor]:
    """A random observation, normalised: cloud (B, N, 3) and state (B, S) in [-1, 1]."""
    return {
        OBS_POINT_CLOUD: torch.rand(batch_size, cloud_points, 3, device=device) * 2 - 1,
        "observation.state": torch.rand(batch_size, N_STATES, device=device) * 2 - 1,
    }


def make_batch(policy: PointCloudPolicy, batch_size: int) -> dict[str, Tensor]:
    """A batch of random training windows."""
    config, device = policy.config, policy.config.device
    return {
        OBS_POINT_CLOUD: torch.rand(batch_size, config.n_obs_steps, CLOUD_POINTS, 3, device=device),
        "observation.state": torch.rand(batch_size, config.n_obs_steps, N_STATES, device=device),
        "action": torch.rand(batch_size, config.horizon, N_ACTIONS, device=device),
    }


def timed(function: Callable[..., Any], *arguments: Any, device: str = "cpu") -> tuple[float, Any]:
    """Milliseconds a call takes, the device's work included, and its result."""
    start = time.perf_counter()
    result = function(*arguments)
    if device != "cpu":
        torch.accelerator.synchronize()
    return 1e3 * (time.perf_counter() - start), result


def times(function: Callable[[], Any], n_calls: int, device: str = "cpu", n_warm_up: int = 10) -> list[float]:
    """Milliseconds of each call, after a few to warm up."""
    return [timed(function, device=device)[0] for _ in range(n_warm_up + n_calls)][n_warm_up:]


def matrix_product_peak(dtype: torch.dtype = torch.float32, device: str = "cpu", size: int = 2048) -> float:
    """The best rate of a square matrix product [FLOP/s]."""
    a, b = torch.randn(2, size, size, dtype=dtype, device=device)
    return 2 * size**3 / (min(times(lambda: a @ b, 10, device, n_warm_up=2)) / 1e3)


def reading_bandwidth(device: str = "cpu", n_megabytes: int = 256) -> float:
    """The best rate of reading memory [bytes/s]."""
    data = torch.ones(n_megabytes * 2**18, device=device)
    return data.nbytes / (min(times(data.sum, 10, device, n_warm_up=2)) / 1e3)


# Provenance -------------------------------------------------------------------------------------------------------


def provenance(device: str = "cpu") -> dict[str, str]:
    """How this run's rows were made: `COLUMNS`."""
    script = Path(sys.argv[0])
    name = script.resolve().relative_to(ROOT) if script.resolve().is_relative_to(ROOT) else Path(script.name)
    threads = [f"{OMP}={os.environ[OMP]}"] if OMP in os.environ else []
    return columns(shlex.join([*threads, "python", str(name), *sys.argv[1:]]), device)


def print_provenance(device: str = "cpu") -> None:
    """The same as the first lines of a text result."""
    for name, value in provenance(device).items():
        print(f"# {name}: {value}")
    print()


def write_rows(rows: Iterable[dict[str, Any]], file: TextIO = sys.stdout, device: str = "cpu") -> None:
    """Write rows as CSV, each as soon as it is measured, with how it was made."""
    made, writer = provenance(device), None
    for row in rows:
        if writer is None:
            writer = csv.DictWriter(file, [*row, *COLUMNS], lineterminator="\n")
            writer.writeheader()
        writer.writerow({**row, **made})
        file.flush()


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file; none if it does not exist."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
