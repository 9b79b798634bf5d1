"""Ctrl-C, SIGTERM and SIGHUP while a command works: one line, an exit code, no traceback, no process, nothing half."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml
from tests.builders import N_POINTS, write_dataset
from tests.protocol.test_run import TINY
from tests.trust.conftest import training_options

BIN = Path(sys.executable).parent
ENVIRONMENT = ("--env.type=metaworld_pointcloud", "--env.task=drawer-close", f"--env.n_points={N_POINTS}")
LINES = {
    signal.SIGINT: "interrupted",
    signal.SIGTERM: "ended by SIGTERM",
    signal.SIGHUP: "ended by SIGHUP",
}
HEEDS_SIGNALS = """
import os, signal, sys
for name in ("SIGINT", "SIGTERM", "SIGHUP"):
    signal.signal(getattr(signal, name), signal.SIG_DFL)
os.execv(sys.argv[1], sys.argv[1:])
"""
"""Runs a command; whoever runs these tests may ignore signals, as nohup does."""
LIMIT = 600
"""Seconds after which a command that has not begun its work, or not ended, hangs."""


class Case(NamedTuple):
    """A command's arguments, when it is at work, what it may leave in its folder, and the signal to try."""

    arguments: Callable[[Path, Path], list[object]]
    """Of the output folder and the training's folder."""
    is_working: Callable[[Path, str], bool]
    """Of the output folder and what was printed."""
    left: set[str]
    signal: signal.Signals


def benchmark(folder: Path, _: Path) -> list[object]:
    lengths = {"metaworld": {"steps": 100_000, "evaluations": 50_000}}
    (folder / "tiny.yaml").write_text(yaml.safe_dump({**TINY, "lengths": lengths}))
    write_dataset(folder / "run" / "demonstrations" / "metaworld" / "drawer-close")
    return ["run", f"--output={folder}/run", f"--setting={folder}/tiny.yaml", "--tasks=drawer-close", "--seeds=0"]


def convert(folder: Path, _: Path) -> list[object]:
    write_dataset(folder / "source", length=500)
    sampled = [f"--source={folder}/source", "--n_points=16", "--num_workers=2"]
    return [*sampled, "--repo_id=test/converted", f"--root={folder}/data"]


CASES = {
    "lerobot-uca-collect": Case(
        lambda folder, _: [*ENVIRONMENT, "--repo_id=test/data", f"--root={folder}/data", "--n_episodes=100"],
        lambda folder, _: any(folder.glob(".data.unfinished-*")),
        set(),
        signal.SIGHUP,
    ),
    "lerobot-uca-convert": Case(
        convert,
        lambda folder, _: any(folder.glob(".data.unfinished-*")),
        {"source"},
        signal.SIGTERM,
    ),
    "lerobot-train": Case(
        lambda folder, trained: [*training_options(trained.parent / "data", folder / "run"), "--steps=100000"],
        lambda folder, _: (folder / "run" / "checkpoints" / "last").exists(),
        {"run"},
        signal.SIGINT,
    ),
    "lerobot-eval": Case(
        lambda folder, trained: [
            f"--policy.path={trained}/checkpoints/last/pretrained_model",
            *(*ENVIRONMENT, "--eval.n_episodes=1000", "--eval.batch_size=2", f"--output_dir={folder}/evaluation"),
        ],
        lambda _, printed: "Running rollout" in printed,
        {"evaluation"},
        signal.SIGTERM,
    ),
    "lerobot-uca-benchmark": Case(
        benchmark,
        lambda folder, _: any(folder.glob("run/cells/*/*/*/*/training/checkpoints/last")),
        {"run", "tiny.yaml"},
        signal.SIGINT,
    ),
    "lerobot-uca-export": Case(
        lambda folder, trained: [trained / "checkpoints/last/pretrained_model", f"--output={folder}/policy.onnx"],
        lambda _, printed: "Loading weights" in printed,
        set(),
        signal.SIGTERM,
    ),
    "lerobot-uca-view": Case(
        lambda _, trained: [f"--source={trained.parent}/data", "--port=8765"],
        lambda _, printed: "Ctrl-C ends it" in printed,
        set(),
        signal.SIGHUP,
    ),
    "lerobot-uca-ur5e-sim": Case(
        lambda *_: ["--ip=127.9.8.7"],
        lambda _, printed: "Ctrl-C ends it" in printed,
        set(),
        signal.SIGTERM,
    ),
}


def wait_for(condition: Callable[[], bool], process: subprocess.Popen) -> None:
    end = time.monotonic() + LIMIT
    while not condition():
        assert process.poll() is None, "it ended before"
        assert time.monotonic() < end, "it has not begun"
        time.sleep(0.02)


def group_is_empty(group: int) -> bool:
    """Whether no process of a group lives."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.parametrize("program", CASES)
def test_a_command_ends_cleanly(program, trained, tmp_path):
    case = CASES[program]
    folder = tmp_path / "work"
    folder.mkdir()
    command = [sys.executable, "-c", HEEDS_SIGNALS, BIN / program, *case.arguments(folder, trained)]
    printed = tmp_path / "printed.txt"
    with printed.open("w") as file:
        options = {"cwd": folder, "start_new_session": True}
        process = subprocess.Popen(command, stdout=file, stderr=file, **options)
    try:
        wait_for(lambda: case.is_working(folder, printed.read_text()), process)
        if case.signal == signal.SIGINT:  # a terminal sends it to all of its processes
            os.killpg(process.pid, case.signal)
        else:
            process.send_signal(case.signal)
        process.wait(LIMIT)
        text = printed.read_text()
        assert process.returncode == 128 + case.signal, text
        assert "Traceback" not in text, text
        assert text.splitlines().count(LINES[case.signal]) == 1, text
        assert {path.name for path in folder.iterdir()} <= case.left
        end = time.monotonic() + LIMIT
        while not group_is_empty(process.pid):
            assert time.monotonic() < end, "a process is left"
            time.sleep(0.02)
    finally:
        if not group_is_empty(process.pid):
            os.killpg(process.pid, signal.SIGKILL)
