import shutil
import subprocess
import sys
from pathlib import Path

import torch

from lerobot_uca.protocol import record


def git(folder: Path, *arguments: str) -> str:
    """The output of a git command, with an author of its own."""
    author = ["-c", "user.name=somebody", "-c", "user.email=somebody@example.com"]
    return subprocess.run(
        ["git", *author, *arguments], cwd=folder, check=True, capture_output=True, text=True
    ).stdout.strip()


def commit_of(file: Path) -> str:
    """What the module says in a place of its own."""
    code = f"import runpy; print(runpy.run_path({str(file)!r})['commit']())"
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.strip()


def test_a_package_inside_anothers_checkout_has_no_commit(tmp_path):
    """A virtual environment in a user's repository, ignored there."""
    git(tmp_path, "init", "--quiet")
    (tmp_path / ".gitignore").write_text(".venv\n")
    installed = tmp_path / ".venv" / "record.py"
    installed.parent.mkdir()
    shutil.copy(record.__file__, installed)
    git(tmp_path, "add", ".gitignore")
    git(tmp_path, "commit", "--quiet", "--message=theirs")
    assert commit_of(installed) == "None"


def test_a_checkout_has_its_commit(tmp_path):
    git(tmp_path, "init", "--quiet")
    file = tmp_path / "record.py"
    shutil.copy(record.__file__, file)
    git(tmp_path, "add", "record.py")
    git(tmp_path, "commit", "--quiet", "--message=ours")
    head = git(tmp_path, "rev-parse", "HEAD")
    assert commit_of(file) == head
    file.write_text(file.read_text() + "# changed\n")
    assert commit_of(file) == f"{head}-dirty"


def test_a_gpu_that_did_not_compute_is_no_hardware_of_a_result(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"the GPU {device}")
    assert record.provenance("cpu")["hardware"]["gpu"] is None
    assert record.provenance("cuda")["hardware"]["gpu"] == "the GPU cuda"
    assert record.columns("a command", "cuda")["cpu"].endswith(" cores, the GPU cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)  # a cell that another machine goes on with
    assert record.provenance("cuda")["hardware"]["gpu"] is None
