"""Rays of a pinhole camera against MuJoCo's geoms, compiled by Numba.

MuJoCo casts rays one by one, and each walks through a mesh's tree. Here a geom asks which pixels it may cover: its
corners are projected into the image, and only the rays through the pixels in between are intersected with it, triangle
by triangle. Most triangles of a mesh lie between two pixels and cost a comparison. Distances are those of `mj_ray`,
bit by bit for meshes, as the arithmetic is the same; the projection only chooses and has a margin for its rounding.

Letters: F triangles, G geoms, V vertices.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.point_clouds.geometry import Array
from lerobot_uca.point_clouds.intersections import (
    MESH,
    PLANE,
    PRIMITIVES,
    Hit,
    Vector,
    at_primitive,
    at_triangle,
    compiled,
)
from lerobot_uca.point_clouds.rays import Hits, Rays

Window = tuple[int, int, int, int]
"""First and last column, first and last row; none if first > last."""

MARGIN = 1e-6  # [pixels], far above rounding, far below the distance of two rays
NEAREST_DEPTH = 1e-9  # [m]; what is nearer to the camera's plane, or behind it, has no projection


class Shapes(NamedTuple):
    """MuJoCo's geoms and meshes, by their names in mjModel and mjData."""

    geom_type: NDArray[np.int32]  # (G,)
    geom_size: Array  # (G, 3)
    geom_aabb: Array  # (G, 6): centre and half lengths, geom's frame
    geom_dataid: NDArray[np.int32]  # (G,), of the mesh
    geom_xpos: Array  # (G, 3)
    geom_xmat: Array  # (G, 9)
    mesh_vert: NDArray[np.float32]  # (V, 3), of all meshes, geom's frame
    mesh_vertadr: NDArray[np.int32]
    mesh_vertnum: NDArray[np.int32]
    mesh_face: NDArray[np.int32]  # (F, 3), of all meshes
    mesh_faceadr: NDArray[np.int32]
    mesh_facenum: NDArray[np.int32]


class Geom(NamedTuple):
    """A geom, and how it is seen."""

    id: int  # MuJoCo's
    rotation: Array  # (3, 3), to the world
    origin: Vector  # of the rays, in the geom's frame
    projection: Array  # (3, 3), from the geom's frame, relative to the origin, to homogeneous pixels


def cast_at(geoms: NDArray[np.intp], model: mujoco.MjModel, data: mujoco.MjData, rays: Rays, hits: Hits) -> None:
    """Replace those hits of the rays that one of the geoms is nearer than.

    Raises:
        ValueError: if a geom is a height field or a signed distance function.
    """
    others = set(model.geom_type[geoms].tolist()) - {*PRIMITIVES, MESH}
    if others:
        name = mujoco.mjtGeom(others.pop()).name.removeprefix("mjGEOM_").lower()
        raise ValueError(f"Rays are not cast at geoms of type {name}.")
    of_data = ("geom_xpos", "geom_xmat")
    shapes = Shapes(*(getattr(data if name in of_data else model, name) for name in Shapes._fields))
    _cast_at(geoms, shapes, rays, hits)


@compiled
def _cast_at(geoms: NDArray[np.intp], shapes: Shapes, rays: Rays, hits: Hits) -> None:
    for geom_id in geoms:
        rotation = shapes.geom_xmat[geom_id].copy().reshape(3, 3)
        origin = _rotated_back(rotation, rays.origin - shapes.geom_xpos[geom_id])
        geom = Geom(geom_id, rotation, origin, _product(rays.projection, rotation))
        if shapes.geom_type[geom_id] == MESH:
            _cast_at_mesh(geom, shapes, rays, hits)
        else:
            _cast_at_primitive(geom, shapes, rays, hits)


