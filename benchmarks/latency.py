"""Milliseconds from an observation to a chunk of actions, of every policy at its full size, untrained weights.

python benchmarks/latency.py                 # measures, writes benchmarks/results/latency.csv and draws latency.png
python benchmarks/latency.py --draw_only     # the picture again, from the CSV file

One process, batch 1, Meta-World's shapes (state 9, action 4), without pre- and postprocessing: the newest frame goes
through the encoder, the one before it is remembered, the network makes the actions. UCA-Flow runs as it does by
default, in OpenVINO, and in PyTorch, as the baselines do. The policies take turns, so that whatever else the machine
does meets all of them alike. Each finds its weights driven out of the cache by those before
it: alone, UCA-Flow is twice as fast (benchmarks/inference.py).
"""

import argparse
import csv
import time
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_policy_config
from lerobot.policies.factory import get_policy_class

import lerobot_policy_uca_flow  # noqa: F401  (registers the policies)
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.modeling_base import PointCloudPolicy

RESULTS = Path(__file__).parent / "results" / "latency.csv"
POLICIES = {
    "UCA-Flow": {"policy_type": "uca_flow"},
    "UCA-Flow (PyTorch)": {"policy_type": "uca_flow", "inference": "eager"},
    "MP1": {"policy_type": "mp1"},
    "FlowPolicy": {"policy_type": "flowpolicy"},
    "Simple DP3": {"policy_type": "simple_dp3"},
    "DP3": {"policy_type": "dp3"},
}
POINTS, THREADS = (512, 1024), (1, 2)
N_STATES, N_ACTIONS = 9, 4
# ms with one thread and 512 points, measured with the public code of each on two cores with AVX-512.
PUBLIC_CODE = {"MP1": 112, "FlowPolicy": 115, "Simple DP3": 65, "DP3": 1116}


def main() -> None:
    """Print a table, write it and draw it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20, help="calls of each policy that are measured")
    parser.add_argument("--warm_up", type=int, default=3, help="calls of each policy before those")
    parser.add_argument("--draw_only", action="store_true", help="draw what was measured before")
    args = parser.parse_args()
    if not args.draw_only:
        rows = measure(args.rounds, args.warm_up)
        with RESULTS.open("w", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    draw()


def measure(n_rounds: int, n_warm_up: int) -> list[dict[str, str]]:
    """A row for each policy, number of points and number of threads."""
    rows = []
    print(f"{'':20}{'parameters':>13}{'calls':>7}{'points':>8}{'threads':>9}{'median':>9}{'p10':>9}{'p90':>9}", end="")
    print(f"{'x UCA-Flow':>12}{'x public code':>15}")
    for n_threads in THREADS:
        torch.set_num_threads(n_threads)
        policies = {name: make(**settings) for name, settings in POLICIES.items()}  # a trace keeps its threads
        for n_points in POINTS:
            observation = {
                OBS_POINT_CLOUD: torch.rand(1, n_points, 3) * 2 - 1,
                "observation.state": torch.rand(1, N_STATES) * 2 - 1,
            }
            for policy in policies.values():
                policy.reset()
            times: dict[str, list[float]] = {name: [] for name in POLICIES}
            for _ in range(n_warm_up + n_rounds):
                for name, policy in policies.items():
                    start = time.perf_counter()
                    policy.predict_action_chunk(observation)
                    times[name].append(1e3 * (time.perf_counter() - start))
            medians = {name: np.median(values[n_warm_up:]) for name, values in times.items()}
            for name, policy in policies.items():
                p10, p90 = np.percentile(times[name][n_warm_up:], (10, 90))
                row = {
                    "policy": name,
                    "parameters": str(sum(parameter.numel() for parameter in policy.ema_model.parameters())),
                    "network_calls": str(count_network_calls(policy)),
                    "points": str(n_points),
                    "threads": str(n_threads),
                    "median_ms": f"{medians[name]:.2f}",
                    "p10_ms": f"{p10:.2f}",
                    "p90_ms": f"{p90:.2f}",
                    "ratio_to_uca_flow": f"{medians[name] / medians['UCA-Flow']:.1f}",
                }
                rows.append(row)
                widths = (20, 13, 7, 8, 9, 9, 9, 9, 12)
                print("".join(f"{row[key]:>{width}}" for key, width in zip(row, widths, strict=True)), end="")
                compared = (n_points, n_threads) == (512, 1) and name in PUBLIC_CODE
                print(f"{medians[name] / PUBLIC_CODE[name]:15.2f}" if compared else "")
    return rows


def make(policy_type: str, **settings: Any) -> PointCloudPolicy:
    """An untrained policy in eval mode, without the second copy of its weights."""
    config = make_policy_config(
        policy_type,
        **settings,
        device="cpu",
        input_features={
            OBS_POINT_CLOUD: PolicyFeature(FeatureType.STATE, (max(POINTS), 3)),
            "observation.state": PolicyFeature(FeatureType.STATE, (N_STATES,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (N_ACTIONS,))},
    )
    policy = get_policy_class(policy_type)(config).eval()
    policy.model = policy.ema_model
    return policy


def count_network_calls(policy: PointCloudPolicy) -> int:
    """Calls of the network for one chunk of actions."""
    config, network = policy.config, policy.ema_model.generator
    calls: list[None] = []
    hook = network.register_forward_hook(lambda *_: calls.append(None))
    with torch.no_grad():
        noise = torch.randn(1, config.horizon, config.n_actions)
        policy.generate(network, noise, torch.randn(1, config.n_obs_steps, config.n_obs_features))
    hook.remove()
    return len(calls)


def draw() -> None:
    """Bars of the CSV file's medians, from p10 to p90."""
    with RESULTS.open() as file:
        rows = list(csv.DictReader(file))
    figure, axes = plt.subplots(1, len(THREADS), figsize=(9, 3.2), sharey=True, layout="constrained")
    for axis, n_threads in zip(axes, THREADS, strict=True):
        for i, n_points in enumerate(POINTS):
            bars = [row for row in rows if (row["threads"], row["points"]) == (str(n_threads), str(n_points))]
            median, p10, p90 = (
                np.array([float(bar[key]) for bar in bars]) for key in ("median_ms", "p10_ms", "p90_ms")
            )
            positions = np.arange(len(bars)) + 0.4 * i
            axis.bar(positions, median, 0.36, yerr=(median - p10, p90 - median), capsize=2, label=f"{n_points} points")
            for x, value, top in zip(positions, median, p90, strict=True):
                label = f"{value:.2g}" if value < 10 else f"{value:.0f}"
                axis.annotate(label, (x, top), (0, 2), textcoords="offset points", ha="center", fontsize=7)
        axis.set_xticks(np.arange(len(bars)) + 0.2, [bar["policy"].replace(" ", "\n") for bar in bars], fontsize=8)
        axis.set_yscale("log")
        axis.set_title(f"{n_threads} thread{'s' * (n_threads > 1)}", fontsize=10)
        axis.margins(y=0.12)
    axes[0].set_ylabel("ms for a chunk of actions")
    axes[0].legend(fontsize=8, loc="upper left")
    figure.savefig(RESULTS.with_suffix(".png"), dpi=120)


if __name__ == "__main__":
    main()
