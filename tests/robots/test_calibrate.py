"""The command: from files to a calibration, with rendered boards."""

import csv
import dataclasses
import sys

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.calibration import CalibrationError, pose_difference, read_calibrations
from lerobot_uca.point_clouds.registration import fit_board
from lerobot_uca.robots import calibrate as command
from lerobot_uca.robots.calibrate import BoardConfig, CalibrateConfig, calibrate

INTRINSICS = (640.0, 480.0, 605.0, 604.0, 321.0, 243.0)
K = np.array([[605.0, 0, 321], [0, 604, 243], [0, 0, 1]])
BOARD = BoardConfig()


def pose(rotation, position):
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = Rotation.from_rotvec(rotation).as_matrix(), position
    return X


X_BASE_CAMERA = pose([2.0, -0.3, 0.1], [0.5, -0.9, 0.6])


def settings(**changes):
    return CalibrateConfig(**{"camera": "front", "serial": "123456", "intrinsics": INTRINSICS, **changes})


def write_csv(file, names, rows):
    with file.open("w", newline="") as opened:
        writer = csv.writer(opened)
        writer.writerow(names)
        writer.writerows(rows)


def write_points(file, *, pixels, noise=0.001, n_points=12, K=K):
    rng = np.random.default_rng(0)
    seen = rng.uniform([-0.3, -0.2, 0.6], [0.3, 0.2, 1.0], (n_points, 3))
    base = seen @ X_BASE_CAMERA[:3, :3].T + X_BASE_CAMERA[:3, 3]
    measured = seen + rng.normal(0, noise, seen.shape)
    names = command.CAMERA_POINT
    if pixels:
        names = command.PIXEL
        projected = measured @ K.T
        measured = np.column_stack([projected[:, :2] / projected[:, 2:], measured[:, 2]])
    write_csv(file, (*command.BASE_POINT, *names), np.hstack([base, measured]).tolist())
    return file


@pytest.mark.parametrize("pixels", [False, True])
def test_touched_points(tmp_path, pixels):
    points = write_points(
        tmp_path / "touched.csv", pixels=pixels, K=np.array([[605.0, 0, 321], [0, 560, 243], [0, 0, 1]])
    )
    calibration, fit = calibrate(settings(points=points, intrinsics=(640.0, 480.0, 605.0, 560.0, 321.0, 243.0)))
    mm, deg = pose_difference(calibration.camera.X_world_camera, X_BASE_CAMERA)
    assert mm < 5  # at the camera, 0.8 m from the points
    assert deg < 0.3
    assert 0.5 < calibration.residual["mm"] < 2.5
    assert (calibration.method, calibration.frame) == ("12 touched points", "base")
    assert len(fit.mm) == 12


