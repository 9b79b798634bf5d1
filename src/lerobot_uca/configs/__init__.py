"""Training configurations, for `lerobot-train --config_path=NAME`; the repository's folder configs/ links here."""

from pathlib import Path

FOLDER = Path(__file__).parent
NAMES = tuple(sorted(path.stem for path in FOLDER.glob("*.yaml")))


def path_of(name: str) -> Path | None:
    """The file of a configuration of this package; None for other names, and for a configuration of the user's."""
    is_users = Path(name).is_file() or Path(name, "train_config.json").is_file()
    return FOLDER / f"{name}.yaml" if name in NAMES and not is_users else None
