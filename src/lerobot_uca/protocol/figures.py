"""Figures of results. They read only what `Results` has read from CSV and JSON files."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_uca.errors import UserError
from lerobot_uca.protocol import paper
from lerobot_uca.protocol.cells import POLICIES, Cell
from lerobot_uca.protocol.results import Results

COLOURS = dict(
    zip(POLICIES, ("#0072B2", "#56B4E9", "#009E73", "#CC79A7", "#D55E00", "#E69F00", "#7F7F7F", "#000000"), strict=True)
)
"""Colours that people who see fewer colours can tell apart, by policy."""
N_CURVE_COLUMNS = 4


def draw(results: Results, folder: Path) -> list[Path]:
    """Write every figure for which there are results, as PNG and SVG; the SVG files.

    Raises:
        UserError: if matplotlib is not installed.
    """
    plt = pyplot()
    drawn = {name: figure(results, plt) for name, figure in FIGURES.items()}
    for name in [name for name, figure in drawn.items() if figure is None]:
        remove(folder / name)
    return [write(figure, folder / name) for name, figure in drawn.items() if figure is not None]


def pyplot() -> Any:
    """Matplotlib without a display.

    Raises:
        UserError: if it is not installed.
    """
    try:
        import matplotlib as mpl

        mpl.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise UserError("Figures need matplotlib: pip install 'lerobot_policy_uca_flow[pictures]'.") from error
    # Without a date, and with ids that do not change, equal results give equal files.
    plt.rcParams |= {"svg.hashsalt": "lerobot_uca", "svg.fonttype": "none", "font.size": 9}
    return plt


def write(figure: Any, path: Path) -> Path:
    """Write a figure as PNG and SVG, by a path without its ending, and close it; the SVG file."""
    for ending in ("png", "svg"):
        metadata: Any = {"Date": None} if ending == "svg" else {}
        figure.savefig(path.with_suffix(f".{ending}"), dpi=150, bbox_inches="tight", metadata=metadata)
    pyplot().close(figure)
    return path.with_suffix(".svg")


def remove(path: Path) -> None:
    """Remove an earlier report's figure, by a path without its ending: it would stand beside other tables."""
    for ending in ("png", "svg"):
        path.with_suffix(f".{ending}").unlink(missing_ok=True)


def curves(results: Results, plt: Any) -> Any:
    """Success over epochs, a panel a task."""
    tasks = [task for task in results.tasks if any(results.curve(task, policy) for policy in results.policies)]
    return _panels(results, plt, tasks, results.curve, "epochs")


def curves_over_minutes(results: Results, plt: Any) -> Any:
    """Success over minutes of training, a panel for each task that all policies, two or more, have learned."""
    n_policies = Counter(task for task, _ in {(cell.task, cell.policy) for cell in results.records})
    tasks = [task for task in results.tasks if n_policies[task] == len(results.policies) > 1]
    figure = _panels(results, plt, tasks, results.curve_over_minutes, "minutes of training")
    for axis, task in zip(figure.axes if figure else (), tasks, strict=False):
        axis.set_xlim(left=0)
        if goal := paper.goal(task):
            axis.axhline(goal.mean, color="black", linewidth=0.8, linestyle="--")
    return figure


