"""One cell from demonstrations to result: `python -m lerobot_uca.protocol.run_cell DIR TASK POLICY SEED`.

It is a process of its own, so that whatever happens to it happens to one cell. Started again, it goes on where it was:
in the training from LeRobot's last checkpoint, and with the first evaluation whose rows are missing.
"""

import json
import logging
import shutil
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from enum import IntEnum
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_uca.errors import UserError
from lerobot_uca.protocol import training
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.folder import CellFolder, RunFolder, write_json
from lerobot_uca.protocol.rows import Row, read_rows, write_rows
from lerobot_uca.protocol.tied import tie_to_parent
from lerobot_uca.protocol.training import CellError, NoSpaceError, no_space_as_such
from lerobot_uca.whole_file import whole_file

if TYPE_CHECKING:
    from lerobot_uca.envs.point_cloud_env import PointCloudEnv
    from lerobot_uca.protocol.evaluation import PolicyPlan

N_ENVS = 10
"""Episodes at once: enough to share the policy's calls."""
NOTED_EVERY = 10.0
"""Seconds between two notes of how long a phase has taken."""


class Outcome(IntEnum):
    """The exit codes of a cell's process."""

    FINISHED = 0
    CLAIMED = 3
    """Another process works on it."""
    FAILED = 4
    """It has recorded the reason. Python itself ends with 1 or 2."""
    NO_SPACE = 28


def run_cell(folder: RunFolder, cell: Cell, expert: str | None) -> Outcome:
    """Do what is left of a cell, unless another process does. A failure is recorded, with its reason."""
    files = folder.cell(cell)
    try:
        with no_space_as_such(), files.claim() as lock:
            if lock is None:
                return Outcome.CLAIMED
            if not files.is_finished:
                _work(folder, cell, expert, lock)
            return Outcome.FINISHED
    except NoSpaceError as error:
        folder.log(f"{cell}: {error}")
        return Outcome.NO_SPACE
    except (CellError, UserError) as error:
        reason = str(error)
    except Exception as error:  # noqa: BLE001 (whatever it is, it concerns this cell alone)
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        with training.open_log(files.path / "training.log") as file:
            traceback.print_exc(file=file)
    write_json(files.failure, {"reason": reason})
    return Outcome.FAILED


def _work(folder: RunFolder, cell: Cell, expert: str | None, lock: TextIOWrapper) -> None:
    files, setting = folder.cell(cell), folder.setting
    length = setting.length(cell)
    dataset = training.collect(folder, cell, expert)
    if training.checkpoint(files, length.steps) is None:
        folder.log(f"{cell}: training {length.steps} steps")
    if not (files.training / "checkpoints" / "last").exists():  # nothing is left of earlier minutes
        _minutes_file(files, "training").unlink(missing_ok=True)
    with _minutes(files, "training"):
        training.train(files, setting, dataset, lock)
    with _minutes(files, "evaluation"):
        _evaluate(folder, cell, dataset)
    final = [row for row in read_rows(files.rows / "final.csv") if isinstance(row, Row)]
    write_json(files.result, _result(folder, cell, dataset, final))
    files.failure.unlink(missing_ok=True)


def _evaluate(folder: RunFolder, cell: Cell, dataset: Path) -> None:
    """Make the rows that are missing. A checkpoint whose rows are there is removed, unless it is the last one."""
    load_lerobot()
    files, setting = folder.cell(cell), folder.setting
    length = setting.length(cell)
    files.rows.mkdir(exist_ok=True)
    for step in range(length.interval, length.steps + 1, length.interval):
        _evaluate_checkpoint(folder, cell, dataset, step, is_final=False)
        done = training.checkpoint(files, step)
        if done is not None and step < length.steps:
            shutil.rmtree(done.parent)
    _evaluate_checkpoint(folder, cell, dataset, length.steps, is_final=True)


def load_lerobot() -> None:
    """Load LeRobot only when it is needed: during the training its memory is the training's."""
    import torch
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    logging.disable(logging.INFO)
    torch.set_num_threads(1)


