"""A folder is written whole or not at all, and by one process at a time."""

import multiprocessing
import os
import re
import signal
from pathlib import Path

import pytest

from lerobot_uca.data.whole_folder import whole_folder
from lerobot_uca.errors import UserError


def write(folder: Path, text: str = "whole", **options: bool) -> None:
    with whole_folder(folder, **options) as unfinished:
        unfinished.mkdir()
        (unfinished / "file").write_text(text)


def fail_while_writing(folder: Path, **options: bool) -> None:
    with whole_folder(folder, **options) as unfinished:
        unfinished.mkdir()
        raise ZeroDivisionError


def write_nothing(folder: Path, **options: bool) -> None:
    with whole_folder(folder, **options):
        pass


def content(folder: Path) -> list[str]:
    """The listing of its parent, hidden files too, and the text in it."""
    return [*sorted(path.name for path in folder.parent.iterdir()), (folder / "file").read_text()]


def test_it_appears_when_it_is_complete(tmp_path):
    folder = tmp_path / "parent" / "data"
    with whole_folder(folder) as unfinished:
        assert not folder.exists()
        assert not unfinished.exists()
        unfinished.mkdir()
        (unfinished / "file").write_text("whole")
        assert not folder.exists()
    assert content(folder) == ["data", "whole"]


def test_an_error_leaves_nothing(tmp_path):
    with pytest.raises(ZeroDivisionError):
        fail_while_writing(tmp_path / "data")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_stays_unless_overwritten(tmp_path):
    folder = tmp_path / "data"
    write(folder, "old")
    with pytest.raises(UserError, match=re.escape(f"'{folder}' exists. Choose another folder, or replace it")):
        write(folder, "new")
    with pytest.raises(ZeroDivisionError):
        fail_while_writing(folder, overwrite=True)
    assert content(folder) == ["data", "old"]
    write(folder, "new", overwrite=True)
    assert content(folder) == ["data", "new"]


def test_an_overwrite_that_cannot_finish_brings_the_old_folder_back(tmp_path):
    folder = tmp_path / "data"
    write(folder, "old")
    with pytest.raises(UserError, match="Cannot write"):
        write_nothing(folder, overwrite=True)
    assert content(folder) == ["data", "old"]


def test_what_others_have_made_meanwhile_stays(tmp_path):
    folder = tmp_path / "data"

    def write_beside(**options):
        with whole_folder(folder, **options) as unfinished:
            unfinished.mkdir()
            folder.mkdir()
            (folder / "file").write_text("theirs")

    with pytest.raises(UserError, match=f"'{folder}' exists"):
        write_beside()
    assert content(folder) == ["data", "theirs"]


def test_a_link_to_another_disk_stays_one(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "parent").mkdir()
    link = tmp_path / "parent" / "data"
    link.symlink_to(tmp_path / "disk" / "data")
    write(link, "first")
    for text in ("second", "third"):
        write(link, text, overwrite=True)
        assert link.is_symlink()
        assert content(link) == ["data", text]
        assert content(tmp_path / "disk" / "data") == ["data", text]


def test_a_second_run_is_refused(tmp_path):
    folder = tmp_path / "data"
    with whole_folder(folder) as unfinished:
        unfinished.mkdir()
        (unfinished / "file").write_text("first")
        with pytest.raises(UserError, match=re.escape(f"Another run is writing '{folder}'.")):
            write(folder, "second", overwrite=True)
    assert content(folder) == ["data", "first"]
    write(tmp_path / "other")  # other folders of the same parent are free


def die_while_writing(folder: Path, moment: str) -> None:
    """Die at 'write', or at an overwrite's worst moment: the old folder has moved away, the new is not there yet."""
    rename = Path.rename

    def rename_then_die(self: Path, target: Path) -> Path:
        renamed = rename(self, target)
        if moment == "rename":
            os.kill(os.getpid(), signal.SIGKILL)
        return renamed

    Path.rename = rename_then_die
    with whole_folder(folder, overwrite=True) as unfinished:
        unfinished.mkdir()
        (unfinished / "file").write_text("new")
        if moment == "write":
            os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("moment", ["write", "rename"])
def test_what_a_killed_run_has_left_is_tidied_up_by_the_next(tmp_path, moment):
    folder = tmp_path / "data"
    write(folder, "old")
    process = multiprocessing.get_context("spawn").Process(target=die_while_writing, args=(folder, moment))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) > 1
    assert folder.exists() == (moment == "write")
    if not folder.exists():
        with pytest.raises(UserError, match=f"'{folder}' exists"):
            write(folder)  # it brings the old one back, before it looks
    assert (folder / "file").read_text() == "old"
    write(folder, "next", overwrite=True)
    assert content(folder) == ["data", "next"]


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="Cannot write"):
        write(tmp_path / "file" / "data")
    with pytest.raises(UserError, match="Cannot write"):
        write(tmp_path / ("x" * 300))
