"""Where cells run. A launcher takes cells and yields how each has ended, as they end."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.run_cell import Outcome

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS"), "1")


class Ended(NamedTuple):
    """How a cell's process has ended: an `Outcome`, or another exit code if it crashed or was killed."""

    cell: Cell
    returncode: int


Launcher = Callable[[Path, Sequence[Cell], str | None], Iterator[Ended]]
"""From the folder, the cells and Adroit's expert to how each has ended."""


def run_process(folder: Path, cell: Cell, expert: str | None) -> int:
    """Run a cell in a process of its own, in one thread; its exit code."""
    arguments = [str(folder), cell.task, cell.policy, str(cell.seed), *([expert] if expert else [])]
    command = [sys.executable, "-m", "lerobot_uca.protocol.run_cell", *arguments]
    return subprocess.run(command, env={**os.environ, **ONE_THREAD}, check=False).returncode  # noqa: S603


def local(n_parallel: int) -> Launcher:
    """On this machine, so many cells at once."""

    def launch(folder: Path, cells: Sequence[Cell], expert: str | None) -> Iterator[Ended]:
        waiting = iter(cells)
        running: dict[Future[int], Cell] = {}
        # The threads only wait for their processes.
        with ThreadPoolExecutor(n_parallel) as pool:
            while True:
                for cell in waiting:
                    running[pool.submit(run_process, folder, cell, expert)] = cell
                    if len(running) == n_parallel:
                        break
                if not running:
                    return
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    cell = running.pop(future)
                    yield Ended(cell, future.result())

    return launch


def n_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


__all__ = ["Ended", "Launcher", "Outcome", "local", "n_cores", "run_process"]
