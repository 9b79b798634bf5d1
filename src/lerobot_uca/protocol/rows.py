"""Rows of results: one an episode, in CSV files that are written whole or not at all."""

import csv
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple, Self

from lerobot_uca.protocol.cells import Cell
from lerobot_uca.whole_file import whole_file


class Row(NamedTuple):
    """One evaluation episode."""

    task: str
    policy: str
    seed: int
    """The training's seed."""
    step: int
    """Training steps before this evaluation."""
    epoch: float
    """The same as passes over the demonstrations."""
    is_final: bool
    """Whether it is one of the last checkpoint's fresh episodes."""
    episode_seed: int
    success: bool
    episode_return: float
    """Sum of the simulator's rewards."""
    length: int
    """Actions executed."""
    ms: float
    """Wall-clock milliseconds an action took: simulation, observation and the episode's share of the plans."""

    @property
    def cell(self) -> Cell:
        """The cell of the episode."""
        return Cell(self.task, self.policy, self.seed)

    @classmethod
    def from_text(cls, values: dict[str, str]) -> Self:
        """The row that `as_text` has written; a ValueError or KeyError says what is wrong."""
        if None in values or None in values.values():
            raise ValueError("it has too many or too few columns")
        return cls(
            task=values["task"],
            policy=values["policy"],
            seed=int(values["seed"]),
            step=int(values["step"]),
            epoch=float(values["epoch"]),
            is_final=_truth(values["is_final"]),
            episode_seed=int(values["episode_seed"]),
            success=_truth(values["success"]),
            episode_return=float(values["episode_return"]),
            length=int(values["length"]),
            ms=float(values["ms"]),
        )

    def as_text(self) -> list[str]:
        """Truth as 0 or 1; the return to the last bit, so that equal episodes give equal rows."""
        rounded = self._replace(epoch=round(self.epoch, 2), ms=round(self.ms, 3))
        return [str(int(value)) if isinstance(value, bool) else str(value) for value in rounded]


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write a CSV file, whole or not at all, also if the process is killed or the disk is full."""
    with whole_file(path) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Row._fields)
        writer.writerows(row.as_text() for row in rows)


class CorruptRow(NamedTuple):
    """A line of a CSV file that is not a row."""

    path: Path
    line: int
    reason: str

    def __str__(self) -> str:
        """The line's name in a warning."""
        return f"{self.path}, line {self.line} is left out: {self.reason}."


def read_rows(path: Path) -> Iterator[Row | CorruptRow]:
    """The rows of a CSV file and, in their places, its lines that are not rows."""
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        reader = csv.DictReader(file)
        try:
            missing = [name for name in Row._fields if name not in (reader.fieldnames or ())]
        except csv.Error as error:  # a line too long to be one
            yield CorruptRow(path, 1, str(error))
            return
        if missing:
            yield CorruptRow(path, 1, f"the header lacks {', '.join(missing)}")
            return
        while True:
            try:
                values = next(reader)
                yield Row.from_text(values)
            except StopIteration:
                return
            except (ValueError, csv.Error) as error:
                yield CorruptRow(path, reader.line_num, str(error))


def _truth(text: str) -> bool:
    if text not in ("0", "1"):
        raise ValueError(f"truth is 0 or 1, got {text!r}")
    return text == "1"
