"""Checkpoints are written whole or not at all, and `last` always names a whole one.

LeRobot writes a checkpoint under its final name, file by file, and removes the link `last` before it makes the new one.
"""

import logging
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

from lerobot.utils.constants import LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR, TRAINING_STATE_DIR
from safetensors import SafetensorError

from lerobot_uca.data.whole_folder import whole_folder
from lerobot_uca.errors import UserError

logger = logging.getLogger(__name__)


def save_whole(save: Callable[..., None]) -> Callable[..., None]:
    """LeRobot's `save_checkpoint`, beside the folder and then moved there.

    A folder that holds other things as well is a program's own, to which LeRobot adds its files as before.
    """

    def save_checkpoint(checkpoint_dir: Path, *args: Any, **kwargs: Any) -> None:
        if _holds_other_things(checkpoint_dir):
            save(checkpoint_dir, *args, **kwargs)
            return
        try:
            with whole_folder(checkpoint_dir, overwrite=True) as unfinished:
                save(unfinished, *args, **kwargs)
        except (UserError, SafetensorError) as error:  # a full disk, for the most part
            raise UserError(f"The checkpoint could not be written: {error} {_how_to_resume(checkpoint_dir)}") from error

    return save_checkpoint


def _holds_other_things(folder: Path) -> bool:
    own = (PRETRAINED_MODEL_DIR, TRAINING_STATE_DIR)
    return folder.is_dir() and any(path.name not in own for path in folder.iterdir())


def _how_to_resume(checkpoint_dir: Path) -> str:
    last = checkpoint_dir.with_name(LAST_CHECKPOINT_LINK)
    if not last.exists():
        return "There is none before it."
    config = last / PRETRAINED_MODEL_DIR / "train_config.json"
    return (
        f"The one before, {last.resolve().name}, is whole. When the reason is mended, go on from it: "
        f"lerobot-train --config_path={config} --resume=true"
    )


def update_last(_: Callable[[Path], Any]) -> Callable[[Path], None]:
    """LeRobot's `update_last_checkpoint`, in one step.

    In a copy that followed links `last` is a folder: a checkpoint, which is kept under another name.
    """

    def update_last_checkpoint(checkpoint_dir: Path) -> None:
        last = checkpoint_dir.with_name(LAST_CHECKPOINT_LINK)
        if last.is_dir() and not last.is_symlink():
            names = (last.with_name(f"{last.name}.copied-{number}") for number in count(1))
            copied = last.rename(next(name for name in names if not name.exists()))
            logger.warning("'%s' was a folder, not a link to one: it is '%s' now.", last, copied.name)
        new = checkpoint_dir.with_name(f".{LAST_CHECKPOINT_LINK}.new")
        new.unlink(missing_ok=True)
        new.symlink_to(checkpoint_dir.name)
        new.replace(last)

    return update_last_checkpoint
