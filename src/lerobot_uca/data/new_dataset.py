"""Where a new dataset goes."""

from pathlib import Path

from huggingface_hub.errors import HFValidationError
from huggingface_hub.utils import validate_repo_id
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_uca.errors import UserError

PARTS = {"data", "images", "meta", "videos", "README.md"}
"""What a LeRobot dataset's folder holds."""


def new_dataset_root(repo_id: str, root: Path | None, *, overwrite: bool) -> Path:
    """The folder of a new dataset.

    Args:
        repo_id: its name, 'user/name'.
        root: as the user wants it; by default where LeRobot looks for the name.
        overwrite: whether a dataset there may be replaced. Nothing else is: a slip in --root would cost trainings.

    Raises:
        UserError: for a name that is none, and for a folder that may not be replaced.
    """
    try:
        validate_repo_id(repo_id)
    except HFValidationError as error:
        raise UserError(f"repo_id must be 'user/name', got '{repo_id}'.") from error
    root = Path(root or HF_LEROBOT_HOME / repo_id).absolute()
    if overwrite and root.exists():
        _check_dataset(root)
    return root


def _check_dataset(root: Path) -> None:
    if not root.is_dir():
        raise UserError(f"--overwrite replaces datasets alone: '{root}' is a file. Choose another folder.")
    names = sorted(path.name for path in root.iterdir())
    if others := [name for name in names if name not in PARTS and not name.startswith(".")]:
        shown = ", ".join(others[:5]) + ", ..." * (len(others) > 5)
        raise UserError(
            f"--overwrite replaces datasets alone: '{root}' holds other things, {shown}. Choose another folder, or "
            "move them away."
        )
    if names and not (root / "meta" / "info.json").is_file():
        raise UserError(
            f"--overwrite replaces datasets alone: '{root}' is none, meta/info.json is missing. Choose another folder, "
            "or remove it yourself."
        )
