"""Where a policy closes its hand in Meta-World, and where the thing lay that it should have grasped.

python benchmarks/grasps.py outputs/train/checkpoints/last/pretrained_model shelf-place

One line an episode, then for x and y how far the hand's place follows the thing's: the slope of a straight line through
all episodes, 1 for a hand that is always at the thing, 0 for one that closes at the same place wherever the thing is.
A hand is closed where it stays 1 cm less open than at the start for five steps; the slopes leave out episodes without.
"""

import argparse
from pathlib import Path

import numpy as np
from common import print_provenance

from lerobot_uca.envs.point_cloud_env import PointCloudEnv
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.run_cell import load_lerobot, make_env

FIRST_SEED = 5_000_000  # no table's episodes
N_STEPS = 5


def main() -> None:
    """Print the episodes and the slopes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("task")
    parser.add_argument("--episodes", type=int, default=40)
    args = parser.parse_args()
    load_lerobot()
    from lerobot_uca.protocol.evaluation import PolicyPlan, run_episodes

    plan = PolicyPlan.from_checkpoint(args.checkpoint)
    frames: list[tuple[np.ndarray, np.ndarray, float]] = []

    def watch(env: PointCloudEnv, step: int) -> None:
        if step == 0:
            frames.clear()
        simulator = env._simulator  # only a study looks inside
        fingers = simulator.data.body("rightpad").xpos - simulator.data.body("leftpad").xpos
        frames.append(
            (simulator.tcp_center.copy(), simulator._get_pos_objects()[:3].copy(), float(np.linalg.norm(fingers)))
        )

    print_provenance()
    seeds = range(FIRST_SEED, FIRST_SEED + args.episodes)
    make = make_env(Cell(f"metaworld/{args.task}", "uca_flow", 0), plan)
    hands, things, successes = [], [], []
    for episode in run_episodes(make, plan.config, plan, seeds, n_envs=1, watch=watch):
        widths = np.array([width for _, _, width in frames])
        successes.append(episode.success)
        verdict = f"{episode.seed} {'success' if episode.success else 'failure'}"
        closed = np.convolve(widths < widths[:N_STEPS].max() - 0.01, np.ones(N_STEPS), mode="valid") == N_STEPS
        if not closed.any():
            print(f"{verdict}: hand does not close")
            continue
        hand, thing, _ = frames[int(closed.argmax())]
        hands.append(hand)
        things.append(thing)
        dx, dy, _ = 1e3 * (hand - thing)
        x, y, _ = thing
        print(f"{verdict}: thing at {x:.3f} {y:.3f} m, hand closes {dx:+.0f} {dy:+.0f} mm from it")
    print(f"success: {sum(successes)} of {len(successes)}")
    for axis, name in enumerate("xy"):
        hand, thing = (np.array(places)[:, axis] for places in (hands, things))
        slope = np.polyfit(thing, hand, 1)[0]
        distance = 1e3 * np.sqrt(np.mean((hand - thing) ** 2))
        print(f"{name}: slope {slope:.2f}, distance {distance:.0f} mm (root mean square)")


if __name__ == "__main__":
    main()
