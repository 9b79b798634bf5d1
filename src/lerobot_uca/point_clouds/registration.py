"""Finding a camera's pose: from touched points, or from a board seen in several poses of the robot.

All lengths are metres. X_a_b is the pose of b in a. Letters: P points, K poses of the robot.
"""

from typing import NamedTuple

import numpy as np

from lerobot_uca.point_clouds.calibration import CalibrationError, rotation_angle
from lerobot_uca.point_clouds.geometry import Array

MIN_POINTS = 4
MIN_POSES = 5
MIN_SPREAD = 0.02
"""[m] Touched points must spread this far from a line (standard deviation), or the rotation about it is open."""
MIN_ROTATION = 10.0
"""[deg] The tool must turn this far about two axes, or the pose along the axis it turns about is open."""
MAX_MM, MAX_DEG = 20.0, 5.0
"""Residuals above these are mistakes in the data: touched points and boards fit within a few millimetres."""


class Fit(NamedTuple):
    """A pose and how well it explains what was measured."""

    X: Array  # (4, 4)
    mm: Array  # distances, one a point or pose [mm]
    deg: Array  # angles, one a pose [deg]; empty for points

    @property
    def residual(self) -> dict[str, float]:
        """Root mean squares, {'mm': ..., 'deg': ...}."""
        values = {"mm": self.mm, "deg": self.deg}
        return {name: round(float(np.sqrt(np.mean(v**2))), 4) for name, v in values.items() if len(v)}


def fit_points(points_camera: Array, points_base: Array) -> Fit:
    """X_base_camera from the same P points in both frames, (P, 3) each: least squares (Kabsch 1976, Umeyama 1991).

    Raises:
        CalibrationError: for fewer than 4 points, points on a line, coordinates that are not finite, and points that do
            not fit.
    """
    a, b = np.asarray(points_camera, dtype=np.float64), np.asarray(points_base, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 3 or not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise CalibrationError(f"Pairs of finite points (P, 3) are needed, got shapes {a.shape} and {b.shape}.")
    if len(a) < MIN_POINTS:
        raise CalibrationError(f"At least {MIN_POINTS} pairs of points are needed, got {len(a)}.")
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    spread = min(np.linalg.svd(each, compute_uv=False)[1] for each in (a - mean_a, b - mean_b)) / np.sqrt(len(a))
    if spread < MIN_SPREAD:
        raise CalibrationError(
            f"The points lie on a line: they spread {1e3 * spread:.1f} mm beside it, at least "
            f"{1e3 * MIN_SPREAD:.0f} mm are needed. Touch points far apart in all directions."
        )
    U, _, Vt = np.linalg.svd((b - mean_b).T @ (a - mean_a))
    R = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    X = _pose(R, mean_b - R @ mean_a)
    fit = Fit(X, 1e3 * np.linalg.norm(a @ R.T + X[:3, 3] - b, axis=1), np.empty(0))
    return _fitting(fit, "Are the rows of both frames the same points, in metres?")


def fit_board(X_base_tool: Array, X_camera_board: Array, *, on_arm: bool) -> Fit:
    """The camera's pose from K poses of the tool and of a board in the camera, (K, 4, 4) each.

    on_arm: the camera sits on the tool and the board lies still: X_tool_camera (eye-in-hand). Otherwise the camera
    stands still and the board sits on the tool: X_base_camera (eye-to-hand). OpenCV's calibrateHandEye, Park and
    Martin's method. The residual is how far the board, which stands still in one of the two frames, moves in it.

    Raises:
        CalibrationError: for fewer than 5 poses, numbers that are not finite, if the tool turned too little about a
            second axis, and for poses that do not fit.
    """
    import cv2  # slow to import

    if len(X_base_tool) != len(X_camera_board) or len(X_base_tool) < MIN_POSES:
        raise CalibrationError(
            f"The board must be seen in at least {MIN_POSES} poses of the robot, got {len(X_camera_board)} views of it "
            f"and {len(X_base_tool)} poses."
        )
    if not (np.isfinite(X_base_tool).all() and np.isfinite(X_camera_board).all()):
        raise CalibrationError(
            f"Poses must hold finite numbers, got others in {_n_bad(X_base_tool)} poses of the robot and "
            f"{_n_bad(X_camera_board)} of the board."
        )
    turn = _second_axis(X_base_tool)
    if turn < MIN_ROTATION:
        raise CalibrationError(
            f"The tool must turn by at least {MIN_ROTATION:g} degrees about two axes, got {turn:.1f} about the second "
            "one. Tilt the tool about x and y as well."
        )
    # X_tool_base instead of X_base_tool turns one problem into the other.
    moving = np.asarray(X_base_tool) if on_arm else np.linalg.inv(X_base_tool)
    R, t = cv2.calibrateHandEye(
        list(moving[:, :3, :3]),
        list(moving[:, :3, 3]),
        list(X_camera_board[:, :3, :3]),
        list(X_camera_board[:, :3, 3]),
        method=cv2.CALIB_HAND_EYE_PARK,
    )
    X = _pose(R, t.ravel())
    boards = moving @ X @ X_camera_board
    mean = _mean_pose(boards)
    mm = 1e3 * np.linalg.norm(boards[:, :3, 3] - mean[:3, 3], axis=1)
    deg = np.array([rotation_angle(mean[:3, :3].T @ board[:3, :3]) for board in boards])
    return _fitting(
        Fit(X, mm, deg),
        "Is each pose that of its picture, in metres and radians (a rotation vector), the board as it was printed, and "
        f"on_arm, {str(on_arm).lower()} here, right?",
    )


def _fitting(fit: Fit, hint: str) -> Fit:
    """The fit, or a `CalibrationError` for data that do not belong together."""
    residual = fit.residual
    if residual["mm"] > MAX_MM or residual.get("deg", 0) > MAX_DEG:
        got = ", ".join(f"{value:.1f} {unit}" for unit, value in residual.items())
        raise CalibrationError(f"The residual must be at most {MAX_MM:g} mm and {MAX_DEG:g} deg, got {got}. {hint}")
    return fit


def _n_bad(poses: Array) -> int:
    return int((~np.isfinite(poses)).any(axis=(1, 2)).sum())


def _second_axis(poses: Array) -> float:
    """The angle by which the poses (K, 4, 4) turn about the second most used axis, [deg]."""
    import cv2

    relative = [poses[0, :3, :3].T @ pose[:3, :3] for pose in poses[1:]]
    vectors = np.array([cv2.Rodrigues(R)[0].ravel() for R in relative])
    across = vectors @ np.linalg.svd(vectors, full_matrices=False)[2][1]
    return float(np.degrees(np.abs(across).max()))


def _mean_pose(poses: Array) -> Array:
    U, _, Vt = np.linalg.svd(poses[:, :3, :3].sum(axis=0))
    return _pose(U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt, poses[:, :3, 3].mean(axis=0))


def _pose(R: Array, t: Array) -> Array:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, t
    return X