@compiled
def _cast_at_mesh(geom: Geom, shapes: Shapes, rays: Rays, hits: Hits) -> None:
    left, right, top, bottom = _window(shapes.geom_aabb[geom.id], geom, rays.of_pixel.shape)
    if left > right or top > bottom:
        return
    mesh = shapes.geom_dataid[geom.id]
    start = shapes.mesh_vertadr[mesh]
    vertices = shapes.mesh_vert[start : start + shapes.mesh_vertnum[mesh]]
    start = shapes.mesh_faceadr[mesh]
    faces = shapes.mesh_face[start : start + shapes.mesh_facenum[mesh]]
    pixels = np.empty((len(vertices), 2))
    for i in range(len(vertices)):
        pixels[i, 0], pixels[i, 1] = _pixel(vertices[i, 0], vertices[i, 1], vertices[i, 2], geom)
    height, width = rays.of_pixel.shape
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        xa, xb, xc = pixels[a, 0], pixels[b, 0], pixels[c, 0]
        ya, yb, yc = pixels[a, 1], pixels[b, 1], pixels[c, 1]
        n_hidden = np.isnan(xa) + np.isnan(xb) + np.isnan(xc)
        if n_hidden == 3:
            continue
        left, right, top, bottom = 0, width - 1, 0, height - 1
        if n_hidden == 0:
            left, right = _between(min(xa, xb, xc), max(xa, xb, xc), width)
            if left > right:
                continue  # before the rows: most triangles end here
            top, bottom = _between(min(ya, yb, yc), max(ya, yb, yc), height)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                ray = rays.of_pixel[row, column]
                if ray >= 0:
                    direction = _rotated_back(geom.rotation, rays.directions[ray])
                    hit = at_triangle(geom.origin, direction, vertices[a], vertices[b], vertices[c])
                    _put_if_nearer(ray, hit, geom, hits)


@compiled
def _cast_at_primitive(geom: Geom, shapes: Shapes, rays: Rays, hits: Hits) -> None:
    kind = shapes.geom_type[geom.id]
    left, right, top, bottom = 0, rays.of_pixel.shape[1] - 1, 0, rays.of_pixel.shape[0] - 1
    if kind != PLANE:  # whose box is a point
        left, right, top, bottom = _window(shapes.geom_aabb[geom.id], geom, rays.of_pixel.shape)
    for row in range(top, bottom + 1):
        for column in range(left, right + 1):
            ray = rays.of_pixel[row, column]
            if ray >= 0:
                direction = _rotated_back(geom.rotation, rays.directions[ray])
                hit = at_primitive(kind, geom.origin, direction, shapes.geom_size[geom.id])
                _put_if_nearer(ray, hit, geom, hits)


@compiled
def _put_if_nearer(ray: int, hit: Hit, geom: Geom, hits: Hits) -> None:
    distance, normal = hit
    if distance < hits.distance[ray]:
        hits.distance[ray] = distance
        hits.geom[ray] = geom.id
        if len(hits.normal):
            for i in range(3):
                hits.normal[ray, i] = (
                    geom.rotation[i, 0] * normal[0] + geom.rotation[i, 1] * normal[1] + geom.rotation[i, 2] * normal[2]
                )


# Choosing the pixels ------------------------------------------------------------------------------------------------


@compiled
def _product(a: Array, b: Array) -> Array:
    """Of two 3 x 3 matrices."""
    product = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                product[i, j] += a[i, k] * b[k, j]
    return product


@compiled
def _rotated_back(rotation: Array, v: Vector) -> Vector:
    """The transposed rotation times a vector, as a tuple."""
    return (
        rotation[0, 0] * v[0] + rotation[1, 0] * v[1] + rotation[2, 0] * v[2],
        rotation[0, 1] * v[0] + rotation[1, 1] * v[1] + rotation[2, 1] * v[2],
        rotation[0, 2] * v[0] + rotation[1, 2] * v[1] + rotation[2, 2] * v[2],
    )


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
    return int(max(0.0, np.ceil(low - MARGIN))), int(min(n - 1.0, np.floor(high + MARGIN)))


@compiled
def _window(box: Array, geom: Geom, shape: tuple[int, int]) -> Window:
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
