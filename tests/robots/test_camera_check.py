"""Cameras against calibrations: librealsense's own objects of a software device, LeRobot's own camera class.

A pipeline needs hardware. So its profile is a stand-in of the two methods that are called; the device, its depth
sensor and the stream's profile behind it are librealsense's.
"""

import dataclasses
import logging

import cv2
import numpy as np
import pytest
from lerobot.cameras.configs import Cv2Rotation

from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.calibration import Calibration
from lerobot_uca.point_clouds.geometry import Camera, as_pose
from lerobot_uca.robots.camera_check import check_cameras
from lerobot_uca.robots.depth_device import DepthDevice, depth_device

rs = pytest.importorskip(
    "pyrealsense2", reason="the extra realsense or the system's libusb is not installed", exc_type=ImportError
)

SERIAL, UNIT = "123456", 0.00025
FACTORY = DepthDevice(SERIAL, 640, 480, fx=385.0, fy=386.5, cx=322.0, cy=238.0, depth_unit=UNIT)


class Profile:
    """The two methods of a running pipeline's profile."""

    def __init__(self, *, coefficient=0.0):
        intrinsics, stream = rs.intrinsics(), rs.video_stream()
        intrinsics.width, intrinsics.height = FACTORY.width, FACTORY.height
        intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy = FACTORY.fx, FACTORY.fy, FACTORY.cx, FACTORY.cy
        intrinsics.model, intrinsics.coeffs = rs.distortion.brown_conrady, [coefficient, 0, 0, 0, 0]
        stream.type, stream.index, stream.uid, stream.bpp, stream.fmt = rs.stream.depth, 0, 1, 2, rs.format.z16
        stream.width, stream.height, stream.fps, stream.intrinsics = FACTORY.width, FACTORY.height, 30, intrinsics
        self.device = rs.software_device()
        sensor = self.device.add_sensor("Stereo Module")
        self.stream = sensor.add_video_stream(stream)
        sensor.add_read_only_option(rs.option.depth_units, UNIT)
        self.device.register_info(rs.camera_info.serial_number, SERIAL)

    def get_device(self):
        return self.device

    def get_stream(self, stream):
        assert stream == rs.stream.depth
        return self.stream


def realsense(rotation=Cv2Rotation.NO_ROTATION, *, use_depth=True, coefficient=0.0):
    from lerobot.cameras.realsense import RealSenseCamera, RealSenseCameraConfig

    turned = rotation in (Cv2Rotation.ROTATE_90, Cv2Rotation.ROTATE_270)
    width, height = (480, 640) if turned else (640, 480)
    camera = RealSenseCamera(
        RealSenseCameraConfig(
            serial_number_or_name=SERIAL, fps=30, width=width, height=height, use_depth=use_depth, rotation=rotation
        )
    )
    camera.rs_profile = Profile(coefficient=coefficient)
    return camera


def calibration_of(device, **changes) -> Calibration:
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = 0.5, 0.0, 0.8
    intrinsics = {key: getattr(device, key) for key in ("fx", "fy", "cx", "cy", "width", "height")}
    camera = Camera("top", **{**intrinsics, **changes}, X_world_camera=as_pose(pose))
    return Calibration(camera, device.serial, depth_unit=device.depth_unit)


def check(calibration, camera, folder, monkeypatch):
    calibration.write(folder)
    monkeypatch.setenv("LEROBOT_UCA_CALIBRATION", str(folder))
    check_cameras({"top": camera})


def test_a_realsenses_depth_stream_is_read():
    device = depth_device(realsense())
    assert dataclasses.replace(device, depth_unit=UNIT) == FACTORY
    assert device.depth_unit == pytest.approx(UNIT)
    assert device.options() == "--serial=123456 --intrinsics='[640,480,385,386.5,322,238]' --depth_unit=0.00025"


