"""Point clouds from a pinhole camera: geometry only, no simulator.

All lengths are metres, all points and directions are in the world frame unless a name says otherwise.
The camera frame is MuJoCo's (and OpenGL's): x to the right, y up, looking along -z.
Letters: N points, R = H * W rays in row-major order from the top left pixel.
"""

from dataclasses import dataclass

import fpsample
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Height of fpsample's k-d tree. It decides where sampling starts and how fast it is;
# 3 was the fastest of 3, 5, 7 and 9 for 700 to 2700 points.
KD_TREE_HEIGHT = 3


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Args:
        name: what errors call it.
        position: of the camera in the world [m].
        rotation: 3 x 3, row by row; its columns are the camera's x, y, z axes in the world (R_world_camera).
        fovy: vertical field of view [deg].
        width, height: of the image [pixels].
    """

    name: str
    position: tuple[float, float, float]
    rotation: tuple[tuple[float, float, float], ...]
    fovy: float
    width: int
    height: int

    def ray_directions(self) -> Array:
        """Unit vectors through the pixel centres, (R, 3), world frame."""
        focal = 0.5 * self.height / np.tan(np.radians(self.fovy) / 2)  # [pixels]
        right = (np.arange(self.width) + 0.5 - self.width / 2) / focal
        up = -(np.arange(self.height) + 0.5 - self.height / 2) / focal
        in_camera = np.stack(np.broadcast_arrays(right[None, :], up[:, None], -1.0), axis=-1).reshape(-1, 3)
        in_world = in_camera @ np.asarray(self.rotation, dtype=np.float64).T
        return in_world / np.linalg.norm(in_world, axis=1, keepdims=True)


@dataclass(frozen=True)
class Crop:
    """An axis-aligned box in the world frame: what lies outside is no part of the cloud.

    Args:
        low, high: opposite corners [m].
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Which of the points (N, 3) lie inside, (N,)."""
        return np.all((points >= self.low) & (points <= self.high), axis=1)

    def span(self, origin: Array, directions: Array) -> tuple[Array, Array]:
        """Where rays from origin (3,) along directions (R, 3) enter and leave the box: two distances [m], (R,) each.

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
    along = np.einsum("rc,c->r", directions, to_centre)  # not by BLAS, see ray_casting.py
    half_chord_squared = radius**2 - (to_centre @ to_centre - along**2)
    hit = (half_chord_squared >= 0) & (along > 0)
    return np.where(hit, along - np.sqrt(np.maximum(half_chord_squared, 0)), np.inf)


def sample_farthest(points: Array, n_points: int) -> NDArray[np.float32]:
    """Farthest point sampling of points (N, 3), exact: (n_points, 3) float32 in sampling order.

    Every prefix of the result is itself a farthest point sampling, so a policy may take the first 128 of 512.
    The k-d tree decides where it starts, so the same points always give the same sample. If there are fewer points
    than asked for, all of them are repeated in turn: zeros would be points at the world's origin.

    Raises:
        ValueError: if there is no point at all.
    """
    if len(points) == 0:
        raise ValueError("The point cloud is empty: 0 points, at least 1 is needed.")
    cloud = np.ascontiguousarray(points, dtype=np.float32)
    n_distinct = min(n_points, len(cloud))
    if len(cloud) < 2**KD_TREE_HEIGHT:  # too few to fill the tree
        order = fpsample.fps_sampling(cloud, n_distinct, start_idx=0)
    else:
        order = fpsample.bucket_fps_kdline_sampling(cloud, n_distinct, h=KD_TREE_HEIGHT, start_idx=0)
    return cloud[np.resize(order, n_points)]


def shade(colours: Array, normals: Array, directions: Array) -> NDArray[np.uint8]:
    """A picture of surfaces lit from the camera: (R, 3) uint8.

    Args:
        colours: of the surfaces, RGB in [0, 1], (R, 3).
        normals: unit surface normals, (R, 3), of either sign.
        directions: unit viewing directions, (R, 3).
    """
    facing = np.abs(np.einsum("rc,rc->r", normals, directions))
    return np.round(255 * np.clip(colours * (0.35 + 0.65 * facing[:, None]), 0, 1)).astype(np.uint8)