def _panels(
    results: Results, plt: Any, tasks: Sequence[str], curve: Callable[[str, str], dict[float, list[float]]], over: str
) -> Any:
    """Success over something, a panel a task; the band is from the lowest to the highest seed."""
    if not tasks:
        return None
    n_columns = min(N_CURVE_COLUMNS, len(tasks))
    n_rows = -(-len(tasks) // n_columns)
    figure, axes = plt.subplots(n_rows, n_columns, figsize=(3 * n_columns, 2.4 * n_rows), squeeze=False, sharey=True)
    for axis in axes.flat[len(tasks) :]:
        axis.set_visible(False)
    drawn = {}
    for axis, task in zip(axes.flat, tasks, strict=False):
        for policy in results.policies:
            if points := curve(task, policy):
                at = list(points)
                rates = [np.multiply(100, each) for each in points.values()]
                means = [each.mean() for each in rates]
                (drawn[policy],) = axis.plot(at, means, marker=".", color=COLOURS[policy])
                band = [each.min() for each in rates], [each.max() for each in rates]
                axis.fill_between(at, *band, color=COLOURS[policy], alpha=0.2, linewidth=0)
        axis.set_title(task)
        axis.set_ylim(-3, 103)
        axis.set_xlabel(over)
    for row in axes:
        row[0].set_ylabel("success [%]")
    titles = [POLICIES[policy].title for policy in drawn]
    figure.legend(drawn.values(), titles, loc="upper center", bbox_to_anchor=(0.5, 0), ncols=4)
    figure.tight_layout()
    return figure


def success_and_latency(results: Results, plt: Any) -> Any:
    """Success against latency (the paper's Figure 1b), over each policy's own tasks; the paper's numbers hollow."""
    figure, axis = plt.subplots(figsize=(5, 3.6))
    n_drawn = 0
    for policy in results.policies:
        time, success = results.milliseconds(results.tasks, policy), results.honest(results.tasks, policy)
        if time and success:
            n_drawn += 1
            mean, low, high = (100 * value for value in success)
            bars = [[max(0, mean - low)], [max(0, high - mean)]]
            axis.errorbar(time.mean, mean, yerr=bars, fmt="o", color=COLOURS[policy], label=POLICIES[policy].title)
    if not n_drawn:
        plt.close(figure)
        return None
    for policy in paper.SUCCESS:
        point = paper.MILLISECONDS[policy]["average"].mean, paper.SUCCESS[policy]["average"].mean
        axis.plot(*point, "o", color=COLOURS[policy], fillstyle="none", label=f"{POLICIES[policy].title}, paper")
    axis.set_xscale("log")
    axis.set_xlabel("inference [ms]")
    axis.set_ylabel("success [%]")
    axis.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def bars(results: Results, plt: Any) -> Any:
    """Success on each task with its interval; a line where the paper prints a number."""
    tasks = [task for task in results.tasks if any(results.seeds(task, policy) for policy in results.policies)]
    if not tasks:
        return None
    height = 0.8 / len(results.policies)
    size = (6, 1.1 + 0.22 * len(tasks) * max(1, len(results.policies) / 2))
    figure, axis = plt.subplots(figsize=size, layout="constrained")
    for index, policy in enumerate(results.policies):
        for row, task in enumerate(tasks):
            estimate, printed = results.honest((task,), policy), paper.of_task(task, policy)
            y = row + (index - (len(results.policies) - 1) / 2) * height
            if estimate:
                mean, low, high = (100 * value for value in estimate)
                axis.barh(y, mean, height=0.9 * height, color=COLOURS[policy], xerr=[[mean - low], [high - mean]])
            if printed:
                axis.plot([printed.mean] * 2, [y - height / 2, y + height / 2], color="black", linewidth=2)
    axis.set_yticks(range(len(tasks)), tasks)
    axis.invert_yaxis()
    axis.set_xlim(0, 103)
    axis.set_xlabel("success [%]; black: the paper's, where it prints one")
    handles = [plt.Rectangle((0, 0), 1, 1, color=COLOURS[policy]) for policy in results.policies]
    titles = [POLICIES[policy].title for policy in results.policies]
    figure.legend(handles, titles, loc="outside lower center", ncols=4)
    return figure


def minutes_to_success(results: Results, plt: Any) -> Any:
    """The share of cells that have reached the paper's success, over minutes of training, a line a policy.

    Of the tasks and seeds that every policy has, lest a line stand higher because its tasks are easier.
    """
    goals = {cell: goal for cell in results.records if (goal := paper.goal(cell.task))}
    trained = {policy: {(cell.task, cell.seed) for cell in goals if cell.policy == policy} for policy in POLICIES}
    trained = {policy: cells for policy, cells in trained.items() if cells}
    common = set.intersection(*trained.values()) if trained else set()
    if not common:
        return None
    figure, axis = plt.subplots(figsize=(5, 3.2))
    for policy in trained:
        cells = [Cell(task, policy, seed) for task, seed in sorted(common)]
        minutes = [results.minutes_until(cell, goals[cell].mean / 100) for cell in cells]
        reached = sorted(each for each in minutes if each is not None)
        longest = max(results.training_minutes(cell) for cell in cells)
        shares = 100 * np.arange(len(reached) + 1) / len(cells)
        label = f"{POLICIES[policy].title}, {len(reached)} of {len(cells)}"
        axis.step([0, *reached, longest], [*shares, shares[-1]], where="post", color=COLOURS[policy], label=label)
    axis.set_ylim(0, 103)
    axis.set_xlim(left=0)
    axis.set_xlabel("minutes of training")
    axis.set_ylabel("at the paper's success [%]")
    axis.legend(loc="lower right")
    return figure


FIGURES: dict[str, Callable[[Results, Any], Any]] = {
    "success_over_epochs": curves,
    "success_over_minutes": curves_over_minutes,
    "success_and_latency": success_and_latency,
    "success_by_task": bars,
    "minutes_to_success": minutes_to_success,
}
CAPTIONS = {
    "success_over_epochs": "Success in the evaluations during training; the band is from the lowest to the highest "
    "training seed.",
    "success_over_minutes": "Success in the evaluations during training over its minutes, on the tasks that all "
    "policies have learned; dashed the paper's UCA-Flow, on the task or on its group where no more is printed.",
    "success_and_latency": "Success of the last checkpoints and the time for a chunk of actions: filled ours, with "
    "95 % interval, over the tasks that are there; hollow the paper's, over its 37 tasks.",
    "success_by_task": "Success of the last checkpoints in fresh episodes, with 95 % interval; the black line is the "
    "paper's number, where it prints one.",
    "minutes_to_success": "How many trainings (a task and a seed) have been, in an evaluation on the way, as "
    "successful as the paper's UCA-Flow on the task, or on the task's group where no more is "
    "printed, after so many minutes. An evaluation has few episodes, so some reach it by luck, "
    "and earlier than they hold it. Of several policies, the tasks and seeds that all have.",
    "rollouts": "An evaluation episode of each policy, from its start to its end: the first that ended as most did.",
}
"""What a figure shows, by its file's name."""
