"""Demonstrations and training of a cell, by the commands that a user would type, each in a process of its own."""

import errno
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from lerobot_uca.envs.experts import metaworld_experts
from lerobot_uca.features import POINT_CLOUD
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.folder import CellFolder, RunFolder, read_json, write_json
from lerobot_uca.protocol.setting import Setting
from lerobot_uca.protocol.tied import tied

BUILT_IN, OURS = "built in", "ours, built in"
LOG_TAIL = 2000  # characters in which a failing command has said why


class CellError(Exception):
    """The reason why a cell has failed, in one line. The other cells go on."""


class NoSpaceError(Exception):
    """The disk is full: no cell can go on."""


def collect(folder: RunFolder, cell: Cell, expert: str | None) -> Path:
    """The task's demonstrations, made if they are not there. Others who need them wait."""
    with folder.demonstrations(cell) as dataset:
        identity = _identity(expert, cell)
        if not ((dataset / "meta" / "info.json").exists() and any(dataset.glob("data/**/*.parquet"))):
            shutil.rmtree(dataset, ignore_errors=True)
            folder.log(f"{cell.task}: collecting {folder.setting.demonstrations} demonstrations")
            options = {
                "env.type": cell.env_type,
                "env.task": cell.env_task,
                "env.observation": folder.setting.observation.get(cell.benchmark, POINT_CLOUD),
                "repo_id": repo_id(cell),
                "root": dataset,
                "n_episodes": folder.setting.demonstrations,
                "smoothing": folder.setting.smoothing.get(cell.task, 1.0),
                "straight_paths": folder.setting.straight_paths.get(cell.benchmark, False),
                "pushes": folder.setting.pushes.get(cell.benchmark, 0.0),
            }
            if cell.benchmark in folder.setting.successful_steps:
                options["successful_steps"] = folder.setting.successful_steps[cell.benchmark]
            if expert is not None and cell.benchmark == "adroit":
                options["expert"] = expert
            write_json(_made_by(dataset), {"expert": identity})  # before: whoever is killed then has said it
            run("lerobot-uca-collect", as_arguments(options), log=folder.cell(cell).path / "collect.log")
        elif (made := demonstrator(dataset)) not in (None, identity):
            raise CellError(f"its demonstrations are by another expert: {made}, now it is {identity}")
        return dataset


def demonstrator(dataset: Path) -> str | None:
    """Who has demonstrated a task; None for a run of an earlier version, which did not record it."""
    made_by = _made_by(dataset)
    return read_json(made_by)["expert"] if made_by.exists() else None


def _made_by(dataset: Path) -> Path:
    return dataset.with_name(f"{dataset.name}.json")


def _identity(expert: str | None, cell: Cell) -> str:
    """What demonstrates a task: a dataset, or a file by what it holds, wherever it lies."""
    if cell.benchmark == "metaworld" and cell.env_task in metaworld_experts.EXPERTS:
        return OURS
    if expert is None or cell.benchmark != "adroit":
        return BUILT_IN
    path = Path(expert.replace("{task}", cell.env_task))
    return f"sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}" if path.is_file() else expert


def train(cell_folder: CellFolder, setting: Setting, dataset: Path, lock: TextIOWrapper) -> None:
    """Train to the last step, from the last checkpoint if there is one."""
    cell, training = cell_folder.cell, cell_folder.training
    checkpoints = training / "checkpoints"
    if checkpoint(cell_folder, setting.length(cell).steps) is not None:
        return
    options: dict[str, Any] = {"dataset.root": dataset, "output_dir": training}
    last = checkpoints / "last" / "pretrained_model" / "train_config.json"
    if last.exists():
        options |= {"config_path": last, "resume": True}
    else:
        shutil.rmtree(training, ignore_errors=True)
        options |= training_options(cell, setting)
    run("lerobot-train", as_arguments(options), log=cell_folder.path / "training.log", keep=lock)


