"""`lerobot-uca-saliency`: which points decide what a policy does, as a picture and, with --rerun, a Rerun recording.

Example:
    lerobot-uca-saliency outputs/train/checkpoints/last/pretrained_model outputs/dataset --output=saliency
"""

import argparse
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline, RenameObservationsProcessorStep
from lerobot.utils.constants import ACTION, OBS_STATE
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import default_collate

from lerobot_uca.data.batched_dataset import BatchedDataset
from lerobot_uca.errors import UserError, reported
from lerobot_uca.features import OBS_POINT_CLOUD, cloud_observation, find_point_cloud, valid_mask
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig
from lerobot_uca.policies.modeling_base import PointCloudPolicy
from lerobot_uca.policies.processor_base import PointCloudProcessorStep
from lerobot_uca.visual.rerun_file import rerun_file
from lerobot_uca.whole_file import whole_file

N_MOMENTS = 4


class Moments(NamedTuple):
    """A policy's observations and actions at K moments of an episode."""

    steps: list[int]
    points: NDArray[np.float32]  # (K, N, 3) [m], the newest frame's
    saliency: NDArray[np.float32]  # (K, N), the largest of a moment is 1
    states: NDArray[np.float32]  # (K, S), in the dataset's units
    actions: NDArray[np.float32]  # (K, n_action_steps, A), in the dataset's units


def saliency(policy: PointCloudPolicy, cloud: Tensor, state: Tensor, noise: Tensor) -> Tensor:
    """The influence of each point of the newest frame on the predicted chunk, (B, N).

    It is the length of the gradient of the chunk's squared length with respect to the point. The paper shows such
    pictures without saying of which number the gradient is.

    Args:
        policy: any of this package.
        cloud, state: a normalised history, (B, O, N, 3) and (B, O, S).
        noise: (B, T, A).
    """
    with torch.enable_grad():
        seen = cloud.detach().clone().requires_grad_()
        model = policy.active_model
        chunk = policy.generate(model.generator, noise, model.encoder(seen, state))
        (gradient,) = torch.autograd.grad(chunk.square().sum(), seen)
    return gradient[:, -1].norm(dim=-1)


def moments_of(checkpoint: Path, dataset_root: Path, episode: int, n_moments: int = N_MOMENTS) -> Moments:
    """Moments of a dataset's episode, evenly spaced.

    Raises:
        UserError: if the checkpoint is not one of this package, the dataset cannot be read, lacks what the policy sees
            or has no such episode, or one of policy and dataset has the robot's own points and the other does not.
    """
    policy, preprocess, postprocess = _load(checkpoint)
    config = policy.config
    if not (dataset_root / "meta" / "info.json").is_file():  # LeRobot would ask the Hub for it
        raise UserError(f"'{dataset_root}' must be a LeRobot dataset (meta/info.json).")
    with reported(f"'{dataset_root}' cannot be read"):
        dataset = BatchedDataset(f"local/{dataset_root.name}", root=dataset_root)
    if not 0 <= episode < dataset.num_episodes:
        raise UserError(f"--episode must be 0 to {dataset.num_episodes - 1}, got {episode}.")
    rename_map = _rename_map(preprocess)
    names = {rename_map.get(name, name): name for name in dataset.meta.features}  # the dataset's, by the policy's
    features = {name: dataset.meta.features[names[name]] for name in names}
    given = cloud_observation(features)
    if given != config.observation:
        raise UserError(
            f"'{checkpoint}' was trained on clouds of env.observation={config.observation}, "
            f"'{dataset_root}' has {given}."
        )
    seconds = [step / dataset.fps for step in config.observation_delta_indices]
    key = find_point_cloud(features)
    if key is None:
        raise UserError(f"'{dataset_root}' must have a point cloud, got {', '.join(names.values())}.")
    state_shape = tuple(features.get(OBS_STATE, {}).get("shape", ()))
    if state_shape != (config.n_states,):
        raise UserError(
            f"'{dataset_root}' must have '{OBS_STATE}' of the checkpoint's shape {(config.n_states,)}, got "
            f"{state_shape or ', '.join(names.values())}."
        )
    mask = valid_mask(key, features)
    seen = [names[name] for name in (key, OBS_STATE, *([mask] if mask else []))]
    windows = dict.fromkeys(seen, seconds)
    dataset = BatchedDataset(dataset.repo_id, root=dataset_root, delta_timestamps=windows)
    of_episode = np.flatnonzero(np.asarray(dataset.hf_dataset["episode_index"]) == episode)
    steps = np.linspace(0, len(of_episode) - 1, n_moments).round().astype(int).tolist()
    raw = default_collate(dataset.__getitems__([int(of_episode[step]) for step in steps]))
    points = PointCloudProcessorStep(config.n_points).uniform(
        raw[names[key]][:, -1], None if mask is None else raw[names[mask]][:, -1]
    )
    batch = preprocess({each: raw[each] for each in seen})
    cloud, state = batch[OBS_POINT_CLOUD], batch[OBS_STATE]
    noise = torch.zeros(len(steps), config.horizon, config.n_actions)  # the middle of what may be drawn
    values = saliency(policy, cloud, state, noise)
    with torch.no_grad():
        actions = postprocess(policy.predict_action_chunk(batch, noise=noise))
    return Moments(
        steps=steps,
        points=points.numpy(),
        saliency=(values / values.amax(dim=1, keepdim=True).clamp_min(1e-12)).numpy(),
        states=raw[names[OBS_STATE]][:, -1].numpy(),
        actions=actions.numpy(),
    )


