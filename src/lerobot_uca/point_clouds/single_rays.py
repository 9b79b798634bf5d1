"""Rays against MuJoCo's geoms, cast one by one by MuJoCo: the reference, and what there is without Numba."""

from copy import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.point_clouds.rays import Hits, Rays

# Groups 0 to 2 are what MuJoCo's renderer draws; 3 to 5 hold collision shapes and trackers.
VISIBLE_GROUPS = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)
HIDDEN_GROUP = 5


def visible(model: mujoco.MjModel) -> NDArray[np.intp]:
    """The geoms that rays may hit."""
    has_material = model.geom_matid >= 0
    opacity = model.geom_rgba[:, 3].copy()
    opacity[has_material] = model.mat_rgba[model.geom_matid[has_material], 3]
    return np.flatnonzero((VISIBLE_GROUPS[model.geom_group] == 1) & (opacity > 0))


def cast_at(geoms: NDArray[np.intp], model: mujoco.MjModel, data: mujoco.MjData, rays: Rays, hits: Hits) -> None:
    """Replace those hits of the rays that one of the geoms is nearer than. As `ray_kernels.cast_at`."""
    only = copy(model)
    only.geom_group[np.setdiff1d(np.arange(model.ngeom), geoms)] = HIDDEN_GROUP
    geom, normal = np.empty(1, np.int32), np.empty(3)
    for ray in near(geoms, model, data, rays):
        direction = rays.directions[ray]
        distance = mujoco.mj_ray(only, data, rays.origin, direction, VISIBLE_GROUPS, True, -1, geom, normal)
        if 0 <= distance < hits.distance[ray]:
            hits.distance[ray], hits.geom[ray] = distance, geom[0]
            if len(hits.normal):
                hits.normal[ray] = normal


def near(geoms: NDArray[np.intp], model: mujoco.MjModel, data: mujoco.MjData, rays: Rays) -> NDArray[np.intp]:
    """The rays that meet the bounding sphere of a geom; a plane has none."""
    to_centre, radius = data.geom_xpos[geoms] - rays.origin, model.geom_rbound[geoms]
    tangent_squared = np.sum(to_centre**2, axis=1) - radius**2
    # The rays that meet a sphere are those that make no larger an angle with its centre than its tangents do.
    tangent = np.where(tangent_squared > 0, np.sqrt(np.maximum(tangent_squared, 0)), -np.inf)
    tangent[radius == 0] = -np.inf
    return np.flatnonzero(np.any(rays.directions @ to_centre.T >= tangent, axis=1))
