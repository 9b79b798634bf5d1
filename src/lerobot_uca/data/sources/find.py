"""The source of a path."""

from pathlib import Path

from lerobot_uca.data.sources.file_sources import FolderSource, ZarrSource
from lerobot_uca.data.sources.lerobot_source import LeRobotSource
from lerobot_uca.data.sources.source import Source
from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.geometry import Crop


def find_source(path: Path, crop: Crop | None, task: str, *, colour: bool = False) -> Source:
    """The source of a path, by what lies in it.

    Raises:
        UserError: if its kind is unknown.
    """
    if (path / "meta" / "info.json").is_file():
        return LeRobotSource(path, crop, colour)
    if (path / ".zgroup").is_file() or (path / "zarr.json").is_file() or path.suffix == ".zarr":
        return ZarrSource(path, crop, task, colour)
    if (path / "frames.csv").is_file():
        return FolderSource(path, crop, task, colour)
    raise UserError(
        f"'{path}' must be a LeRobot dataset (meta/info.json), a zarr of DP3's layout, or a folder with a frames.csv."
    )
