"""What LeRobot's commands show of this package in a terminal: one line for a user's mistake, no foreign noise."""

import errno
import logging
import sys
from types import TracebackType

from lerobot_uca.errors import UserError

# Files and folders that cannot be used. The message names them, and a traceback would add nothing.
USERS_FILE_ERRORS = {errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EROFS, errno.ENOSPC, errno.ENAMETOOLONG}


def report_errors_in_one_line() -> None:
    """Let what a user can mend end the process with its message alone, and all other errors as before."""
    previous = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        if isinstance(error, UserError) or (isinstance(error, OSError) and error.errno in USERS_FILE_ERRORS):
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
