"""Processor time [ms] of an observation's stages, before and after, of a step and of a picture: an episode's medians.

All of it runs in one thread, and what else the machine does meanwhile hardly counts. The last column is the fewest
points inside the crop.

all rays: MuJoCo's mj_multiRay at everything, as it was at first. near rays: what is fixed once, mj_multiRay along rays
that pass near something that moves, in one thread, as it was then; crop before: as it was then. rays, crop: the same
today. sample: as it has always been. observation, step: all of it, today.

python benchmarks/point_cloud.py --expert='../shared/adroit_experts/{task}.npz'
"""

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from common import print_provenance
from lerobot.envs import make_env_config

from lerobot_uca.envs.configs import PointCloudEnvConfig
from lerobot_uca.envs.experts.expert import Expert
from lerobot_uca.point_clouds import single_rays
from lerobot_uca.point_clouds.cameras import Marker, PointCloudCamera
from lerobot_uca.point_clouds.geometry import Array, ray_sphere_distances, sample_farthest
from lerobot_uca.point_clouds.rays import Rays

TASKS = {
    "metaworld_pointcloud": ("drawer-close", "dial-turn", "shelf-place", "hand-insert", "hammer"),
    "adroit_pointcloud": ("hammer", "door", "pen", "relocate"),
}
STAGES = ("all rays", "near rays", "crop before", "rays", "crop", "sample", "observation", "step", "picture", "points")


def main() -> None:
    """Print one row a task."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100, help="steps of the episode to measure")
    parser.add_argument("--expert", help="who acts in Adroit, as for lerobot-uca-collect; random actions by default")
    args = parser.parse_args()
    print_provenance()
    print(f"{'processor time [ms], median':36}" + "".join(f"{name:>13}" for name in STAGES))
    for kind, tasks in TASKS.items():
        for task in tasks:
            config = make_env_config(kind, task=task)
            rows = measure(config, task, expert_of(config, task, args.expert), args.steps)
            times, n_points = np.median(rows[:, :-1], axis=0), rows[:, -1].min()
            name = f"{kind.removesuffix('_pointcloud')} {task}, {config.n_points} points"
            print(f"{name:36}" + "".join(f"{value:13.2f}" for value in times) + f"{n_points:13.0f}")


def expert_of(config: PointCloudEnvConfig, task: str, adroits: str | None) -> Expert:
    """Meta-World's own, the given one for Adroit, or one that acts at random."""
    if config.type == "adroit_pointcloud" and adroits is None:
        return lambda env: env.action_space.sample()
    return next(config.attempts(task, adroits if config.type == "adroit_pointcloud" else None, 0)).expert()


def measure(config: PointCloudEnvConfig, task: str, expert: Expert, n_steps: int) -> np.ndarray:
    """Times [ms] of the stages and the number of points inside the crop, (steps, 10)."""
    env = config.env_factory(task)()
    env.action_space.seed(0)
    env.reset(seed=0)
    camera = env.observer.camera
    assert isinstance(camera, PointCloudCamera)
    before = MultiRay(camera._caster.rays)
    rows = []
    for _ in range(n_steps):
        step, _ = timed(env.step, expert(env))
        scene = env._simulator.model, env._simulator.data
        all_rays, _ = timed(before.cast, *scene)
        near_rays, _ = timed(before.cast_near, *scene)
        rays, hits = timed(camera._caster.cast, *scene)
        crop_before, _ = timed(crop_as_before, camera, hits.distance.copy(), env._markers())
        crop, points = timed(camera.points, scene[0], hits, env._markers())
        sample, _ = timed(sample_farthest, points, env.n_points)
        observe, _ = timed(env.observe)
        picture, _ = timed(env.render)
        rows.append([all_rays, near_rays, crop_before, rays, crop, sample, observe, step, picture, len(points)])
    return np.array(rows)


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Milliseconds of this thread that a call takes, and its result."""
    start = time.thread_time()
    result = function(*arguments)
    return 1e3 * (time.thread_time() - start), result


def crop_as_before(camera: PointCloudCamera, distance: Array, markers: Sequence[Marker]) -> Array:
    """`PointCloudCamera.points`, asking all rays for each marker and numpy.all for each point."""
    rays, crop = camera._caster.rays, camera.crop
    for marker in markers:
        to_marker = ray_sphere_distances(rays.origin, rays.directions, marker.centre, marker.radius)
        np.minimum(distance, to_marker, out=distance)
    near = (distance >= camera._enter) & (distance <= camera._leave)
    points = rays.origin + rays.directions[near] * distance[near, None]
    return points[np.all((points >= crop.low) & (points <= crop.high), axis=1)]


class MultiRay:
    """MuJoCo's own way to cast many rays."""

    def __init__(self, rays: Rays) -> None:
        self.rays = rays

    def cast(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """All rays at everything."""
        self._cast(self.rays.directions, model, data, at_fixed=True)

    def cast_near(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """The rays near something that moves at what moves."""
        geoms = single_rays.visible(model)
        moving = geoms[model.body_weldid[model.geom_bodyid[geoms]] != 0]
        near = single_rays.near(moving, model, data, self.rays)
        self._cast(self.rays.directions[near], model, data, at_fixed=False)

    def _cast(self, directions: Array, model: mujoco.MjModel, data: mujoco.MjData, *, at_fixed: bool) -> None:
        n_rays = len(directions)
        geom, distance = np.empty(n_rays, np.int32), np.empty(n_rays)
        scene = (model, data, self.rays.origin, directions.ravel(), single_rays.VISIBLE_GROUPS, at_fixed, -1)
        mujoco.mj_multiRay(*scene, geom, distance, None, n_rays, mujoco.mjMAXVAL)


if __name__ == "__main__":
    main()
