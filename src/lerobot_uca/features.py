"""Names of the features that datasets, environments and policies share, besides LeRobot's own."""

from collections.abc import Iterable, Mapping
from typing import Any

OBS_POINT_CLOUD = "observation.point_cloud"
"""(N, 3) float32 [m], in the frame that the environment or robot states; with colours (N, 6), RGB after xyz."""

ENV_NAMES = {"point_cloud": OBS_POINT_CLOUD, "agent_pos": "observation.state"}
"""The environments' names of their observations, and the policies'."""

POINT_CLOUD_KEYS = (OBS_POINT_CLOUD, "observation.pointcloud", "observation.pointcloud.xyz")
"""Keys under which a point cloud is found, in this order: this package's and other plugins'."""

POINT_CLOUD, OBJECT_CLOUD = "point_cloud", "object_cloud"
"""The environments' observations that are clouds, with the robot in them and without."""

OBSERVATION_INFO = "observation"
"""features[key]['info'][OBSERVATION_INFO] says which of them a dataset's cloud is; POINT_CLOUD if nothing does."""

VALID_MASK_SUFFIX = ".valid_mask"
"""Appended to a cloud's key (without .xyz), it names which of its points are valid, (N,) bool."""

INTRINSICS, EXTRINSICS = "observation.intrinsics.", "observation.extrinsics."
"""Before a camera's name: its calibration beside depth images, (3, 3) [pixels] and (4, 4) [m], camera to world."""


def find_point_cloud(keys: Iterable[str]) -> str | None:
    """The key of the point cloud among these, if there is one."""
    known = set(keys)
    return next((key for key in POINT_CLOUD_KEYS if key in known), None)


def valid_mask(key: str, keys: Iterable[str]) -> str | None:
    """The key of the mask that belongs to the point cloud under a key, if it is among these."""
    mask = key.removesuffix(".xyz") + VALID_MASK_SUFFIX
    return mask if mask in set(keys) else None


def observation_info(observation: str) -> dict[str, str]:
    """What a dataset's cloud says of itself. A point_cloud says nothing, as before there were others."""
    return {OBSERVATION_INFO: observation} if observation == OBJECT_CLOUD else {}


def cloud_observation(features: Mapping[str, Mapping[str, Any]]) -> str:
    """Which of the environments' observations the cloud of a dataset's features is."""
    key = find_point_cloud(features)
    info = {} if key is None else features[key].get("info") or {}
    return info.get(OBSERVATION_INFO, POINT_CLOUD)
