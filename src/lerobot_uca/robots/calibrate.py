"""`lerobot-uca-calibrate`: where a camera is, from touched points or from a board seen in several poses of the robot.

Example:
    lerobot-uca-calibrate --points=touched.csv --camera=front --serial=123456 --intrinsics='[640,480,605,605,321,243]'
"""

import csv
import logging
import shutil
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from lerobot.configs import parser
from tqdm import tqdm

from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.calibration import (
    Calibration,
    CalibrationError,
    check_intrinsics,
    pose_difference,
    read_calibrations,
)
from lerobot_uca.point_clouds.depth import MILLIMETRE
from lerobot_uca.point_clouds.geometry import Array, Camera, as_pose
from lerobot_uca.point_clouds.registration import Fit, fit_board, fit_points

logger = logging.getLogger(__name__)

CAMERA_POINT, PIXEL = ("camera_x", "camera_y", "camera_z"), ("u", "v", "depth")
BASE_POINT = ("base_x", "base_y", "base_z")
POSE = ("x", "y", "z", "rx", "ry", "rz")
MIN_SQUARES, MIN_CORNERS = 3, 6
DEFAULT_FOLDER = Path("calibration")


@dataclass
class BoardConfig:
    """A ChArUco board as it was printed."""

    # Squares along x and y.
    squares: tuple[int, int] = (7, 5)
    # Edge of a square [m]. Measure it on the print.
    square: float = 0.03
    # Edge of a marker [m].
    marker: float = 0.022
    # The markers' dictionary, one of OpenCV's.
    dictionary: str = "DICT_4X4_50"


@dataclass
class CalibrateConfig:
    """Find a fixed camera's pose in the robot's base frame, or an arm camera's in the tool's, and write it to a file.

    From points that the tool's tip has touched: a CSV with the columns base_x, base_y, base_z [m] and either camera_x,
    camera_y, camera_z [m] or u, v [pixels], depth [m]:

      lerobot-uca-calibrate --points=touched.csv --camera=front --serial=123456 --intrinsics='[640,480,605,605,321,243]'

    From a ChArUco board in several poses of the robot: a folder with pictures and a poses.csv with the columns
    image, x, y, z [m], rx, ry, rz [rad, rotation vector], the tool's pose in the base frame, as a UR shows it. The
    pictures are of the imager whose frame depth has, on a RealSense D400 the left infrared one with its emitter off:

      lerobot-uca-calibrate --board_folder=board --camera=front --serial=123456 --intrinsics='[640,480,605,605,321,243]'

    The file goes to --folder. LEROBOT_UCA_CALIBRATION or --policy.depth.calibration names that folder afterwards.
    """

    # The camera's name in the robot's configuration.
    camera: str
    # Serial number of the device; names the file.
    serial: str
    # Width, height, fx, fy, cx, cy [pixels], of the depth image, as the camera's software tells them.
    intrinsics: tuple[float, float, float, float, float, float]
    # Touched points, a CSV.
    points: Path | None = None
    # Pictures of a board and the robot's poses.
    board_folder: Path | None = None
    # The board.
    board: BoardConfig = field(default_factory=BoardConfig)
    # The camera sits on the arm and the board lies still (eye-in-hand); otherwise the board sits on the arm.
    on_arm: bool = False
    # Metres a unit of the camera's depth images.
    depth_unit: float = MILLIMETRE
    # The folder of calibrations.
    folder: Path = DEFAULT_FOLDER


def calibrate(config: CalibrateConfig) -> tuple[Calibration, Fit]:
    """Find the pose.

    Raises:
        UserError: for data that are missing, wrong or do not determine the pose.
    """
    if not config.serial or set(config.serial) & {"/", "\\"}:
        raise UserError(f"serial names the file, so it must have a character and no slash, got '{config.serial}'.")
    if (config.points is None) == (config.board_folder is None):
        raise UserError("Give either --points (touched points) or --board_folder (pictures of a board).")
    width, height, fx, fy, cx, cy = config.intrinsics
    camera = Camera(config.camera, fx, fy, cx, cy, int(width), int(height), as_pose(np.eye(4)))
    try:
        check_intrinsics(camera, "--intrinsics")
        if config.points is not None:
            if config.on_arm:
                raise UserError("Touched points calibrate a fixed camera; for one on the arm use --board_folder.")
            fit = fit_points(*read_points(config.points, camera))
            method = f"{len(fit.mm)} touched points"
        else:
            assert config.board_folder is not None
            fit = fit_board(*see_board(config.board_folder, config.board, camera), on_arm=config.on_arm)
            method = f"ChArUco board in {len(fit.mm)} poses, {'eye-in-hand' if config.on_arm else 'eye-to-hand'}"
        calibration = Calibration(
            replace(camera, X_world_camera=as_pose(fit.X)),
            serial=config.serial,
            frame="tool" if config.on_arm else "base",
            depth_unit=config.depth_unit,
            date=datetime.now(UTC).date().isoformat(),
            method=method,
            residual=fit.residual,
        )
        return Calibration.from_dict(calibration.as_dict()), fit  # reading checks it
    except CalibrationError as error:
        raise UserError(str(error)) from error


