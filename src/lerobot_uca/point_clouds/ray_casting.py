"""Rays cast into a MuJoCo scene: no OpenGL, no display, the same points on every machine."""

import logging
from collections.abc import Callable
from functools import cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.point_clouds import single_rays
from lerobot_uca.point_clouds.geometry import Camera
from lerobot_uca.point_clouds.rays import Hits, Rays

logger = logging.getLogger(__name__)


class RayCaster:
    """Casts the same rays of a camera again and again.

    Two things make it fast: what is fixed to the world is cast at once, and again only when the model or one of its
    poses is another one (its shapes and colours must stay); and `ray_kernels` casts. `mj_multiRay` is not used: it
    misses geoms near the line that runs straight down from the camera (MuJoCo 3.10; docs/results.md).

    Args:
        camera: where the rays start and which way they go.
        matters: pixels whose rays are cast, (H * W,); all of them by default.
        with_normals: whether hits hold the surfaces' normals.
    """

    def __init__(self, camera: Camera, matters: NDArray[np.bool_] | None = None, *, with_normals: bool = False) -> None:
        self.rays = Rays.of(camera, np.ones(camera.width * camera.height, bool) if matters is None else matters)
        self._with_normals = with_normals
        self._model: mujoco.MjModel | None = None

    def cast(self, model: mujoco.MjModel, data: mujoco.MjData) -> Hits:
        """The nearest visible surface along each ray."""
        cast_at = _caster()
        if model is not self._model:
            self._model = model
            geoms = single_rays.visible(model)
            moves = model.body_weldid[model.geom_bodyid[geoms]] != 0
            self._fixed, self._moving = geoms[~moves], geoms[moves]
            self._fixed_poses: NDArray[Any] | None = None
        poses = np.hstack([data.geom_xpos[self._fixed], data.geom_xmat[self._fixed]])
        if self._fixed_poses is None or not np.array_equal(poses, self._fixed_poses):
            self._fixed_poses = poses
            self._fixed_hits = Hits.none(len(self.rays.directions), with_normals=self._with_normals)
            cast_at(self._fixed, model, data, self.rays, self._fixed_hits)
        hits = self._fixed_hits.copy()
        cast_at(self._moving, model, data, self.rays, hits)
        return hits


@cache
def _caster() -> Callable[..., None]:
    """The fastest way to cast rays that is installed. The hits are the same."""
    try:
        from lerobot_uca.point_clouds import ray_kernels  # slow to import, and not needed to read a configuration
    except ImportError as error:
        logger.warning("Rays are cast one by one, ten times slower than with Numba: %s", error)
        return single_rays.cast_at
    return ray_kernels.cast_at
