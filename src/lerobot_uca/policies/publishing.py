"""A policy's page on the Hugging Face Hub, and its upload."""

import time
from collections.abc import Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from statistics import median
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import torch
from huggingface_hub import ModelCard, ModelCardData
from lerobot.configs.train import TrainPipelineConfig
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, OBS_STATE, PRETRAINED_MODEL_DIR
from torch import Tensor

from lerobot_uca.features import OBS_POINT_CLOUD, POINT_CLOUD
from lerobot_uca.hub import upload_command, uploading
from lerobot_uca.point_clouds.recipe import CloudRecipe
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig

if TYPE_CHECKING:
    from lerobot_uca.policies.modeling_base import PointCloudPolicy

PAPERS = {
    "uca_flow": "*Unified Condition-Action Modeling for Accurate One-Step Action Generation* (UCA-Flow)",
    "dp3": "[3D Diffusion Policy](https://arxiv.org/abs/2403.03954) (DP3)",
    "simple_dp3": "[3D Diffusion Policy](https://arxiv.org/abs/2403.03954) (Simple DP3)",
    "flowpolicy": "[FlowPolicy](https://arxiv.org/abs/2412.04987)",
    "mp1": "[MP1](https://arxiv.org/abs/2507.10543)",
}
N_TIMED = 20

retry_of: ContextVar[Mapping[str, str]] = ContextVar("retry_of", default=MappingProxyType({}))
"""The command that uploads a policy again, by its repository: LeRobot uploads its processors next, not saying whose."""


@dataclass(frozen=True)
class Evaluation:
    """The result of the last evaluation of a training."""

    pc_success: float
    n_episodes: int
    first_seed: int | None
    step: int  # of the training, after which it was made


class PublishedPolicy:
    """Uploading of a point-cloud policy; part of `PointCloudPolicy`."""

    config: PointCloudPolicyConfig
    ema_step: Tensor
    evaluation: Evaluation | None = None

    def remember_success(self, info: Mapping[str, Any], first_seed: int | None) -> None:
        """Take note of an evaluation for the card, as LeRobot's `eval_policy_all` returns it."""
        overall = info["overall"]
        self.evaluation = Evaluation(overall["pc_success"], overall["n_episodes"], first_seed, int(self.ema_step))

    def push_model_to_hub(self, cfg: TrainPipelineConfig, *args: Any, **kwargs: Any) -> None:
        """Upload weights, settings and card.

        Raises:
            UserError: if it fails; it says where the policy lies, and how to upload it.
        """
        output_dir, repo_id = cfg.output_dir, self.config.repo_id
        assert output_dir is not None
        assert repo_id is not None
        folder = output_dir / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK / PRETRAINED_MODEL_DIR
        retry = upload_command(repo_id, folder, private=self.config.private)
        retry_of.set({repo_id: retry})
        with uploading(f"The policy in '{folder}'", retry):
            super().push_model_to_hub(cfg, *args, **kwargs)  # type: ignore[misc]

    def generate_model_card(  # noqa: PLR0917 (LeRobot's signature)
        self,
        dataset_repo_id: str,
        model_type: str,
        license: str | None,  # noqa: A002 (LeRobot's name)
        tags: list[str] | None,
        cfg: TrainPipelineConfig | None = None,
        dataset_meta: Any = None,
    ) -> ModelCard:
        """The page of this policy: what it is, was trained on and does, its inputs and outputs, and how to run it."""
        data = ModelCardData(
            license=license or "apache-2.0",
            library_name="lerobot",
            pipeline_tag="robotics",
            tags=sorted({*(tags or []), "robotics", "lerobot", "point-cloud", model_type}),
            model_name=model_type,
            datasets=dataset_repo_id,
        )
        sections = (
            _what_it_is(self.config),
            _results(self.evaluation, cfg, latency_ms(self)),  # type: ignore[arg-type]
            _features(self.config, dataset_meta),
            _clouds(self.config),
            _data(dataset_repo_id, dataset_meta),
            _training(cfg),
            _commands(self.config, cfg),
            f"## Licence\n\n{data.license}",
        )
        return ModelCard(f"---\n{data.to_yaml()}\n---\n\n" + "\n\n".join(section for section in sections if section))


def latency_ms(policy: "PointCloudPolicy") -> float:
    """Median milliseconds from one normalised observation history to a chunk of actions, here and now."""
    config = policy.config
    assert config.input_features is not None
    device, was_training = next(policy.parameters()).device, policy.training
    n_points = config.n_points or config.input_features[OBS_POINT_CLOUD].shape[0]
    observation = {
        OBS_POINT_CLOUD: torch.zeros(1, n_points, config.n_channels, device=device),
        OBS_STATE: torch.zeros(1, config.n_states, device=device),
    }
    policy.eval()
    policy.reset()
    times = []
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        for _ in range(N_TIMED):
            start = time.perf_counter()
            policy.predict_action_chunk(observation).cpu()
            times.append(time.perf_counter() - start)
    policy.reset()
    policy.train(was_training)
    return 1e3 * median(times)


