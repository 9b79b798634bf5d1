"""Calibration files, and finding a camera's pose."""

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from lerobot_uca.point_clouds.calibration import (
    Calibration,
    CalibrationError,
    pose_difference,
    read_calibrations,
    rotation_angle,
)
from lerobot_uca.point_clouds.geometry import Camera, as_pose
from lerobot_uca.point_clouds.registration import fit_board, fit_points


def pose(rng, reach=0.5, turn=np.pi):
    X = np.eye(4)
    X[:3, :3] = Rotation.from_rotvec(rng.uniform(-1, 1, 3) / np.sqrt(3) * turn).as_matrix()
    X[:3, 3] = rng.uniform(-reach, reach, 3)
    return X


def calibration(**changes):
    camera = Camera("front", 605.1, 605.3, 321.7, 242.9, 640, 480, as_pose(pose(np.random.default_rng(3))))
    settings = {"serial": "123456", "date": "2026-11-25", "method": "12 points", "residual": {"mm": 1.3}, **changes}
    return Calibration(camera, **settings)


# Files --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("changes", [{}, {"frame": "tool", "depth_unit": 2.5e-4}])
def test_a_file_holds_everything(tmp_path, changes):
    written = calibration(**changes)
    file = written.write(tmp_path / "new")
    assert file.name == ("123456.yaml")
    assert read_calibrations(tmp_path / "new") == {"front": written}


def test_a_view_takes_the_files_numbers():
    view = calibration(depth_unit=2.5e-4).view(near=0.1, far=2.0)
    assert (view.unit, view.near, view.far, view.camera.name) == (2.5e-4, 0.1, 2.0, "front")
    with pytest.raises(CalibrationError, match="Camera 'front' moves with the tool"):
        calibration(frame="tool").view()


