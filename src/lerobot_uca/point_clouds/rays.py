"""The rays of a camera and their first hits. Letters: H x W pixels, R rays. Lengths in metres, world frame."""

import itertools
import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.point_clouds.geometry import Array, Camera

NEAREST_DEPTH = 1e-3  # [m]; what is nearer to the camera's plane, or behind it, has no exact projection
NO_GEOM = -1
"""A hit's geom where nothing was hit."""
_CUBE = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


class Rays(NamedTuple):
    """A camera's rays, through those of its pixels that matter."""

    origin: Array  # (3,)
    directions: Array  # (R, 3), unit
    projection: Array  # (3, 3), of a point relative to the origin to homogeneous pixels: column, row, 1
    of_pixel: NDArray[np.int32]  # (H, W), index of the ray, -1 where there is none

    @classmethod
    def of(cls, camera: Camera, matters: NDArray[np.bool_]) -> Self:
        """The rays through the pixels (H * W,) that matter."""
        of_pixel = np.full(len(matters), -1, np.int32)
        of_pixel[matters] = np.arange(matters.sum())
        intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        projection = intrinsics @ np.array(camera.X_world_camera)[:3, :3].T
        directions = camera.ray_directions()[matters]
        return cls(camera.position, directions, projection, of_pixel.reshape(camera.height, camera.width))

    def around(self, centre: Array, radius: float) -> NDArray[np.int32]:
        """The rays, and some more, that may meet a sphere: those through the pixels of a cube around it."""
        corners = centre + radius * _CUBE - self.origin
        columns, rows, depths = self.projection @ corners.T
        if depths.min() < NEAREST_DEPTH:  # it reaches behind the camera
            return np.arange(len(self.directions), dtype=np.int32)
        columns, rows = columns / depths, rows / depths
        left, top = (max(0, math.floor(pixels.min())) for pixels in (columns, rows))
        right, bottom = (max(0, math.ceil(pixels.max()) + 1) for pixels in (columns, rows))
        window = self.of_pixel[top:bottom, left:right].ravel()
        return window[window >= 0]


class Hits(NamedTuple):
    """The first hits of R rays."""

    distance: Array  # (R,) [m], inf where nothing was hit
    geom: NDArray[np.int32]  # (R,), `NO_GEOM` where nothing was hit
    normal: Array  # (R, 3), of any length; (0, 3) without normals

    @classmethod
    def none(cls, n_rays: int, *, with_normals: bool) -> Self:
        """Nothing was hit yet."""
        normal = np.zeros((n_rays if with_normals else 0, 3))
        return cls(np.full(n_rays, np.inf), np.full(n_rays, NO_GEOM, np.int32), normal)

    def copy(self) -> Self:
        """The same in memory of its own."""
        return type(self)(self.distance.copy(), self.geom.copy(), self.normal.copy())
