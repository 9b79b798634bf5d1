"""Pixels that geoms and their triangles may cover in a pinhole camera's image, compiled by Numba.

They choose which rays are cast at what. Each has a margin for rounding, so none is missed.

Letters: V vertices.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.point_clouds.compiling import compiled
from lerobot_uca.point_clouds.geometry import Array
from lerobot_uca.point_clouds.intersections import Vector
from lerobot_uca.point_clouds.rays import NEAREST_DEPTH

Window = tuple[int, int, int, int]
"""First and last column, first and last row; none if first > last."""

MARGIN = 1e-6  # [pixels], far above rounding, far below the distance of two rays


class Geom(NamedTuple):
    """A geom, and how it is seen."""

    id: int  # MuJoCo's
    rotation: Array  # (3, 3), to the world
    origin: Vector  # of the rays, in the geom's frame
    projection: Array  # (3, 3), from the geom's frame, relative to the origin, to homogeneous pixels


class Outline(NamedTuple):
    """A triangle in the image, its corners relative to the first one [pixels]."""

    x: float  # of the first corner
    y: float
    xb: float
    yb: float
    xc: float
    yc: float
    slack: float  # what the margin can change in the comparison


@compiled
def _pixel(x: float, y: float, z: float, geom: Geom) -> tuple[float, float]:
    """Column and row of a point in the geom's frame; NaN if it is not in front of the camera."""
    x, y, z = x - geom.origin[0], y - geom.origin[1], z - geom.origin[2]
    to_pixel = geom.projection
    depth = to_pixel[2, 0] * x + to_pixel[2, 1] * y + to_pixel[2, 2] * z
    if depth < NEAREST_DEPTH:
        return np.nan, np.nan
    return (
        (to_pixel[0, 0] * x + to_pixel[0, 1] * y + to_pixel[0, 2] * z) / depth,
        (to_pixel[1, 0] * x + to_pixel[1, 1] * y + to_pixel[1, 2] * z) / depth,
    )


@compiled
def _between(low: float, high: float, n: int) -> tuple[int, int]:
    """The first and the last of n pixels from one coordinate to another; first > last if there is none."""
    first, last = np.ceil(low - MARGIN), np.floor(high + MARGIN)
    return int(min(max(0.0, first), n)), int(max(min(n - 1.0, last), -1.0))


@compiled
def projected(vertices: NDArray[np.float32], geom: Geom, shape: tuple[int, int]) -> tuple[Array, NDArray[np.int32]]:
    """Pixels (V, 2) and windows (V, 4) of vertices: NaN and all of the image where there is no projection.

    The window of a triangle reaches from its corners' least to their greatest pixels.
    """
    height, width = shape
    pixels = np.empty((len(vertices), 2))
    windows = np.empty((len(vertices), 4), np.int32)
    for i in range(len(vertices)):
        column, row = _pixel(vertices[i, 0], vertices[i, 1], vertices[i, 2], geom)
        pixels[i] = column, row
        if np.isnan(column):
            windows[i] = 0, width - 1, 0, height - 1
        else:
            windows[i, 0], windows[i, 1] = _between(column, column, width)
            windows[i, 2], windows[i, 3] = _between(row, row, height)
    return pixels, windows


@compiled
def outline_of(a: Array, b: Array, c: Array) -> Outline:
    """The outline of a triangle by its corners' pixels (2,)."""
    xb, yb, xc, yc = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
    slack = 8 * MARGIN * (1 + abs(xb) + abs(yb) + abs(xc) + abs(yc))
    return Outline(a[0], a[1], xb, yb, xc, yc, slack)


@compiled
def may_cover(outline: Outline, column: int, row: int) -> bool:
    """Whether a pixel lies on one side of all three edges; so also if a corner has no projection."""
    x, y, slack = column - outline.x, row - outline.y, outline.slack
    ab = outline.xb * y - outline.yb * x
    ca = x * outline.yc - y * outline.xc
    bc = outline.xb * outline.yc - outline.yb * outline.xc - ab - ca
    return not (((ab < -slack) | (bc < -slack) | (ca < -slack)) & ((ab > slack) | (bc > slack) | (ca > slack)))


@compiled
def window(box: Array, geom: Geom, shape: tuple[int, int]) -> Window:
    """The pixels that a box (6,), centre and half lengths in the geom's frame, may cover."""
    height, width = shape
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    n_hidden = 0
    for x in (box[0] - box[3], box[0] + box[3]):
        for y in (box[1] - box[4], box[1] + box[4]):
            for z in (box[2] - box[5], box[2] + box[5]):
                column, row = _pixel(x, y, z, geom)
                if np.isnan(column):
                    n_hidden += 1
                else:
                    left, right = min(left, column), max(right, column)
                    top, bottom = min(top, row), max(bottom, row)
    if n_hidden == 8:
        return 0, -1, 0, -1
    if n_hidden:  # the box reaches behind the camera
        return 0, width - 1, 0, height - 1
    first_column, last_column = _between(left, right, width)
    first_row, last_row = _between(top, bottom, height)
    return first_column, last_column, first_row, last_row
