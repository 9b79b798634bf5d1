"""RealSense cameras: registered where librealsense loads, and a line about those that it no longer knows."""

import importlib
import importlib.metadata
import logging
from pathlib import Path
from typing import Any

from lerobot_uca.errors import UserError

USB_DEVICES = Path("/sys/bus/usb/devices")
INTEL = "8086"
L515_PRODUCTS = ("0b0d", "0b3d", "0b64")
"""USB product numbers of the L500 family, of which the L515 was sold."""
DROPPED_BY = "2.55.1"
"""The first release of librealsense without the L500 family, and the one that LeRobot needs."""

logger = logging.getLogger(__name__)


def register() -> None:
    """Let LeRobot register --camera.type=intelrealsense, or say what keeps librealsense from loading.

    Its wheel does not bring a library of the system that it needs. LeRobot's own commands for robots import it as soon
    as it is installed, before any plugin, and end in Python's error.
    """
    try:
        importlib.import_module("lerobot.cameras.realsense")
    except ImportError as error:
        logger.warning(
            "RealSense cameras cannot be used, since librealsense does not load: %s. On Debian: "
            "apt install libusb-1.0-0",
            error,
        )


def connect(name: str, camera: Any) -> None:
    """Connect a LeRobot camera.

    Raises:
        UserError: if it fails; it says so where an L515 is plugged in, which the installed librealsense does not know.
    """
    try:
        camera.connect()
    except (OSError, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        hint = dropped_camera(USB_DEVICES)
        raise UserError(f"Camera '{name}' cannot be opened: {reason}.{f' {hint}' if hint else ''}") from error


def dropped_camera(devices: Path) -> str | None:
    """A line about an L515 among the USB devices that Linux lists in a folder; None if there is none."""
    for product in devices.glob("*/idProduct"):
        vendor = product.with_name("idVendor")
        if product.read_text().strip() in L515_PRODUCTS and vendor.read_text().strip() == INTEL:
            return (
                f"An L515 is plugged in: librealsense {DROPPED_BY} and newer dropped it, installed is {_installed()}. "
                "Use a D435 or D455; for the L515 build librealsense 2.54 from source."
            )
    return None


def _installed() -> str:
    try:
        return importlib.metadata.version("pyrealsense2")
    except importlib.metadata.PackageNotFoundError:
        return "none"
