"""Writing a file whole or not at all."""

import errno
import os
import shutil
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path

ABANDONED_AFTER = 3600.0  # [s]


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Write a file that appears under its name when it is complete and on the disk, and only then.

        with whole_file(Path("report.txt")) as unfinished:
            unfinished.write_text(report)

    The yielded path lies beside the file and has the suffix of `path`, which may be a link to it and stays one. Until
    the block ends, what was there before stays; if the block raises, it stays for good, and what the block wrote is
    removed. The new file has the old one's permissions. Of several writers the last one's file is there, whole. What a
    killed one has left, under a hidden name, is removed by a later one, an hour after it was last written.

    Raises:
        OSError: if it cannot be written. Callers say what was to be written, and where it was asked for.
    """
    if path.exists() and not path.is_file():  # as root, replacing /dev/null would take it from the whole machine
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    file = Path(os.path.realpath(path))
    _tidy_up(file, path.suffix)
    unfinished = file.with_name(f".{file.stem}.unfinished-{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        yield unfinished
        with unfinished.open("rb+") as written:
            os.fsync(written.fileno())  # or a power cut leaves the new name with nothing in it
        if file.exists():
            with suppress(OSError):  # some disks have no permissions
                shutil.copymode(file, unfinished)
        unfinished.replace(file)
    finally:
        unfinished.unlink(missing_ok=True)


def _tidy_up(file: Path, suffix: str) -> None:
    for left in file.parent.glob(f".{escape(file.stem)}.unfinished-*{escape(suffix)}"):
        with suppress(OSError):  # another writer has removed it
            if time.time() - left.stat().st_mtime > ABANDONED_AFTER:
                left.unlink()
