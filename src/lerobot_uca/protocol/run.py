"""`lerobot-uca-benchmark run`: all cells that are not finished, wherever they are to run."""

import json
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from lerobot_uca.errors import UserError
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.folder import RunFolder, free_bytes, write_json
from lerobot_uca.protocol.launchers import Ended, Launcher
from lerobot_uca.protocol.run_cell import Outcome
from lerobot_uca.protocol.training import ended

MIN_FREE_BYTES = 1 << 30
"""A run does not begin or go on with less space: demonstrations, checkpoints and logs of a small cell take a tenth."""


def run(folder: RunFolder, cells: Sequence[Cell], launch: Launcher, expert: str | None) -> bool:
    """Run the cells that are not finished; whether all of them are now.

    Raises:
        UserError: before anything starts, if a cell cannot run; then and afterwards, if the disk is full.
    """
    for cell in cells:
        folder.setting.length(cell)
    if expert is None and any(cell.benchmark == "adroit" for cell in cells):
        raise UserError(
            "Adroit has no expert built in. Give one with --expert=..., in which {task} stands for the task: "
            "weights as .npz or as an original DAPG pickle, or a Minari dataset such as minari:D4RL/{task}/expert-v2."
        )
    missing = [cell for cell in cells if not folder.cell(cell).is_finished]
    folder.log(f"{len(missing)} of {len(cells)} cells to do, setting '{folder.setting.name}'")
    if not missing:
        return True
    _check_space(folder)
    begin = time.monotonic()
    failed, claimed = [], []
    for n_done, each in enumerate(launch(folder.path, missing, expert), start=1):
        if each.returncode == Outcome.NO_SPACE:
            raise UserError(
                f"No space left for '{folder.path}'. Free some and start the same command again: it goes on."
            )
        if each.returncode == Outcome.CLAIMED:
            claimed.append(each.cell)
        elif each.returncode != Outcome.FINISHED:
            failed.append(each.cell)
        minutes_left = (time.monotonic() - begin) / 60 / n_done * (len(missing) - n_done)
        folder.log(f"[{n_done}/{len(missing)}, {_duration(minutes_left)} left] {_describe(folder, each)}")
        if n_done < len(missing):
            _check_space(folder)
    folder.log(
        f"finished: {len(missing) - len(failed) - len(claimed)}, failed: {len(failed)}, "
        f"being worked on by another process: {len(claimed)}"
    )
    return not failed and not claimed


def _check_space(folder: RunFolder) -> None:
    if free_bytes(folder.path) < MIN_FREE_BYTES:
        raise UserError(
            f"Less than {MIN_FREE_BYTES >> 30} GiB of space left for '{folder.path}'. "
            "Free some and start the same command again: it goes on."
        )


def _describe(folder: RunFolder, each: Ended) -> str:
    files = folder.cell(each.cell)
    match each.returncode:
        case Outcome.FINISHED:
            result = json.loads(files.result.read_text(encoding="utf-8"))
            minutes = ", ".join(f"{phase} {value:.1f} min" for phase, value in result["minutes"].items())
            return f"{each.cell}: {100 * result['success']:.0f} % of {result['episodes']} fresh episodes ({minutes})"
        case Outcome.CLAIMED:
            return f"{each.cell}: another process works on it"
        case Outcome.FAILED if each.reason is None:
            return f"{each.cell} FAILED: {json.loads(files.failure.read_text(encoding='utf-8'))['reason']}"
    reason = each.reason or f"its process {ended(each.returncode)}"  # it could not say so itself
    with suppress(OSError):  # which may be why: the other cells go on
        write_json(files.failure, {"reason": reason})
    return f"{each.cell} FAILED: {reason}"


def _duration(minutes: float) -> str:
    hours, minutes = divmod(round(minutes), 60)
    return f"{hours}:{minutes:02d} h"


def make_folder(path: Path, setting_name: str) -> RunFolder:
    """The run's folder, with a setting by name."""
    from lerobot_uca.protocol.setting import Setting

    return RunFolder.create(path, Setting.load(setting_name))