WRONG = {
    "no rotation": ({"pose": np.diag([1.0, 1.0, 1.1, 1.0]).tolist()}, "pose must hold a rotation.*got 0.21 and 1.1"),
    "a mirror": ({"pose": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()}, "pose must hold a rotation.*and -1"),
    "millimetres": ({"pose": [[1, 0, 0, 500], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "within 5.0 m of the base"),
    "no matrix": ({"pose": [1, 2, 3]}, "pose must be 4 x 4"),
    "nan": ({"pose": np.full((4, 4), np.nan).tolist()}, "pose must be 4 x 4"),
    "no intrinsics": ({"intrinsics": None}, "needs camera, intrinsics"),
    "other intrinsics": ({"intrinsics": {"width": 640}}, "needs camera, intrinsics.*fx"),
    "focal length in mm": (
        {"intrinsics": {"width": 640, "height": 480, "fx": 1.88, "fy": 1.88, "cx": 320, "cy": 240}},
        "fx, fy must be pixels that fit 640 x 480, got 1.88, 1.88",
    ),
    "focal length of zero": (
        {"intrinsics": {"width": 640, "height": 480, "fx": 600, "fy": 0, "cx": 320, "cy": 240}},
        "fx, fy must be pixels that fit 640 x 480, got 600, 0",
    ),
    "centre outside": (
        {"intrinsics": {"width": 640, "height": 480, "fx": 600, "fy": 600, "cx": 960, "cy": 240}},
        "cx, cy must lie inside 640 x 480, got 960, 240",
    ),
    "unit": ({"depth_unit": 1000}, "depth_unit must be metres a unit"),
    "frame": ({"frame": "world"}, "frame must be one of base, tool, got 'world'"),
    "residual": ({"residual": 3}, "needs camera, intrinsics"),
    "infinite width": (
        {"intrinsics": {"width": np.inf, "height": 480, "fx": 600, "fy": 600, "cx": 320, "cy": 240}},
        "needs camera, intrinsics",
    ),
    "no serial": ({"serial": ""}, "must name its camera's serial"),
}


@pytest.mark.parametrize(("changes", "message"), WRONG.values(), ids=WRONG)
def test_an_invalid_calibration_is_refused_by_file(tmp_path, changes, message):
    file = tmp_path / "123456.yaml"
    file.write_text(yaml.safe_dump({**calibration().as_dict(), **changes}))
    with pytest.raises(CalibrationError, match=message) as error:
        read_calibrations(tmp_path)
    assert str(file) in str(error.value)


@pytest.mark.parametrize("text", ["[1, 2", "- 1", "\x00"])
def test_other_files_are_refused(tmp_path, text):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(CalibrationError, match="must"):
        read_calibrations(tmp_path)


def test_what_cannot_be_read_is_named(tmp_path):
    (tmp_path / "old.yaml").mkdir()
    with pytest.raises(CalibrationError, match=r"old\.yaml' must be a YAML file: .*Is a directory"):
        read_calibrations(tmp_path)


def test_a_folder_holds_one_calibration_a_camera(tmp_path):
    with pytest.raises(CalibrationError, match=r"must be a folder of calibrations \(\*.yaml\), made by"):
        read_calibrations(tmp_path / "missing")
    calibration().write(tmp_path)
    calibration(serial="654321").write(tmp_path)
    with pytest.raises(CalibrationError, match=r"must hold one calibration of camera 'front', got 123456\.yaml and"):
        read_calibrations(tmp_path)


def test_what_a_killed_writer_has_left_is_no_calibration(tmp_path):
    file = calibration().write(tmp_path)
    (tmp_path / f".{file.stem}.unfinished-0123abcd.yaml").write_text(file.read_text())
    assert list(read_calibrations(tmp_path)) == ["front"]


@pytest.mark.parametrize("degrees", [0.0, 1e-5, 1.0, 90.0, 179.0])
def test_how_far_poses_are_apart(degrees):
    a = pose(np.random.default_rng(0))
    b = a.copy()
    b[:3, :3] = a[:3, :3] @ Rotation.from_rotvec([0, 0, np.radians(degrees)]).as_matrix()
    b[:3, 3] += [0.003, 0, -0.004]
    assert pose_difference(a, b) == pytest.approx((5.0, degrees), abs=1e-9)
    assert rotation_angle(np.eye(3)) == 0


# Poses --------------------------------------------------------------------------------------------------------------


def test_exact_points_give_the_exact_pose():
    rng = np.random.default_rng(0)
    X, points = pose(rng), rng.uniform(-0.3, 0.3, (4, 3))
    fit = fit_points(points, points @ X[:3, :3].T + X[:3, 3])
    np.testing.assert_allclose(fit.X, X, atol=1e-12)
    assert fit.residual["mm"] == pytest.approx(0, abs=1e-9)


def test_noisy_points_give_the_pose_within_the_noise():
    """2 mm a coordinate, 12 points: the mean of 12 is 0.6 mm off a coordinate."""
    errors, residuals = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        X, points = pose(rng), rng.uniform(-0.3, 0.3, (12, 3))
        fit = fit_points(points + rng.normal(0, 0.002, (12, 3)), points @ X[:3, :3].T + X[:3, 3])
        centre = np.eye(4)
        centre[:3, 3] = points.mean(axis=0)
        errors.append(pose_difference(fit.X @ centre, X @ centre))
        residuals.append(fit.residual["mm"])
    mm, deg = np.sqrt(np.mean(np.square(errors), axis=0))
    assert mm < 1.2
    assert deg < 0.35
    # Of 36 coordinates 6 are spent on the pose: sqrt(3 * 30 / 36) * 2 mm.
    assert np.sqrt(np.mean(np.square(residuals))) == pytest.approx(3.16, rel=0.05)


@pytest.mark.parametrize("n_points", [3, 2, 0])
def test_too_few_points(n_points):
    with pytest.raises(CalibrationError, match=f"At least 4 pairs of points are needed, got {n_points}"):
        fit_points(np.zeros((n_points, 3)), np.zeros((n_points, 3)))


def test_points_on_a_line_are_refused():
    rng = np.random.default_rng(0)
    points = np.linspace(0, 0.5, 8)[:, None] * [1, 2, 3] + rng.normal(0, 0.002, (8, 3))
    with pytest.raises(CalibrationError, match=r"The points lie on a line: they spread \d.\d mm beside it"):
        fit_points(points, points)


def test_points_that_are_not_finite():
    with pytest.raises(CalibrationError, match="Pairs of finite points"):
        fit_points(np.full((5, 3), np.nan), np.zeros((5, 3)))


def boards(rng, *, on_arm, n_poses=12, mm=0.0, deg=0.0, turn=np.pi / 2):
    """X, X_base_tool and X_camera_board of a simulated calibration with noise in what the camera sees."""
    X, X_still = pose(rng), pose(rng)
    X_base_tool = np.array([pose(rng, turn=turn) for _ in range(n_poses)])
    # The board stands still: X_base_board = X_base_tool X_tool_camera X_camera_board; or moves with the tool:
    # X_base_tool X_tool_board = X_base_camera X_camera_board.
    X_camera_still = np.linalg.inv(X_base_tool @ X) if on_arm else np.linalg.inv(X) @ X_base_tool
    seen = X_camera_still @ X_still
    for board in seen:
        board[:3, 3] += rng.normal(0, mm / 1e3, 3)
        board[:3, :3] = board[:3, :3] @ Rotation.from_rotvec(rng.normal(0, np.radians(deg), 3)).as_matrix()
    return X, X_base_tool, seen


@pytest.mark.parametrize("on_arm", [False, True])
def test_an_exact_board_gives_the_exact_pose(on_arm):
    X, X_base_tool, seen = boards(np.random.default_rng(1), on_arm=on_arm, n_poses=5)
    fit = fit_board(X_base_tool, seen, on_arm=on_arm)
    np.testing.assert_allclose(fit.X, X, atol=1e-9)
    assert max(fit.residual.values()) < 1e-6


@pytest.mark.parametrize("on_arm", [False, True])
def test_a_noisy_board_gives_the_pose_within_the_noise(on_arm):
    """1 mm and 0.2 degrees, which at 0.8 m are 3 mm, in each of 15 views."""
    errors, residuals = [], []
    for seed in range(40):
        X, X_base_tool, seen = boards(np.random.default_rng(seed), on_arm=on_arm, n_poses=15, mm=1.0, deg=0.2)
        fit = fit_board(X_base_tool, seen, on_arm=on_arm)
        errors.append(pose_difference(fit.X, X))
        residuals.append([fit.residual["mm"], fit.residual["deg"]])
    mm, deg = np.sqrt(np.mean(np.square(errors), axis=0))
    assert mm < 3.0
    assert deg < 0.2
    mm, deg = np.sqrt(np.mean(np.square(residuals), axis=0))
    assert 1.0 < mm < 4.0
    assert 0.2 < deg < 0.5


@pytest.mark.parametrize("on_arm", [False, True])
def test_a_tool_that_turns_about_one_axis_is_refused(on_arm):
    rng = np.random.default_rng(0)
    _, X_base_tool, seen = boards(rng, on_arm=on_arm)
    for X, angle in zip(X_base_tool, np.linspace(0, 1.5, 12), strict=True):
        X[:3, :3] = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    with pytest.raises(CalibrationError, match=r"by at least 10 degrees about two axes, got 0\.0 about the second"):
        fit_board(X_base_tool, seen, on_arm=on_arm)


def test_data_that_do_not_belong_together_are_refused():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.3, (12, 3))
    with pytest.raises(CalibrationError, match=r"at most 20 mm and 5 deg, got \d+.\d mm. Are the rows of both frames"):
        fit_points(points, points[::-1])
    with pytest.raises(CalibrationError, match="The residual must be"):
        fit_points(points, points * (1, 1, -1))  # mirrored
    _, tool, seen = boards(rng, on_arm=False)
    with pytest.raises(CalibrationError, match="metres and radians"):
        fit_board(tool, seen[::-1], on_arm=False)
    with pytest.raises(CalibrationError, match="on_arm, true here, right"):
        fit_board(tool, seen, on_arm=True)


def test_too_few_poses():
    _, X_base_tool, seen = boards(np.random.default_rng(0), on_arm=False, n_poses=4)
    with pytest.raises(CalibrationError, match="in at least 5 poses of the robot, got 4 views of it and 4 poses"):
        fit_board(X_base_tool, seen, on_arm=False)
