"""The cells of a benchmark: a cell is one policy on one task with one training seed."""

from collections.abc import Collection, Mapping
from difflib import get_close_matches
from typing import NamedTuple

from lerobot_uca.envs import adroit, metaworld
from lerobot_uca.errors import UserError

ENVIRONMENTS = {"adroit": "adroit_pointcloud", "metaworld": "metaworld_pointcloud"}
"""LeRobot's environment type by benchmark."""


def _of_metaworld(names: Collection[str]) -> tuple[str, ...]:
    return tuple(f"metaworld/{name}" for name in names)


_ADROIT_PAPER = tuple(f"adroit/{name}" for name in adroit.PAPER_TASKS)
_DIFFICULTIES = metaworld.task_groups()

# The columns of the paper's Table 1. Meta-World's own difficulties hold more tasks than the paper's groups.
PAPER_GROUPS = {
    "adroit": _ADROIT_PAPER,
    "easy": _of_metaworld(metaworld.PAPER_TASKS[:21]),
    "medium": _of_metaworld(metaworld.PAPER_TASKS[21:25]),
    "hard": _of_metaworld(metaworld.PAPER_TASKS[25:29]),
    "very_hard": _of_metaworld(metaworld.PAPER_TASKS[29:]),
}
SUITES = {
    "paper": tuple(task for tasks in PAPER_GROUPS.values() for task in tasks),
    "ablation": (
        *("adroit/door", "adroit/pen"),
        *_of_metaworld(("dial-turn", "peg-insert-side", "lever-pull", "pick-place-wall", "stick-pull", "shelf-place")),
    ),
    "all": (*(f"adroit/{name}" for name in adroit.TASKS), *_of_metaworld(_DIFFICULTIES["all"])),
}
"""Tasks by suite: Table 1's 37, the eight of Table 3, and all that there are."""


class Method(NamedTuple):
    """A policy type and the options that make a policy of the paper's tables of it."""

    type: str
    options: Mapping[str, str | bool] = {}
    title: str = ""


POLICIES = {
    "uca_flow": Method("uca_flow", title="UCA-Flow"),
    "without_dual_pass": Method("uca_flow", {"dual_pass": False}, "- DualPass"),
    "cross_attention": Method("uca_flow", {"conditioning": "cross_attention"}, "- Unified/c: cross-attention"),
    "adaln": Method("uca_flow", {"conditioning": "adaln"}, "- Unified/a: AdaLN"),
    "dp3": Method("dp3", title="DP3"),
    "simple_dp3": Method("simple_dp3", title="Simple DP3"),
    "flowpolicy": Method("flowpolicy", title="FlowPolicy"),
    "mp1": Method("mp1", title="MP1"),
}
"""The paper's method, its three ablations and the four baselines."""


class Cell(NamedTuple):
    """One training and its evaluations."""

    task: str
    """'benchmark/name'."""
    policy: str
    """A key of `POLICIES`."""
    seed: int

    def __str__(self) -> str:
        """The name in progress lines and errors."""
        return f"{self.task} {self.policy} seed {self.seed}"

    @property
    def benchmark(self) -> str:
        """The part before the slash."""
        return self.task.split("/")[0]

    @property
    def env_type(self) -> str:
        """LeRobot's name for the environment."""
        return ENVIRONMENTS[self.benchmark]

    @property
    def env_task(self) -> str:
        """The environment's name for the task."""
        return self.task.split("/")[1]


def grid(suite: str, tasks: str | None, policies: str, seeds: str) -> list[Cell]:
    """The cells of a command line, seed by seed, so that a first table is there soon.

    Args:
        suite: a key of `SUITES`.
        tasks: comma-separated names or groups out of the suite; None for all of it.
        policies: comma-separated keys of `POLICIES`.
        seeds: comma-separated training seeds.

    Raises:
        UserError: for names that there are not; it lists those that there are.
    """
    chosen = resolve_tasks(suite, tasks)
    methods = resolve_policies(policies)
    try:
        numbers = [int(seed) for seed in seeds.split(",")]
    except ValueError as error:
        raise UserError(f"--seeds must be whole numbers separated by commas, got '{seeds}'.") from error
    if min(numbers) < 0:
        raise UserError(f"--seeds must be at least 0, got '{seeds}'.")
    return [Cell(task, policy, seed) for seed in dict.fromkeys(numbers) for task in chosen for policy in methods]


def resolve_policies(names: str) -> list[str]:
    """Keys of `POLICIES`, without repetition."""
    chosen = list(dict.fromkeys(name.strip() for name in names.split(",") if name.strip()))
    for name in chosen:
        if name not in POLICIES:
            raise UserError(f"Unknown policy '{name}'. Policies: {', '.join(POLICIES)}.")
    if not chosen:
        raise UserError(f"No policy given. Policies: {', '.join(POLICIES)}.")
    return chosen


def resolve_tasks(suite: str, names: str | None) -> list[str]:
    """Tasks 'benchmark/name' of a suite, by name, name without its benchmark, or group."""
    if suite not in SUITES:
        raise UserError(f"Unknown suite '{suite}'. Suites: {', '.join(SUITES)}.")
    if names is None:
        return list(SUITES[suite])
    entries = [name.strip() for name in names.split(",") if name.strip()]
    if not entries:
        raise UserError(f"No task given. Leave --tasks out for the {len(SUITES[suite])} tasks of suite '{suite}'.")
    return list(dict.fromkeys(task for entry in entries for task in _matching(suite, entry)))


def _matching(suite: str, entry: str) -> list[str]:
    tasks = SUITES[suite]
    in_group = [task for task in PAPER_GROUPS.get(entry, ()) if task in tasks]
    if in_group:
        return in_group
    found = [task for task in tasks if entry in (task, task.split("/")[1])]
    if len(found) > 1:
        raise UserError(f"Task '{entry}' stands for several: write {' or '.join(found)}.")
    if not found:
        nearest = get_close_matches(entry, [task.split("/")[1] for task in tasks], n=1)
        hint = f" Did you mean '{nearest[0]}'?" if nearest else ""
        raise UserError(
            f"Unknown task '{entry}' in suite '{suite}'.{hint} Tasks: {', '.join(tasks)}; "
            f"groups: {', '.join(PAPER_GROUPS)}; suites: {', '.join(SUITES)}."
        )
    return found
