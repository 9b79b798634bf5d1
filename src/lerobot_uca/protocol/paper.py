"""The paper's numbers (UCA-Flow, arXiv version, Tables 1 to 3): mean and spread over three seeds, as printed there."""

from typing import NamedTuple

from lerobot_uca.protocol.cells import PAPER_GROUPS, SUITES


class Printed(NamedTuple):
    """A number of the paper and what follows its plus-minus sign."""

    mean: float
    spread: float


COLUMNS = ("hammer", "door", "pen", "easy", "medium", "hard", "very_hard", "average")
"""Columns of Tables 1 and 2: three tasks of Adroit, four groups of Meta-World, and the mean over 37 tasks."""


def _row(*numbers: tuple[float, float]) -> dict[str, Printed]:
    return {column: Printed(*map(float, number)) for column, number in zip(COLUMNS, numbers, strict=True)}


SUCCESS = {
    "dp3": _row((100, 0), (56, 5), (46, 10), (87.3, 2.2), (44.5, 8.7), (32.7, 7.7), (39.4, 9.0), (68.7, 4.7)),
    "simple_dp3": _row((98, 2), (40, 17), (36, 4), (86.8, 2.3), (42.0, 6.5), (38.7, 7.5), (35.0, 11.6), (67.4, 5.0)),
    "flowpolicy": _row((98, 1), (61, 2), (54, 4), (84.8, 2.2), (58.2, 7.9), (40.2, 4.5), (52.2, 5.0), (71.6, 3.5)),
    "mp1": _row((100, 0), (69, 2), (58, 5), (88.2, 1.1), (68.0, 3.1), (58.1, 5.0), (67.2, 2.7), (78.9, 2.1)),
    "uca_flow": _row(
        *((100, 0), (77.3, 2.0), (63.0, 3.4), (92.4, 1.2), (79.3, 3.4), (68.0, 2.0), (85.3, 2.0), (88.2, 1.7))
    ),
}
"""Table 1: success [%].

The averages are those of the columns, weighted by their tasks, but for UCA-Flow's: its columns give 86.4, not 88.2.
"""

MILLISECONDS = {
    "dp3": _row(
        *((129.5, 13.9), (141.3, 14.8), (145.1, 12.3), (129.3, 10.7)),
        *((134.7, 11.5), (131.9, 12.4), (138.4, 10.8), (132.2, 11.2)),
    ),
    "simple_dp3": _row(
        *((103.1, 11.4), (111.3, 10.2), (128.2, 13.1), (91.9, 8.6)),
        *((98.3, 9.1), (101.3, 9.7), (103.8, 10.2), (97.0, 9.2)),
    ),
    "flowpolicy": _row(
        *((15.3, 1.1), (13.2, 4.0), (12.0, 2.8), (12.0, 1.4), (12.2, 1.5), (13.5, 1.4), (14.5, 1.6), (12.6, 1.5))
    ),
    "mp1": _row((7.1, 0.2), (7.2, 0.1), (7.4, 0.3), (6.7, 0.0), (6.7, 0.1), (6.7, 0.1), (6.8, 0.1), (6.8, 0.1)),
    "uca_flow": _row((2.9, 0.2), (2.9, 0.1), (3.0, 0.3), (3.1, 0.1), (2.9, 0.1), (3.0, 0.1), (2.8, 0.1), (2.9, 0.1)),
}
"""Table 2: inference [ms] on an RTX A5000."""

NETWORK_CALLS = {"dp3": 10, "simple_dp3": 10, "flowpolicy": 1, "mp1": 1, "uca_flow": 1}
"""Network calls for a chunk of actions."""

_ABLATION = {
    "uca_flow": (
        (77.3, 2.0),
        (63.0, 3.4),
        (92.3, 4.7),
        (90.6, 4.0),
        (89.3, 3.2),
        (90.6, 3.2),
        (75.3, 2.3),
        (74.0, 3.5),
    ),
    "without_dual_pass": (
        *((74.3, 5.0), (57.0, 3.6), (91.3, 7.3), (88.0, 3.6), (89.0, 0.0), (89.6, 5.8), (70.0, 3.5), (64.0, 7.8)),
    ),
    "cross_attention": (
        *((68.2, 1.8), (58.2, 6.9), (87.3, 10.5), (86.3, 3.2), (79.0, 1.0), (84.0, 3.4), (62.3, 3.2), (56.6, 3.8)),
    ),
    "adaln": (
        *((56.5, 2.1), (48.6, 4.6), (78.6, 9.3), (61.0, 1.7), (63.6, 6.0), (60.3, 11.2), (68.0, 3.5), (32.3, 1.5)),
    ),
}
ABLATION = {
    policy: {task: Printed(*map(float, number)) for task, number in zip(SUITES["ablation"], numbers, strict=True)}
    for policy, numbers in _ABLATION.items()
}
"""Table 3: success [%] by task."""


def of_task(task: str, policy: str) -> Printed | None:
    """A policy's success [%] on one task, where the paper prints it."""
    in_table_1 = SUCCESS.get(policy, {}).get(task.split("/")[1]) if task in PAPER_GROUPS["adroit"] else None
    return ABLATION.get(policy, {}).get(task) or in_table_1


def goal(task: str) -> Printed | None:
    """UCA-Flow's success [%] on a task, or on the task's group where no more is printed; None outside the 37 tasks."""
    for group, tasks in PAPER_GROUPS.items():
        if task in tasks:
            return of_task(task, "uca_flow") or SUCCESS["uca_flow"][group]
    return None