def read_points(file: Path, camera: Camera) -> tuple[Array, Array]:
    """The same points in the camera's and in the base frame, (P, 3) each [m]."""
    rows = _read_csv(file)
    base = _columns(file, rows, BASE_POINT)
    if rows and set(CAMERA_POINT) <= rows[0].keys():
        return _columns(file, rows, CAMERA_POINT), base
    u, v, depth = _columns(file, rows, PIXEL).T
    return np.stack([(u - camera.cx) / camera.fx * depth, (v - camera.cy) / camera.fy * depth, depth], axis=1), base


def see_board(folder: Path, board: BoardConfig, camera: Camera) -> tuple[Array, Array]:
    """X_base_tool and X_camera_board, (K, 4, 4) each, of the pictures that show enough of the board."""
    import cv2  # slow to import

    file = folder / "poses.csv"
    rows = _read_csv(file)
    poses = _columns(file, rows, POSE)
    names = _names(file, rows)
    if not (board.dictionary.startswith("DICT_") and hasattr(cv2.aruco, board.dictionary)):
        raise UserError(f"board.dictionary must be one of OpenCV's, such as DICT_4X4_50, got '{board.dictionary}'.")
    if not (0 < board.marker < board.square and min(board.squares) >= MIN_SQUARES):
        raise UserError(
            f"A board has at least {MIN_SQUARES} x {MIN_SQUARES} squares and markers smaller than these, got "
            f"board.squares={list(board.squares)}, board.square={board.square}, board.marker={board.marker}."
        )
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    charuco = cv2.aruco.CharucoBoard(board.squares, board.square, board.marker, dictionary)
    detector = cv2.aruco.CharucoDetector(charuco)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    seen, unseen = [], []
    for name, pose in zip(tqdm(names, desc="Pictures", unit="picture", disable=None), poses, strict=True):
        picture = cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)
        if picture is None or picture.shape != (camera.height, camera.width):
            got = "no picture" if picture is None else f"{picture.shape[1]} x {picture.shape[0]}"
            raise UserError(f"'{folder / name}' must be {camera.width} x {camera.height} pixels, got {got}.")
        X_camera_board = _board_pose(detector, charuco, picture, K)
        if X_camera_board is None:
            unseen.append(name)
        else:
            seen.append((_from_vectors(pose[3:], pose[:3]), X_camera_board))
    if unseen:
        logger.warning(
            "%d of %d pictures show too little of the board: %s.", len(unseen), len(names), ", ".join(unseen)
        )
    X_base_tool, X_camera_boards = ([pair[side] for pair in seen] for side in (0, 1))
    return np.array(X_base_tool).reshape(-1, 4, 4), np.array(X_camera_boards).reshape(-1, 4, 4)


def _names(file: Path, rows: list[dict[str, str]]) -> list[str]:
    if "image" not in rows[0]:
        raise UserError(f"'{file}' must have the column image, the names of the pictures, got {', '.join(rows[0])}.")
    for index, row in enumerate(rows, start=1):
        if not row["image"]:  # None in a row that is too short
            raise UserError(f"'{file}' must have the name of a picture in each row, got none in row {index}.")
    return [row["image"] for row in rows]