def training_options(cell: Cell, setting: Setting) -> dict[str, Any]:
    """Options of a new training, besides its folders."""
    length = setting.length(cell)
    policy = {f"policy.{name}": value for name, value in setting.policy_options(cell).items()}
    return {
        "dataset.repo_id": repo_id(cell),
        **policy,
        "policy.push_to_hub": False,
        "batch_size": setting.batch_size,
        "steps": length.steps,
        "save_freq": length.interval,
        "env_eval_freq": 0,
        "num_workers": 0,
        "log_freq": max(1, length.steps // 100),
        "seed": cell.seed,
    }


def checkpoint(cell_folder: CellFolder, step: int) -> Path | None:
    """The folder of the weights after some steps, if they are there whole.

    LeRobot writes the training's state after the weights, and 'last' after both.
    """
    checkpoints = cell_folder.training / "checkpoints"
    for folder in checkpoints.glob("[0-9]*"):
        if int(folder.name) == step and (checkpoints / "last").exists() and step <= _last_step(checkpoints):
            return folder / "pretrained_model"
    return None


def _last_step(checkpoints: Path) -> int:
    return int((checkpoints / "last").resolve().name)


def repo_id(cell: Cell) -> str:
    """The name of a task's dataset."""
    return f"local/{cell.task.replace('/', '-')}"


def as_arguments(options: dict[str, Any]) -> list[str]:
    """Options as draccus reads them."""
    return [f"--{name}={_as_text(value)}" for name, value in options.items()]


def _as_text(value: Any) -> str:
    return json.dumps(value) if value is None or isinstance(value, bool) else str(value)


def run(program: str, arguments: list[str], *, log: Path, keep: TextIOWrapper | None = None) -> None:
    """Run a command of this environment; what it prints is added to a log.

    Args:
        program: its name.
        arguments: its arguments.
        log: a file.
        keep: a lock that is held as long as the command runs, even if this process does not live as long.

    Raises:
        CellError: if it fails; says how, and the last thing it has printed.
        NoSpaceError: if it fails for want of space.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    # -P: of the working directory nothing is imported
    tie = [sys.executable, "-P", "-m", "lerobot_uca.protocol.tied"]
    with open_log(log) as file:
        file.write(f"$ {program} {' '.join(arguments)}\n")
        file.flush()
        start = file.tell()
        keep_open = () if keep is None else (keep.fileno(),)
        result = subprocess.run(  # noqa: S603
            [*tie, str(Path(sys.executable).with_name(program)), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=file,
            env={**os.environ, **tied()},
            pass_fds=keep_open,
            check=False,
        )
    if result.returncode:
        said = _tail(log, start)
        if os.strerror(errno.ENOSPC) in said or os.strerror(errno.EDQUOT) in said:
            raise NoSpaceError(f"{program} found no space left on the disk of '{log.parent}'.")
        raise CellError(f"{program} {ended(result.returncode)}: {_last_line(said)} (see {log})")


def open_log(path: Path) -> TextIOWrapper:
    """A log to add to, on a new line: what was killed leaves a progress bar without an end of line."""
    file = path.open("a", encoding="utf-8")
    if file.tell():
        file.write("\n")
    return file


def ended(returncode: int) -> str:
    """The end of a process, in words."""
    if returncode >= 0:
        return f"ended with exit code {returncode}"
    name = signal.Signals(-returncode).name
    hint = ", as processes are when the memory is full" if -returncode == signal.SIGKILL else ""
    return f"was killed by {name}{hint}"


def _tail(log: Path, start: int) -> str:
    with log.open("rb") as file:
        file.seek(max(start, log.stat().st_size - LOG_TAIL))
        return file.read().decode(errors="replace")


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.replace("\r", "\n").splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("error: ")]
    return (errors or lines or ["it has printed nothing"])[-1].removeprefix("error: ")


@contextmanager
def no_space_as_such() -> Iterator[None]:
    """Raise a `NoSpaceError` for an OSError of a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise NoSpaceError(str(error)) from error
        raise
