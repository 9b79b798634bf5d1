"""Calibrations that a dataset holds beside its depth images, in the layout of LeRobot's open pull request 4696.

`observation.intrinsics.<camera>` (3, 3) [pixels] and `observation.extrinsics.<camera>` (4, 4) [m], camera to world, in
each frame. The world is taken for the robot's base frame.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_uca.errors import UserError
from lerobot_uca.features import EXTRINSICS, INTRINSICS, find_point_cloud
from lerobot_uca.point_clouds.calibration import Calibration, CalibrationError, pose_difference
from lerobot_uca.point_clouds.recipe import camera_of, depth_keys

logger = logging.getLogger(__name__)

STILL = (1.0, 0.1)
"""(mm, deg) A camera that moves less in a dataset is a fixed one."""


def recorded_calibrations(dataset: Any, episodes: Sequence[int] | None = None) -> dict[str, Calibration]:
    """The calibrations of a LeRobot dataset's depth cameras that it holds itself, by the name of the camera.

    Args:
        dataset: opened.
        episodes: that matter, of those that were opened; by default all.

    Raises:
        UserError: if a camera moves, or has several intrinsics.
        CalibrationError: if one cannot be right.
    """
    found = {}
    for key in depth_keys(dataset.features):
        name = camera_of(key)
        if {INTRINSICS + name, EXTRINSICS + name} <= dataset.features.keys():
            found[name] = _calibration(dataset, name, dataset.features[key]["shape"], episodes)
    if found:
        logger.warning(
            "Calibrations in the dataset are used: camera %s. Its world frame must be the robot's base frame.",
            ", ".join(found),
        )
    return found


def calibrations_of_depth(dataset: Any, rename_map: Mapping[str, str]) -> dict[str, Calibration]:
    """The same for a training, under the names that the policy sees; none if it sees a cloud.

    Raises:
        UserError: as `recorded_calibrations`, and if a calibration cannot be right.
    """
    names = {key: rename_map.get(key, key) for key in dataset.features}
    if find_point_cloud(names.values()) is not None:
        return {}
    try:
        recorded = recorded_calibrations(dataset)
    except CalibrationError as error:
        raise UserError(str(error)) from error
    return {camera_of(name): recorded[camera_of(key)] for key, name in names.items() if camera_of(key) in recorded}


def _calibration(dataset: Any, name: str, shape: tuple[int, ...], episodes: Sequence[int] | None) -> Calibration:
    wanted = [INTRINSICS + name, EXTRINSICS + name, "episode_index"]
    columns = dataset.hf_dataset.select_columns(wanted).with_format("numpy")[:]
    is_chosen = np.isin(columns["episode_index"], columns["episode_index"] if episodes is None else episodes)
    K, X = (np.asarray(columns[kind + name], dtype=np.float64)[is_chosen] for kind in (INTRINSICS, EXTRINSICS))
    episode_of = columns["episode_index"][is_chosen]
    changes = np.abs(K - K[0]).max(axis=(1, 2))
    if (is_off := changes > 1e-3).any():
        raise UserError(
            f"'{INTRINSICS}{name}' must be the same in all frames, it changes by {changes.max():g}, first in episode "
            f"{episode_of[is_off.argmax()]}: choose episodes in which it stays."
        )
    moved = np.array([pose_difference(X[0], each) for each in X])
    if (is_off := (moved > STILL).any(axis=1)).any():
        (mm, deg), episode = moved.max(axis=0), episode_of[is_off.argmax()]
        raise UserError(
            f"Camera '{name}' moves by {mm:.1f} mm and {deg:.2f} deg in the dataset, first in episode {episode} "
            f"('{EXTRINSICS}{name}'). Clouds need a fixed camera: choose episodes in which it stands still."
        )
    (fx, _, cx), (_, fy, cy), _ = K[0].tolist()
    height, width = shape[1:] if shape[0] == 1 else shape[:2]  # (1, H, W), (H, W) or (H, W, 1)
    values = {
        "camera": name,
        "intrinsics": {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy},
        "pose": X[0].tolist(),
        "method": "recorded in the dataset",
    }
    return Calibration.from_dict(values, f"The dataset's calibration of camera '{name}'")
