"""A page in the browser that shows a cloud and chooses its crop."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.calibration import CalibrationError
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.point_clouds.recipe import make_crop
from lerobot_uca.whole_file import whole_file

INSIDE, OUTSIDE = (33, 102, 172), (200, 200, 200)
POINTS_ACROSS = 250
"""Points that would fit side by side along the diagonal of all that is shown; decides how large they are."""


class CropPage:
    """A page on this machine: a cloud, a slider for each face of the crop, and a button that writes the crop.

    Args:
        port: of the page.
        config: training configuration that the button writes to.
        crop: to begin with.
        points: all that will be shown, (M, 3) [m] or more channels; the sliders reach as far, and as far as the crop.

    Raises:
        UserError: if viser is not installed.
    """

    def __init__(self, port: int, config: Path, crop: Crop, points: NDArray[np.float32]) -> None:
        try:
            import viser
        except ImportError as error:
            raise UserError("The page needs viser: pip install 'lerobot_policy_uca_flow[view]'.") from error
        self.server: Any = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
        self._config, self._points = config, points[:0]
        seen = np.concatenate([points[:, :3], [crop.low, crop.high]])
        low, high = np.floor(100 * seen.min(axis=0)) / 100, np.ceil(100 * seen.max(axis=0)) / 100
        centre, diagonal = (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.01)
        self._point_size = diagonal / POINTS_ACROSS
        self.server.initial_camera.look_at = centre
        self.server.initial_camera.position = centre + diagonal * np.array([-0.5, -0.5, 0.5])
        gui = self.server.gui
        self._sliders = [
            gui.add_slider(
                f"{side} {'xyz'[axis]} [m]",
                min=float(low[axis]),
                max=float(high[axis]),
                step=0.001,
                initial_value=float(corner[axis]),
            )
            for side, corner in (("lowest", crop.low), ("highest", crop.high))
            for axis in range(3)
        ]
        button = gui.add_button(f"write the crop to {config}")
        self._status = gui.add_markdown("")
        for slider in self._sliders:
            slider.on_update(lambda _: self.show(self._points))
        button.on_click(lambda _: self.write())

    @property
    def crop(self) -> Crop:
        """The crop that the sliders say, which may be none: the lowest above the highest."""
        x, y, z, x_high, y_high, z_high = (round(float(slider.value), 3) for slider in self._sliders)
        return Crop((x, y, z), (x_high, y_high, z_high))

    def show(self, points: NDArray[np.float32]) -> None:
        """Show a cloud, (M, 3) [m] or with colours (M, 6)."""
        self._points, crop = points, self.crop
        xyz = points[:, :3]
        self.server.scene.add_point_cloud("/cloud", xyz, colours_of(points, crop), point_size=self._point_size)
        self._status.content = f"{int(crop.contains(xyz).sum())} of {len(points)} points are inside the crop"

    def write(self) -> None:
        """Write the crop to the configuration, and say so, or why not, on the page."""
        try:
            before = write_crop(self._config, make_crop(self.crop.low, self.crop.high))
        except (UserError, CalibrationError) as error:
            self._status.content = str(error)
        else:
            kept = f"; as it was, with its comments, it is {before} now" if before else ""
            self._status.content = f"written to {self._config}{kept}"


def colours_of(points: NDArray[np.float32], crop: Crop) -> NDArray[np.uint8]:
    """RGB of points (M, 3) or (M, 6), (M, 3): blue or their own inside the crop, grey outside.

    Colours above 1 are taken as 0 to 255, others as 0 to 1.
    """
    own = points[:, 3:6]
    inside = own * (1 if own.max(initial=0) > 1 else 255) if own.shape[1] else np.array(INSIDE)
    return np.where(crop.contains(points[:, :3])[:, None], inside, OUTSIDE).clip(0, 255).astype(np.uint8)


def write_crop(file: Path, crop: Crop) -> Path | None:
    """Write a crop as policy.depth of a training configuration; what else is in the file is kept, but for comments.

    Returns:
        The file as it was, under another name, if it had comments.

    Raises:
        UserError: if the file is not YAML, holds something else or cannot be written.
    """
    if file.suffix not in (".yaml", ".yml"):
        raise UserError(f"The crop is written into a YAML file, such as crop.yaml, got '{file}'.")
    try:
        text = file.read_text(encoding="utf-8") if file.exists() else ""
        settings = yaml.safe_load(text)
    except (OSError, UnicodeError, yaml.YAMLError) as error:
        raise UserError(f"'{file}' cannot be read: {' '.join(str(error).split())}") from error
    has_comments = "#" in text and yaml.safe_dump(settings, sort_keys=False) != text
    settings = _options(settings, f"'{file}'")
    policy = settings["policy"] = _options(settings.get("policy"), f"policy in '{file}'")
    depth = policy["depth"] = _options(policy.get("depth"), f"policy.depth in '{file}'")
    depth["crop_low"], depth["crop_high"] = list(crop.low), list(crop.high)
    before = file.with_name(f"{file.name}.old") if has_comments else None
    try:
        for target, content in ((before, text), (file, yaml.safe_dump(settings, sort_keys=False))):
            if target is not None:
                with whole_file(target) as unfinished:
                    unfinished.write_text(content, encoding="utf-8")
    except OSError as error:
        raise UserError(f"Cannot write '{file}': {error}") from error
    return before


def _options(values: Any, what: str) -> dict[str, Any]:
    """Options by name, none where nothing stands."""
    if not isinstance(values, dict | None):
        raise UserError(f"{what} must hold options of a training by name, got {type(values).__name__}.")
    return values or {}
