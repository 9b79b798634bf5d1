"""The command, end to end and tiny, with real trainings."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.builders import N_POINTS, write_dataset

from lerobot_uca.errors import UserError
from lerobot_uca.policies.precision import has_bfloat16
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.folder import RunFolder
from lerobot_uca.protocol.report import report
from lerobot_uca.protocol.results import Results
from lerobot_uca.protocol.rollouts import film
from lerobot_uca.protocol.rows import Row
from lerobot_uca.protocol.setting import Setting
from lerobot_uca.protocol.training import checkpoint

TASK = "metaworld/drawer-close"
GOOD, BAD = Cell(TASK, "uca_flow", 0), Cell(TASK, "simple_dp3", 0)
TINY = {
    "description": "as small as can be",
    "batch_size": 4,
    "lengths": {"metaworld": {"steps": 4, "evaluations": 2}, "adroit": {"steps": 4, "evaluations": 2}},
    "demonstrations": 1,
    "interim_episodes": 1,
    "final_episodes": 2,
    "policy": {"device": "cpu", "n_points": N_POINTS, "inference": "eager", "dtype": "bfloat16"},
    "policies": {"uca_flow": {"dim": 16, "n_layers": 1, "n_heads": 2}, "simple_dp3": {"horizon": 3}},
}


def benchmark(output: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [Path(sys.executable).with_name("lerobot-uca-benchmark"), "run", f"--output={output}", "--parallel=1"]
    return subprocess.run([*command, *options], capture_output=True, text=True, check=False)


def make_run(output: Path, **changes: object) -> RunFolder:
    """A folder with a setting, and without demonstrations."""
    values = {**TINY, **changes}
    folder = RunFolder.create(output, Setting.from_values("tiny", values))
    (output / "tiny.yaml").write_text(yaml.safe_dump(values))
    return folder


def with_demonstrations(folder: RunFolder) -> RunFolder:
    with folder.demonstrations(GOOD) as dataset:
        write_dataset(dataset)
    return folder


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> tuple[RunFolder, subprocess.CompletedProcess[str]]:
    """A run of two cells, of which the first cannot be trained."""
    folder = make_run(tmp_path_factory.mktemp("run"))
    options = ["--tasks=drawer-close", "--policies=simple_dp3,uca_flow", "--seeds=0"]
    return folder, benchmark(folder.path, f"--setting={folder.path}/tiny.yaml", *options)


def test_a_cell_that_fails_is_recorded_and_the_rest_goes_on(finished):
    folder, result = finished
    assert result.returncode == 1
    assert "Traceback" not in result.stdout + result.stderr
    reason = json.loads(folder.cell(BAD).failure.read_text())["reason"]
    assert reason.startswith("lerobot-train ended with exit code 1: policy.horizon must be at least")
    assert f"{BAD} FAILED: lerobot-train" in result.stdout
    assert folder.cell(GOOD).is_finished
    assert not folder.cell(BAD).is_finished


def test_there_is_a_row_for_each_episode(finished):
    folder, _ = finished
    rows = list(folder.read())
    assert all(isinstance(row, Row) for row in rows)
    assert {row.cell for row in rows} == {GOOD}
    setting = folder.setting
    expected = [(4, True, seed) for seed in setting.final_seeds(GOOD)]
    expected += [
        (step, False, seed) for index, step in enumerate((2, 4)) for seed in setting.interim_seeds(GOOD, index)
    ]
    assert [(row.step, row.is_final, row.episode_seed) for row in rows] == expected
    assert all(row.length == 200 or row.success for row in rows)
    dataset = folder.path / "demonstrations" / GOOD.task
    n_frames = json.loads((dataset / "meta" / "info.json").read_text())["total_frames"]
    assert {row.epoch for row in rows} == {round(step * 4 / n_frames, 2) for step in (2, 4)}


def test_a_result_says_how_it_was_made(finished):
    folder, _ = finished
    result = json.loads(folder.cell(GOOD).result.read_text())
    assert result["cell"] == GOOD._asdict()
    assert result["setting"] == folder.setting.as_values()
    assert result["versions"]["lerobot"] == "0.6.1"
    assert result["hardware"]["cores"] >= 1
    assert "expert" in result
    assert result["dtype"] == ("bfloat16" if has_bfloat16("cpu") else "float32")
    assert result["minutes"]["training"] > 0
    assert result["inference"]["median_ms"] > 0
    checkpoints = folder.cell(GOOD).training / "checkpoints"
    assert {path.name for path in checkpoints.iterdir()} == {"000004", "last"}


def test_progress_is_in_a_log_file(finished):
    folder, result = finished
    log = (folder.path / "progress.log").read_text()
    assert "2 of 2 cells to do, setting 'tiny'" in log
    assert "[2/2, 0:00 h left]" in log
    assert "finished: 1, failed: 1, being worked on by another process: 0" in log
    assert set(log.splitlines()) <= set(result.stdout.splitlines())


def test_rollouts_are_shown_when_asked_for(finished, tmp_path):
    """An episode of the rows is run again: it ends where they say, and its pictures are different ones."""
    folder, _ = finished
    row = Results.read([folder.path])[0].typical_episode(GOOD)
    strip = film(checkpoint(folder.cell(GOOD), 4), GOOD, row)
    assert (strip.cell, strip.episode_seed, strip.success) == (GOOD, row.episode_seed, row.success)
    assert list(strip.pictures) == np.linspace(0, row.length, 6).round().tolist()
    assert len({picture.tobytes() for picture in strip.pictures.values()}) == 6
    written = report([folder.path], tmp_path / "report", as_html=True, rollouts_of=[GOOD.task])
    assert "Table 1" in written
    assert (tmp_path / "report" / "rollouts.png").read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "report" / "report.html").read_text()
    assert "An evaluation episode of each policy" in page
    assert page.count("data:image/png;base64") == 6
    report([folder.path], tmp_path / "plain", as_html=False)
    assert not (tmp_path / "plain" / "rollouts.png").exists()
    with pytest.raises(UserError, match=r"No finished cell of metaworld/reach has its last checkpoint in"):
        report([folder.path], tmp_path / "other", as_html=False, rollouts_of=["metaworld/reach"])
    assert not (tmp_path / "other").exists()
    with pytest.raises(UserError, match="has its last checkpoint"):  # rows alone make no pictures
        report([tmp_path / "plain"], tmp_path / "other", as_html=False, rollouts_of=[GOOD.task])


def test_a_finished_cell_is_not_done_again(finished):
    folder, _ = finished
    files = folder.cell(GOOD)
    before = {path: path.stat().st_mtime_ns for path in files.path.rglob("*")}
    options = ["--tasks=drawer-close", "--policies=uca_flow", "--seeds=0", f"--setting={folder.path}/tiny.yaml"]
    result = benchmark(folder.path, *options)
    assert result.returncode == 0, result.stderr
    assert "0 of 1 cells to do" in result.stdout
    assert {path: path.stat().st_mtime_ns for path in files.path.rglob("*")} == before


def test_another_setting_is_refused(finished):
    folder, _ = finished
    result = benchmark(folder.path, "--tasks=drawer-close", "--setting=small")
    assert result.returncode == 1
    assert result.stderr.startswith(f"error: '{folder.path}' was made with another setting: batch_size was 4, now")


def test_adroit_needs_an_expert(tmp_path):
    result = benchmark(tmp_path / "run", "--tasks=adroit/door", "--seeds=0")
    assert result.stderr.startswith("error: Adroit has no expert built in. Give one with --expert=")


def start(folder: RunFolder, *options: str) -> subprocess.Popen[bytes]:
    command = [Path(sys.executable).with_name("lerobot-uca-benchmark"), "run", f"--output={folder.path}"]
    setting = f"--setting={folder.path}/tiny.yaml"
    return subprocess.Popen([*command, setting, "--tasks=drawer-close", *options], stdout=subprocess.DEVNULL)


def wait_for(condition) -> None:
    while not condition():
        time.sleep(0.05)


def test_a_run_that_is_killed_goes_on_inside_the_training(tmp_path):
    folder = with_demonstrations(make_run(tmp_path, lengths={"metaworld": {"steps": 300, "evaluations": 3}}))
    files = folder.cell(GOOD)
    killed = start(folder, "--seeds=0")
    checkpoints = files.training / "checkpoints"
    wait_for((checkpoints / "last").exists)
    killed.kill()
    killed.wait()
    wait_for(lambda: _is_free(files))  # its training dies with it
    step = int((checkpoints / "last").resolve().name)
    assert step < 300
    assert not files.rows.exists()
    result = benchmark(folder.path, f"--setting={folder.path}/tiny.yaml", "--tasks=drawer-close", "--seeds=0")
    assert result.returncode == 0, result.stdout + result.stderr
    first, second = (line for line in (files.path / "training.log").read_text().splitlines() if line[:1] == "$")
    assert "--resume" not in first
    assert "--resume=true" in second
    assert f"Training:   0%|          | 0/{300 - step}" in (files.path / "training.log").read_text()
    assert {path.name for path in files.rows.iterdir()} == {
        *("step_000100.csv", "step_000200.csv", "step_000300.csv", "final.csv")
    }


def _is_free(files) -> bool:
    with files.claim() as lock:
        return lock is not None
