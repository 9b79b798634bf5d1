"""Cells on the GPUs of a machine, and elsewhere: a Ray cluster, and submitit without Slurm."""

import os
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch

from lerobot_uca.errors import UserError
from lerobot_uca.protocol import launchers
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.command import main
from lerobot_uca.protocol.folder import RunFolder
from lerobot_uca.protocol.launchers import Ended, local, on_ray, on_slurm
from lerobot_uca.protocol.setting import Setting

CELL = Cell("metaworld/reach", "uca_flow", 0)


def test_a_ray_address_that_does_not_answer():
    pytest.importorskip("ray")
    with pytest.raises(UserError) as caught:
        on_ray("127.0.0.1:1")
    assert str(caught.value).startswith("No Ray cluster answers at --ray='127.0.0.1:1'")


def test_slurm_without_slurm(monkeypatch):
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", "")
    with pytest.raises(UserError, match="there is no command sbatch on this machine"):
        on_slurm({})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--slurm=partition"], "--slurm takes options as partition=gpu,gres=gpu:1,time=600, got 'partition'."),
        (["--parallel=0"], "--parallel must be at least 1, got 0."),
        (["--parallel=0", "--slurm"], "--parallel must be at least 1, got 0."),
        (["--parallel=-1", "--ray=auto"], "--parallel must be at least 1, got -1."),
    ],
)
def test_wrong_options(tmp_path, options, message):
    with pytest.raises(UserError) as caught:
        main(["run", f"--output={tmp_path}/run", "--tasks=reach", *options])
    assert str(caught.value) == message


def test_submitit_runs_each_cell_in_a_task_of_its_own(tmp_path, monkeypatch):
    pytest.importorskip("submitit")
    # Stands for a cell's process: this test is of the launcher.
    monkeypatch.setattr(launchers, "run_process", lambda folder, cell, expert: cell.seed)
    other = CELL._replace(seed=1)
    launch = on_slurm({"partition": "short"}, cluster="local")
    assert sorted(launch(tmp_path, [CELL, other], None)) == [Ended(CELL, 0), Ended(other, 1)]


SLURM = {
    "srun": "",
    "sbatch": 'cp "$1" {folder}/submission.sh; echo Submitted batch job 7',
    "sacct": "echo 'JobID|State|NodeList'; echo '7_0|CANCELLED|n'; echo '7_1|RUNNING|n'; echo '7_2|PENDING|n'",
    "scancel": 'echo "$1" >> {folder}/cancelled',
}
"""The commands of a Slurm on which one task has ended, one runs and one waits."""


@pytest.mark.parametrize(("end", "cancelled"), [(KeyboardInterrupt, ["7_1", "7_2"]), (SystemExit, [])])
def test_slurm_tasks_end_with_ctrl_c_and_not_with_the_connection(tmp_path, monkeypatch, end, cancelled):
    submitit = pytest.importorskip("submitit")
    for name, command in SLURM.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{command.format(folder=tmp_path)}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(submitit.SlurmJob, "_results_timeout_s", 0)
    ends = on_slurm({"partition": "short"}, 2)(tmp_path, [CELL._replace(seed=seed) for seed in range(3)], None)
    assert next(ends).reason.startswith("Slurm gave it up: ")

    def sleep(seconds):
        raise end

    (tmp_path / "cancelled").touch()
    monkeypatch.setattr(launchers.time, "sleep", sleep)
    with pytest.raises(end):
        next(ends)
    assert (tmp_path / "cancelled").read_text().split() == cancelled
    assert "#SBATCH --array=0-2%2\n" in (tmp_path / "submission.sh").read_text()


def test_a_cell_imports_nothing_of_the_working_directory(tmp_path, monkeypatch):
    """Where a person has a yaml.py, for example."""
    (tmp_path / "yaml.py").write_text("raise SystemExit(77)")
    monkeypatch.chdir(tmp_path)
    assert launchers.run_process(tmp_path / "no folder", CELL, None) == 1


