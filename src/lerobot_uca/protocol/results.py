"""Results of one or several runs, by cell, as the tables and figures need them."""

import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from lerobot_uca.errors import UserError
from lerobot_uca.protocol.cells import POLICIES, Cell
from lerobot_uca.protocol.folder import RECORDS, SETTING, RunFolder, first_difference, write_json
from lerobot_uca.protocol.intervals import Estimate, Successes, mean_difference, mean_rate, wilson
from lerobot_uca.protocol.rows import CorruptRow, Row, write_rows
from lerobot_uca.protocol.setting import FIRST_TUNING_SEED, Setting

N_BEST = 5
_WRITTEN = re.compile(rf"episodes(_({'|'.join(POLICIES)})_\d+)?\.csv")
"""The names that `Results.write` has given to files of rows; of earlier versions a single one."""


class Spread(NamedTuple):
    """A mean and the standard deviation of what it is of."""

    mean: float
    deviation: float | None
    """None where there is nothing to compare."""
    n_tasks: int
    """Of the tasks asked for, those that there are."""


class Results:
    """Rows of evaluation episodes and what was recorded of each finished cell.

    Args:
        setting: with which all of them were made.
        rows: of all cells.
        records: the contents of their cell.json.
    """

    def __init__(self, setting: Setting, rows: Iterable[Row], records: Iterable[dict[str, Any]]) -> None:
        self.setting, self.rows = setting, sorted(rows, key=lambda row: (*row.cell, row.is_final, *row[3:]))
        self.records = {Cell(**record["cell"]): record for record in records}
        self._final: dict[Cell, dict[int, bool]] = defaultdict(dict)
        self._interim: dict[Cell, dict[int, list[bool]]] = defaultdict(lambda: defaultdict(list))
        self._epochs: dict[tuple[str, int], float] = {}
        for row in self.rows:
            self._epochs[row.task, row.step] = row.epoch
            if row.is_final:
                self._final[row.cell][row.episode_seed] = row.success
            else:
                self._interim[row.cell][row.step].append(row.success)
        cells = {*self._final, *self._interim}
        self.policies = [policy for policy in POLICIES if any(cell.policy == policy for cell in cells)]
        self.tasks = sorted({cell.task for cell in cells})
        self._cells = sorted(cells)

    @classmethod
    def read(cls, paths: Sequence[Path]) -> tuple[Self, list[CorruptRow]]:
        """The results in folders, and the lines in them that are not rows.

        Raises:
            UserError: if a path is not a run's folder, they were made with different settings, or hold different
                results of the same cell.
        """
        folders = [RunFolder.open(path) for path in paths]
        first = folders[0]
        for other in folders[1:]:
            difference = first_difference(first.setting.as_values(), other.setting.as_values())
            if difference:
                raise UserError(
                    f"'{first.path}' and '{other.path}' were made with different settings: {difference}. "
                    "A table holds results of one setting."
                )
        found = [(folder.path, row) for folder in folders for row in folder.read()]
        rows = _without_repetition([(path, row) for path, row in found if isinstance(row, Row)])
        records = [record for folder in folders for record in folder.records()]
        _check_experts(records)
        return cls(first.setting, rows, records), [row for _, row in found if isinstance(row, CorruptRow)]

    def of(self, is_wanted: Callable[[Cell], bool]) -> Self:
        """The results of some cells alone."""
        rows = (row for row in self.rows if is_wanted(row.cell))
        return type(self)(self.setting, rows, (self.records[cell] for cell in self.records if is_wanted(cell)))

    def without_tuning(self) -> tuple[Self, list[int]]:
        """The results without training seeds for tuning, which have other episodes, and these seeds.

        Where there are no others, nothing is left out.
        """
        tuning = sorted({cell.seed for cell in self._cells if cell.seed >= FIRST_TUNING_SEED})
        if not tuning or all(cell.seed in tuning for cell in self._cells):
            return self, []
        return self.of(lambda cell: cell.seed not in tuning), tuning

    def write(self, folder: Path) -> None:
        """Write all of it into a folder that `read` reads, in place of other results there."""
        # First, since a folder with both is a report, which a second try may replace.
        write_json(folder / RECORDS, {"cells": [self.records[cell] for cell in sorted(self.records)]})
        write_json(folder / SETTING, self.setting.as_values())
        by_file: dict[Path, list[Row]] = defaultdict(list)  # of up to 0.6 MB, 37 tasks each
        for row in self.rows:
            by_file[folder / f"episodes_{row.policy}_{row.seed}.csv"].append(row)
        for path, rows in by_file.items():
            write_rows(path, rows)
        for path in {*folder.glob("episodes*.csv")} - {*by_file}:
            if _WRITTEN.fullmatch(path.name):
                path.unlink()

    def seeds(self, task: str, policy: str) -> list[int]:
        """Training seeds whose last checkpoint is evaluated."""
        return [cell.seed for cell in self._cells if cell[:2] == (task, policy) and cell in self._final]

    def first_cells(self) -> list[Cell]:
        """Of each policy on each task the first training seed whose last checkpoint is evaluated."""
        found = [(task, policy, self.seeds(task, policy)) for task in self.tasks for policy in self.policies]
        return [Cell(task, policy, seeds[0]) for task, policy, seeds in found if seeds]

    def typical_episode(self, cell: Cell) -> Row:
        """The first fresh episode that ended as most of the cell's did."""
        final = [row for row in self.rows if row.cell == cell and row.is_final]
        mostly = 2 * sum(row.success for row in final) >= len(final)
        return next(row for row in final if row.success == mostly)

    # The honest rule: the last checkpoint, fresh episodes. ------------------------------------------------------

    def successes(self, task: str, policy: str) -> Successes | None:
        """The last checkpoints' successes in the fresh episodes that all training seeds have, if there are any."""
        return _aligned([self._final[Cell(task, policy, seed)] for seed in self.seeds(task, policy)])

    def n_evaluated(self, tasks: Sequence[str], policy: str) -> int:
        """How many of the tasks have a last checkpoint that is evaluated."""
        return sum(bool(self.seeds(task, policy)) for task in tasks)

    def honest(self, tasks: Sequence[str], policy: str) -> Estimate | None:
        """Success on those of the tasks that are there; of a single training Wilson's interval of its episodes."""
        there = [found for task in tasks if (found := self.successes(task, policy)) is not None]
        if not there:
            return None
        if len(there) == len(there[0]) == 1:
            return wilson(float(there[0].mean()), there[0].shape[1])
        return mean_rate(there)

    def difference(self, policy: str, other: str, tasks: Sequence[str]) -> tuple[Estimate, list[str]] | None:
        """Success of policy minus other in the same episodes, on the tasks that both have, and those tasks.

        Paired by task, training seed and episode.
        """
        paired = {task: pairs for task in tasks if (pairs := self._pairs(task, policy, other)) is not None}
        return (mean_difference([*paired.values()]), list(paired)) if paired else None

    def _pairs(self, task: str, policy: str, other: str) -> Successes | None:
        both = sorted({*self.seeds(task, policy)} & {*self.seeds(task, other)})
        found = _aligned([self._final[Cell(task, name, seed)] for name in (policy, other) for seed in both])
        return None if found is None else found[: len(both)] - found[len(both) :]

    # The paper's rule: the mean of the best five evaluations during training, of each seed. ---------------------

    def papers_rule(self, tasks: Sequence[str], policy: str) -> Spread | None:
        """Success on those of the tasks that are there, all alike: the mean of their seeds' means.

        The deviation is over the means of the training seeds that have all of these tasks.
        """
        by_task: dict[str, dict[int, float]] = defaultdict(dict)
        for cell in self._cells:
            if cell.task in tasks and cell.policy == policy:
                rates = sorted((float(np.mean(each)) for each in self._interim[cell].values()), reverse=True)
                if len(rates) >= N_BEST:
                    by_task[cell.task][cell.seed] = float(np.mean(rates[:N_BEST]))
        if not by_task:
            return None
        common = set.intersection(*map(set, by_task.values()))
        of_seeds = [np.mean([rates[seed] for rates in by_task.values()]) for seed in sorted(common)]
        mean = float(np.mean([np.mean([*rates.values()]) for rates in by_task.values()]))
        return Spread(mean, _deviation(of_seeds), len(by_task))

    def curve(self, task: str, policy: str) -> dict[float, list[float]]:
        """Success by epoch, of each seed."""
        by_epoch: dict[float, list[float]] = defaultdict(list)
        for cell in self._cells:
            if cell[:2] == (task, policy):
                for step, successes in sorted(self._interim[cell].items()):
                    by_epoch[self._epochs[task, step]].append(float(np.mean(successes)))
        return dict(sorted(by_epoch.items()))

    def curve_over_minutes(self, task: str, policy: str) -> dict[float, list[float]]:
        """Success by minutes of training, of each finished seed; the minutes are the seeds' mean."""
        cells = [cell for cell in self.records if cell[:2] == (task, policy)]
        by_step: dict[int, list[tuple[float, float]]] = defaultdict(list)
        for cell in cells:
            for step, successes in sorted(self._interim[cell].items()):
                by_step[step].append((self._minutes_at(cell, step), float(np.mean(successes))))
        return {
            float(np.mean([each[0] for each in points])): [each[1] for each in points] for points in by_step.values()
        }

    # Training time. ---------------------------------------------------------------------------------------------

    def training_minutes(self, cell: Cell) -> float:
        """Minutes that a finished cell's training took."""
        return float(self.records[cell]["minutes"]["training"])

    def minutes_until(self, cell: Cell, success: float) -> float | None:
        """Minutes of training before a finished cell's first evaluation with this success."""
        for step, successes in sorted(self._interim[cell].items()):
            if np.mean(successes) >= success:
                return self._minutes_at(cell, step)
        return None

    def _minutes_at(self, cell: Cell, step: int) -> float:
        """Minutes of training before a finished cell's step, its steps equally long."""
        return self.training_minutes(cell) * step / self.setting.length(cell).steps

    # Inference. -------------------------------------------------------------------------------------------------

    def milliseconds(self, tasks: Sequence[str], policy: str) -> Spread | None:
        """The median time for a chunk: mean and deviation over the cells."""
        cells = [cell for cell in self.records if cell.task in tasks and cell.policy == policy]
        times = [self.records[cell]["inference"]["median_ms"] for cell in cells]
        return Spread(float(np.mean(times)), _deviation(times), len({cell.task for cell in cells})) if times else None

    def hardware(self) -> list[str]:
        """The hardware that the cells ran on, and the precision of their trainings, which depends on it."""
        kinds = dict.fromkeys(
            (json.dumps(record["hardware"], sort_keys=True), record.get("dtype")) for record in self.records.values()
        )
        return [_hardware(json.loads(hardware), dtype) for hardware, dtype in kinds]


