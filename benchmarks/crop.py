"""Check that the crop keeps a task's objects: all 50 Meta-World tasks, many seeds; optionally a picture of the clouds.

python benchmarks/crop.py --seeds=50
python benchmarks/crop.py --seeds=1 --picture=outputs/clouds.png

Two shares are printed for each task, each the worst over the seeds: of the object and goal positions, those inside the
crop (an object's origin may lie up to 3 cm below, in the table it stands on), and of the points that the camera sees of
movable objects, those inside. Then, in the mean over the seeds, how many of a cloud's first 128 points lie on them.
Which body is movable is the simulator's knowledge; the crop goes by position.
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np
from common import print_provenance
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tqdm import tqdm

from lerobot_uca.envs.metaworld import MetaworldPointCloudEnv, ScriptedExpert, camera_of, drawn_goal, task_descriptions
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.point_clouds.ray_casting import RayCaster

TABLE_SLACK = 0.03  # [m]
N_FIRST = 128  # what the setting `small` shows of a cloud
SAME_POINT = 1e-5  # [m], float32's rounding


def main() -> None:
    """Check, and draw if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50, help="initial states a task")
    parser.add_argument("--picture", type=Path, help="PNG to draw all clouds into, 40 steps into an expert's episode")
    args = parser.parse_args()
    shares = {task: worst_shares(task, args.seeds) for task in tqdm(task_descriptions(), unit="task")}
    print_provenance()
    header = f"share inside, worst of {args.seeds} seeds"
    print(f"{header:34}{'positions':>10}{'points of movable objects':>28}{'of 128':>8}")
    for task, (positions, points, n_points) in shares.items():
        print(f"{task:34}{positions:10.2f}{points:28.2f}{n_points:8.1f}")
    worst = [min(values) for values in zip(*shares.values(), strict=True)]
    print(f"{'worst task':34}{worst[0]:10.2f}{worst[1]:28.2f}{worst[2]:8.1f}")
    if args.picture:
        draw(args.picture)


def worst_shares(task: str, n_seeds: int) -> tuple[float, float, float]:
    """The smallest share of positions, and of visible points of movable objects, inside the crop; the latter of 128."""
    env = MetaworldPointCloudEnv(task)
    low = np.array(env.crop.low) - [0, 0, TABLE_SLACK]
    around_origins = Crop(tuple(low), env.crop.high)
    caster = RayCaster(camera_of(task))
    positions, points, counts = [], [], []
    for seed in range(n_seeds):
        cloud = env.reset(seed=seed)[0]["point_cloud"][:N_FIRST]
        simulator = env._simulator
        objects = np.array(simulator._get_pos_objects()).reshape(-1, 3)
        goal = drawn_goal(task, simulator._target_pos)
        positions.append(around_origins.contains(np.concatenate([objects, [goal]])).mean())
        hits = caster.cast(simulator.model, simulator.data)
        movable = is_movable(simulator.model)[simulator.model.geom_bodyid[hits.geom]] & (hits.geom >= 0)
        counts.append(0)
        if movable.any():
            seen = caster.rays.origin + caster.rays.directions[movable] * hits.distance[movable, None]
            points.append(env.crop.contains(seen).mean())
            counts[-1] = (cKDTree(seen).query(cloud)[0] < SAME_POINT).sum()
    return min(positions), min(points, default=1.0), float(np.mean(counts))


def is_movable(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Bodies that a joint moves and that are not the robot's, (nbody,)."""
    movable = np.zeros(model.nbody, dtype=bool)
    for body in range(1, model.nbody):
        chain = [body]
        while model.body_parentid[chain[-1]] > 0:
            chain.append(model.body_parentid[chain[-1]])
        robot = any(model.body(ancestor).name == "base" for ancestor in chain)
        movable[body] = not robot and any(model.body_jntnum[ancestor] > 0 for ancestor in chain)
    return movable


def draw(path: Path) -> None:
    """All clouds on one page."""
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    mpl.use("Agg")
    tasks = list(task_descriptions())
    figure = plt.figure(figsize=(25, 25))
    for index, task in enumerate(tasks):
        env, expert = MetaworldPointCloudEnv(task), ScriptedExpert(task)
        env.reset(seed=0)
        for _ in range(40):
            observation, *_ = env.step(expert(env))
        cloud = observation["point_cloud"]
        axes = figure.add_subplot(8, 7, index + 1, projection="3d")
        axes.scatter(*cloud.T, c=cloud[:, 2], s=3)
        axes.set_title(task)
        axes.set_aspect("equal")
        axes.view_init(elev=35, azim=-30)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=60)
    print(path)


if __name__ == "__main__":
    main()
