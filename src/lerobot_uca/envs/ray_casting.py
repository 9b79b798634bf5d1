"""Cameras that see a MuJoCo scene by ray casting: no OpenGL, no display, the same points on every machine.

Like MuJoCo's own renderer they see the geoms of the visible groups and the task's markers (goal sites, which are no
geoms and which `mj_multiRay` therefore passes through).
"""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.envs.point_cloud import Array, Camera, Crop, ray_sphere_distances, shade

# Groups 0 to 2 are what MuJoCo's renderer draws; 3 to 5 hold collision shapes and trackers.
VISIBLE_GROUPS = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)
BACKGROUND = np.array([235, 238, 242], dtype=np.uint8)
DEFAULT_GEOM_COLOUR = np.array([0.5, 0.5, 0.5, 1.0], dtype=np.float32)


class Marker(NamedTuple):
    """A sphere that shows where a goal is: centre [m, world], radius [m], RGB colour in [0, 1]."""

    centre: Array
    radius: float
    colour: Array


class _Hits(NamedTuple):
    distance: Array  # (R,) [m], inf where nothing was hit
    geom: NDArray[np.int32]  # (R,), -1 where nothing was hit
    normal: Array | None  # (R, 3), unit


class _RayCaster:
    """Casts the same rays again and again; directions and buffers are made once."""

    def __init__(self, origin: Array, directions: Array, *, with_normals: bool) -> None:
        self.origin = origin
        self.directions = np.ascontiguousarray(directions)
        n_rays = len(directions)
        self._distance = np.empty(n_rays)
        self._geom = np.empty(n_rays, dtype=np.int32)
        self._normal = np.empty(3 * n_rays) if with_normals else None

    def cast(self, model: mujoco.MjModel, data: mujoco.MjData) -> _Hits:
        """The nearest visible surface along each ray. The arrays are overwritten by the next call."""
        mujoco.mj_multiRay(
            m=model,
            d=data,
            pnt=self.origin,
            vec=self.directions.ravel(),
            geomgroup=VISIBLE_GROUPS,
            flg_static=True,
            bodyexclude=-1,
            geomid=self._geom,
            dist=self._distance,
            normal=self._normal,
            nray=len(self.directions),
            cutoff=mujoco.mjMAXVAL,
        )
        self._distance[self._geom < 0] = np.inf
        normal = None if self._normal is None else self._normal.reshape(-1, 3)
        return _Hits(self._distance, self._geom, normal)


class PointCloudCamera:
    """Sees the part of the scene inside a crop as points.

    Args:
        camera: where the rays start and which way they go.
        crop: what to keep. Rays that miss it are never cast.
    """

    def __init__(self, camera: Camera, crop: Crop) -> None:
        origin = np.asarray(camera.position)
        directions = camera.ray_directions()
        self.camera, self.crop = camera, crop
        self._caster = _RayCaster(origin, directions[crop.meets(origin, directions)], with_normals=False)

    def capture(self, model: mujoco.MjModel, data: mujoco.MjData, markers: Sequence[Marker] = ()) -> Array:
        """Visible points inside the crop, (N, 3), world frame [m]. `data` must be up to date (`mj_forward`)."""
        caster = self._caster
        distance = caster.cast(model, data).distance
        for marker in markers:
            to_marker = ray_sphere_distances(caster.origin, caster.directions, marker.centre, marker.radius)
            np.minimum(distance, to_marker, out=distance)
        hit = np.isfinite(distance)
        points = caster.origin + caster.directions[hit] * distance[hit, None]
        return points[self.crop.contains(points)]


class PictureCamera:
    """Sees the scene as a shaded picture: the colour of each surface, lit from the camera."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._caster = _RayCaster(np.asarray(camera.position), camera.ray_directions(), with_normals=True)

    def capture(self, model: mujoco.MjModel, data: mujoco.MjData, markers: Sequence[Marker] = ()) -> NDArray[np.uint8]:
        """The picture, (H, W, 3) uint8."""
        caster = self._caster
        distance, geom, normal = caster.cast(model, data)
        assert normal is not None
        colour = surface_colours(model)[geom]
        for marker in markers:
            to_marker = ray_sphere_distances(caster.origin, caster.directions, marker.centre, marker.radius)
            nearer = to_marker < distance
            surface = caster.origin + caster.directions[nearer] * to_marker[nearer, None]
            normal[nearer] = (surface - marker.centre) / marker.radius
            colour[nearer] = marker.colour
            np.minimum(distance, to_marker, out=distance)
        picture = shade(colour, normal, caster.directions)
        picture[np.isinf(distance)] = BACKGROUND
        return picture.reshape(self.camera.height, self.camera.width, 3)


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
