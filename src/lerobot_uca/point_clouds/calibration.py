"""Camera calibrations: one YAML file a camera, owned by an installation, validated when read.

# Lengths in metres, pixels in pixels. pose: X_base_camera (frame: base) or X_tool_camera (frame: tool).
serial: '123456'
camera: front
intrinsics: {width: 640, height: 480, fx: 605.1, fy: 605.3, cx: 321.7, cy: 242.9}
depth_unit: 0.001
frame: base
pose: [[...], [...], [...], [0, 0, 0, 1]]
date: '2026-11-25'
method: 12 touched points
residual: {mm: 1.3, deg: 0.2}
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import yaml

from lerobot_uca.point_clouds.depth import FAR, MILLIMETRE, NEAR, DepthView
from lerobot_uca.point_clouds.geometry import Array, Camera, as_pose
from lerobot_uca.whole_file import whole_file

FRAMES = ("base", "tool")
MAX_DISTANCE = 5.0
"""[m] A camera farther from its frame is a mistake in units: arms reach 1.3 m."""
TOLERANCE = 1e-3
"""A rotation's largest distance from orthonormal; a pose written with four decimals passes."""
HEADER = "# Lengths in metres, pixels in pixels. pose: X_base_camera (frame: base) or X_tool_camera (frame: tool),\n"
HEADER += "# OpenCV's convention: the camera's x to the right, y down, z forward. Written by lerobot-uca-calibrate.\n"


class CalibrationError(ValueError):
    """A calibration that is missing or cannot be right. The message says the rule, what was got and where."""


@dataclass(frozen=True)
class Calibration:
    """A camera's pose, and its map from points to pixels.

    Args:
        camera: intrinsics, image size and pose; its name is the one in the robot's configuration ('front' of
            `observation.images.front_depth`).
        serial: of the device.
        frame: what the pose refers to: base (a fixed camera) or tool (a camera on the arm).
        depth_unit: metres a unit of its depth images.
        date, method: when and how it was made.
        residual: of the fit, {'mm': ..., 'deg': ...}; what was not measured is missing.
    """

    camera: Camera
    serial: str = ""
    frame: str = "base"
    depth_unit: float = MILLIMETRE
    date: str = ""
    method: str = ""
    residual: dict[str, float] = field(default_factory=dict)

    def view(self, near: float = NEAR, far: float = FAR) -> DepthView:
        """A view that turns this camera's depth images into points in the base frame.

        Raises:
            CalibrationError: for a camera on the arm, whose pose in the base frame changes.
        """
        if self.frame != "base":
            raise CalibrationError(
                f"Camera '{self.camera.name}' moves with the tool (frame: {self.frame}). Clouds need a fixed camera "
                "(frame: base)."
            )
        return DepthView(self.camera, self.depth_unit, near, far)

    def as_dict(self) -> dict[str, Any]:
        """The content of a file: numbers, text and lists only."""
        camera = asdict(self.camera)
        pose, name = camera.pop("X_world_camera"), camera.pop("name")
        return {
            "serial": self.serial,
            "camera": name,
            "intrinsics": {key: camera[key] for key in ("width", "height", "fx", "fy", "cx", "cy")},
            "depth_unit": self.depth_unit,
            "frame": self.frame,
            "pose": [list(row) for row in pose],
            "date": self.date,
            "method": self.method,
            "residual": self.residual,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], source: str = "The calibration") -> Self:
        """The inverse of `as_dict`.

        Raises:
            CalibrationError: for missing or implausible values. `source` says whose they are.
        """
        try:
            numbers = values["intrinsics"]
            intrinsics = {key: float(numbers[key]) for key in ("fx", "fy", "cx", "cy")}
            width, height = int(numbers["width"]), int(numbers["height"])
            pose = np.array(values["pose"], dtype=np.float64)
            name, depth_unit = str(values["camera"]), float(values.get("depth_unit", MILLIMETRE))
            residual = {str(key): float(value) for key, value in (values.get("residual") or {}).items()}
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise CalibrationError(
                f"{source} needs camera, intrinsics (width, height, fx, fy, cx, cy) and pose (4 x 4): "
                f"{type(error).__name__} {error}."
            ) from error
        if pose.shape != (4, 4) or not np.all(np.isfinite(pose)) or not np.allclose(pose[3], (0, 0, 0, 1)):
            raise CalibrationError(f"{source}: pose must be 4 x 4 with the last row 0 0 0 1, got {pose.tolist()}.")
        camera = Camera(name=name, **intrinsics, width=width, height=height, X_world_camera=as_pose(pose))
        texts = {key: str(values.get(key, "")) for key in ("serial", "date", "method")}
        frame = str(values.get("frame", "base"))
        calibration = cls(camera, frame=frame, depth_unit=depth_unit, residual=residual, **texts)
        _check(calibration, source)
        return calibration

    def write(self, folder: Path) -> Path:
        """Write `folder/<serial>.yaml` and return it."""
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / f"{self.serial}.yaml"
        text = yaml.safe_dump(self.as_dict(), sort_keys=False, default_flow_style=None, width=110)
        with whole_file(file) as unfinished:
            unfinished.write_text(HEADER + text, encoding="utf-8")
        return file


