"""Rays of a pinhole camera against MuJoCo's geoms, compiled by Numba.

MuJoCo casts rays one by one, and each walks through a mesh's tree. Here a geom asks which pixels it may cover: its
corners are projected into the image, and only the rays through the pixels in between are intersected with it, triangle
by triangle. Most triangles of a mesh lie between two pixels and cost a comparison; a pixel outside a triangle's outline
costs a few products. Distances are those of `mj_ray`,
bit by bit for meshes, as the arithmetic is the same; the projection only chooses and has a margin for its rounding.

Letters: F triangles, G geoms, V vertices.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.point_clouds.compiling import compiled
from lerobot_uca.point_clouds.covered_pixels import Geom, may_cover, outline_of, projected, window
from lerobot_uca.point_clouds.geometry import Array
from lerobot_uca.point_clouds.intersections import (
    MESH,
    PLANE,
    PRIMITIVES,
    Hit,
    Vector,
    at_primitive,
    at_triangle,
    triangle,
)
from lerobot_uca.point_clouds.rays import Hits, Rays


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
    left, right, top, bottom = window(shapes.geom_aabb[geom.id], geom, rays.of_pixel.shape)
    if left > right or top > bottom:
        return
    mesh = shapes.geom_dataid[geom.id]
    start = shapes.mesh_vertadr[mesh]
    vertices = shapes.mesh_vert[start : start + shapes.mesh_vertnum[mesh]]
    start = shapes.mesh_faceadr[mesh]
    faces = shapes.mesh_face[start : start + shapes.mesh_facenum[mesh]]
    pixels, windows = projected(vertices, geom, rays.of_pixel.shape)
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        left = min(windows[a, 0], windows[b, 0], windows[c, 0])
        right = max(windows[a, 1], windows[b, 1], windows[c, 1])
        if left > right:
            continue  # before the rows: most triangles end here
        top = min(windows[a, 2], windows[b, 2], windows[c, 2])
        bottom = max(windows[a, 3], windows[b, 3], windows[c, 3])
        if top > bottom or (np.isnan(pixels[a, 0]) and np.isnan(pixels[b, 0]) and np.isnan(pixels[c, 0])):
            continue
        outline = outline_of(pixels[a], pixels[b], pixels[c])
        surface = triangle(geom.origin, vertices[a], vertices[b], vertices[c])
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                if not may_cover(outline, column, row):
                    continue
                ray = rays.of_pixel[row, column]
                if ray >= 0:
                    hit = at_triangle(_rotated_back(geom.rotation, rays.directions[ray]), surface)
                    _put_if_nearer(ray, hit, geom, hits)


@compiled
def _cast_at_primitive(geom: Geom, shapes: Shapes, rays: Rays, hits: Hits) -> None:
    kind = shapes.geom_type[geom.id]
    left, right, top, bottom = 0, rays.of_pixel.shape[1] - 1, 0, rays.of_pixel.shape[0] - 1
    if kind != PLANE:  # whose box is a point
        left, right, top, bottom = window(shapes.geom_aabb[geom.id], geom, rays.of_pixel.shape)
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