def _load(checkpoint: Path) -> tuple[PointCloudPolicy, Any, Any]:
    if not (checkpoint / "config.json").is_file():
        raise UserError(f"'{checkpoint}' has no config.json. A checkpoint is a folder like .../last/pretrained_model.")
    config = PreTrainedConfig.from_pretrained(checkpoint)
    if not isinstance(config, PointCloudPolicyConfig):
        raise UserError(f"'{checkpoint}' must be a policy of this package, got type '{config.type}'.")
    config.device, config.inference = "cpu", "eager"
    policy_class: Any = get_policy_class(config.type)
    with redirect_stdout(None):  # LeRobot says that it loads
        policy = policy_class.from_pretrained(checkpoint, config=config).eval()
    config.depth.keep_calibrations()  # clouds are given, and not by cameras here
    overrides = {"device_processor": {"device": "cpu"}}
    processors = make_pre_post_processors(
        config, pretrained_path=str(checkpoint), preprocessor_overrides=overrides, postprocessor_overrides=overrides
    )
    return policy, *processors


def _rename_map(preprocess: PolicyProcessorPipeline) -> dict[str, str]:
    """How the training renamed its data's features."""
    steps = [step for step in preprocess.steps if isinstance(step, RenameObservationsProcessorStep)]
    return {old: new for step in steps for old, new in step.rename_map.items()}


def draw(moments: Moments, path: Path) -> None:
    """A picture of each moment's cloud, coloured by saliency from grey to red."""
    try:
        import matplotlib as mpl

        mpl.use("Agg")
        from matplotlib import pyplot as plt
    except ImportError as error:
        raise UserError("Pictures need matplotlib: pip install 'lerobot_policy_uca_flow[pictures]'.") from error
    colours = mpl.colors.LinearSegmentedColormap.from_list("saliency", ("#c4c9cf", "#f28c28", "#b00020"))
    n_moments = len(moments.steps)
    figure = plt.figure(figsize=(4 * n_moments, 4.2), layout="constrained")
    low, high = moments.points.min(axis=(0, 1)), moments.points.max(axis=(0, 1))
    every: list[Any] = []
    for index, step in enumerate(moments.steps):
        axes: Any = figure.add_subplot(1, n_moments, index + 1, projection="3d")
        order = np.argsort(moments.saliency[index])  # the greatest last, in front
        points, values = moments.points[index][order], moments.saliency[index][order]
        shown = axes.scatter(*points.T, c=values, s=6 + 40 * values, cmap=colours, vmin=0, vmax=1, depthshade=False)
        axes.set_title(f"step {step}")
        axes.set(xlabel="x [m]", ylabel="y [m]", xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.text2D(0.02, 0.85, "z [m] upwards", transform=axes.transAxes, fontsize=8)
        axes.set_aspect("equal")
        axes.locator_params(nbins=4)
        axes.view_init(elev=30, azim=-40)
        every.append(axes)
    figure.suptitle("Points that decide the predicted actions (grey: hardly, red: most of all at this step)")
    figure.colorbar(shown, ax=every, shrink=0.7, label="influence, the step's greatest is 1")
    with whole_file(path) as unfinished:
        figure.savefig(unfinished, dpi=100)
    plt.close(figure)


def record(moments: Moments, path: Path) -> None:
    """A Rerun recording: the cloud coloured by saliency, the state and the predicted chunk."""
    with rerun_file(path, "lerobot_uca_saliency") as (rerun, recording):
        for index, step in enumerate(moments.steps):
            recording.set_time("step", sequence=step)
            value = moments.saliency[index][:, None]
            colours = (255 * np.hstack([value, value**2, 0.4 * (1 - value)])).astype(np.uint8)
            recording.log("cloud", rerun.Points3D(moments.points[index], colors=colours))
            recording.log(OBS_STATE.replace(".", "/"), rerun.Scalars(moments.states[index]))
            for ahead, action in enumerate(moments.actions[index]):
                recording.log(f"{ACTION}/{ahead}_steps_ahead", rerun.Scalars(action))


def main(arguments: Sequence[str] | None = None) -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(
        prog="lerobot-uca-saliency", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path, help="folder pretrained_model of a trained policy")
    parser.add_argument("dataset", type=Path, help="folder of a dataset with the policy's features")
    parser.add_argument("--episode", type=int, default=0, help="of the dataset (default: 0)")
    parser.add_argument("--output", type=Path, default=Path("saliency"), help="folder to write (default: saliency)")
    parser.add_argument("--rerun", action="store_true", help="also a recording, saliency.rrd")
    args = parser.parse_args(arguments)
    moments = moments_of(args.checkpoint, args.dataset, args.episode)
    try:
        args.output.mkdir(parents=True, exist_ok=True)
        draw(moments, args.output / "saliency.png")
        if args.rerun:
            record(moments, args.output / "saliency.rrd")
    except OSError as error:
        raise UserError(f"--output '{args.output}' cannot be written: {error}") from error
    print(args.output / "saliency.png")
