"""Cells elsewhere: a real Ray cluster, and submitit without Slurm."""

import pytest

from lerobot_uca.errors import UserError
from lerobot_uca.protocol import launchers
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.command import main
from lerobot_uca.protocol.launchers import Ended, on_ray, on_slurm

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
        (["--slurm=partition"], "--slurm takes options as partition=gpu,time=600, got 'partition'."),
        (["--parallel=0"], "--parallel must be at least 1, got 0."),
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
