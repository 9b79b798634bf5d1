import errno
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from lerobot_uca.errors import UserError
from lerobot_uca.protocol import run_cell as run_cell_module
from lerobot_uca.protocol import training
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.command import main
from lerobot_uca.protocol.folder import RunFolder, write_json
from lerobot_uca.protocol.launchers import Ended
from lerobot_uca.protocol.rows import Row, write_rows
from lerobot_uca.protocol.run import run as run_cells
from lerobot_uca.protocol.run_cell import Outcome, run_cell
from lerobot_uca.protocol.setting import Setting
from lerobot_uca.protocol.tied import PARENT, tied
from lerobot_uca.protocol.training import CellError, NoSpaceError, as_arguments, run

CELL, OTHER = (Cell("metaworld/reach", "uca_flow", seed) for seed in (0, 1))


@pytest.fixture
def folder(tmp_path) -> RunFolder:
    lengths = {"metaworld": {"steps": 4, "evaluations": 2}}
    setting = Setting.from_values("tiny", {"description": "-", "batch_size": 8, "lengths": lengths})
    return RunFolder.create(tmp_path / "run", setting)


def run_python(code: str, log: Path) -> None:
    run("python", ["-c", code], log=log)


def test_a_command_that_fails_says_why(tmp_path):
    with pytest.raises(CellError) as caught:
        run_python("import sys; print('working'); sys.exit('error: it is too warm')", tmp_path / "log")
    assert str(caught.value) == f"python ended with exit code 1: it is too warm (see {tmp_path}/log)"
    assert "working\n" in (tmp_path / "log").read_text()


def test_a_record_says_whose_expert_it_was():
    tasks = ("metaworld/soccer", "metaworld/door-open", "metaworld/push")
    assert [training._identity(None, Cell(task, "uca_flow", 0)) for task in tasks] == [
        *["ours, built in"] * 2,
        "built in",
    ]


def test_nothing_of_the_working_directory_is_imported(tmp_path, monkeypatch):
    (tmp_path / "ctypes.py").write_text("raise SystemExit('of a person')")
    monkeypatch.chdir(tmp_path)
    run_python("print('done')", tmp_path / "log")


def test_a_command_that_is_killed_for_memory(tmp_path):
    with pytest.raises(CellError, match="python was killed by SIGKILL, as processes are when the memory is full"):
        run_python("import os; print('at work', flush=True); os.kill(os.getpid(), 9)", tmp_path / "log")


def test_a_command_that_was_killed_in_the_middle_of_a_line_leaves_the_next_its_own(tmp_path):
    log = tmp_path / "log"
    with pytest.raises(CellError):
        run_python("import os; print('step 1 of 3', end='', flush=True); os.kill(os.getpid(), 9)", log)
    run_python("print('done')", log)
    first, killed, second, done = log.read_text().splitlines()
    assert killed == "step 1 of 3"
    assert [line.partition(" ")[0] for line in (first, second)] == ["$", "$"]
    assert done == "done"


def test_a_command_that_finds_no_space(tmp_path):
    code = "import errno, os; raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))"
    with pytest.raises(NoSpaceError, match="python found no space left"):
        run_python(code, tmp_path / "log")


def test_options_are_written_as_draccus_reads_them():
    options = {"policy.dual_pass": False, "policy.unet_widths": [8, 16], "root": Path("a")}
    assert as_arguments(options) == [
        "--policy.dual_pass=false",
        "--policy.unet_widths=[8, 16]",
        "--root=a",
    ]


def test_demonstrations_are_made_as_the_setting_says(tmp_path, monkeypatch):
    values = {"description": "-", "batch_size": 8, "lengths": {"metaworld": {"steps": 4, "evaluations": 2}}}
    disturbed = {
        "smoothing": {"metaworld/reach": 0.5},
        "straight_paths": {"metaworld": True},
        "pushes": {"metaworld": 0.1},
        "successful_steps": {"metaworld": 7},
        "observation": {"metaworld": "object_cloud"},
    }
    folder = RunFolder.create(tmp_path / "run", Setting.from_values("tiny", {**values, **disturbed}))
    called = []
    monkeypatch.setattr(training, "run", lambda command, arguments, **_: called.append((command, arguments)))
    training.collect(folder, CELL, None)
    ((command, arguments),) = called
    assert command == "lerobot-uca-collect"
    expected = {"--env.task=reach", "--n_episodes=10", "--smoothing=0.5", "--pushes=0.1", "--successful_steps=7"}
    assert {*expected, "--straight_paths=true", "--env.observation=object_cloud"} <= set(arguments)


