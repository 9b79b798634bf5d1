"""Are the robot's cameras those that were calibrated?"""

from collections.abc import Mapping
from typing import Any

from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.calibration import CalibrationError
from lerobot_uca.point_clouds.recipe import installed_calibrations


def check_cameras(cameras: Mapping[str, Any]) -> None:
    """Compare connected depth cameras with the installation's calibrations, where $LEROBOT_UCA_CALIBRATION names some.

    Raises:
        UserError: for another device or another image size than the calibration of the camera's name was made with.
    """
    try:
        installed = installed_calibrations() or {}
    except CalibrationError as error:
        raise UserError(str(error)) from error
    for name, camera in cameras.items():
        if name not in installed or not getattr(camera, "use_depth", False):
            continue
        calibration = installed[name]
        serial = str(getattr(camera, "serial_number", "") or "")
        if serial and calibration.serial and serial != calibration.serial:
            raise UserError(
                f"Camera '{name}' is the device {serial}, its calibration is of {calibration.serial}: calibrate it, or "
                "let LEROBOT_UCA_CALIBRATION name its own."
            )
        size, calibrated = (camera.width, camera.height), (calibration.camera.width, calibration.camera.height)
        if size != calibrated:
            raise UserError(
                f"Camera '{name}' gives images of {size[0]} x {size[1]}, its calibration is for {calibrated[0]} x "
                f"{calibrated[1]}: record with that size, or calibrate this one."
            )
