"""One training writes into an output folder at a time.

LeRobot refuses a folder that exists, which it does from the first checkpoint on; until then, and with --resume=true, a
second training replaces the checkpoints of the first.
"""

import atexit
import os
from contextlib import ExitStack
from pathlib import Path

from lerobot_uca.data.whole_folder import only_writer

_held = ExitStack()
_folders: set[Path] = set()
atexit.register(_held.close)


def keep_others_out(output_dir: Path) -> None:
    """Refuse other trainings into a folder until this process ends, however it ends.

    Raises:
        UserError: if another training is writing there.
    """
    folder = output_dir.absolute()
    if folder in _folders or os.environ.get("RANK", "0") != "0":  # the processes of a distributed training are one run
        return
    folder.parent.mkdir(parents=True, exist_ok=True)
    _held.enter_context(only_writer(folder))
    _folders.add(folder)
