"""A camera, what it sees, and tiny datasets of it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_uca.point_clouds.calibration import Calibration
from lerobot_uca.point_clouds.geometry import Camera, Crop, as_pose
from lerobot_uca.point_clouds.recipe import CloudRecipe, DepthSource
from tests.builders import N_ACTIONS, N_STATES

LOOKING_DOWN_AND_AHEAD = np.array([[0.0, -0.6, 0.8], [-1.0, 0.0, 0.0], [0.0, -0.8, -0.6]])
CROP = Crop((0.2, -0.3, 0.01), (0.9, 0.35, 0.4))
DEPTH_KEY = "observation.images.front_depth"
N_CLOUD_POINTS = 48


def make_camera(name="front", *, position=(-0.3, 0.05, 0.7), size=(64, 48), rotation=LOOKING_DOWN_AND_AHEAD) -> Camera:
    width, height = size
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = rotation, position
    return Camera(name, 0.9 * width, 0.92 * width, 0.48 * width, 0.51 * height, width, height, as_pose(X))


def make_calibration(camera: Camera | None = None, **changes: object) -> Calibration:
    settings = {"serial": "123456", "date": "2026-11-25", "method": "12 touched points", "residual": {"mm": 1.3}}
    return Calibration(camera or make_camera(), **{**settings, **changes})


def make_recipe(**changes: object) -> CloudRecipe:
    source = DepthSource(DEPTH_KEY, make_calibration(**changes))
    return CloudRecipe((source,), CROP, N_CLOUD_POINTS)


def random_depth(camera: Camera, seed: int = 0) -> np.ndarray:
    """Depths [m] some of which lie inside the crop, (H, W)."""
    return np.random.default_rng(seed).uniform(0.3, 1.8, (camera.height, camera.width))


def live_frame(seed: int) -> np.ndarray:
    """A frame like a RealSense camera's: uint16 mm (H, W, 1), with pixels that measure nothing or very far."""
    frame = np.rint(1e3 * random_depth(make_camera(), seed)).astype(np.uint16)
    frame[::5, ::3], frame[1::7, ::4] = 0, 12000
    return frame[..., None]


def write_depth_dataset(
    root: Path,
    *,
    video: bool,
    n_episodes: int = 2,
    length: int = 6,
    columns: dict[str, Callable[[int], np.ndarray]] | None = None,
    **info: object,
) -> LeRobotDataset:
    """Depth images `live_frame(index)`, states and actions, as lerobot-record writes them.

    Args:
        columns: further features, which give a frame's values for its index.
        info: of the depth images.
    """
    columns = columns or {}
    rng = np.random.default_rng(0)
    names = ["height", "width", "channels"]
    features = {
        DEPTH_KEY: {
            "dtype": "video" if video else "image",
            "shape": (48, 64, 1),
            "names": names,
            "info": {"is_depth_map": True, **info},
        },
        "observation.state": {"dtype": "float32", "shape": (N_STATES,), "names": None},
        "action": {"dtype": "float32", "shape": (N_ACTIONS,), "names": None},
        **{key: {"dtype": "float32", "shape": of(0).shape, "names": None} for key, of in columns.items()},
    }
    dataset = LeRobotDataset.create("test/depth", fps=20, features=features, root=root, use_videos=video)
    for index in range(n_episodes * length):
        values = {
            key: rng.normal(size=shape).astype(np.float32)
            for key, shape in (("observation.state", N_STATES), ("action", N_ACTIONS))
        }
        values |= {key: of(index).astype(np.float32) for key, of in columns.items()}
        dataset.add_frame({DEPTH_KEY: live_frame(index), **values, "task": "push"})
        if index % length == length - 1:
            dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("test/depth", root=root)
