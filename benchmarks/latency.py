"""Milliseconds from an observation to a chunk of actions, of every policy at its full size, untrained weights.

python benchmarks/latency.py                 # measures, writes benchmarks/results/latency.csv and draws latency.png
python benchmarks/latency.py --draw_only     # the picture again, from the CSV file

One process, batch 1, Meta-World's shapes (state 9, action 4): encoder and network, without pre- and postprocessing.
The policies take turns, so that whatever else the machine does meets all of them alike.
"""

import argparse
import csv
import time
from pathlib import Path

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
NAMES = {"uca_flow": "UCA-Flow", "mp1": "MP1", "flow": "FlowPolicy", "simple_dp3": "Simple DP3", "dp3": "DP3"}
POINTS, THREADS = (512, 1024), (1, 2)
N_STATES, N_ACTIONS = 9, 4
# ms with one thread and 512 points, measured with the public code of each on two cores with AVX-512.
PUBLIC_CODE = {"mp1": 112, "flow": 115, "simple_dp3": 65, "dp3": 1116}


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
    policies = {name: make(name) for name in NAMES}
    rows = []
    print(f"{'':12}{'parameters':>13}{'calls':>7}{'points':>8}{'threads':>9}{'median':>9}{'p10':>9}{'p90':>9}", end="")
    print(f"{'x UCA-Flow':>12}{'x public code':>15}")
    for n_threads in THREADS:
        torch.set_num_threads(n_threads)
        for n_points in POINTS:
            observation = {
                OBS_POINT_CLOUD: torch.rand(1, 2, n_points, 3) * 2 - 1,
                "observation.state": torch.rand(1, 2, N_STATES) * 2 - 1,
            }
            times: dict[str, list[float]] = {name: [] for name in NAMES}
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
                    "network_calls": str(count_network_calls(policy, observation)),
                    "points": str(n_points),
                    "threads": str(n_threads),
                    "median_ms": f"{medians[name]:.2f}",
                    "p10_ms": f"{p10:.2f}",
                    "p90_ms": f"{p90:.2f}",
                    "ratio_to_uca_flow": f"{medians[name] / medians['uca_flow']:.1f}",
                }
                rows.append(row)
                widths = (12, 13, 7, 8, 9, 9, 9, 9, 12)
                print("".join(f"{row[key]:>{width}}" for key, width in zip(row, widths, strict=True)), end="")
                compared = (n_points, n_threads) == (512, 1) and name in PUBLIC_CODE
                print(f"{medians[name] / PUBLIC_CODE[name]:15.2f}" if compared else "")
    return rows


def make(name: str) -> PointCloudPolicy:
    """An untrained policy in eval mode, without the second copy of its weights."""
    config = make_policy_config(
        name,
        device="cpu",
        input_features={
            OBS_POINT_CLOUD: PolicyFeature(FeatureType.STATE, (max(POINTS), 3)),
            "observation.state": PolicyFeature(FeatureType.STATE, (N_STATES,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (N_ACTIONS,))},
    )
    policy = get_policy_class(name)(config).eval()
    policy.model = policy.ema_model
    return policy


def count_network_calls(policy: PointCloudPolicy, observation: dict[str, torch.Tensor]) -> int:
    """Calls of the network for one chunk of actions."""
    calls: list[None] = []
    hook = policy.ema_model.generator.register_forward_hook(lambda *_: calls.append(None))
    policy.predict_action_chunk(observation)
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
                axis.annotate(f"{value:.0f}", (x, top), (0, 2), textcoords="offset points", ha="center", fontsize=7)
        axis.set_xticks(np.arange(len(NAMES)) + 0.2, [NAMES[bar["policy"]] for bar in bars], fontsize=8)
        axis.set_yscale("log")
        axis.set_title(f"{n_threads} thread{'s' * (n_threads > 1)}", fontsize=10)
        axis.margins(y=0.12)
    axes[0].set_ylabel("ms for a chunk of actions")
    axes[0].legend(fontsize=8, loc="upper left")
    figure.savefig(RESULTS.with_suffix(".png"), dpi=120)


if __name__ == "__main__":
    main()