def _evaluate_checkpoint(folder: RunFolder, cell: Cell, dataset: Path, step: int, *, is_final: bool) -> None:
    """Write an evaluation's rows, unless all of them are there."""
    files, setting = folder.cell(cell), folder.setting
    path = files.rows / ("final.csv" if is_final else f"step_{step:06d}.csv")
    index = step // setting.length(cell).interval - 1
    seeds = setting.final_seeds(cell) if is_final else setting.interim_seeds(cell, index)
    if path.exists() and [getattr(row, "episode_seed", None) for row in read_rows(path)] == [*seeds]:
        return
    from lerobot_uca.protocol.evaluation import PolicyPlan, run_episodes

    checkpoint = training.checkpoint(files, step)
    if checkpoint is None:
        raise CellError(f"its checkpoint after {step} steps is gone. Remove '{files.path}' to train anew")
    plan = PolicyPlan.from_checkpoint(checkpoint)
    epoch = step * setting.batch_size / _n_frames(dataset)
    episodes = run_episodes(make_env(cell, plan), plan.config, plan, seeds, n_envs=N_ENVS)
    rows = [
        Row(*cell, step, epoch, is_final, each.seed, each.success, each.episode_return, each.length, each.ms)
        for each in episodes
    ]
    rows.sort(key=lambda row: row.episode_seed)
    write_rows(path, rows)
    success = 100 * sum(row.success for row in rows) / len(rows)
    folder.log(f"{cell}: after {step} steps {success:.0f} % of {len(rows)} {'fresh ' * is_final}episodes")


def make_env(cell: Cell, plan: "PolicyPlan") -> Callable[[], "PointCloudEnv"]:
    """Makes the cell's environment as the policy knows it, with no more points than it looks at: the first ones."""
    from lerobot.envs.configs import EnvConfig

    config: Any = EnvConfig.get_choice_class(cell.env_type)(task=cell.env_task)
    config.n_points = plan.config.n_points or config.n_points
    config.observation = plan.config.observation
    return config.env_factory(cell.env_task)


def _n_frames(dataset: Path) -> int:
    return json.loads((dataset / "meta" / "info.json").read_text(encoding="utf-8"))["total_frames"]


def _result(folder: RunFolder, cell: Cell, dataset: Path, final: list[Row]) -> dict[str, Any]:
    from lerobot_uca.protocol.latency import measure
    from lerobot_uca.protocol.record import provenance

    files, setting = folder.cell(cell), folder.setting
    checkpoint = training.checkpoint(files, setting.length(cell).steps)
    assert checkpoint is not None
    config = json.loads((checkpoint / "config.json").read_text(encoding="utf-8"))  # device and precision it found there
    return {
        "cell": cell._asdict(),
        "success": sum(row.success for row in final) / len(final),
        "episodes": len(final),
        "minutes": {phase: _read_minutes(files, phase) for phase in ("training", "evaluation")},
        "inference": measure(checkpoint),
        "setting": setting.as_values(),
        "expert": training.demonstrator(dataset),
        "training_options": training.training_options(cell, setting),
        "dtype": config["dtype"],  # the processor decides, too (policies/precision.py)
        **provenance(config["device"]),
    }


@contextmanager
def _minutes(files: CellFolder, phase: str) -> Iterator[None]:
    """Add the time of a phase to what earlier processes of this cell have needed for it, also if this one is killed."""
    before, begin = _read_minutes(files, phase), time.monotonic()

    def note() -> None:
        with suppress(OSError), whole_file(_minutes_file(files, phase)) as unfinished:
            unfinished.write_text(f"{before + (time.monotonic() - begin) / 60:.3f}\n", encoding="utf-8")

    def keep_noting() -> None:
        while not is_over.wait(NOTED_EVERY):
            note()

    is_over = threading.Event()
    notes = threading.Thread(target=keep_noting, daemon=True)
    notes.start()
    try:
        yield
    finally:
        is_over.set()
        notes.join()
        note()


def _read_minutes(files: CellFolder, phase: str) -> float:
    try:
        return float(_minutes_file(files, phase).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return 0.0


def _minutes_file(files: CellFolder, phase: str) -> Path:
    return files.path / f"{phase}_minutes.txt"


def main() -> None:
    """Run the cell that the command line names."""
    tie_to_parent()
    path, task, policy, seed, *expert = sys.argv[1:]
    try:
        folder = RunFolder.open(Path(path))
    except UserError as error:  # on a node that does not share the disk
        sys.exit(f"error: {error}")
    sys.exit(run_cell(folder, Cell(task, policy, int(seed)), expert[0] if expert else None))


if __name__ == "__main__":
    main()