@pytest.fixture
def adroit(tmp_path, monkeypatch) -> RunFolder:
    """A folder in which Adroit's demonstrations are made at once."""

    def collected(command, arguments, **_):
        root = Path(next(text for text in arguments if text.startswith("--root=")).removeprefix("--root="))
        for file in ("meta/info.json", "data/chunk-000/file-000.parquet"):
            (root / file).parent.mkdir(parents=True)
            (root / file).touch()

    monkeypatch.setattr(training, "run", collected)
    values = {"description": "-", "batch_size": 8, "lengths": {"adroit": {"steps": 4, "evaluations": 2}}}
    return RunFolder.create(tmp_path / "run", Setting.from_values("tiny", values))


def test_a_task_has_one_expert(adroit, tmp_path):
    """By what its file holds, wherever it lies."""
    for name, text in (("a", "weights"), ("b", "weights"), ("c", "others")):
        (tmp_path / f"{name}_pen.npz").write_text(text)
    cell = Cell("adroit/pen", "uca_flow", 0)
    dataset = training.collect(adroit, cell, f"{tmp_path}/a_{{task}}.npz")
    expert = training.demonstrator(dataset)
    assert expert.startswith("sha256:")
    training.collect(adroit, cell, f"{tmp_path}/b_{{task}}.npz")
    for other in ("c_{task}.npz", "nowhere/{task}.npz"):
        with pytest.raises(CellError, match=f"demonstrations are by another expert: {expert}, now it is"):
            training.collect(adroit, cell, f"{tmp_path}/{other}")
    dataset.with_name("pen.json").unlink()  # a run of an earlier version
    training.collect(adroit, cell, f"{tmp_path}/c_{{task}}.npz")


def test_demonstrations_without_data_are_made_again(adroit):
    cell = Cell("adroit/pen", "uca_flow", 0)
    dataset = training.collect(adroit, cell, "minari:pen")
    (dataset / "data/chunk-000/file-000.parquet").unlink()
    training.collect(adroit, cell, "minari:pen")
    assert (dataset / "data/chunk-000/file-000.parquet").exists()


def test_experts_are_found_from_any_folder(tmp_path, monkeypatch):
    """A Ray worker's, for example."""
    given = []
    monkeypatch.setattr("lerobot_uca.protocol.command.run", lambda *arguments: given.append(arguments[-1]) or True)
    monkeypatch.chdir(tmp_path)
    for expert in ("experts/{task}.npz", "minari:D4RL/{task}/expert-v2"):
        main(["run", "--output=run", "--tasks=pen", f"--expert={expert}"])
    assert given == [str(tmp_path / "experts/{task}.npz"), "minari:D4RL/{task}/expert-v2"]


def test_a_child_whose_parent_is_gone_before_it_is_tied_ends(tmp_path):
    """As when the command is killed while a cell starts: it would keep the cell claimed."""
    command = [sys.executable, "-m", "lerobot_uca.protocol.tied", "/bin/sh", "-c", f"touch {tmp_path}/ran"]
    orphan = subprocess.run(command, env={**os.environ, PARENT: "1"}, check=False)
    assert orphan.returncode == 1
    assert not (tmp_path / "ran").exists()
    assert subprocess.run(command, env={**os.environ, **tied()}, check=False).returncode == 0
    assert (tmp_path / "ran").exists()


def test_an_evaluation_that_lacks_episodes_is_made_again(folder, monkeypatch):
    files = folder.cell(CELL)
    files.rows.mkdir(parents=True)
    seeds = folder.setting.final_seeds(CELL)
    rows = [Row(*CELL, 4, 1.0, True, seed, True, 1.0, 200, 5.0) for seed in seeds]
    asked = []
    monkeypatch.setattr(training, "checkpoint", lambda *_: asked.append(1))  # there is none
    for n_rows in (0, 1, len(rows)):
        write_rows(files.rows / "final.csv", rows[:n_rows])
        with suppress(CellError):
            run_cell_module._evaluate_checkpoint(folder, CELL, Path(), 4, is_final=True)
    assert len(asked) == 2  # not where all are there


def test_minutes_of_a_training_that_left_nothing_do_not_count(folder, monkeypatch):
    files = folder.cell(CELL)
    monkeypatch.setattr(training, "collect", lambda *_: Path())
    monkeypatch.setattr(training, "train", lambda *_: None)
    monkeypatch.setattr(run_cell_module, "_evaluate", lambda *_: 1 / 0)
    files.path.mkdir(parents=True)
    for is_left, minutes in ((False, 0), (True, 7)):
        (files.path / "training_minutes.txt").write_text("7.0")
        if is_left:
            (files.training / "checkpoints" / "last").mkdir(parents=True)
        run_cell(folder, CELL, None)
        assert float((files.path / "training_minutes.txt").read_text()) == pytest.approx(minutes, abs=0.1)


