"""Observing a simulated scene: as a point cloud, or as the depth image that a policy makes its cloud from."""

from collections.abc import Sequence

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBJECT_CLOUD, POINT_CLOUD
from lerobot_uca.point_clouds.cameras import DepthCamera, Marker, PointCloudCamera
from lerobot_uca.point_clouds.depth import to_millimetres
from lerobot_uca.point_clouds.geometry import Camera, Crop, sample_farthest


class CloudObserver:
    """A point cloud, (n_points, 3) float32, world frame [m].

    It is a farthest point sampling, in sampling order, of what the camera sees inside the crop.
    """

    key = "point_cloud"

    def __init__(self, camera: Camera, crop: Crop, n_points: int, robot: str) -> None:  # noqa: ARG002 (the others')
        self.camera = PointCloudCamera(camera, crop)
        self.n_points = n_points
        self.space = gym.spaces.Box(-np.inf, np.inf, (n_points, 3), np.float32)

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData, markers: Sequence[Marker]) -> NDArray[np.float32]:
        """The cloud.

        Raises:
            UserError: if it is empty.
        """
        points = self.camera.capture(model, data, markers)
        if len(points) == 0:
            camera, crop = self.camera.camera, self.camera.crop
            raise UserError(
                f"the cloud is empty. Camera {camera.name} at {tuple(camera.position.tolist())} m sees no point inside "
                f"the crop {crop.low} to {crop.high} m."
            )
        return sample_farthest(points, self.n_points)


class ObjectCloudObserver(CloudObserver):
    """The same without the robot, which its state tells: a self-filter, as on a real arm whose shape is known.

    Of 128 points up to 117 lie on the robot (Meta-World's reach), each of which is one fewer on the task. Should it
    hide everything else, the cloud is the robot's.
    """

    def __init__(self, camera: Camera, crop: Crop, n_points: int, robot: str) -> None:
        super().__init__(camera, crop, n_points, robot)
        self.camera = PointCloudCamera(camera, crop, left_out=robot)


class DepthObserver:
    """A depth image as a RealSense camera gives it, (1, height, width) uint16 [mm], 0 where nothing is."""

    def __init__(self, camera: Camera, crop: Crop, n_points: int, robot: str) -> None:  # noqa: ARG002 (the others')
        self.camera = DepthCamera(camera)
        self.key = depth_name(camera)
        self.space = gym.spaces.Box(0, np.iinfo(np.uint16).max, (1, camera.height, camera.width), np.uint16)

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData, markers: Sequence[Marker]) -> NDArray[np.uint16]:
        """The image."""
        return to_millimetres(self.camera.capture(model, data, markers))[None]


Observer = CloudObserver | DepthObserver
OBSERVERS: dict[str, type[Observer]] = {
    POINT_CLOUD: CloudObserver,
    OBJECT_CLOUD: ObjectCloudObserver,
    "depth": DepthObserver,
}


def observer_of(observation: str) -> type[Observer]:
    """The observer of that name in `OBSERVERS`.

    Raises:
        UserError: for another name.
    """
    if observation not in OBSERVERS:
        raise UserError(f"env.observation must be one of {', '.join(OBSERVERS)}, got '{observation}'.")
    return OBSERVERS[observation]


def depth_name(camera: Camera) -> str:
    """A camera's depth image among an environment's observations; LeRobot puts 'observation.' before it."""
    return f"images.{camera.name}_depth"
