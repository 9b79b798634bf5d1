"""Training configurations, for `lerobot-train --config_path=NAME`; the repository's folder configs/ links here."""

from pathlib import Path

FOLDER = Path(__file__).parent
NAMES = tuple(sorted(path.stem for path in FOLDER.glob("*.yaml")))


def path_of(name: str) -> Path | None:
    """The file of a configuration of this package; None for other names, and where a file or folder is called so."""
    return FOLDER / f"{name}.yaml" if name in NAMES and not Path(name).exists() else None
