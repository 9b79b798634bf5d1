"""Milliseconds from an observation to a chunk of actions, of every policy at its full size, untrained weights.

python benchmarks/latency.py                 # measures, writes benchmarks/results/latency.csv and draws latency.png
python benchmarks/latency.py --draw_only     # the picture again, from the CSV file

Each policy is computed by PyTorch and by OpenVINO, so that like compares with like; 'default' says which of the two a
user gets without asking. One process, batch 1, Meta-World's shapes (state 9, action 4), without pre- and
postprocessing: the newest frame goes through the encoder, the one before it is remembered, the network makes the
actions. The policies take turns, so that whatever else the machine does meets all of them alike. Each finds its weights
driven out of the cache by the others': alone, UCA-Flow is twice as fast (benchmarks/inference.py). 9 GB of memory.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import torch
from common import RESULTS, make_observation, make_policy, read_rows, timed, write_rows
from tqdm import tqdm

from lerobot_uca.policies.modeling_base import PointCloudPolicy

POLICIES = {"UCA-Flow": "uca_flow", "MP1": "mp1", "FlowPolicy": "flowpolicy", "Simple DP3": "simple_dp3", "DP3": "dp3"}
ENGINES = {"PyTorch": "eager", "OpenVINO": "openvino"}
# ms with one thread and 512 points, measured with the public code of each on two cores with AVX-512.
PUBLIC_CODE = {"MP1": 112, "FlowPolicy": 115, "Simple DP3": 65, "DP3": 1116}
REFERENCE = "UCA-Flow"


class Entry(NamedTuple):
    """A policy and what computes it."""

    name: str
    engine: str
    policy: PointCloudPolicy
    is_default: bool


def main() -> None:
    """Measure, write and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=RESULTS / "latency.csv", help="CSV file, beside it the picture")
    parser.add_argument("--policies", nargs="+", default=list(POLICIES), choices=list(POLICIES))
    parser.add_argument("--points", type=int, nargs="+", default=[512, 1024])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=20, help="calls of each policy that are measured")
    parser.add_argument("--warm_up", type=int, default=3, help="calls of each policy before those")
    parser.add_argument("--draw_only", action="store_true", help="draw what was measured before")
    args = parser.parse_args()
    if not args.draw_only:
        unfinished = args.output.with_suffix(".unfinished")
        with unfinished.open("w", newline="") as file:
            write_rows(measure_all(args), file)
        unfinished.replace(args.output)
    draw(args.output)


def measure_all(args: argparse.Namespace) -> Iterator[dict[str, str]]:
    """Rows for each number of threads and points."""
    for n_threads in args.threads:
        torch.set_num_threads(n_threads)
        entries = [entry for name in args.policies for entry in make_entries(name, max(args.points))]
        for n_points in args.points:
            times = measure([entry.policy for entry in entries], n_points, args.warm_up, args.rounds)
            yield from make_rows(entries, times, n_points, n_threads)


def make_entries(name: str, cloud_points: int) -> Iterator[Entry]:
    """A policy, by each engine; all of them share one copy of the weights."""
    first = make_policy(POLICIES[name], cloud_points)
    default = first.config.inference
    for engine, inference in ENGINES.items():
        policy = make_policy(POLICIES[name], cloud_points, inference=inference)
        policy.model = policy.ema_model = first.ema_model
        yield Entry(name, engine, policy, inference == default)


def measure(policies: list[PointCloudPolicy], n_points: int, n_warm_up: int, n_rounds: int) -> list[list[float]]:
    """Milliseconds of each policy's calls, which take turns."""
    observation = make_observation(cloud_points=n_points)
    times: list[list[float]] = [[] for _ in policies]
    for policy in policies:
        policy.reset()
    for _ in tqdm(range(n_warm_up + n_rounds), desc=f"{n_points} points", unit="round"):
        for policy, own in zip(policies, times, strict=True):
            own.append(timed(policy.predict_action_chunk, observation)[0])
    return [own[n_warm_up:] for own in times]


def make_rows(
    entries: list[Entry], times: list[list[float]], n_points: int, n_threads: int
) -> Iterator[dict[str, str]]:
    """A row for each policy and engine."""
    medians = [float(np.median(own)) for own in times]
    reference = {entry.engine: ms for entry, ms in zip(entries, medians, strict=True) if entry.name == REFERENCE}
    for entry, own, median in zip(entries, times, medians, strict=True):
        p10, p90 = np.percentile(own, (10, 90))
        compared = (n_points, n_threads) == (512, 1) and entry.engine == "PyTorch" and entry.name in PUBLIC_CODE
        row = {
            "policy": entry.name,
            "computed_by": entry.engine,
            "default": "yes" if entry.is_default else "no",
            "parameters": str(sum(parameter.numel() for parameter in entry.policy.ema_model.parameters())),
            "network_calls": str(count_network_calls(entry.policy)),
            "points": str(n_points),
            "threads": str(n_threads),
            "median_ms": f"{median:.2f}",
            "p10_ms": f"{p10:.2f}",
            "p90_ms": f"{p90:.2f}",
            "ratio_to_uca_flow_by_the_same": f"{median / reference[entry.engine]:.1f}" if reference else "",
            "ratio_to_public_code": f"{median / PUBLIC_CODE[entry.name]:.2f}" if compared else "",
        }
        print(f"{entry.name:12}{entry.engine:10}{n_points:6} points {n_threads} threads {median:9.2f} ms")
        yield row


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


def draw(path: Path) -> None:
    """Bars of a CSV file's medians with its fewest points and threads, from p10 to p90; defaults are hatched."""
    rows = read_rows(path)
    fewest = {key: str(min(int(row[key]) for row in rows)) for key in ("points", "threads")}
    rows = [row for row in rows if fewest.items() <= row.items()]
    figure, axes = plt.subplots(figsize=(7, 3.4), layout="constrained")
    names = list(dict.fromkeys(row["policy"] for row in rows))
    for i, engine in enumerate(ENGINES):
        bars = [row for row in rows if row["computed_by"] == engine]
        median, p10, p90 = (np.array([float(bar[key]) for bar in bars]) for key in ("median_ms", "p10_ms", "p90_ms"))
        positions = np.array([names.index(bar["policy"]) for bar in bars]) + 0.4 * i
        drawn = axes.bar(positions, median, 0.36, yerr=(median - p10, p90 - median), capsize=2, label=engine)
        for bar, patch, x, value, top in zip(bars, drawn, positions, median, p90, strict=True):
            patch.set_hatch("//" if bar["default"] == "yes" else "")
            label = f"{value:.2g}" if value < 10 else f"{value:.0f}"
            axes.annotate(label, (x, top), (0, 2), textcoords="offset points", ha="center", fontsize=8)
    axes.set_xticks(np.arange(len(names)) + 0.2, names)
    axes.set_yscale("log")
    axes.margins(y=0.12)
    axes.set_ylabel("ms for a chunk of actions")
    axes.set_title(
        f"{fewest['points']} points, {fewest['threads']} thread; hatched: what a user gets by default", fontsize=10
    )
    axes.legend(fontsize=9, loc="upper left", title="computed by", title_fontsize=9)
    figure.savefig(path.with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
