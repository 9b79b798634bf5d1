"""Writing a file whole or not at all."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Write a file that appears under its name when it is complete and on the disk, and only then.

        with whole_file(Path("report.txt")) as unfinished:
            unfinished.write_text(report)

    The yielded path lies beside `path` and has its suffix. Until the block ends, what was there before stays; if the
    block raises, it stays for good, and what the block wrote is removed.

    Raises:
        OSError: if it cannot be written. Callers say what was to be written, and where it was asked for.
    """
    if path.exists() and not path.is_file():  # as root, replacing /dev/null would take it from the whole machine
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    unfinished = path.with_name(f".{path.stem}.unfinished{path.suffix}")
    try:
        yield unfinished
        with unfinished.open("rb+") as file:
            os.fsync(file.fileno())  # or a power cut leaves the new name with nothing in it
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
