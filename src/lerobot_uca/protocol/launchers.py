"""Launchers run cells. A launcher takes cells and yields the end of each, as they end."""

import itertools
import logging
import os
import shutil
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from lerobot_uca.errors import UserError
from lerobot_uca.processes import n_cores
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.folder import RunFolder
from lerobot_uca.protocol.run_cell import Outcome
from lerobot_uca.protocol.setting import Setting
from lerobot_uca.protocol.tied import tied

VISIBLE_GPUS = "CUDA_VISIBLE_DEVICES"
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS"), "1")


N_RETRIES = 5  # of a cell whose node has died
N_CLAIMS = 5  # tries to claim a cell, POLL_SECONDS and a process apart: a node's last processes may hold it for seconds
MAX_MINUTES = 24 * 60  # of a cell on Slurm, unless the options say another time
POLL_SECONDS = 0.5


class Ended(NamedTuple):
    """The end of a cell's process: an `Outcome`, or another exit code if it crashed or was killed."""

    cell: Cell
    returncode: int
    reason: str | None = None
    """The reason why the launcher has given it up, if it has."""


Launcher = Callable[[Path, Sequence[Cell], str | None], Iterator[Ended]]
"""Maps the folder, the cells and Adroit's expert to the end of each cell."""


def run_process(folder: Path, cell: Cell, expert: str | None) -> int:
    """Run a cell in a process of its own, in one thread; its exit code."""
    return _start(folder, cell, expert).wait()


def _start(folder: Path, cell: Cell, expert: str | None, gpu: str | None = None) -> "subprocess.Popen[bytes]":
    arguments = [str(folder), cell.task, cell.policy, str(cell.seed), *([expert] if expert else [])]
    # -P: of the working directory, whose yaml.py may be anything, nothing is imported
    command = [sys.executable, "-P", "-m", "lerobot_uca.protocol.run_cell", *arguments]
    chosen = {} if gpu is None else {VISIBLE_GPUS: gpu}
    return subprocess.Popen(command, env={**os.environ, **ONE_THREAD, **chosen, **tied()})  # noqa: S603


def local(n_parallel: int | None = None) -> Launcher:
    """Run so many cells at once on this machine. They end when the launcher is left, with Ctrl-C for example.

    Args:
        n_parallel: by default one a core, or one a GPU if that is where the setting computes; they take turns in them.
    """

    def launch(folder: Path, cells: Sequence[Cell], expert: str | None) -> Iterator[Ended]:
        places = _places(RunFolder.open(folder).setting)
        free = deque(itertools.islice(itertools.cycle(places), n_parallel or len(places)))
        waiting = deque(cells)
        running: list[tuple[subprocess.Popen[bytes], Cell, str | None]] = []
        try:
            while waiting or running:
                while waiting and free:
                    cell, gpu = waiting.popleft(), free.popleft()
                    running.append((_start(folder, cell, expert, gpu), cell, gpu))
                time.sleep(POLL_SECONDS)
                for each in [each for each in running if each[0].poll() is not None]:
                    running.remove(each)
                    process, cell, gpu = each
                    free.append(gpu)
                    yield Ended(cell, process.returncode)
        finally:
            for process, *_ in running:
                process.kill()  # and with it its training, which is tied to it
                process.wait()

    return launch


def _places(setting: Setting) -> list[str | None]:
    """The GPU of each cell that may run at once: its name, or None where there is nothing to choose."""
    device, n_gpus = setting.policy.get("device"), 0
    if device != "cpu":
        import torch

        device = device or str(torch.accelerator.current_accelerator(check_available=True) or "cpu")
        n_gpus = torch.cuda.device_count()
    if device == "cpu" or (device == "cuda" and not n_gpus):
        return [None] * n_cores()
    if device != "cuda":
        return [None]  # a single one, mps or cuda:1
    visible = os.environ.get(VISIBLE_GPUS)
    return [*(visible.split(",") if visible else map(str, range(n_gpus)))][:n_gpus]


