"""Cameras that see a MuJoCo scene by ray casting.

Like MuJoCo's own renderer they see the geoms of the visible groups and the task's markers (goal sites, which are not
geoms and which rays therefore pass through).
"""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.point_clouds.geometry import Array, Camera, Crop, ray_sphere_distances
from lerobot_uca.point_clouds.ray_casting import RayCaster
from lerobot_uca.point_clouds.rays import NO_GEOM, Hits, Rays

ROUNDING = 1e-9  # [m], far above that of a distance and far below what a camera resolves
MIN_LENGTH = 1e-30  # [m]; a ray without a hit has a normal of length 0
BACKGROUND = np.array([235, 238, 242], dtype=np.uint8)
DEFAULT_GEOM_COLOUR = np.array([0.5, 0.5, 0.5, 1.0], dtype=np.float32)


class Marker(NamedTuple):
    """A sphere that shows where a goal is: centre [m, world], radius [m], RGB colour in [0, 1]."""

    centre: Array
    radius: float
    colour: Array


class PointCloudCamera:
    """Sees the part of the scene inside a crop as points.

    Args:
        camera: where the rays start and which way they go.
        crop: what to keep. Rays that miss it are never cast.
        left_out: name of a body that, with all that hangs on it, hides what is behind it but gives no points, unless
            it hides everything.
    """

    def __init__(self, camera: Camera, crop: Crop, left_out: str | None = None) -> None:
        origin = camera.position
        directions = camera.ray_directions()
        self.camera, self.crop = camera, crop
        self._left_out = left_out
        self._model: mujoco.MjModel | None = None
        enter, leave = crop.span(origin, directions)
        meets = enter <= leave
        self._caster = RayCaster(camera, meets)
        self._enter, self._leave = enter[meets] - ROUNDING, leave[meets] + ROUNDING

    def capture(self, model: mujoco.MjModel, data: mujoco.MjData, markers: Sequence[Marker] = ()) -> Array:
        """Visible points inside the crop, (N, 3), world frame [m]. `data` must be up to date (`mj_forward`)."""
        return self.points(model, self._caster.cast(model, data), markers)

    def points(self, model: mujoco.MjModel, hits: Hits, markers: Sequence[Marker]) -> Array:
        """Points inside the crop at the hits of its rays, which it changes, or at markers before them, (N, 3)."""
        rays, (distance, geom, _) = self._caster.rays, hits
        for marker in markers:
            geom[_put_nearer(distance, rays, marker)] = NO_GEOM
        near = np.flatnonzero((distance >= self._enter) & (distance <= self._leave))
        points = rays.origin + rays.directions[near] * distance[near, None]
        is_seen = self.crop.contains(points)
        if self._left_out is not None:
            is_other = is_seen & ~self._is_left_out(model)[geom[near]]
            is_seen = is_other if is_other.any() else is_seen
        return points[is_seen]

    def _is_left_out(self, model: mujoco.MjModel) -> NDArray[np.bool_]:
        """Whether each geom is, (ngeom + 1,): the last one, at `NO_GEOM`, is none."""
        if model is not self._model:
            self._model, root = model, model.body(self._left_out).id
            bodies = np.arange(model.nbody) == root
            for body in range(root + 1, model.nbody):  # parents come first
                bodies[body] |= bodies[model.body_parentid[body]]
            self._left_out_geoms = np.append(bodies[model.geom_bodyid], False)
        return self._left_out_geoms


class DepthCamera:
    """Sees the scene as a depth camera does: the depth of each pixel along the camera's z axis, without noise."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._caster = RayCaster(camera)

    def capture(self, model: mujoco.MjModel, data: mujoco.MjData, markers: Sequence[Marker] = ()) -> Array:
        """Depths (H, W) [m], inf where nothing is. `to_millimetres` makes of them what a RealSense camera gives."""
        distance = self._caster.cast(model, data).distance
        for marker in markers:
            _put_nearer(distance, self._caster.rays, marker)
        return self.camera.depth(distance)


class PictureCamera:
    """Sees the scene as a shaded picture: the colour of each surface, lit from the camera."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._caster = RayCaster(camera, with_normals=True)
        self._model: mujoco.MjModel | None = None

    def capture(self, model: mujoco.MjModel, data: mujoco.MjData, markers: Sequence[Marker] = ()) -> NDArray[np.uint8]:
        """The picture, (H, W, 3) uint8."""
        rays = self._caster.rays
        distance, geom, normal = self._caster.cast(model, data)
        if model is not self._model:
            self._model, self._colours = model, surface_colours(model)
        colour = self._colours[geom]
        for marker in markers:
            nearer = _put_nearer(distance, rays, marker)
            normal[nearer] = rays.origin + rays.directions[nearer] * distance[nearer, None] - marker.centre
            colour[nearer] = marker.colour
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), MIN_LENGTH)
        picture = shade(colour, normal, rays.directions)
        picture[np.isinf(distance)] = BACKGROUND
        return picture.reshape(self.camera.height, self.camera.width, 3)


def _put_nearer(distance: Array, rays: Rays, marker: Marker) -> NDArray[np.int32]:
    """Replace the distances (R,) of those rays that a marker is nearer along, and return these rays."""
    around = rays.around(marker.centre, marker.radius)
    to_marker = ray_sphere_distances(rays.origin, rays.directions[around], marker.centre, marker.radius)
    nearer = to_marker < distance[around]
    distance[around[nearer]] = to_marker[nearer]
    return around[nearer]


def shade(colours: Array, normals: Array, directions: Array) -> NDArray[np.uint8]:
    """A picture of surfaces lit from the camera: (R, 3) uint8.

    Args:
        colours: of the surfaces, RGB in [0, 1], (R, 3).
        normals: unit surface normals, (R, 3), of either sign.
        directions: unit viewing directions, (R, 3).
    """
    facing = np.abs(np.einsum("rc,rc->r", normals, directions))
    return np.round(255 * np.clip(colours * (0.35 + 0.65 * facing[:, None]), 0, 1)).astype(np.uint8)


def surface_colours(model: mujoco.MjModel) -> Array:
    """One RGB colour in [0, 1] for each geom, (ngeom, 3): its own or its material's, times its texture's mean."""
    own = np.any(model.geom_rgba != DEFAULT_GEOM_COLOUR, axis=1)
    has_material = model.geom_matid >= 0
    if model.nmat == 0:
        return model.geom_rgba[:, :3].astype(np.float64)
    material_colours = np.array([_material_colour(model, material) for material in range(model.nmat)])
    from_material = has_material & ~own
    return np.where(from_material[:, None], material_colours[model.geom_matid], model.geom_rgba[:, :3])


def _material_colour(model: mujoco.MjModel, material: int) -> Array:
    colour = model.mat_rgba[material, :3].astype(np.float64)
    texture = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]
    if texture < 0:
        return colour
    start = model.tex_adr[texture]
    channels = model.tex_nchannel[texture]
    size = model.tex_height[texture] * model.tex_width[texture] * channels
    texels = model.tex_data[start : start + size].reshape(-1, channels)[:, :3]
    return colour * texels.mean(axis=0) / 255
