"""Errors and warnings in one line."""

import functools
import logging
import sys
from pathlib import Path
from types import TracebackType

from draccus.utils import DraccusException

from lerobot_uca.errors import UserError


def is_command() -> bool:
    """Whether this process is one of LeRobot's commands or of this package's, not somebody's own program."""
    return Path(sys.argv[0]).stem.startswith("lerobot")


def report_user_errors() -> None:
    """A `UserError` ends the process with its message in one line, also when draccus or LeRobot has wrapped it.

    Python prints a traceback for it, and for what somebody's own program has made of it.
    """
    previous = sys.excepthook
    if getattr(previous, "_reports_user_errors", False):
        return

    @functools.wraps(previous)  # with what it says of itself
    def hook(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, UserError):
            cause = cause.__cause__ if is_command() or isinstance(cause, DraccusException) else None
        if cause is not None:
            print(f"error: {cause}", file=sys.stderr)
        else:
            previous(kind, error, traceback)

    hook._reports_user_errors = True  # type: ignore[attr-defined]
    sys.excepthook = hook


class _DecoderWarning(logging.Filter):
    """One line, once, instead of a page with every dataset."""

    def __init__(self) -> None:
        super().__init__()
        self._said = False

    def filter(self, record: logging.LogRecord) -> bool:
        if "'torchcodec' is installed but cannot be loaded" not in record.getMessage():
            return True
        record.msg, record.args = "torchcodec cannot be loaded (no FFmpeg?): pyav decodes videos, if there are any.", ()
        first, self._said = not self._said, True
        return first


def shorten_decoder_warning() -> None:
    """Without FFmpeg, LeRobot prints a page of torchcodec's traceback for each dataset."""
    target = logging.getLogger("lerobot.utils.import_utils")
    if not any(isinstance(each, _DecoderWarning) for each in target.filters):
        target.addFilter(_DecoderWarning())
