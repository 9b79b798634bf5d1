"""A connected depth camera's own words about its depth: serial, intrinsics, unit."""

from dataclasses import dataclass, replace
from typing import Any, Self

import cv2

MAX_DISTORTION = 1e-3  # of the model's coefficients; a D400's depth is rectified and has none


@dataclass(frozen=True)
class DepthDevice:
    """The depth stream of a device as the robot hands its images on, that is after the camera's rotation.

    Args:
        serial: of the device.
        width, height: of the images [pixels].
        fx, fy, cx, cy: focal lengths and principal point [pixels]; pixel centres at whole numbers, as librealsense has
            them, too.
        depth_unit: metres a unit.
        is_distorted: whether straight lines are bent in its images, which clouds do not correct.
    """

    serial: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    depth_unit: float
    is_distorted: bool = False

    def rotated(self, rotation: int | None) -> Self:
        """The device with images turned by one of OpenCV's rotations; None leaves them as they are."""
        right, bottom = self.width - 1, self.height - 1
        turned = replace(self, width=self.height, height=self.width, fx=self.fy, fy=self.fx)
        match rotation:
            case cv2.ROTATE_90_CLOCKWISE:
                return replace(turned, cx=bottom - self.cy, cy=self.cx)
            case cv2.ROTATE_180:
                return replace(self, cx=right - self.cx, cy=bottom - self.cy)
            case cv2.ROTATE_90_COUNTERCLOCKWISE:
                return replace(turned, cx=self.cy, cy=right - self.cx)
        return self

    def options(self) -> str:
        """What lerobot-uca-calibrate wants to know of it."""
        numbers = ",".join(f"{number:.6g}" for number in (self.width, self.height, self.fx, self.fy, self.cx, self.cy))
        return f"--serial={self.serial} --intrinsics='[{numbers}]' --depth_unit={self.depth_unit:g}"


def depth_device(camera: Any) -> DepthDevice | None:
    """Read a connected LeRobot camera's depth stream; None if its type does not tell.

    LeRobot's RealSense camera keeps the pipeline's profile, but exposes neither intrinsics nor the depth scale; cameras
    of this package have a method `depth_device`.
    """
    if hasattr(camera, "depth_device"):
        device: DepthDevice = camera.depth_device()
        return device
    profile = getattr(camera, "rs_profile", None)
    return None if profile is None else _read_realsense(profile).rotated(camera.rotation)


def _read_realsense(profile: Any) -> DepthDevice:
    """The depth stream of a librealsense pipeline, from its `rs.pipeline_profile`."""
    import pyrealsense2 as rs

    device = profile.get_device()
    found = profile.get_stream(rs.stream.depth).as_video_stream_profile().get_intrinsics()
    return DepthDevice(
        serial=device.get_info(rs.camera_info.serial_number),
        width=found.width,
        height=found.height,
        fx=found.fx,
        fy=found.fy,
        cx=found.ppx,
        cy=found.ppy,
        depth_unit=device.first_depth_sensor().get_depth_scale(),
        is_distorted=any(abs(each) > MAX_DISTORTION for each in found.coeffs),
    )