def _hardware(kind: dict[str, Any], dtype: str | None) -> str:
    precision = f", trained in {dtype}" if dtype else ""
    return f"{kind['gpu'] or kind['cpu']} ({kind['cores']} cores, {kind['threads']} thread a cell{precision})"


def _check_experts(records: Iterable[dict[str, Any]]) -> None:
    """A task's cells have learned from one demonstrator; earlier versions did not record it."""
    experts: dict[str, set[str]] = defaultdict(set)
    for record in records:
        if record.get("expert") is not None:
            experts[record["cell"]["task"]].add(record["expert"])
    for task, found in experts.items():
        if len(found) > 1:
            raise UserError(
                f"Cells of {task} have learned from different experts: {', '.join(sorted(found))}. A table holds "
                "results of one."
            )


def _without_repetition(found: Iterable[tuple[Path, Row]]) -> list[Row]:
    """Each episode once: a run's and its report's folder hold the same."""
    first: dict[tuple[Any, ...], tuple[Path, Row]] = {}
    for path, row in found:
        # A cell has one last checkpoint, whatever its step.
        key = (*row.cell, None if row.is_final else row.step, row.episode_seed)
        other, same = first.setdefault(key, (path, row))
        if row != same:
            raise UserError(
                f"'{other}' and '{path}' hold different results of {row.cell}, in the episode of seed "
                f"{row.episode_seed} for example. A table takes one training of a cell: leave one of them out."
            )
    return [row for _, row in first.values()]


def _deviation(values: Sequence[Any]) -> float | None:
    return float(np.std(values)) if len(values) > 1 else None


def _aligned(outcomes: Sequence[dict[int, bool]]) -> Successes | None:
    """Outcomes by episode as rows, in the episodes that all of them have; None if there are none."""
    common = sorted(set.intersection(*map(set, outcomes))) if outcomes else []
    return np.array([[int(each[episode]) for episode in common] for each in outcomes]) if common else None