def test_a_cell_without_space_stops_the_run_and_stays_open(folder, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(run_cell_module, "_work", full)
    assert run_cell(folder, CELL, None) == Outcome.NO_SPACE
    assert not folder.cell(CELL).failure.exists()

    def launch(path, cells, expert):
        yield Ended(CELL, Outcome.NO_SPACE)
        raise AssertionError("the run must stop")

    with pytest.raises(UserError, match=r"No space left for .* start the same command again: it goes on"):
        run_cells(folder, [CELL, OTHER], launch, None)


def test_a_cells_process_that_is_killed_is_recorded_and_the_rest_goes_on(folder, capsys):
    def launch(path, cells, expert):
        assert list(cells) == [CELL, OTHER]
        yield Ended(CELL, -9)
        yield Ended(OTHER, Outcome.CLAIMED)

    assert not run_cells(folder, [CELL, OTHER], launch, None)
    assert "its process was killed by SIGKILL, as processes are when the memory is full" in (
        folder.cell(CELL).failure.read_text()
    )
    output = capsys.readouterr().out
    assert f"[1/2, 0:00 h left] {CELL} FAILED: its process was killed" in output
    assert "finished: 0, failed: 1, being worked on by another process: 1" in output


def test_a_cells_process_that_could_not_begin_is_recorded_and_the_rest_goes_on(folder, tmp_path, capfd):
    """As on a node that does not share the disk. What an earlier try has recorded is not its reason."""
    write_json(folder.cell(CELL).failure, {"reason": "an old one"})
    command = [sys.executable, "-m", "lerobot_uca.protocol.run_cell", str(tmp_path / "nowhere"), *map(str, CELL)]
    ended = subprocess.run(command, check=False, capture_output=True, text=True)
    assert ended.stderr.startswith("error: ")
    assert "is not the folder of a benchmark run" in ended.stderr

    def launch(path, cells, expert):
        yield Ended(CELL, ended.returncode)
        folder.cell(OTHER).path.touch()  # no folder: nothing can be recorded
        yield Ended(OTHER, ended.returncode)

    assert not run_cells(folder, [CELL, OTHER], launch, None)
    output = capfd.readouterr().out
    for cell in (CELL, OTHER):
        assert f"{cell} FAILED: its process ended with exit code 1" in output
    assert "an old one" not in output
    assert "finished: 0, failed: 2" in output


def test_a_run_begins_and_goes_on_with_space_alone(folder, monkeypatch, capsys):
    """After the last cell nothing more needs any."""
    monkeypatch.setattr("lerobot_uca.protocol.run.free_bytes", lambda _: free.pop(0))
    launched = []

    def launch(path, cells, expert):
        for cell in cells:
            launched.append(cell)
            yield Ended(cell, Outcome.CLAIMED)

    free = [1000]
    with pytest.raises(UserError, match=r"Less than 1 GiB of space left for .* it goes on"):
        run_cells(folder, [CELL, OTHER], launch, None)
    assert launched == []
    free = [1 << 40, 1000]
    with pytest.raises(UserError, match="Less than 1 GiB of space left"):
        run_cells(folder, [CELL, OTHER], launch, None)
    assert launched == [CELL]
    free = [1 << 40, 1 << 40]
    run_cells(folder, [CELL, OTHER], launch, None)
    assert "being worked on by another process: 2" in capsys.readouterr().out


def test_options_as_they_are_typed():
    typed = as_arguments({"a": True, "b": None, "c": 0.5, "d": "text"})
    assert typed == ["--a=true", "--b=null", "--c=0.5", "--d=text"]


def test_the_minutes_of_a_killed_process_count(folder):
    """Its last note is at most 10 s old; here 0.02 s, of 0.6."""
    files = folder.cell(CELL)
    files.path.mkdir(parents=True)
    code = f"""
import os, time
from pathlib import Path
from lerobot_uca.protocol import run_cell
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.folder import CellFolder
run_cell.NOTED_EVERY = 0.02
with run_cell._minutes(CellFolder(Path({str(folder.path)!r}), {CELL!r}), "training"):
    time.sleep(0.6)
    os.kill(os.getpid(), 9)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -signal.SIGKILL
    killed = run_cell_module._read_minutes(files, "training")
    assert 0.3 < killed * 60 < 20
    with run_cell_module._minutes(files, "training"):
        pass
    assert run_cell_module._read_minutes(files, "training") >= killed


def test_any_exception_concerns_one_cell(folder, monkeypatch):
    monkeypatch.setattr(run_cell_module, "_work", lambda *_: 1 / 0)
    assert run_cell(folder, CELL, None) == Outcome.FAILED
    assert '"reason": "ZeroDivisionError: division by zero"' in folder.cell(CELL).failure.read_text()


def test_a_trainings_options_are_the_cells_and_the_settings():
    lengths = {"metaworld": {"steps": 400, "evaluations": 2}}
    setting = Setting.from_values("tiny", {"description": "-", "batch_size": 8, "lengths": lengths})
    options = training.training_options(Cell("metaworld/reach", "adaln", 3), setting)
    wanted = {"seed": 3, "batch_size": 8, "steps": 400, "save_freq": 200, "policy.conditioning": "adaln"}
    assert {name: options[name] for name in wanted} == wanted
