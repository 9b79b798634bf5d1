"""Rays against single surfaces in their own frame, compiled by Numba, by the formulas of MuJoCo's ray casting."""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.point_clouds.compiling import compiled
from lerobot_uca.point_clouds.geometry import Array

MIN_DENOMINATOR = 1e-15  # mjMINVAL: MuJoCo takes a ray as parallel to a surface below it

Vector = tuple[float, float, float]
Hit = tuple[float, Vector]
"""Distance [m], inf for a miss, and normal, of any length."""
MISS = (np.inf, (0.0, 0.0, 0.0))

PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = (
    int(each)
    for each in (
        mujoco.mjtGeom.mjGEOM_PLANE,
        mujoco.mjtGeom.mjGEOM_SPHERE,
        mujoco.mjtGeom.mjGEOM_CAPSULE,
        mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        mujoco.mjtGeom.mjGEOM_CYLINDER,
        mujoco.mjtGeom.mjGEOM_BOX,
        mujoco.mjtGeom.mjGEOM_MESH,
    )
)
PRIMITIVES = (PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX)


class Triangle(NamedTuple):
    """A triangle a, b, c as seen from the rays' origin: what is the same for all rays."""

    p: Vector  # a - c
    q: Vector  # b - c
    s: Vector  # origin - c
    normal: Vector  # p x q, of any length
    height: float  # s times normal


@compiled
def triangle(origin: Vector, a: NDArray[np.float32], b: NDArray[np.float32], c: NDArray[np.float32]) -> Triangle:
    """The triangle of three corners (3,), in the frame of the origin."""
    c0, c1, c2 = np.float64(c[0]), np.float64(c[1]), np.float64(c[2])
    p0, p1, p2 = a[0] - c0, a[1] - c1, a[2] - c2
    q0, q1, q2 = b[0] - c0, b[1] - c1, b[2] - c2
    s0, s1, s2 = origin[0] - c0, origin[1] - c1, origin[2] - c2
    n0, n1, n2 = p1 * q2 - p2 * q1, p2 * q0 - p0 * q2, p0 * q1 - p1 * q0
    return Triangle((p0, p1, p2), (q0, q1, q2), (s0, s1, s2), (n0, n1, n2), s0 * n0 + s1 * n1 + s2 * n2)


@compiled
def at_triangle(direction: Vector, triangle: Triangle) -> Hit:
    """Where a ray meets a triangle, from either side."""
    p, q, s, n = triangle.p, triangle.q, triangle.s, triangle.normal
    denominator = direction[0] * n[0] + direction[1] * n[1] + direction[2] * n[2]
    if abs(denominator) < MIN_DENOMINATOR:
        return MISS
    # Cramer's rule for c + u (a - c) + v (b - c) = origin + t direction.
    e0 = s[1] * direction[2] - s[2] * direction[1]
    e1 = s[2] * direction[0] - s[0] * direction[2]
    e2 = s[0] * direction[1] - s[1] * direction[0]
    u = -(q[0] * e0 + q[1] * e1 + q[2] * e2) / denominator
    v = (p[0] * e0 + p[1] * e1 + p[2] * e2) / denominator
    t = -triangle.height / denominator
    if (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0):  # one branch, which is easily foretold
        return t, n
    return MISS


@compiled
def at_primitive(kind: int, origin: Vector, direction: Vector, size: Array) -> Hit:
    """Where a ray meets one of `PRIMITIVES`, of a size as in MuJoCo's geom_size."""
    if kind == PLANE:
        return _at_plane(origin, direction, size)
    if kind == BOX:
        return _at_box(origin, direction, size)
    if kind == CYLINDER:
        return _at_cylinder(origin, direction, size)
    if kind == CAPSULE:
        return _at_capsule(origin, direction, size)
    if kind == SPHERE:
        return _at_ellipsoid(origin, direction, (size[0], size[0], size[0]))
    return _at_ellipsoid(origin, direction, (size[0], size[1], size[2]))


@compiled
def _at_plane(origin: Vector, direction: Vector, size: Array) -> Hit:
    """From above only, as MuJoCo's; a size of 0 is infinite."""
    if direction[2] > -MIN_DENOMINATOR:
        return MISS
    t = -origin[2] / direction[2]
    x, y = origin[0] + t * direction[0], origin[1] + t * direction[1]
    if t < 0 or (size[0] > 0 and abs(x) > size[0]) or (size[1] > 0 and abs(y) > size[1]):
        return MISS
    return t, (0.0, 0.0, 1.0)