@pytest.mark.parametrize("rotation", Cv2Rotation)
def test_intrinsics_turn_with_the_image(rotation):
    """A pixel that is turned with its image keeps its ray, turned about the optical axis."""
    camera = realsense(rotation)
    device = depth_device(camera)
    rng = np.random.default_rng(0)
    for u, v in zip(rng.integers(0, 640, 5), rng.integers(0, 480, 5), strict=True):
        image = np.zeros((480, 640), np.uint8)
        image[v, u] = 1
        if camera.rotation is not None:
            image = cv2.rotate(image, camera.rotation)
        assert image.shape == (device.height, device.width)
        ((turned_v, turned_u),) = np.argwhere(image)
        ray = (u - FACTORY.cx) / FACTORY.fx, (v - FACTORY.cy) / FACTORY.fy
        turned = (turned_u - device.cx) / device.fx, (turned_v - device.cy) / device.fy
        clockwise = {
            Cv2Rotation.NO_ROTATION: ray,
            Cv2Rotation.ROTATE_90: (-ray[1], ray[0]),
            Cv2Rotation.ROTATE_180: (-ray[0], -ray[1]),
            Cv2Rotation.ROTATE_270: (ray[1], -ray[0]),
        }
        np.testing.assert_allclose(turned, clockwise[rotation])


@pytest.mark.parametrize("rotation", Cv2Rotation)
def test_the_calibration_of_the_device_passes(tmp_path, monkeypatch, rotation):
    camera = realsense(rotation)
    device = depth_device(camera)
    check(calibration_of(device, fx=device.fx * 1.01, cy=device.cy + 4), camera, tmp_path, monkeypatch)


OTHERS = {
    "another lens or stream": ({"fx": 385 * 1.6, "fy": 386.5 * 1.6}, "another focal length than its calibration"),
    "another rotation": ({"cx": 639 - 322.0 + 60}, r"another principal point .*--intrinsics='\[640,480"),
    "another size": ({"width": 848}, "images of 640 x 480, its calibration is for 848 x 480"),
}


@pytest.mark.parametrize(("change", "message"), OTHERS.values(), ids=OTHERS)
def test_other_intrinsics_are_refused(tmp_path, monkeypatch, change, message):
    with pytest.raises(UserError, match=message):
        check(calibration_of(FACTORY, **change), realsense(), tmp_path, monkeypatch)


def test_another_unit_and_another_device_are_refused(tmp_path, monkeypatch):
    calibration = calibration_of(FACTORY)
    with pytest.raises(UserError, match="another unit of depth"):
        check(dataclasses.replace(calibration, depth_unit=0.001), realsense(), tmp_path / "unit", monkeypatch)
    with pytest.raises(UserError, match="the device 123456, its calibration is of 654321"):
        check(dataclasses.replace(calibration, serial="654321"), realsense(), tmp_path / "device", monkeypatch)


def test_a_calibrated_camera_without_depth_is_refused(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="gives no depth: give it use_depth: true"):
        check(calibration_of(FACTORY), realsense(use_depth=False), tmp_path, monkeypatch)


def test_extrinsics_that_do_not_hold_a_rotation_are_refused(tmp_path, monkeypatch):
    calibration = calibration_of(FACTORY)
    mirrored = dataclasses.replace(calibration.camera, X_world_camera=as_pose(np.diag([1.0, 1.0, -1.0, 1.0])))
    with pytest.raises(UserError, match=r"pose must hold a rotation"):
        check(dataclasses.replace(calibration, camera=mirrored), realsense(), tmp_path, monkeypatch)


def test_an_uncalibrated_camera_says_what_calibrating_it_needs(monkeypatch, caplog):
    monkeypatch.delenv("LEROBOT_UCA_CALIBRATION", raising=False)
    caplog.set_level(logging.INFO)
    check_cameras({"top": realsense(coefficient=0.1)})
    assert "--serial=123456 --intrinsics='[640,480,385,386.5,322,238]' --depth_unit=0.00025" in caplog.text
    assert "bends straight lines" in caplog.text
