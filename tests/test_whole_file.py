"""A file is written whole or not at all."""

import multiprocessing
import os
import signal
import stat
from pathlib import Path

import pytest

from lerobot_uca.whole_file import whole_file


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "report.txt"
    path.write_text("old")
    return path


def killed_while_writing(file: Path) -> None:
    with whole_file(file) as unfinished:
        unfinished.write_text("half of the n")
        os.kill(os.getpid(), signal.SIGKILL)


def test_what_was_there_stays_until_the_new_file_is_complete(file):
    with whole_file(file) as unfinished:
        unfinished.write_text("new")
        assert (file.read_text(), unfinished.suffix) == ("old", ".txt")
    assert file.read_text() == "new"
    assert list(file.parent.iterdir()) == [file]


def fail_while_writing(file: Path) -> None:
    with whole_file(file) as unfinished:
        unfinished.write_text("half of the n")
        raise ZeroDivisionError


def test_a_failure_leaves_what_was_there_and_nothing_else(file):
    with pytest.raises(ZeroDivisionError):
        fail_while_writing(file)
    assert file.read_text() == "old"
    assert list(file.parent.iterdir()) == [file]


def test_a_kill_leaves_what_was_there_and_a_later_writer_tidies_up(file):
    process = multiprocessing.get_context("spawn").Process(target=killed_while_writing, args=(file,))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert file.read_text() == "old"
    with whole_file(file) as unfinished:
        unfinished.write_text("new")
    assert file.read_text() == "new"
    (left,) = set(file.parent.iterdir()) - {file}  # somebody could still be writing it
    os.utime(left, (0, 0))
    with whole_file(file) as unfinished:
        unfinished.write_text("newer")
    assert list(file.parent.iterdir()) == [file]


def test_of_two_writers_the_last_ones_file_is_there_whole(file):
    with whole_file(file) as first:
        first.write_text("first, whole")
        with whole_file(file) as second:
            second.write_text("sec")
            second.write_text("second, whole")
        assert file.read_text() == "second, whole"
    assert file.read_text() == "first, whole"
    assert list(file.parent.iterdir()) == [file]


def test_a_link_stays_one_and_permissions_stay(file):
    file.chmod(0o640)
    link = file.with_name("link.txt")
    link.symlink_to(file.name)
    with whole_file(link) as unfinished:
        unfinished.write_text("new")
    assert (link.readlink(), file.read_text()) == (Path(file.name), "new")
    assert stat.S_IMODE(file.stat().st_mode) == 0o640


def test_a_link_gives_its_suffix_to_a_file_without_one(tmp_path):
    """As in the Hub's cache, whose files are named by their contents."""
    link = tmp_path / "picture.png"
    link.symlink_to("3f2a")
    with whole_file(link) as unfinished:
        assert unfinished.suffix == ".png"
        unfinished.write_text("new")
    assert (tmp_path / "3f2a").read_text() == "new"


def test_a_link_to_itself_is_replaced(tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    with whole_file(tmp_path / "loop") as unfinished:
        unfinished.write_text("new")
    assert (tmp_path / "loop").read_text() == "new"


def test_a_block_that_writes_nothing_is_an_error(file):
    with pytest.raises(FileNotFoundError), whole_file(file):
        pass
    assert file.read_text() == "old"


def test_what_is_no_file_is_not_replaced(tmp_path):
    """Root could replace /dev/null so; here a pipe stands for it."""
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path):
        kind = stat.S_IFMT(path.stat().st_mode)
        with pytest.raises(OSError, match="not a regular file"), whole_file(path) as unfinished:
            unfinished.write_text("new")
        assert stat.S_IFMT(path.stat().st_mode) == kind


def test_a_folder_that_is_not_there_is_an_error_of_the_system(tmp_path):
    with pytest.raises(OSError, match="no_folder"), whole_file(tmp_path / "no_folder" / "file") as unfinished:
        unfinished.write_text("new")
