"""A camera that librealsense dropped is named where it fails to open."""

import sys

import pytest

from lerobot_uca.errors import UserError
from lerobot_uca.robots import realsense
from lerobot_uca.robots.realsense import connect, dropped_camera, register


def plug_in(folder, vendor, product):
    device = folder / f"usb-{product}"
    device.mkdir(parents=True)
    (device / "idVendor").write_text(f"{vendor}\n")
    (device / "idProduct").write_text(f"{product}\n")


class AbsentCamera:
    def connect(self):
        raise ConnectionError("Failed to open RealSenseCamera(123). Run lerobot-find-cameras")


def test_an_l515_is_named_with_the_release_that_dropped_it(tmp_path, monkeypatch):
    plug_in(tmp_path, "8086", "0b64")
    assert dropped_camera(tmp_path).startswith("An L515 is plugged in: librealsense 2.55.1 and newer dropped it")
    monkeypatch.setattr(realsense, "USB_DEVICES", tmp_path)
    with pytest.raises(
        UserError, match=r"Camera 'front' cannot be opened: .*cameras\. An L515 is plugged in.*D435 or D455"
    ):
        connect("front", AbsentCamera())


@pytest.mark.parametrize("device", [None, ("8086", "0b07"), ("1234", "0b64")], ids=["none", "D435", "another maker's"])
def test_other_failures_are_the_cameras_own_reason(tmp_path, monkeypatch, device):
    if device is not None:
        plug_in(tmp_path, *device)
    monkeypatch.setattr(realsense, "USB_DEVICES", tmp_path)
    with pytest.raises(UserError, match=r"^Camera 'front' cannot be opened: Failed to open .*find-cameras\.$"):
        connect("front", AbsentCamera())


def test_a_librealsense_that_does_not_load_is_said_in_a_line(monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "lerobot.cameras.realsense", None)  # so its import fails
    register()
    (record,) = caplog.records
    assert "librealsense does not load" in record.message
    assert "apt install libusb-1.0-0" in record.message
