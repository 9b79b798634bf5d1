"""What LeRobot's commands show of this package in a terminal: one line for a user's mistake, no foreign noise."""

import logging
import sys
from types import TracebackType

from lerobot_uca.errors import UserError


def report_user_errors_in_one_line() -> None:
    """Let an uncaught `UserError` end the process with its message alone, and all other errors as before."""
    previous = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        if isinstance(error, UserError):
            print(f"error: {error}", file=sys.stderr)
        else:
            previous(kind, error, traceback)

    sys.excepthook = hook


def quiet_video_decoder() -> None:
    """Drop LeRobot's page-long warning that torchcodec found no FFmpeg and pyav decodes videos instead.

    It comes with every dataset, and point clouds need no video decoder at all.
    """
    logging.getLogger("lerobot.utils.import_utils").addFilter(
        lambda record: "'torchcodec' is installed but cannot be loaded" not in record.getMessage()
    )
