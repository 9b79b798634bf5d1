"""The clouds that a calibrated depth camera sees now."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from lerobot.cameras import CameraConfig, make_cameras_from_configs
from numpy.typing import NDArray

from lerobot_uca.errors import UserError, reported
from lerobot_uca.point_clouds.calibration import CalibrationError
from lerobot_uca.point_clouds.depth import DepthError, DepthToCloud
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.point_clouds.recipe import calibration_of, installed_calibrations
from lerobot_uca.robots.camera_check import check_cameras
from lerobot_uca.robots.realsense import connect


def live_clouds(
    config: CameraConfig, name: str, calibration: str | None, crop: Crop, n_points: int
) -> Iterator[NDArray[np.float32]]:
    """The newest points inside a crop, (up to n_points, 3) [m, base frame], again and again until it is closed.

    Args:
        config: of LeRobot's camera.
        name: by which it is calibrated.
        calibration: folder of calibrations; None for $LEROBOT_UCA_CALIBRATION.
        crop: what belongs to the cloud.
        n_points: at most.

    Raises:
        UserError: for a camera that gives no depth, is not calibrated, is another one or cannot be opened.
    """
    if not getattr(config, "use_depth", False):
        raise UserError(f"Camera '{name}' of type {config.type} must give depth: --camera.use_depth=true.")
    try:
        make = DepthToCloud([calibration_of(name, installed_calibrations(calibration)).view()], crop, n_points)
    except CalibrationError as error:
        raise UserError(str(error)) from error
    with reported(f"Camera '{name}' cannot be opened"):  # a RealSense is looked for by its name here
        camera: Any = make_cameras_from_configs({name: config})[name]
    connect(name, camera)
    try:
        check_cameras({name: camera})
        while True:
            yield make.points([camera.read_latest_depth()], n_points)
    except (DepthError, ConnectionError, TimeoutError, RuntimeError) as error:  # the last of a thread that has ended
        raise UserError(f"Camera '{name}' gives no cloud: {error}") from error
    finally:
        camera.disconnect()
