"""Check that the crop keeps a task's objects: all 50 Meta-World tasks, many seeds; optionally a picture of the clouds.

python benchmarks/crop.py --seeds=50
python benchmarks/crop.py --seeds=1 --picture=outputs/clouds.png

Two shares are printed for each task, each the worst over the seeds: of the object and goal positions, those inside the
crop (an object's origin may lie up to 3 cm below, in the table it stands on), and of the points that the camera sees of
movable objects, those inside. Which body is movable is the simulator's knowledge; the crop goes by position.
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np
from common import print_provenance
from numpy.typing import NDArray
from tqdm import tqdm

from lerobot_uca.envs.metaworld import MetaworldPointCloudEnv, ScriptedExpert, camera_of, drawn_goal, task_descriptions
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.point_clouds.ray_casting import RayCaster

TABLE_SLACK = 0.03  # [m]


def main() -> None:
    """Check, and draw if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50, help="initial states a task")
    parser.add_argument("--picture", type=Path, help="PNG to draw all clouds into, 40 steps into an expert's episode")
    args = parser.parse_args()
    shares = {task: worst_shares(task, args.seeds) for task in tqdm(task_descriptions(), unit="task")}
    print_provenance()
    print(f"{f'share inside, worst of {args.seeds} seeds':34}{'positions':>10}{'points of movable objects':>28}")
    for task, (positions, points) in shares.items():
        print(f"{task:34}{positions:10.2f}{points:28.2f}")
    print(f"{'worst task':34}{min(p for p, _ in shares.values()):10.2f}{min(p for _, p in shares.values()):28.2f}")
    if args.picture:
        draw(args.picture)


def worst_shares(task: str, n_seeds: int) -> tuple[float, float]:
    """The smallest share of positions, and of visible points of movable objects, inside the crop."""
    env = MetaworldPointCloudEnv(task)
    low = np.array(env.crop.low) - [0, 0, TABLE_SLACK]
    around_origins = Crop(tuple(low), env.crop.high)
    caster = RayCaster(camera_of(task))
    positions, points = [], []
    for seed in range(n_seeds):
        env.reset(seed=seed)
        simulator = env._simulator
        objects = np.array(simulator._get_pos_objects()).reshape(-1, 3)
        goal = drawn_goal(task, simulator._target_pos)
        positions.append(around_origins.contains(np.concatenate([objects, [goal]])).mean())
        hits = caster.cast(simulator.model, simulator.data)
        movable = is_movable(simulator.model)[simulator.model.geom_bodyid[hits.geom]] & (hits.geom >= 0)
        if movable.any():
            seen = caster.rays.origin + caster.rays.directions[movable] * hits.distance[movable, None]
            points.append(env.crop.contains(seen).mean())
    return min(positions), min(points, default=1.0)


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
