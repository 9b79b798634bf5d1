"""Rays cast into a MuJoCo scene: no OpenGL, no display, the same points on every machine."""

from concurrent.futures import ThreadPoolExecutor
from copy import copy
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.point_clouds.geometry import Array

# Groups 0 to 2 are what MuJoCo's renderer draws; 3 to 5 hold collision shapes and trackers.
VISIBLE_GROUPS = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)
HIDDEN_GROUP = 5

Indices = NDArray[np.intp]


class Hits(NamedTuple):
    """The first hits of R rays."""

    distance: Array  # (R,) [m], inf where nothing was hit
    geom: NDArray[np.int32]  # (R,), -1 where nothing was hit
    normal: Array  # (R, 3), unit; (R, 0) without normals

    def copy(self) -> "Hits":
        """The same in memory of its own."""
        return Hits(self.distance.copy(), self.geom.copy(), self.normal.copy())

    def put_nearer(self, rays: Indices, other: "Hits") -> None:
        """Replace those of the rays (R',) that the other hits, R' of them, are nearer on."""
        nearer = other.distance < self.distance[rays]
        rays = rays[nearer]
        self.distance[rays] = other.distance[nearer]
        self.geom[rays] = other.geom[nearer]
        self.normal[rays] = other.normal[nearer]


class RayCaster:
    """Casts the same rays again and again.

    Three things make it fast: what is fixed to the world is cast once, and again only when the model or one of its
    poses is another one (its shapes and colours must stay); only rays that meet the bounding sphere of something that
    moves are cast at what moves; and two threads share them.

    Args:
        origin: of all rays, (3,), world frame [m].
        directions: unit vectors, (R, 3), world frame.
        with_normals: whether hits hold the surfaces' normals.
    """

    def __init__(self, origin: Array, directions: Array, *, with_normals: bool) -> None:
        self.origin = origin
        self.directions = directions
        self._transposed_directions = np.ascontiguousarray(directions.T)
        self._with_normals = with_normals
        self._second_thread = ThreadPoolExecutor(max_workers=1)  # starts with the first cast
        self._model: mujoco.MjModel | None = None

    def cast(self, model: mujoco.MjModel, data: mujoco.MjData) -> Hits:
        """The nearest visible surface along each ray."""
        if model is not self._model:
            self._model = model
            moves, is_visible = model.body_weldid[model.geom_bodyid] != 0, _is_visible(model)
            self._fixed, self._moving = ~moves & is_visible, moves & is_visible  # (ngeom,)
            self._second_data = mujoco.MjData(model)
            self._fixed_poses = np.empty(0)
        poses = np.hstack([data.geom_xpos, data.geom_xmat])[self._fixed]
        if not np.array_equal(poses, self._fixed_poses):
            self._fixed_poses = poses
            without_moving = copy(model)
            without_moving.geom_group[self._moving] = HIDDEN_GROUP
            self._fixed_hits = self._cast(np.arange(len(self.directions)), without_moving, data, at_fixed=True)
        hits = self._fixed_hits.copy()
        rays = self._rays_near(model, data)
        # Every other ray each, so that both meet as many surfaces. MuJoCo works in the data: each thread needs its own.
        first, second = rays[::2], rays[1::2]
        mujoco.mj_copyData(self._second_data, model, data)
        second_hits = self._second_thread.submit(self._cast, second, model, self._second_data, at_fixed=False)
        hits.put_nearer(first, self._cast(first, model, data, at_fixed=False))
        hits.put_nearer(second, second_hits.result())
        return hits

    def _rays_near(self, model: mujoco.MjModel, data: mujoco.MjData) -> Indices:
        """The rays (R',) that meet the bounding sphere of a moving geom."""
        to_centre = data.geom_xpos[self._moving] - self.origin
        tangent_squared = np.sum(to_centre**2, axis=1) - model.geom_rbound[self._moving] ** 2
        # The rays that meet a sphere are those that make no larger an angle with its centre than its tangents do.
        tangent = np.where(tangent_squared > 0, np.sqrt(np.maximum(tangent_squared, 0)), -np.inf)
        # Geoms first, rays last: three times faster to reduce than the other way round. No product by BLAS, whose
        # second thread goes on spinning for milliseconds and takes its core from the second one here.
        along = np.einsum("gc,cr->gr", to_centre, self._transposed_directions)
        return np.flatnonzero(np.any(along >= tangent[:, None], axis=0))

    def _cast(self, rays: Indices, model: mujoco.MjModel, data: mujoco.MjData, *, at_fixed: bool) -> Hits:
        hits = Hits(
            distance=np.empty(len(rays)),
            geom=np.empty(len(rays), np.int32),
            normal=np.empty((len(rays), 3 if self._with_normals else 0)),
        )
        mujoco.mj_multiRay(
            m=model,
            d=data,
            pnt=self.origin,
            vec=self.directions[rays].ravel(),
            geomgroup=VISIBLE_GROUPS,
            flg_static=at_fixed,
            bodyexclude=-1,
            geomid=hits.geom,
            dist=hits.distance,
            normal=hits.normal.ravel() if self._with_normals else None,
            nray=len(rays),
            cutoff=mujoco.mjMAXVAL,
        )
        hits.distance[hits.geom < 0] = np.inf
        return hits


def _is_visible(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """The geoms that rays may hit, (ngeom,)."""
    is_transparent = (model.geom_matid < 0) & (model.geom_rgba[:, 3] == 0)
    return (VISIBLE_GROUPS[model.geom_group] == 1) & ~is_transparent
