import fcntl
import subprocess
import sys

import pytest

from lerobot_uca.data.whole_folder import whole_folder
from lerobot_uca.errors import UserError
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.folder import RunFolder
from lerobot_uca.protocol.setting import Setting

CELL = Cell("metaworld/reach", "uca_flow", 0)
VALUES = {
    "description": "-",
    "batch_size": 8,
    "lengths": {"metaworld": {"steps": 4, "evaluations": 2}},
    "policy": {"device": "cpu"},
}


def make_setting(**changes) -> Setting:
    return Setting.from_values("mine", {**VALUES, **changes})


def test_a_folder_opens_with_its_setting(tmp_path):
    made = RunFolder.create(tmp_path / "run", make_setting())
    assert RunFolder.open(tmp_path / "run").setting == made.setting
    assert RunFolder.create(tmp_path / "run", make_setting(description="other words")).setting.batch_size == 8


@pytest.mark.parametrize(
    ("changes", "difference"),
    [
        ({"batch_size": 4}, "batch_size was 8, now it is 4"),
        ({"policy": {"device": "cuda"}}, 'policy.device was "cpu", now it is "cuda"'),
        ({"policy": {"device": "cpu", "dim": 8}}, "policy.dim was null, now it is 8"),
        ({"lengths": {"metaworld": {"steps": 6, "evaluations": 2}}}, "lengths.metaworld.steps was 4, now it is 6"),
    ],
)
def test_a_folder_of_another_setting(tmp_path, changes, difference):
    RunFolder.create(tmp_path, make_setting())
    with pytest.raises(UserError) as caught:
        RunFolder.create(tmp_path, make_setting(**changes))
    assert f"was made with another setting: {difference}. Choose another --output" in str(caught.value)


def test_demonstrations_are_written_while_their_folder_is_held(tmp_path):
    folder = RunFolder.create(tmp_path, make_setting())
    with folder.demonstrations(CELL) as dataset, whole_folder(dataset) as unfinished:
        unfinished.mkdir()
        claim = dataset.with_name(f".{dataset.name}.claim")
        with claim.open() as file, pytest.raises(BlockingIOError):  # by one process at a time
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    assert dataset.is_dir()


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"--output '.*/file/run' cannot be written"):
        RunFolder.create(tmp_path / "file" / "run", make_setting())


def test_what_is_not_a_run(tmp_path):
    with pytest.raises(UserError, match=r"it has no setting\.json"):
        RunFolder.open(tmp_path)


def test_a_cell_is_claimed_by_one_and_free_when_its_process_is_killed(tmp_path):
    folder = RunFolder.create(tmp_path, make_setting())
    code = f"""
from pathlib import Path
from lerobot_uca.protocol.folder import RunFolder
from lerobot_uca.protocol.cells import Cell
with RunFolder.open(Path({str(tmp_path)!r})).cell(Cell(*{tuple(CELL)!r})).claim() as lock:
    print(lock is not None, flush=True)
    input()
"""
    other = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert other.stdout.readline() == "True\n"
    with folder.cell(CELL).claim() as lock:
        assert lock is None
    with folder.cell(CELL._replace(seed=1)).claim() as lock:
        assert lock is not None
    other.kill()
    other.wait()
    with folder.cell(CELL).claim() as lock:
        assert lock is not None
    other.stdin.close()
    other.stdout.close()
