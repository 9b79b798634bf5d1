"""The release of LeRobot that this package is made for. It imports nothing that another release may lack."""

import logging
from collections.abc import Sequence

import lerobot
from packaging.version import Version

SUPPORTED_LEROBOT = "0.6.1"

logger = logging.getLogger(__name__)


def is_supported() -> bool:
    """Whether the installed LeRobot is that release."""
    return lerobot.__version__ == SUPPORTED_LEROBOT


def warn_of_another(missing_parts: Sequence[str]) -> None:
    """Say in one line that LeRobot is too old or too new, what does not work, and how to mend it."""
    age = "old" if Version(lerobot.__version__) < Version(SUPPORTED_LEROBOT) else "new"
    missing = f"Not available: {', '.join(missing_parts)}. " if missing_parts else ""
    logger.warning(
        "LeRobot %s is too %s: this package is made for %s. %sCheckpoints are not written whole, resuming does not "
        "repeat an unbroken run, and reading is slow. To mend it: pip install lerobot==%s",
        *(lerobot.__version__, age, SUPPORTED_LEROBOT, missing, SUPPORTED_LEROBOT),
    )