class StubRay(ModuleType):
    """A Ray whose tasks end one by one, and which keeps how many there were each time."""

    exceptions = SimpleNamespace(RayError=RuntimeError)

    def __init__(self):
        self.at_once = []

    def remote(self, **_):
        return lambda _: SimpleNamespace(remote=lambda folder, cell, expert: cell)

    def wait(self, tasks):
        self.at_once.append(len(tasks))
        return tasks[:1], tasks[1:]

    def get(self, _):
        return 0

    def shutdown(self):
        pass


@pytest.mark.parametrize(("n_parallel", "at_once"), [(2, [2, 2, 2, 1]), (None, [4, 3, 2, 1])])
def test_ray_runs_so_many_cells_at_once(tmp_path, monkeypatch, n_parallel, at_once):
    ray = StubRay()
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(launchers, "_connect", lambda *_: None)
    cells = [CELL._replace(seed=seed) for seed in range(4)]
    ends = on_ray("auto", n_parallel)(make_folder(tmp_path / "run", "cpu").path, cells, None)
    assert list(ends) == [Ended(cell, 0) for cell in cells]
    assert ray.at_once == at_once


def make_folder(path: Path, device: str | None = None) -> RunFolder:
    policy = {} if device is None else {"device": device}
    values = {"description": "", "batch_size": 4, "lengths": {"metaworld": {"steps": 4, "evaluations": 2}}}
    return RunFolder.create(path, Setting.from_values("a setting", {**values, "policy": policy}))


@pytest.mark.parametrize(
    ("device", "n_gpus", "places"),
    [
        ("cpu", 2, [None] * 3),
        ("cuda", 0, [None] * 3),
        ("cuda", 2, ["0", "1"]),
        ("cuda:1", 2, [None]),
        ("mps", 0, [None]),
        (None, 0, [None] * 3),
    ],
)
def test_cells_at_once(tmp_path, monkeypatch, device, n_gpus, places):
    monkeypatch.setattr(launchers, "n_cores", lambda: 3)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: n_gpus)
    monkeypatch.setattr(torch.accelerator, "current_accelerator", lambda check_available: None)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert launchers._places(make_folder(tmp_path / "run", device).setting) == places


@pytest.mark.parametrize(("n_parallel", "seen"), [(None, [["4", "4", "7"], ["4", "7", "7"]]), (1, [["4"] * 3])])
def test_each_cell_sees_one_gpu(tmp_path, monkeypatch, n_parallel, seen):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,7")
    python = tmp_path / "python"  # stands for a cell: this test is of what its process is given
    python.write_text(f'#!/bin/sh\nsleep 0.1\necho "$CUDA_VISIBLE_DEVICES" >> {tmp_path}/seen\n')
    python.chmod(0o755)
    monkeypatch.setattr(launchers.sys, "executable", str(python))
    cells = [CELL._replace(seed=seed) for seed in range(3)]
    ends = local(n_parallel)(make_folder(tmp_path / "run", "cuda").path, cells, None)
    assert sorted(ends) == [Ended(cell, 0) for cell in cells]
    assert sorted((tmp_path / "seen").read_text().split()) in seen


@pytest.mark.parametrize(("setting", "options"), [("paper", ""), ("paper", "partition=a,gres=gpu:1"), ("small", "")])
def test_slurm_shows_gpus_to_those_who_ask(tmp_path, monkeypatch, capsys, setting, options):
    monkeypatch.setattr("lerobot_uca.protocol.command.on_slurm", lambda *_: lambda *_: iter([Ended(CELL, 2)]))
    with pytest.raises(SystemExit):
        main(["run", f"--output={tmp_path}/run", f"--setting={setting}", "--tasks=reach", f"--slurm={options}"])
    is_told = "--slurm asks for none" in capsys.readouterr().out
    assert is_told == (setting == "paper" and not options)