def on_ray(address: str, n_parallel: int | None = None) -> Launcher:
    """Run on a Ray cluster whose nodes share the disk. A cell whose node dies is begun anew on another and goes on.

    Args:
        address: HOST:PORT, or auto.
        n_parallel: cells at once; by default as many as the cluster takes.

    Raises:
        UserError: if Ray is not installed, or the address does not answer.
    """
    try:
        import ray
    except ImportError as error:
        raise UserError("--ray needs Ray: pip install 'lerobot_policy_uca_flow[ray]'.") from error
    _connect(ray, address)

    def launch(folder: Path, cells: Sequence[Cell], expert: str | None) -> Iterator[Ended]:
        needs_gpu = RunFolder.open(folder).setting.policy.get("device") != "cpu" and ray.cluster_resources().get("GPU")
        remote = ray.remote(num_cpus=1, num_gpus=1 if needs_gpu else 0, max_retries=N_RETRIES)(_claim_and_run)
        waiting = deque(cells)
        running: dict[Any, Cell] = {}
        while waiting or running:
            while waiting and len(running) < (n_parallel or len(cells)):
                cell = waiting.popleft()
                running[remote.remote(folder, cell, expert)] = cell
            (done, *_), _ = ray.wait(list(running))
            cell = running.pop(done)
            try:
                yield Ended(cell, ray.get(done))
            except ray.exceptions.RayError as error:
                yield Ended(cell, Outcome.FAILED, f"Ray gave it up: {' '.join(str(error).split())[:300]}")
        ray.shutdown()

    return launch


def _claim_and_run(folder: Path, cell: Cell, expert: str | None) -> int:
    """As `run_process`, for a cell that may be claimed by what is left of a node that has died."""
    for _ in range(N_CLAIMS):
        returncode = run_process(folder, cell, expert)
        if returncode != Outcome.CLAIMED:
            break
        time.sleep(POLL_SECONDS)
    return returncode


def _connect(ray: Any, address: str) -> None:
    host, separator, port = address.removeprefix("ray://").rpartition(":")
    try:
        if separator:  # Ray itself would try for minutes
            socket.create_connection((host, int(port)), timeout=10).close()
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError) as error:
        raise UserError(
            f"No Ray cluster answers at --ray='{address}': {error}. It is HOST:PORT of the head node, as "
            "'ray start --head' prints it, or auto."
        ) from error


def on_slurm(options: Mapping[str, str], n_parallel: int | None = None, cluster: str = "slurm") -> Launcher:
    """Run as a Slurm array, one task a cell, through submitit. The nodes share the disk.

    Ctrl-C cancels the tasks that have not ended. Without this process they go on, and the same command takes them up.

    Args:
        options: of sbatch, by their long names: partition, time, gres, ...
        n_parallel: cells at once; by default as many as submitit lets an array have.
        cluster: submitit's name of the scheduler; 'local' runs the tasks here.

    Raises:
        UserError: if submitit or Slurm is not installed.
    """
    try:
        import submitit
    except ImportError as error:
        raise UserError("--slurm needs submitit: pip install 'lerobot_policy_uca_flow[slurm]'.") from error
    if cluster == "slurm" and shutil.which("sbatch") is None:
        raise UserError("--slurm needs Slurm: there is no command sbatch on this machine.")

    def launch(folder: Path, cells: Sequence[Cell], expert: str | None) -> Iterator[Ended]:
        executor = submitit.AutoExecutor(folder / "slurm", cluster=cluster)
        executor.update_parameters(name="lerobot-uca-benchmark", cpus_per_task=1, timeout_min=MAX_MINUTES)
        executor.update_parameters(slurm_additional_parameters=dict(options))
        executor.update_parameters(slurm_setup=["export PYTHONSAFEPATH=1"])  # as -P above
        if n_parallel is not None:
            executor.update_parameters(slurm_array_parallelism=n_parallel)
        jobs = executor.map_array(run_process, *zip(*((folder, cell, expert) for cell in cells), strict=True))
        running = dict(zip(jobs, cells, strict=True))
        try:
            while running:
                for job in [job for job in running if job.done()]:
                    cell = running.pop(job)
                    try:
                        yield Ended(cell, job.result())
                    except (submitit.core.utils.FailedJobError, submitit.core.utils.UncompletedJobError) as error:
                        yield Ended(cell, Outcome.FAILED, f"Slurm gave it up: {' '.join(str(error).split())[:300]}")
                time.sleep(POLL_SECONDS)
        except (KeyboardInterrupt, GeneratorExit):  # not if the connection to this machine is lost: they go on
            for job in running:
                job.cancel(check=False)  # it may have ended meanwhile
            raise

    return launch
