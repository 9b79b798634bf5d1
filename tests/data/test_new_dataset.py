"""What --overwrite may replace."""

import pytest
from lerobot.utils.constants import HF_LEROBOT_HOME
from tests.builders import write_dataset

from lerobot_uca.data.new_dataset import new_dataset_root
from lerobot_uca.errors import UserError


def test_a_dataset_may_be_replaced(tmp_path):
    write_dataset(tmp_path / "data", n_episodes=1)
    (tmp_path / "data" / ".cache").mkdir()
    (tmp_path / "data" / "README.md").touch()
    assert new_dataset_root("a/b", tmp_path / "data", overwrite=True) == tmp_path / "data"
    assert new_dataset_root("a/b", tmp_path / "new", overwrite=True) == tmp_path / "new"


def test_nothing_else_is(tmp_path):
    """A folder of datasets or of trainings, one step too high."""
    (tmp_path / "file").touch()
    (tmp_path / "folder" / "data").mkdir(parents=True)
    (tmp_path / "hidden" / ".git").mkdir(parents=True)
    write_dataset(tmp_path / "mixed", n_episodes=1)
    (tmp_path / "mixed" / "training").mkdir()
    reasons = {
        "file": "is a file",
        "folder": "is none, meta/info.json",
        "hidden": "is none, meta/info.json",
        "mixed": "holds other things, training",
    }
    for name, reason in reasons.items():
        with pytest.raises(UserError, match=f"^--overwrite replaces datasets alone: '.*/{name}' {reason}"):
            new_dataset_root("a/b", tmp_path / name, overwrite=True)


def test_the_name():
    assert new_dataset_root("a/b", None, overwrite=False) == HF_LEROBOT_HOME / "a" / "b"
    with pytest.raises(UserError, match="repo_id must be 'user/name', got 'a/b/c'"):
        new_dataset_root("a/b/c", None, overwrite=False)