def _board_pose(detector: Any, board: Any, picture: Any, K: Array) -> Array | None:
    import cv2

    corners, ids, _, _ = detector.detectBoard(picture)
    if ids is None or len(ids) < MIN_CORNERS or board.checkCharucoCornersCollinear(ids):
        return None
    on_board, in_picture = board.matchImagePoints(corners, ids)
    found, rotation, translation = cv2.solvePnP(on_board, in_picture, K, np.zeros(5), flags=cv2.SOLVEPNP_IPPE)
    if not found:
        return None
    rotation, translation = cv2.solvePnPRefineLM(on_board, in_picture, K, np.zeros(5), rotation, translation)
    X = _from_vectors(np.asarray(rotation, np.float64), np.asarray(translation, np.float64))
    return X if np.isfinite(X).all() else None


def _from_vectors(rotation: Array, translation: Array) -> Array:
    import cv2

    X = np.eye(4)
    X[:3, :3], X[:3, 3] = cv2.Rodrigues(rotation)[0], np.ravel(translation)
    return X


def _read_csv(file: Path) -> list[dict[str, str]]:
    try:
        with file.open(newline="", encoding="utf-8-sig") as opened:  # spreadsheets write a mark at the beginning
            return [{(key or "").strip(): value for key, value in row.items()} for row in csv.DictReader(opened)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"'{file}' cannot be read: {error}") from error


def _columns(file: Path, rows: list[dict[str, str]], names: tuple[str, ...]) -> Array:
    missing = [name for name in names if not rows or name not in rows[0]]
    if missing:
        got = ", ".join(rows[0]) if rows else "no rows"
        raise UserError(
            f"'{file}' must have the columns {', '.join(names)}; {', '.join(missing)} is missing, got {got}."
        )
    try:
        values = np.array([[float(row[name]) for name in names] for row in rows])
    except (TypeError, ValueError) as error:
        raise UserError(f"'{file}' must hold numbers in {', '.join(names)}: {error}") from error
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise UserError(
            f"'{file}' must hold finite numbers in {', '.join(names)}, got {values[bad[0]]} in row {bad[0] + 1}."
        )
    return values


@parser.wrap()
def run(config: CalibrateConfig) -> None:
    """Calibrate, say how well it fits and what changed, and write the file."""
    calibration, fit = calibrate(config)
    pose = calibration.camera.X_world_camera
    before = _previous(config)
    try:
        replaced = _copy_replaced(config)
        file = calibration.write(config.folder)
        for former in replaced - {file}:
            former.unlink()
    except OSError as error:
        raise UserError(f"--folder '{config.folder}' cannot be written: {error}") from error
    worst = int(np.argmax(fit.mm))
    residual = ", ".join(f"{value:.2f} {unit}" for unit, value in calibration.residual.items())
    print(f"Camera '{config.camera}' in the {calibration.frame} frame at {np.round(calibration.camera.position, 4)} m.")
    print(f"Residual {residual} (RMS); the worst of {len(fit.mm)} is number {worst + 1}, {fit.mm[worst]:.2f} mm off.")
    if before is not None:
        mm, deg = pose_difference(before.camera.X_world_camera, pose)
        print(f"It was {mm:.1f} mm and {deg:.2f} deg from here ({before.date or 'no date'}).")
    print(f"Written: {file}. Use it: export LEROBOT_UCA_CALIBRATION={config.folder.absolute()}")


def _copy_replaced(config: CalibrateConfig) -> set[Path]:
    """Copy to .old what stands for this camera's name, this device or its file, and is no calibration any longer.

    A name stands for one device, and a device has one name and one file.
    """
    new = (config.camera, config.serial, f"{config.serial}.yaml")
    replaced = set()
    for file in config.folder.glob("[!.]*.yaml"):
        values = yaml.safe_load(file.read_text(encoding="utf-8"))
        camera, serial = str(values["camera"]), str(values["serial"])
        is_shared = [ours == theirs for ours, theirs in zip(new, (camera, serial, file.name), strict=True)]
        if any(is_shared) and not all(is_shared):  # all: the same camera, calibrated anew
            aside = shutil.copy2(file, file.with_name(f"{file.name}.old"))
            logger.warning("Camera '%s' was the device %s: its file is %s now.", camera, serial, aside)
            replaced.add(file)
    return replaced


def _previous(config: CalibrateConfig) -> Calibration | None:
    if not any(config.folder.glob("[!.]*.yaml")):
        return None
    try:
        return read_calibrations(config.folder).get(config.camera)
    except CalibrationError as error:
        raise UserError(str(error)) from error