def _what_it_is(config: PointCloudPolicyConfig) -> str:
    paper = PAPERS.get(config.type, config.type)
    return (
        f"# {config.repo_id or config.type}\n\n"
        f"A robot policy on 3D point clouds of the type `{config.type}`, the method of {paper}, for "
        "[LeRobot](https://github.com/huggingface/lerobot) with the plugin `lerobot_policy_uca_flow`. From the last "
        f"{config.n_obs_steps} point clouds and robot states it makes {config.horizon} actions, of which "
        f"{config.n_action_steps} are executed before it looks again."
    )


def _results(evaluation: Evaluation | None, cfg: TrainPipelineConfig | None, latency: float) -> str:
    lines = ["## Results\n"]
    if evaluation is None:
        lines.append("- Success: not evaluated during training; see *Commands*.")
    else:
        where = f" in `{cfg.env.type}` ({cfg.env.task})" if cfg is not None and cfg.env is not None else ""
        seeds = "" if evaluation.first_seed is None else f", environment seeds from {evaluation.first_seed}"
        total = "" if cfg is None else f" of {cfg.steps}"
        lines.append(
            f"- Success: {evaluation.pc_success:.1f} % of {evaluation.n_episodes} episodes{where}{seeds}, after step "
            f"{evaluation.step}{total}"
        )
    lines.append(
        f"- Latency: {latency:.1f} ms for a chunk of actions, median of {N_TIMED}, on the machine that trained it"
    )
    return "\n".join(lines)


def _features(config: PointCloudPolicyConfig, dataset_meta: Any) -> str:
    known = {} if dataset_meta is None else dataset_meta.features
    rows = ["## Inputs and action\n", "| feature | shape | meaning |", "|---|---|---|"]
    assert config.input_features is not None
    for key, feature in {**config.input_features, **config.output_features}.items():
        if key == OBS_POINT_CLOUD:
            colours = " and its colour, as the training data has it" if config.colour else ""
            meaning = f"xyz of each point [m], in the frame of the training data{colours}"
        else:
            names = known.get(key, {}).get("names")
            listed = ", ".join(map(str, names)) if isinstance(names, list | tuple) else "not named in the data"
            meaning = f"{listed}; in the units of the training data"
        rows.append(f"| `{key}` | {tuple(feature.shape)} | {meaning} |")
    return "\n".join(rows)


def _clouds(config: PointCloudPolicyConfig) -> str:
    """Cameras, calibrations and crop, if the clouds were made from depth images."""
    if config.depth.recipe is None:
        return ""
    recipe = CloudRecipe.from_dict(config.depth.recipe)
    rows = [
        "## Clouds from depth images\n",
        f"Crop: {list(recipe.crop.low)} to {list(recipe.crop.high)} m in the robot's base, {recipe.n_points} points",
        "On another robot LEROBOT_UCA_CALIBRATION names the folder of its calibrations.\n",
        "| depth images | camera's place [m] | depth [m] | calibration |",
        "|---|---|---|---|",
    ]
    for source in recipe.sources:
        made = source.calibration
        place = [round(row[3], 3) for row in made.camera.X_world_camera[:3]]
        error = "".join(f", error {value:g} {unit}" for unit, value in made.residual.items())
        calibration = f"{made.method or 'by an unknown method'} {made.date}{error}"
        rows.append(f"| `{source.key}` | {place} | {source.near:g} to {source.far:g} | {calibration} |")
    return "\n".join(rows)


def _data(dataset_repo_id: str, dataset_meta: Any) -> str:
    lines = [f"## Data\n\n- Dataset: `{dataset_repo_id}`"]
    if dataset_meta is not None:
        lines.append(
            f"- {dataset_meta.total_episodes} episodes, {dataset_meta.total_frames} frames at {dataset_meta.fps} Hz"
        )
        lines += [f"- Task: {task}" for task in dataset_meta.tasks.index]
        if dataset_meta.robot_type:
            lines.append(f"- Robot: {dataset_meta.robot_type}")
    return "\n".join(lines)


def _training(cfg: TrainPipelineConfig | None) -> str:
    if cfg is None:
        return ""
    return f"## Training\n\n{cfg.steps} steps of batches of {cfg.batch_size}, seed {cfg.seed}; `train_config.json`."


def _commands(config: PointCloudPolicyConfig, cfg: TrainPipelineConfig | None) -> str:
    path = config.repo_id or "user/name"
    env = cfg.env if cfg is not None else None
    environment = f"--env.type={env.type} --env.task={env.task}" if env is not None else "--env.type=..."
    if config.depth.recipe is None and (env is None or hasattr(env, "n_points")):
        assert config.input_features is not None
        environment += f" --env.n_points={config.input_features[OBS_POINT_CLOUD].shape[0]}"
    if config.observation != POINT_CLOUD:
        environment += f" --env.observation={config.observation}"
    return (
        "## Commands\n\n```bash\npip install lerobot_policy_uca_flow\n"
        f"lerobot-eval --policy.path={path} {environment} --eval.n_episodes=50\n"
        f"lerobot-rollout --policy.path={path} --robot.type=...\n"
        f"lerobot-uca-export {path} --output=policy.onnx\n```"
    )
