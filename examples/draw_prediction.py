"""Draw a trained policy's observation and predictions: a PNG.

    python examples/draw_prediction.py --checkpoint=outputs/.../pretrained_model --task=drawer-close --output=next.png

It is also the shortest complete use of a checkpoint from Python: environment, preprocessor, policy, postprocessor.
"""

import argparse
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from lerobot.envs import preprocess_observation
from lerobot.policies import make_pre_post_processors
from lerobot.utils.constants import OBS_STATE
from matplotlib import pyplot as plt
from mpl_toolkits.mplot3d import Axes3D
from numpy.typing import NDArray

import lerobot_policy_uca_flow  # noqa: F401  (registers policy and environment)
from lerobot_uca.envs.metaworld import MetaworldPointCloudEnv
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy

METRES_PER_ACTION = 0.01  # Meta-World moves the hand by up to 1 cm an action
N_MOMENTS = 3
N_SAMPLES = 16
STRETCH = 5  # predictions reach 3 cm; drawn longer, they can be seen


def main() -> None:
    """Roll the policy out and draw three moments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", type=Path, required=True, help="folder of a trained UCA-Flow policy")
    parser.add_argument("--task", required=True, help="Meta-World task, such as drawer-close")
    parser.add_argument("--output", type=Path, required=True, help="PNG to write")
    parser.add_argument("--seed", type=int, default=1000, help="seed of the episode")
    parser.add_argument("--every", type=int, default=24, help="steps between the moments that are drawn")
    args = parser.parse_args()

    policy = UCAFlowPolicy.from_pretrained(args.checkpoint)
    preprocess, postprocess = make_pre_post_processors(policy.config, pretrained_path=str(args.checkpoint))
    env = MetaworldPointCloudEnv(args.task, observation=policy.config.observation)
    torch.manual_seed(args.seed)

    mpl.use("Agg")
    figure = plt.figure(figsize=(5 * N_MOMENTS, 9))
    observation, _ = env.reset(seed=args.seed)
    n_steps = policy.config.obs_span + 1
    batches: deque[dict[str, torch.Tensor]] = deque(maxlen=n_steps)  # what `select_action` remembers by itself
    for step in range(args.every * (N_MOMENTS - 1) + 1):
        batch = preprocess(preprocess_observation({key: value[None] for key, value in observation.items()}))
        batches.extend([batch] * (1 if batches else n_steps))  # the first one stands for those before it
        moment, rest = divmod(step, args.every)
        if rest == 0:
            actions = sample_actions(policy, list(batches)[:: policy.config.obs_stride], postprocess)
            axes = figure.add_subplot(2, N_MOMENTS, moment + 1)
            axes.imshow(env.render())
            axes.set_title(f"{args.task}, step {step}")
            axes.axis("off")
            below = figure.add_subplot(2, N_MOMENTS, N_MOMENTS + moment + 1, projection="3d")
            assert isinstance(below, Axes3D)
            cloud = observation["point_cloud"][: policy.config.n_points]
            draw_cloud(below, env.crop, cloud, observation["agent_pos"][:3], actions)
        observation, *_ = env.step(postprocess(policy.select_action(batch))[0].numpy())
    figure.suptitle(
        f"Above, the scene. Below, the policy's cloud (coloured by height), the hand (black) and {N_SAMPLES} one-step "
        f"predictions of its motion (red, drawn {STRETCH} x as long)"
    )
    figure.tight_layout()
    args.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.output, dpi=80)
    print(args.output)


def sample_actions(
    policy: UCAFlowPolicy,
    observed: Sequence[dict[str, torch.Tensor]],
    postprocess: Callable[[torch.Tensor], torch.Tensor],
) -> NDArray[np.float32]:
    """Several predictions from the observed steps, oldest first: (samples, actions, 4), in the environment's units."""
    steps = {key: torch.stack([batch[key] for batch in observed], dim=1) for key in (OBS_POINT_CLOUD, OBS_STATE)}
    history = {key: value.expand(N_SAMPLES, *value.shape[1:]) for key, value in steps.items()}  # equal, each with noise
    return postprocess(policy.predict_action_chunk(history)).numpy()


def draw_cloud(
    axes: Axes3D, crop: Crop, cloud: NDArray[np.float32], hand: NDArray[np.float32], actions: NDArray[np.float32]
) -> None:
    """The cloud, coloured by height, the hand, and its predicted paths."""
    axes.scatter(*cloud.T, c=cloud[:, 2], s=8, cmap="viridis")
    axes.scatter(*hand, color="black", s=40)
    for sample in actions:
        path = hand + STRETCH * METRES_PER_ACTION * np.vstack([np.zeros(3), sample[:, :3].cumsum(axis=0)])
        axes.plot(*path.T, color="crimson", linewidth=1)
    limits = zip(("xlim", "ylim", "zlim"), zip(crop.low, crop.high, strict=True), strict=True)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", **dict(limits))
    axes.set_aspect("equal")
    axes.locator_params(nbins=4)
    axes.view_init(elev=30, azim=-40)


if __name__ == "__main__":
    main()
