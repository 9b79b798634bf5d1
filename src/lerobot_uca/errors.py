"""The kind of error that a user can mend."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from textwrap import shorten

logger = logging.getLogger(__name__)


class UserError(ValueError):
    """Something the user gave is wrong. The message says the rule, what was got and what is valid, in one line.

    Configurations do not raise it while they are made but when LeRobot asks them for something: draccus, which makes
    them from a command line, would swallow the message.
    """


@contextmanager
def reported(what: str) -> Iterator[None]:
    """Report whatever a library raises for a damaged or hostile file as a `UserError`: 'what: the reason'."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        logger.debug("Reported in one line:", exc_info=True)
        reason = shorten(" ".join(str(error).split()), 300) or "the file is damaged"
        raise UserError(f"{what}: {type(error).__name__}: {reason}") from error
