"""Point clouds from a pinhole camera: geometry only, no simulator.

All lengths are metres, all points and directions are in the world frame unless a name says otherwise.
X_a_b is the pose of b in a: it takes points from frame b to frame a.
Letters: N points, R = H * W rays in row-major order from the top left pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Pose = tuple[tuple[float, float, float, float], ...]
"""A rigid motion, 4 x 4, row by row."""

# Height of fpsample's k-d tree. It decides where sampling starts and how fast it is;
# 3 was the fastest of 3, 5, 7 and 9 for 700 to 2700 points.
KD_TREE_HEIGHT = 3


def opencv_from_opengl(X_world_camera: Array) -> Array:
    """A camera's pose (4, 4) from OpenGL's convention (y up, z backward) to OpenCV's (y down, z forward), or back."""
    return np.asarray(X_world_camera, dtype=np.float64) @ np.diag([1.0, -1.0, -1.0, 1.0])


def as_pose(X: Array) -> Pose:
    """A 4 x 4 array as numbers that do not change."""
    first, second, third, fourth = np.asarray(X, dtype=np.float64).tolist()
    return tuple(first), tuple(second), tuple(third), tuple(fourth)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in OpenCV's convention: x to the right, y down, z forward; pixel centres at whole numbers.

    Args:
        name: used in error messages.
        fx, fy: focal lengths [pixels].
        cx, cy: principal point [pixels].
        width, height: of the image [pixels].
        X_world_camera: pose, 4 x 4, row by row; its columns are the camera's x, y and z axes and its position [m].
    """

    name: str
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    X_world_camera: Pose

    @classmethod
    def from_fovy(
        cls,
        name: str,
        position: Sequence[float],
        rotation: Sequence[Sequence[float]],
        fovy: float,
        size: tuple[int, int],
    ) -> Self:
        """A camera as MuJoCo and OpenGL describe it: x to the right, y up, looking along -z.

        Args:
            name: used in error messages.
            position: in the world [m].
            rotation: 3 x 3, its columns are the axes of the OpenGL camera in the world.
            fovy: vertical field of view [deg]. The principal point is the centre, pixels are square.
            size: width and height [pixels].
        """
        width, height = size
        focal = float(0.5 * height / np.tan(np.radians(fovy) / 2))
        X_world_opengl = np.eye(4)
        X_world_opengl[:3, :3], X_world_opengl[:3, 3] = rotation, position
        pose = as_pose(opencv_from_opengl(X_world_opengl))
        return cls(name, focal, focal, (width - 1) / 2, (height - 1) / 2, width, height, pose)

    @property
    def position(self) -> Array:
        """The position in the world, (3,) [m]."""
        return np.array(self.X_world_camera)[:3, 3].copy()

    def ray_directions(self) -> Array:
        """Unit vectors through the pixel centres, (R, 3), world frame."""
        rays = self.depth_rays()
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def depth_rays(self) -> Array:
        """Vectors through the pixel centres along which a distance is a depth, (R, 3), world frame."""
        return self._rays_at_unit_depth() @ np.asarray(self.X_world_camera)[:3, :3].T

    def unproject(self, depth: Array) -> Array:
        """Points seen at a depth (H, W), measured along the camera's z axis [m]: (R, 3), world frame [m]."""
        if np.shape(depth) != (self.height, self.width):
            raise ValueError(
                f"A depth of camera '{self.name}' has shape {(self.height, self.width)}, got {np.shape(depth)}."
            )
        X = np.asarray(self.X_world_camera)
        return (self._rays_at_unit_depth() * np.reshape(depth, (-1, 1))) @ X[:3, :3].T + X[:3, 3]

    def depth(self, distances: Array) -> Array:
        """Depths (H, W) along the camera's z axis [m] of points at distances (R,) along the rays [m]."""
        return np.reshape(distances * self._cosines, (self.height, self.width))

    @cached_property
    def _cosines(self) -> Array:
        """Depth of each pixel's point a metre along its ray, (R,): a simulated camera asks at each step."""
        return 1 / np.linalg.norm(self._rays_at_unit_depth(), axis=1)

    def _rays_at_unit_depth(self) -> Array:
        """Camera frame, (R, 3)."""
        right = (np.arange(self.width) - self.cx) / self.fx
        down = (np.arange(self.height) - self.cy) / self.fy
        return np.stack(np.broadcast_arrays(right[None, :], down[:, None], 1.0), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class Crop:
    """An axis-aligned box in the world frame; points outside are not part of the cloud.

    Args:
        low, high: opposite corners [m].
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def contains(self, points: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
        """Whether each of the points (N, 3) lies inside, (N,)."""
        x, y, z = ((points >= self.low) & (points <= self.high)).T  # np.all takes twice as long
        return x & y & z

    def span(self, origin: Array, directions: Array) -> tuple[Array, Array]:
        """Distances [m] at which rays from origin (3,) along directions (R, 3) enter and leave the box, (R,) each.

        A ray that misses the box has enter > leave. It cannot give a point, so it need not be cast.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            to_low = (np.asarray(self.low) - origin) / directions
            to_high = (np.asarray(self.high) - origin) / directions
        # fmax and fmin drop the NaN of a ray that runs inside a face of the box.
        enter = np.fmax.reduce(np.fmin(to_low, to_high), axis=1, initial=0)
        leave = np.fmin.reduce(np.fmax(to_low, to_high), axis=1)
        return enter, leave


def ray_sphere_distances(origin: Array, directions: Array, centre: Array, radius: float) -> Array:
    """Distances [m] from origin (3,) along unit directions (R, 3) to a sphere, (R,); inf for a miss."""
    to_centre = centre - origin
    along = np.einsum("rc,c->r", directions, to_centre)  # not by BLAS, whose threads would spin
    half_chord_squared = radius**2 - (to_centre @ to_centre - along**2)
    hit = (half_chord_squared >= 0) & (along > 0)
    return np.where(hit, along - np.sqrt(np.maximum(half_chord_squared, 0)), np.inf)


MAX_PLAIN_POINTS = 1024
"""Above it, `subsample_farthest` uses the k-d tree, which is then several times faster."""


def subsample_farthest(points: NDArray[np.float32], n_points: int) -> NDArray[np.float32]:
    """Farthest point sampling of a cloud (N, 3 or more) with N of at least n_points, exact: (n_points, 3 or more).

    It starts from the first of up to 1024 points, so that a cloud in sampling order gives its own first n_points.
    """
    if len(points) > MAX_PLAIN_POINTS:
        return sample_farthest(points, n_points)
    import fpsample  # where a cloud is sampled: policies must register without it

    return points[fpsample.fps_sampling(_xyz(points), n_points, start_idx=0)]


def sample_farthest(points: NDArray[np.floating[Any]], n_points: int) -> NDArray[np.float32]:
    """Farthest point sampling of points (N, 3 or more), exact: (n_points, 3 or more) float32 in sampling order.

    Distances are those of xyz, the first three channels; further ones, such as colours, come along.

    Every prefix of the result is itself a farthest point sampling, so a policy may take the first 128 of 512.
    The k-d tree decides where it starts, so the same points always give the same sample. If there are fewer points
    than asked for, all of them are repeated in turn: zeros would be points at the world's origin.

    Raises:
        ValueError: if the cloud is empty.
    """
    if len(points) == 0:
        raise ValueError("The point cloud is empty: 0 points, at least 1 is needed.")
    import fpsample  # as above

    cloud = np.asarray(points, dtype=np.float32)
    xyz = _xyz(cloud)
    n_distinct = min(n_points, len(cloud))
    if len(cloud) < 2**KD_TREE_HEIGHT:  # too few to fill the tree
        order = fpsample.fps_sampling(xyz, n_distinct, start_idx=0)
    else:
        order = fpsample.bucket_fps_kdline_sampling(xyz, n_distinct, h=KD_TREE_HEIGHT, start_idx=0)
    return cloud[np.resize(order, n_points)]


def _xyz(points: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.ascontiguousarray(points[:, :3])
