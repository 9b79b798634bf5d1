"""Recordings for Rerun."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot_uca.errors import UserError
from lerobot_uca.whole_file import whole_file


@contextmanager
def rerun_file(path: Path, name: str) -> Iterator[tuple[Any, Any]]:
    """The module `rerun` and a `RecordingStream` that becomes a file when the block ends, whole or not at all.

    Until then it is kept in memory: Rerun's own writing to a file neither reports a full disk nor always ends on one.

    Args:
        path: ends in .rrd.
        name: the application's, in Rerun's viewer.

    Raises:
        UserError: if Rerun is not installed, or the file cannot be written.
    """
    try:
        import rerun
    except ImportError as error:
        raise UserError("Recordings need rerun-sdk: pip install 'lerobot_policy_uca_flow[rerun]'.") from error
    recording = rerun.RecordingStream(name)
    memory = recording.memory_recording()
    yield rerun, recording
    try:
        with whole_file(path) as unfinished:
            unfinished.write_bytes(memory.drain_as_bytes())
    except OSError as error:
        raise UserError(f"Cannot write '{path}': {error}") from error
