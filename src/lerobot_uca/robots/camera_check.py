"""Are the robot's cameras those that were calibrated?"""

import logging
from collections.abc import Mapping
from typing import Any

from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.calibration import Calibration, CalibrationError
from lerobot_uca.point_clouds.recipe import CALIBRATION_VARIABLE, installed_calibrations
from lerobot_uca.robots.depth_device import DepthDevice, depth_device

FOCAL_TOLERANCE = 0.02
"""A focal length's largest difference from the calibrated one: boards find it within 1 %, other streams and image sizes
of the same device differ by more."""
CENTRE_TOLERANCE = 0.02  # of the image's width: a principal point's largest difference
UNIT_TOLERANCE = 0.001

logger = logging.getLogger(__name__)


def check_cameras(cameras: Mapping[str, Any]) -> None:
    """Compare connected cameras with the installation's calibrations, where $LEROBOT_UCA_CALIBRATION names some.

    A depth camera without a calibration is said, with the intrinsics that `lerobot-uca-calibrate` asks for.

    Raises:
        UserError: for a calibrated camera that gives no depth, is another device or has another image size, other
            intrinsics or another unit than its calibration; for calibrations that cannot be right.
    """
    try:
        installed = installed_calibrations() or {}
    except CalibrationError as error:
        raise UserError(str(error)) from error
    for name, camera in cameras.items():
        has_depth = getattr(camera, "use_depth", False)
        if name in installed and not has_depth:
            raise UserError(
                f"Camera '{name}' is calibrated and gives no depth: give it use_depth: true, or let "
                f"{CALIBRATION_VARIABLE} name a folder without it."
            )
        if has_depth:
            device = depth_device(camera)
            if device is not None and device.is_distorted:
                logger.warning("Camera '%s' bends straight lines; clouds do not correct that.", name)
            if name in installed:
                _check_serial_and_size(name, camera, installed[name])
                if device is not None:
                    _check_device(name, device, installed[name])
            elif device is not None:
                logger.info("Camera '%s' has no calibration; it says: %s", name, device.options())


def _check_serial_and_size(name: str, camera: Any, calibration: Calibration) -> None:
    serial = str(getattr(camera, "serial_number", "") or "")
    if serial and calibration.serial and serial != calibration.serial:
        raise UserError(
            f"Camera '{name}' is the device {serial}, its calibration is of {calibration.serial}: calibrate it, or "
            f"let {CALIBRATION_VARIABLE} name its own."
        )
    size, calibrated = (camera.width, camera.height), (calibration.camera.width, calibration.camera.height)
    if size != calibrated:
        raise UserError(
            f"Camera '{name}' gives images of {size[0]} x {size[1]}, its calibration is for {calibrated[0]} x "
            f"{calibrated[1]}: record with that size, or calibrate this one."
        )


def _check_device(name: str, device: DepthDevice, calibration: Calibration) -> None:
    """Compare what the device says of its depth stream, after the camera's rotation."""
    camera = calibration.camera
    differences = {
        "focal length": max(abs(device.fx / camera.fx - 1), abs(device.fy / camera.fy - 1)) / FOCAL_TOLERANCE,
        "principal point": max(abs(device.cx - camera.cx), abs(device.cy - camera.cy))
        / (CENTRE_TOLERANCE * camera.width),
        "unit of depth": abs(device.depth_unit / calibration.depth_unit - 1) / UNIT_TOLERANCE,
    }
    if wrong := [what for what, difference in differences.items() if difference > 1]:
        raise UserError(
            f"Camera '{name}' has another {' and '.join(wrong)} than its calibration: the device says "
            f"{device.options()}, the calibration {_options(calibration)}. Another rotation or stream? Calibrate it "
            "with the device's."
        )


def _options(calibration: Calibration) -> str:
    camera = calibration.camera
    return DepthDevice(
        calibration.serial,
        *(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy),
        depth_unit=calibration.depth_unit,
    ).options()