def read_calibrations(folder: Path) -> dict[str, Calibration]:
    """The calibrations of an installation, by the name of the camera.

    Raises:
        CalibrationError: if the folder holds none, two of one name, or one that cannot be right.
    """
    files = sorted(folder.glob("[!.]*.yaml")) if folder.is_dir() else []
    if not files:
        raise CalibrationError(f"'{folder}' must be a folder of calibrations (*.yaml), made by lerobot-uca-calibrate.")
    found: dict[str, Calibration] = {}
    file_of: dict[str, Path] = {}
    for file in files:
        try:
            values = yaml.safe_load(file.read_text(encoding="utf-8"))
        except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
            raise CalibrationError(f"'{file}' must be a YAML file: {' '.join(str(error).split())}") from error
        if not isinstance(values, dict):
            raise CalibrationError(f"'{file}' must hold a calibration, got {type(values).__name__}.")
        calibration = Calibration.from_dict(values, source=f"'{file}'")
        if not calibration.serial:
            raise CalibrationError(f"'{file}' must name its camera's serial: another device is not calibrated by it.")
        name = calibration.camera.name
        if name in found:
            raise CalibrationError(
                f"'{folder}' must hold one calibration of camera '{name}', got {file_of[name].name} and {file.name}: "
                "move one of them elsewhere."
            )
        found[name], file_of[name] = calibration, file
    return found


def pose_difference(X_world_a: Any, X_world_b: Any) -> tuple[float, float]:
    """The distance between two poses: (mm, deg)."""
    a, b = np.asarray(X_world_a, dtype=np.float64), np.asarray(X_world_b, dtype=np.float64)
    return float(1e3 * np.linalg.norm(a[:3, 3] - b[:3, 3])), rotation_angle(a[:3, :3].T @ b[:3, :3])


def rotation_angle(R: Array) -> float:
    """The angle of a rotation (3, 3) [deg], exact for small ones too."""
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.degrees(np.arctan2(np.linalg.norm(axis), np.trace(R) - 1)))


def check_intrinsics(camera: Camera, source: str) -> None:
    """Raise a `CalibrationError` for focal lengths or a centre that cannot be a camera's. `source` says whose."""
    width, height = camera.width, camera.height
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    if not (width > 0 and height > 0 and 0.2 * width < fx < 20 * width and 0.5 * fy < fx < 2 * fy):
        raise CalibrationError(f"{source}: fx, fy must be pixels that fit {width} x {height}, got {fx:g}, {fy:g}.")
    if not (0 < cx < width and 0 < cy < height):
        raise CalibrationError(f"{source}: cx, cy must lie inside {width} x {height}, got {cx:g}, {cy:g}.")


def _check(calibration: Calibration, source: str) -> None:
    camera = calibration.camera
    pose, frame = np.array(camera.X_world_camera), calibration.frame
    R, distance = pose[:3, :3], float(np.linalg.norm(pose[:3, 3]))
    error = float(np.abs(R.T @ R - np.eye(3)).max())
    if error > TOLERANCE or np.linalg.det(R) < 0:
        raise CalibrationError(
            f"{source}: pose must hold a rotation: R'R differs from 1 by at most {TOLERANCE} and det R = 1, got "
            f"{error:.3g} and {np.linalg.det(R):.3g}."
        )
    if distance > MAX_DISTANCE:
        raise CalibrationError(
            f"{source}: the camera must be within {MAX_DISTANCE} m of the {frame}, got {distance:g} m. Lengths are "
            "metres."
        )
    check_intrinsics(camera, source)
    if not 1e-6 < calibration.depth_unit <= 1:
        raise CalibrationError(
            f"{source}: depth_unit must be metres a unit (0.001 for mm), got {calibration.depth_unit:g}."
        )
    if frame not in FRAMES:
        raise CalibrationError(f"{source}: frame must be one of {', '.join(FRAMES)}, got '{frame}'.")
