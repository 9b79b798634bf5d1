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

    The yielded path lies beside `path` and has its suffix. Until the block ends, what was there before stays; if the
    block raises, it stays for good, and what the block wrote is removed. The new file has the old one's permissions, a
    link stays one, and of several writers the last one's file is there, whole. What a killed one has left is removed by
    a later one, an hour after it was last written.

    Raises:
        OSError: if it cannot be written. Callers say what was to be written, and where it was asked for.
    """
    path = path.resolve()
    if path.exists() and not path.is_file():  # as root, replacing /dev/null would take it from the whole machine
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    unfinished = path.with_name(f".{path.stem}.unfinished-{uuid.uuid4().hex}{path.suffix}")
    _tidy_up(path)
    try:
        yield unfinished
        with unfinished.open("rb+") as file:
            os.fsync(file.fileno())  # or a power cut leaves the new name with nothing in it
        if path.exists():
            shutil.copymode(path, unfinished)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _tidy_up(path: Path) -> None:
    for left in path.parent.glob(f".{escape(path.stem)}.unfinished-*{escape(path.suffix)}"):
        with suppress(OSError):  # another writer has removed it
            if time.time() - left.stat().st_mtime > ABANDONED_AFTER:
                left.unlink()
