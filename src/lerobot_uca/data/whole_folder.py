"""Writing a folder whole or not at all, by one process at a time."""

import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from tempfile import TemporaryDirectory

from filelock import FileLock, Timeout

from lerobot_uca.errors import UserError

logger = logging.getLogger(__name__)


@contextmanager
def whole_folder(folder: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Write a folder that appears under its name when it is complete, and only then.

        with whole_folder(Path("data/door")) as unfinished:
            write_everything_into(unfinished)

    The yielded path does not exist yet; it lies in a hidden folder beside `folder` and is moved there when the block
    ends. If the block raises, it is removed. The next run removes the remains of a killed one.

    Args:
        folder: to write. Its parents are made if need be.
        overwrite: replace it if it exists. The old one stays until the new one is complete.

    Raises:
        UserError: if the folder exists, another process is writing it, or it cannot be written.
    """
    folder = folder.resolve()  # a link to another disk stays one
    try:
        _check_absent(folder, overwrite)
        folder.parent.mkdir(parents=True, exist_ok=True)
        with only_writer(folder):
            _tidy_up(folder)
            _check_absent(folder, overwrite)  # another run may have just finished
            prefix = f".{folder.name}.unfinished-"
            with TemporaryDirectory(prefix=prefix, dir=folder.parent, ignore_cleanup_errors=True) as unfinished:
                new = Path(unfinished, folder.name)
                yield new
                _check_absent(folder, overwrite)  # others, who know no lock, may have made it meanwhile
                _replace(folder, new)
    except OSError as error:
        raise UserError(f"Cannot write '{folder}': {error}") from error


def _check_absent(folder: Path, overwrite: bool) -> None:
    if folder.exists() and not overwrite:
        raise UserError(f"'{folder}' exists. Choose another folder, or replace it with --overwrite.")


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Hold the folder's lock, which the system takes back when the process ends, however that is.

    Raises:
        UserError: if another process holds it.
    """
    lock = FileLock(folder.with_name(f".{folder.name}.lock"), blocking=False)
    try:
        lock.acquire()
    except Timeout as error:
        raise UserError(
            f"Another run is writing '{folder}'. Wait until it has ended, or choose another folder."
        ) from error
    try:
        yield
    finally:
        with suppress(OSError):  # Windows does not remove what is open
            Path(lock.lock_file).unlink()  # still held: who waits for it sees that it is gone, and makes another
        lock.release()


def _backup(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.replaced")


def _tidy_up(folder: Path) -> None:
    """Remove what a killed run has left, and bring back what it was about to replace."""
    for left in folder.parent.glob(f".{escape(folder.name)}.unfinished-*"):
        _remove(left)
    backup = _backup(folder)
    if backup.exists() and not folder.exists():
        backup.rename(folder)
        logger.warning("A run was ended while it replaced '%s': the folder from before is back.", folder)
    _remove(backup)


def _replace(folder: Path, new: Path) -> None:
    if not folder.exists():
        new.rename(folder)
        return
    backup = _backup(folder)
    folder.rename(backup)
    try:
        new.rename(folder)
    except OSError:
        backup.rename(folder)
        raise
    _remove(backup)


def _remove(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