@compiled
def _at_box(origin: Vector, direction: Vector, size: Array) -> Hit:
    nearest, n0, n1, n2 = np.inf, 0.0, 0.0, 0.0
    for axis in range(3):
        if abs(direction[axis]) < MIN_DENOMINATOR:
            continue
        i, j = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1.0, 1.0):
            t = (side * size[axis] - origin[axis]) / direction[axis]
            if (
                0 <= t < nearest
                and abs(origin[i] + t * direction[i]) <= size[i]
                and abs(origin[j] + t * direction[j]) <= size[j]
            ):
                nearest = t
                n0, n1, n2 = side * (axis == 0), side * (axis == 1), side * (axis == 2)
    return nearest, (n0, n1, n2)


@compiled
def _roots(a: float, b: float, c: float) -> tuple[float, float]:
    """The roots of a t^2 + 2 b t + c, the smaller one first; NaN if there is none."""
    determinant = b * b - a * c
    if a < MIN_DENOMINATOR or determinant < MIN_DENOMINATOR:
        return np.nan, np.nan
    root = np.sqrt(determinant)
    return (-b - root) / a, (-b + root) / a


@compiled
def _at_ellipsoid(origin: Vector, direction: Vector, radii: Vector) -> Hit:
    s0, s1, s2 = 1 / radii[0] ** 2, 1 / radii[1] ** 2, 1 / radii[2] ** 2
    a = s0 * direction[0] ** 2 + s1 * direction[1] ** 2 + s2 * direction[2] ** 2
    b = s0 * direction[0] * origin[0] + s1 * direction[1] * origin[1] + s2 * direction[2] * origin[2]
    c = s0 * origin[0] ** 2 + s1 * origin[1] ** 2 + s2 * origin[2] ** 2 - 1
    for t in _roots(a, b, c):
        if t >= 0:
            return t, (
                s0 * (origin[0] + t * direction[0]),
                s1 * (origin[1] + t * direction[1]),
                s2 * (origin[2] + t * direction[2]),
            )
    return MISS


@compiled
def _at_side(origin: Vector, direction: Vector, size: Array) -> Hit:
    """The round side of a cylinder of radius size[0] and half length size[1] along z."""
    a = direction[0] ** 2 + direction[1] ** 2
    b = direction[0] * origin[0] + direction[1] * origin[1]
    c = origin[0] ** 2 + origin[1] ** 2 - size[0] ** 2
    for t in _roots(a, b, c):
        if t >= 0 and abs(origin[2] + t * direction[2]) <= size[1]:
            return t, (origin[0] + t * direction[0], origin[1] + t * direction[1], 0.0)
    return MISS


@compiled
def _at_cylinder(origin: Vector, direction: Vector, size: Array) -> Hit:
    nearest, (n0, n1, n2) = _at_side(origin, direction, size)
    if abs(direction[2]) > MIN_DENOMINATOR:
        for side in (-1.0, 1.0):
            t = (side * size[1] - origin[2]) / direction[2]
            x, y = origin[0] + t * direction[0], origin[1] + t * direction[1]
            if 0 <= t < nearest and x * x + y * y <= size[0] * size[0]:
                nearest, n0, n1, n2 = t, 0.0, 0.0, side
    return nearest, (n0, n1, n2)


@compiled
def _at_capsule(origin: Vector, direction: Vector, size: Array) -> Hit:
    nearest, (n0, n1, n2) = _at_side(origin, direction, size)
    for side in (-1.0, 1.0):
        z = origin[2] - side * size[1]
        a = direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2
        b = direction[0] * origin[0] + direction[1] * origin[1] + direction[2] * z
        c = origin[0] ** 2 + origin[1] ** 2 + z * z - size[0] ** 2
        for t in _roots(a, b, c):
            height = z + t * direction[2]
            if 0 <= t < nearest and side * height >= 0:  # the half that is not inside the cylinder
                nearest, n0, n1, n2 = t, origin[0] + t * direction[0], origin[1] + t * direction[1], height
    return nearest, (n0, n1, n2)
