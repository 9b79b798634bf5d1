"""The folder of a run: where everything lies, and who works on which cell.

DIR/setting.json                               the setting of all cells
DIR/progress.log                               a line for each thing that happened
DIR/demonstrations/TASK/                       the dataset that all cells of a task share; beside it TASK.json, by whom
DIR/cells/TASK/POLICY/SEED/training/           LeRobot's output folder
                          /rows/step_*.csv     evaluations during training, rows/final.csv the last one
                          /cell.json           written when the cell is finished
                          /failure.json        why it is not
                          /*.log               what collecting and training printed
"""

import fcntl
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from io import TextIOWrapper
from pathlib import Path
from typing import Any, Self

from lerobot_uca.errors import UserError
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.rows import CorruptRow, Row, read_rows
from lerobot_uca.protocol.setting import Setting
from lerobot_uca.whole_file import whole_file

RECORDED = ("cell", "minutes", "inference", "hardware")
"""What reports need of a cell.json."""
SETTING, RECORDS = "setting.json", "cells.json"
"""A run's or a report's file of its setting, and a report's of the records of its cells."""


class CellFolder:
    """The files of one cell."""

    def __init__(self, root: Path, cell: Cell) -> None:
        self.cell = cell
        self.path = root / "cells" / cell.task / cell.policy / str(cell.seed)
        self.training = self.path / "training"
        self.rows = self.path / "rows"
        self.result = self.path / "cell.json"
        self.failure = self.path / "failure.json"

    @property
    def is_finished(self) -> bool:
        """Whether nothing is left to do."""
        with suppress(UserError):
            return is_record(read_json(self.result))
        return False

    @contextmanager
    def claim(self) -> Iterator[TextIOWrapper | None]:
        """The lock of this cell, or None while another process, here or on the shared disk, holds it.

        It is the operating system's: it ends with the process that holds it, however that ends. A child that is given
        the file keeps the cell claimed as long as it lives.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        with _locked(self.path / "lock", fcntl.LOCK_EX | fcntl.LOCK_NB) as file:
            yield file


class RunFolder:
    """The folder of a run."""

    def __init__(self, path: Path, setting: Setting) -> None:
        self.path, self.setting = path.absolute(), setting

    @classmethod
    def create(cls, path: Path, setting: Setting) -> Self:
        """The folder, made if it is not there.

        Raises:
            UserError: if it cannot be written, or was made with another setting.
        """
        file = path / SETTING
        values = setting.as_values()
        try:
            (path / "demonstrations").mkdir(parents=True, exist_ok=True)
            with _locked(path / "lock", fcntl.LOCK_EX):
                if not file.exists():
                    write_json(file, values)
        except OSError as error:
            raise UserError(f"--output '{path}' cannot be written: {error}") from error
        difference = first_difference(cls.open(path).setting.as_values(), values)
        if difference:
            raise UserError(
                f"'{path}' was made with another setting: {difference}. Choose another --output, or the same --setting."
            )
        return cls(path, setting)

    @classmethod
    def open(cls, path: Path) -> Self:
        """A folder that is there.

        Raises:
            UserError: if it is not one.
        """
        file = path / SETTING
        if not file.is_file():
            raise UserError(f"'{path}' is not the folder of a benchmark run: it has no setting.json.")
        return cls(path, Setting.from_values(path.name, read_json(file)))

    def cell(self, cell: Cell) -> CellFolder:
        """The files of a cell."""
        return CellFolder(self.path, cell)

    @contextmanager
    def demonstrations(self, cell: Cell) -> Iterator[Path]:
        """The folder of a task's dataset, there or not yet, for one process at a time."""
        folder = self.path / "demonstrations" / cell.task
        folder.parent.mkdir(parents=True, exist_ok=True)
        # Not named .NAME.lock: lerobot-uca-collect, which writes the folder meanwhile, locks that one.
        with _locked(folder.with_name(f".{folder.name}.claim"), fcntl.LOCK_EX):
            yield folder

    def log(self, message: str) -> None:
        """Print a line with the time, and add it to progress.log. One write: lines of several processes do not mix."""
        line = f"{datetime.now(UTC).astimezone():%Y-%m-%d %H:%M:%S} {message}"
        print(line, flush=True)
        # The disk may be full.
        with suppress(OSError), (self.path / "progress.log").open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")

    def read(self) -> Iterator[Row | CorruptRow]:
        """All rows of all cells, and the lines that are not rows."""
        rows = self.path.glob("cells/*/*/*/*/rows/[!.]*.csv")  # without what a killed process has not finished
        for path in [*sorted(self.path.glob("episodes*.csv")), *sorted(rows)]:
            yield from read_rows(path)

    def records(self) -> Iterator[dict[str, Any]]:
        """The record of each finished cell."""
        for path in self.path.glob(RECORDS):
            values = read_json(path)
            records = values.get("cells") if isinstance(values, dict) else None
            for record in records if isinstance(records, list) else [None]:
                yield _checked(path, record)
        for path in sorted(self.path.glob("cells/*/*/*/*/cell.json")):
            yield _checked(path, read_json(path))


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write a JSON file, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as unfinished:
        unfinished.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")


def is_record(values: Any) -> bool:
    """Whether these are what a finished cell's cell.json holds, as far as reports need it."""
    is_whole = isinstance(values, dict) and values.keys() >= {*RECORDED}
    return is_whole and isinstance(values["cell"], dict) and values["cell"].keys() == {*Cell._fields}


def _checked(path: Path, record: Any) -> dict[str, Any]:
    if not is_record(record):
        raise UserError(f"'{path}' is not what is recorded of a cell: it has no {', '.join(RECORDED)}.")
    return record


def read_json(path: Path) -> Any:
    """The values in a JSON file.

    Raises:
        UserError: if it cannot be read.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"'{path}' cannot be read: {error}") from error


def first_difference(made: Any, given: Any, name: str = "") -> str | None:
    """The first value in which two settings differ, described; None if there is none. Names and words do not count."""
    if isinstance(made, dict) and isinstance(given, dict):
        for key in dict.fromkeys([*made, *given]):
            if not name and key in ("name", "description"):
                continue
            difference = first_difference(made.get(key), given.get(key), f"{name}.{key}" if name else key)
            if difference:
                return difference
        return None
    return None if made == given else f"{name} was {json.dumps(made)}, now it is {json.dumps(given)}"


@contextmanager
def _locked(path: Path, operation: int) -> Iterator[TextIOWrapper | None]:
    with path.open("a", encoding="utf-8") as file:
        try:
            fcntl.flock(file, operation)
        except BlockingIOError:
            yield None
            return
        yield file


def free_bytes(path: Path) -> int:
    """Free space on the disk of a folder."""
    status = os.statvfs(path)
    return status.f_bavail * status.f_frsize