def render_boards(folder, *, on_arm, n_poses=10, noise=2.0):
    """Pictures of a board as a pinhole camera sees it, and the tool's poses; returns the camera's pose."""
    rng = np.random.default_rng(1)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    charuco = cv2.aruco.CharucoBoard(BOARD.squares, BOARD.square, BOARD.marker, dictionary)
    pixels = 40  # a square
    picture = charuco.generateImage((BOARD.squares[0] * pixels, BOARD.squares[1] * pixels))
    X = pose([0.1, -0.2, 0.3], [0.02, -0.05, 0.08]) if on_arm else X_BASE_CAMERA
    X_still = pose([0.2, 0.1, -0.4], [0.45, 0.1, 0.02]) if on_arm else pose([0.3, 0.1, 0.2], [0.01, 0.0, 0.1])
    folder.mkdir()
    rows = []
    for index in range(n_poses):
        X_camera_board = pose(rng.uniform(-0.5, 0.5, 3), rng.uniform([-0.17, -0.12, 0.4], [-0.03, -0.02, 0.6]))
        if on_arm:
            X_base_tool = X_still @ np.linalg.inv(X_camera_board) @ np.linalg.inv(X)
        else:
            X_base_tool = X @ X_camera_board @ np.linalg.inv(X_still)
        # Pixel centres are at whole numbers: the board's corner lies half a pixel before the first one.
        board_of_pixel = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, pixels / BOARD.square]]) * BOARD.square / pixels
        homography = K @ X_camera_board[:3, [0, 1, 3]] @ board_of_pixel
        seen = cv2.warpPerspective(picture, homography, (640, 480), flags=cv2.INTER_LINEAR, borderValue=180)
        seen = np.clip(seen + rng.normal(0, noise, seen.shape), 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{index}.png"), seen)
        vector = Rotation.from_matrix(X_base_tool[:3, :3]).as_rotvec()
        rows.append([f"{index}.png", *X_base_tool[:3, 3], *vector])
    write_csv(folder / "poses.csv", ("image", *command.POSE), rows)
    return X


@pytest.mark.parametrize("on_arm", [False, True])
def test_a_board_in_pictures(tmp_path, on_arm):
    X = render_boards(tmp_path / "board", on_arm=on_arm)
    calibration, fit = calibrate(settings(board_folder=tmp_path / "board", on_arm=on_arm))
    mm, deg = pose_difference(calibration.camera.X_world_camera, X)
    assert mm < 3
    assert deg < 0.3
    assert len(fit.mm) == 10
    assert calibration.residual["mm"] < 3
    assert calibration.frame == ("tool" if on_arm else "base")


def test_pictures_without_the_board_are_left_out_and_named(tmp_path, caplog):
    folder = tmp_path / "board"
    render_boards(folder, on_arm=False)
    cv2.imwrite(str(folder / "3.png"), np.full((480, 640), 128, np.uint8))
    _, fit = calibrate(settings(board_folder=folder))
    assert len(fit.mm) == 9
    assert "1 of 10 pictures show too little of the board: 3.png." in caplog.messages


def test_a_row_of_corners_is_too_little_of_the_board():
    """It may turn about the row; OpenCV's pose of it has NaN."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    charuco = cv2.aruco.CharucoBoard(BOARD.squares, BOARD.square, BOARD.marker, dictionary)
    detector, picture = cv2.aruco.CharucoDetector(charuco), np.full((480, 640), 255, np.uint8)
    picture[40:440, 40:600] = charuco.generateImage((560, 400))
    assert command._board_pose(detector, charuco, picture, K) is not None
    picture[200:] = 255  # two rows of squares are left
    assert len(detector.detectBoard(picture)[1]) == command.MIN_CORNERS
    assert command._board_pose(detector, charuco, picture, K) is None


def test_poses_that_are_not_finite_are_refused():
    poses = np.tile(np.eye(4), (6, 1, 1))
    boards = poses.copy()
    boards[3, 0, 3] = np.nan
    with pytest.raises(CalibrationError, match="finite numbers, got others in 0 poses of the robot and 1 of the board"):
        fit_board(poses, boards, on_arm=False)


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["lerobot-uca-calibrate", *arguments])
    command.run()


def test_the_command_writes_a_file_and_tells_what_changed(tmp_path, monkeypatch, capsys):
    points = write_points(tmp_path / "touched.csv", pixels=False)
    arguments = ["--camera=front", "--serial=123456", "--intrinsics=[640,480,605,604,321,243]", f"--points={points}"]
    run(monkeypatch, *arguments, f"--folder={tmp_path / 'cameras'}")
    first = capsys.readouterr().out
    assert "Residual " in first
    assert "mm (RMS); the worst of 12 is number" in first
    assert "It was" not in first
    stored = read_calibrations(tmp_path / "cameras")["front"]
    assert stored.serial == "123456"
    assert stored == calibrate(settings(points=points))[0]
    write_points(points, pixels=False, noise=0.003)
    run(monkeypatch, *arguments, f"--folder={tmp_path / 'cameras'}")
    assert "deg from here (20" in capsys.readouterr().out


def test_a_camera_that_is_replaced(tmp_path, monkeypatch, caplog):
    """Its name stands for the new device, and the old one's file stays to be looked at."""
    folder, points = tmp_path / "cameras", write_points(tmp_path / "touched.csv", pixels=False)
    options = ["--intrinsics=[640,480,605,604,321,243]", f"--folder={folder}"]
    for camera, serial in (("front", "111"), ("side", "333"), ("front", "222")):
        run(monkeypatch, f"--camera={camera}", f"--serial={serial}", *options, f"--points={points}")
    assert {name: each.serial for name, each in read_calibrations(folder).items()} == {"front": "222", "side": "333"}
    assert sorted(file.name for file in folder.iterdir()) == ["111.yaml.old", "222.yaml", "333.yaml"]
    assert "Camera 'front' was the device 111: its file is" in caplog.text
    (folder / "111.yaml.old").rename(folder / "111.yaml")
    with pytest.raises(CalibrationError, match=r"one calibration of camera 'front', got 111\.yaml and 222\.yaml"):
        read_calibrations(folder)


def test_a_camera_that_gets_another_name(tmp_path, monkeypatch, caplog):
    """The device has one file, which held the former name's calibration."""
    folder, points = tmp_path / "cameras", write_points(tmp_path / "touched.csv", pixels=False)
    options = ["--serial=111", "--intrinsics=[640,480,605,604,321,243]", f"--folder={folder}", f"--points={points}"]
    run(monkeypatch, "--camera=front", *options)
    before = (folder / "111.yaml").read_text()
    run(monkeypatch, "--camera=side", *options)
    assert list(read_calibrations(folder)) == ["side"]
    assert (folder / "111.yaml.old").read_text() == before
    assert "Camera 'front' was the device 111: its file is" in caplog.text
    run(monkeypatch, "--camera=side", *options)
    assert (folder / "111.yaml.old").read_text() == before


def test_a_spreadsheets_csv(tmp_path):
    points = write_points(tmp_path / "touched.csv", pixels=False)
    expected = calibrate(settings(points=points))[0]
    points.write_text(points.read_text(), encoding="utf-8-sig")
    assert calibrate(settings(points=points))[0] == expected


def bad_inputs(tmp_path):
    points = tmp_path / "touched.csv"
    write_points(points, pixels=False)
    few = tmp_path / "few.csv"
    write_points(few, pixels=False, n_points=3)
    words = tmp_path / "words.csv"
    words.write_text("base_x,base_y,base_z,camera_x,camera_y,camera_z\n1,2,x,4,5,6\n")
    columns = tmp_path / "columns.csv"
    columns.write_text("x,y\n1,2\n")
    (tmp_path / "empty").mkdir()
    no_picture = tmp_path / "no_picture"
    no_picture.mkdir()
    write_csv(no_picture / "poses.csv", ("image", *command.POSE), [["a.png", 0, 0, 0, 0, 0, 0]])
    no_image, nan = tmp_path / "no_image", tmp_path / "nan.csv"
    no_image.mkdir()
    write_csv(no_image / "poses.csv", command.POSE, [[0, 0, 0, 0, 0, 0]])
    short = tmp_path / "short"
    short.mkdir()
    write_csv(short / "poses.csv", (*command.POSE, "image"), [[0, 0, 0, 0, 0, 0, "0.png"], [0, 0, 0, 0, 0, 0]])
    cv2.imwrite(str(short / "0.png"), np.zeros((480, 640), np.uint8))
    huge = tmp_path / "huge.csv"
    huge.write_text("x" * 200_000)
    nan.write_text("base_x,base_y,base_z,camera_x,camera_y,camera_z\n1,2,3,4,5,6\n1,2,nan,4,5,6\n")
    return {
        "must have the column image, the names of the pictures, got x, y, z": settings(board_folder=no_image),
        "must have the name of a picture in each row, got none in row 2": settings(board_folder=short),
        "huge.csv' cannot be read: field larger than field limit": settings(points=huge),
        r"must hold finite numbers in base_x, base_y, base_z, got \[ 1.  2. nan\] in row 2": settings(points=nan),
        "must be one of OpenCV's, such as DICT_4X4_50, got 'CharucoBoard'": settings(
            board_folder=no_picture, board=dataclasses.replace(BOARD, dictionary="CharucoBoard")
        ),
        "Give either --points": settings(),
        "for one on the arm use --board_folder": settings(points=points, on_arm=True),
        "At least 4 pairs of points are needed, got 3": settings(points=few),
        "must hold numbers in base_x": settings(points=words),
        "base_x, base_y, base_z is missing, got x, y": settings(points=columns),
        "touched2.csv' cannot be read": settings(points=tmp_path / "touched2.csv"),
        "poses.csv' cannot be read": settings(board_folder=tmp_path / "empty"),
        "must be 640 x 480 pixels, got no picture": settings(board_folder=no_picture),
        "board.dictionary must be one of OpenCV's": settings(
            board_folder=no_picture, board=dataclasses.replace(BOARD, dictionary="DICT_9")
        ),
        "and markers smaller than these, got board.squares=.7, 5., board.square=0.03, board.marker=0.05": settings(
            board_folder=no_picture, board=dataclasses.replace(BOARD, square=0.03, marker=0.05)
        ),
        "at least 3 x 3 squares": settings(board_folder=no_picture, board=dataclasses.replace(BOARD, squares=(1, 1))),
        "serial names the file, so it must have a character": settings(points=points, serial=""),
        "and no slash, got '../a'": settings(points=points, serial="../a"),
        "fx, fy must be pixels": settings(points=points, intrinsics=(640.0, 480.0, 1.9, 1.9, 320.0, 240.0)),
    }


def test_wrong_input_is_one_line(tmp_path):
    for message, config in bad_inputs(tmp_path).items():
        with pytest.raises(UserError, match=message):
            calibrate(config)


def test_a_folder_that_cannot_be_written(tmp_path, monkeypatch):
    points = write_points(tmp_path / "touched.csv", pixels=False)
    (tmp_path / "file").touch()
    options = ["--camera=front", "--serial=123456", "--intrinsics=[640,480,605,604,321,243]", f"--points={points}"]
    with pytest.raises(UserError, match=r"--folder '.*file' cannot be written"):
        run(monkeypatch, *options, f"--folder={tmp_path / 'file'}")


def test_intrinsics_are_looked_at_first(tmp_path):
    points = write_points(tmp_path / "touched.csv", pixels=True)
    with pytest.raises(UserError, match=r"^--intrinsics: fx, fy must be pixels that fit 640 x 480, got 605, 0"):
        calibrate(settings(points=points, intrinsics=(640.0, 480.0, 605.0, 0.0, 321.0, 243.0)))
