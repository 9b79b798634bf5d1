"""Configuration shared by the point-cloud policies: observations, horizons, encoder, training recipe."""

import logging
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_uca.bounds import check_bounds, within
from lerobot_uca.errors import UserError
from lerobot_uca.features import OBJECT_CLOUD, OBS_POINT_CLOUD, POINT_CLOUD, cloud_observation, find_point_cloud
from lerobot_uca.inference.backends import BACKENDS, EAGER, OF_ANY_DEVICE
from lerobot_uca.point_clouds.recipe import depth_keys
from lerobot_uca.policies.augmentation_config import AugmentationConfig, SceneTurnConfig
from lerobot_uca.policies.depth_config import DepthConfig
from lerobot_uca.policies.optimizer import FusedAdamWConfig

logger = logging.getLogger(__name__)

NO_PEFT = (
    "PEFT trains an adapter alone, which has no averaged weights, and these are what is evaluated: train the whole "
    "network, which is small, without --peft."
)


@dataclass
class PointCloudPolicyConfig(PreTrainedConfig):
    """Configuration shared by the policies that see a point cloud and a robot state.

    Which steps are observed, predicted and executed, for the default values (0 is the current step):

        | step        | -1  |  0  |  1  |  2  |
        | observed    | yes | yes |     |     |   n_obs_steps = 2, obs_stride = 1
        | predicted   | yes | yes | yes | yes |   horizon = 4
        | executed    |     | yes | yes | yes |   n_action_steps = 3, entries [1:4] of the prediction

    and with every second step observed (the paper's real robot: stride 2, horizon 16):

        | step        | -2  | -1  |  0  |  1  |  2  |
        | observed    | yes |     | yes |     |     |   n_obs_steps = 2, obs_stride = 2
        | predicted   | yes | yes | yes | yes | yes |   horizon = 5
        | executed    |     |     | yes | yes | yes |   n_action_steps = 3, entries [2:5] of the prediction
    """

    # Observation steps O, the current one included.
    n_obs_steps: int = within(2, least=1, most=128)
    # Steps from one observation step to the next. An action is predicted for each step, also between them.
    obs_stride: int = within(1, least=1, most=128)
    # Predicted actions T, from the first observation step on.
    horizon: int = within(4, least=1, most=1024)
    # Actions executed before the next prediction, from the current step on.
    n_action_steps: int = within(3, least=1, most=1024)
    # The number of a cloud's points that the policy sees, sampled farthest point by farthest point; null for all. A
    # cloud in this order already, as those of this package's environments are, keeps its first ones.
    n_points: int | None = within(None, least=1)
    # Whether the policy sees the points' colours: clouds (N, 6), xyz and RGB, which the dataset must hold.
    colour: bool = False

    # The state's dimensions that hold the hand's x, y and z in the clouds' frame [m], such as [0, 1, 2] in Meta-World:
    # clouds are then seen from the hand. The paper's and the baselines' clouds, and by default ours, are not.
    hand_position: tuple[int, ...] | None = None

    # The environments' observation that training's clouds are: point_cloud, or object_cloud, without the robot. Written
    # by training, not for users; evaluation checks that its environment gives the same.
    observation: str = POINT_CLOUD

    # Training from depth images, which become clouds.
    depth: DepthConfig = field(default_factory=DepthConfig)

    # Changes to training's clouds as a real camera would make them.
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)

    # Training's scenes turned about the hand, with the motion to learn.
    scene_turn: SceneTurnConfig = field(default_factory=SceneTurnConfig)

    # LeRobot takes the point cloud for a state: it is normalised by channel.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {"STATE": NormalizationMode.MIN_MAX, "ACTION": NormalizationMode.MIN_MAX}
    )
    # A robot state's dimension that moves less in the data, in the feature's unit, counts as constant: stretched to
    # [-1, 1], a joint's measuring noise would be a large signal, and far larger where the joint is held elsewhere.
    min_state_range: float = within(1e-4, least=1e-4)

    # Widths of the point encoder's layers (the baselines').
    point_widths: tuple[int, ...] = within((64, 128, 256), least=1, most=8192)
    # Features of a cloud (the baselines').
    n_point_features: int = within(64, least=1, most=8192)
    # Features of a robot state (the baselines').
    n_state_features: int = within(64, least=1, most=8192)

    # The engine that computes actions, the same to rounding: eager (PyTorch, the reference), openvino or onnxruntime
    # (on a CPU; faster for small networks; on other devices it is PyTorch), compile (torch.compile, on a GPU with CUDA
    # graphs).
    # openvino_bfloat16 is faster still where the processor has bfloat16 instructions, UCA-Flow's actions within
    # about 2 % of their range (docs/inference.md).
    inference: str = "eager"
    # Precision of training: float32 or bfloat16 (autocast; the weights stay float32). LeRobot also evaluates with it
    # during training; lerobot-eval uses float32 unless told policy.use_amp=true. A processor without instructions for
    # bfloat16 trains in float32 and says so.
    dtype: str = "float32"
    # The averaged weights follow with decay 1 - (1 + step)^-ema_power, step 0 at the first two updates as in the
    # baselines' code ...
    ema_power: float = within(0.75, least=0, most=10)
    # ... but at most this one.
    ema_max_decay: float = within(0.9999, least=0, most=1)
    # AdamW's learning rate, after the warm-up and before the cosine.
    optimizer_lr: float = within(1e-4, above=0, most=10)
    # AdamW's betas.
    optimizer_betas: tuple[float, float] = within((0.95, 0.999), least=0, below=1)
    # AdamW's epsilon.
    optimizer_eps: float = within(1e-8, above=0, most=1)
    # AdamW's weight decay.
    optimizer_weight_decay: float = within(1e-6, least=0, most=10)
    # Gradients are scaled down to this norm; 0 switches it off.
    optimizer_grad_clip_norm: float = within(1.0, least=0)
    # Steps of linear warm-up, followed by a cosine to zero over the remaining steps.
    scheduler_warmup_steps: int = within(500, least=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        with suppress(ValueError):  # in Python texts do; `validate_sizes` names the one that is no mode
            self.normalization_mapping = {
                str(getattr(kind, "value", kind)): NormalizationMode(mode)
                for kind, mode in self.normalization_mapping.items()
            }
        self.is_new_training = False
        """Whether a checkpoint is loaded to be trained anew in this process, and not to be resumed. It is not saved."""

    def validate_sizes(self) -> None:
        """Raise a `UserError` for values outside their bounds or that do not fit together."""
        check_bounds(self, "policy")
        check_bounds(self.augmentation, "policy.augmentation")
        check_bounds(self.scene_turn, "policy.scene_turn")
        if self.horizon < self.executed.stop:
            raise UserError(
                f"policy.horizon must be at least (n_obs_steps - 1) * obs_stride + n_action_steps = "
                f"{self.executed.stop}, got {self.horizon}: the actions to execute would not all be predicted."
            )
        if self.dtype not in ("float32", "bfloat16"):
            raise UserError(f"policy.dtype must be float32 or bfloat16, got '{self.dtype}'.")
        if self.use_peft:
            raise UserError(NO_PEFT)
        self._validate_normalization()
        if self.inference not in BACKENDS:
            raise UserError(f"policy.inference must be one of {', '.join(BACKENDS)}, got '{self.inference}'.")

    def _validate_normalization(self) -> None:
        mapping = self.normalization_mapping
        if not {"STATE", "ACTION"} <= mapping.keys():  # of what is not named LeRobot passes the raw values on
            raise UserError(
                "policy.normalization_mapping must name STATE (which the cloud is, too) and ACTION, got "
                f"{', '.join(sorted(mapping)) or 'nothing'}. IDENTITY leaves one as it is."
            )
        if unknown := [mode for mode in mapping.values() if mode not in list(NormalizationMode)]:
            valid = ", ".join(mode.value for mode in NormalizationMode)
            raise UserError(f"policy.normalization_mapping must name some of {valid}, got '{unknown[0]}'.")

    def validate_features(self) -> None:
        """Keep of the dataset's features what the policy uses: a cloud, a state and an action.

        Raises:
            UserError: if one is missing or has a shape that does not fit, or if `validate_sizes` finds something.
        """
        self.validate_sizes()
        inputs: dict[str, PolicyFeature] = self.input_features or {}
        cloud_key = find_point_cloud(inputs) or OBS_POINT_CLOUD
        for key, shape in ((cloud_key, f"(N, {self.n_channels})"), (OBS_STATE, "(S,)")):
            if key not in inputs:
                raise UserError(
                    f"Policy '{self.type}' needs the feature '{key}' of shape {shape}, "
                    f"got {', '.join(inputs) or 'none'}."
                )
        if ACTION not in (self.output_features or {}):
            raise UserError(f"Policy '{self.type}' needs the feature '{ACTION}' of shape (A,).")
        cloud, state, action = inputs[cloud_key], inputs[OBS_STATE], self.output_features[ACTION]
        n_channels = self.n_channels
        if len(cloud.shape) != 2 or cloud.shape[1] < n_channels or cloud.shape[0] < (self.n_points or 1):
            raise UserError(
                f"'{cloud_key}' must have shape (N, {n_channels}) with N at least {self.n_points or 1} "
                f"(policy.n_points), or more channels after {'xyz and RGB (policy.colour)' if self.colour else 'xyz'}, "
                f"got {tuple(cloud.shape)}."
            )
        for key, feature in ((OBS_STATE, state), (ACTION, action)):
            if len(feature.shape) != 1:
                raise UserError(f"'{key}' must be a vector, got shape {tuple(feature.shape)}.")
        hand = self.hand_position
        if hand is not None and not (len(hand) == len(set(hand)) == 3 and set(hand) <= set(range(state.shape[0]))):
            raise UserError(
                f"policy.hand_position must be three different dimensions of '{OBS_STATE}', "
                f"0 to {state.shape[0] - 1}, or null, got {list(hand)}."
            )
        self.scene_turn.check(hand, state.shape[0], action.shape[0])
        self.input_features: dict[str, PolicyFeature] | None = {
            OBS_POINT_CLOUD: PolicyFeature(FeatureType.STATE, (cloud.shape[0], n_channels)),
            OBS_STATE: PolicyFeature(FeatureType.STATE, tuple(state.shape)),
        }

    def set_dataset_feature_metadata(self, features: dict[str, Any]) -> None:
        """Take note of how a dataset's clouds are made, and of how many points; of depth images, make them.

        LeRobot calls it before training. It would keep the number of points of a checkpoint that is trained further.

        Raises:
            UserError: if depth images lack a calibration or a crop, or do not fit the checkpoint to be trained further.
        """
        self._take_observation(features)
        if self.observation == OBJECT_CLOUD:
            self.depth.recipe = None  # a checkpoint's, for clouds with the robot
        knows_clouds = self.depth.recipe is not None
        recipe = self.depth.settle(features)
        cloud_key = find_point_cloud(features)
        if cloud_key is not None and OBS_POINT_CLOUD in (self.input_features or {}):
            cloud = PolicyFeature(FeatureType.STATE, tuple(features[cloud_key]["shape"]))
            self.input_features = {**(self.input_features or {}), OBS_POINT_CLOUD: cloud}
        if recipe is None or cloud_key is not None:
            return
        if self.pretrained_path and not knows_clouds:
            raise UserError(
                f"'{self.pretrained_path}' was trained on clouds of unknown origin: the dataset needs "
                f"'{OBS_POINT_CLOUD}', got depth images. lerobot-uca-convert makes clouds from them."
            )
        if self.colour:
            raise UserError("policy.colour=true needs clouds with colours (N, 6): depth images have none.")
        inputs = {key: feature for key, feature in (self.input_features or {}).items() if key not in recipe.keys}
        self.input_features = {**inputs, OBS_POINT_CLOUD: PolicyFeature(FeatureType.STATE, (recipe.n_points, 3))}

    def _take_observation(self, features: dict[str, Any]) -> None:
        if find_point_cloud(features) is None and not depth_keys(features):
            return  # under another name, which a rename_map gives; the features come again with it
        observation = cloud_observation(features)
        if self.pretrained_path and observation != self.observation:
            logger.warning("The checkpoint saw clouds of env.observation=%s, now %s.", self.observation, observation)
        self.observation = observation

    def check_dataset(self, features: Mapping[str, Mapping[str, Any]]) -> None:
        """Raise a `UserError` if a dataset's features, already renamed, cannot continue this checkpoint's training."""
        before = {**(self.input_features or {}), **(self.output_features or {})}
        cloud_key = find_point_cloud(features)
        known = {**features, **({OBS_POINT_CLOUD: features[cloud_key]} if cloud_key else {})}
        for key in before.keys() & {OBS_POINT_CLOUD, OBS_STATE, ACTION}:
            if key == OBS_POINT_CLOUD and self.depth.recipe is not None:
                continue  # made from depth images
            if key not in known:
                raise UserError(
                    f"The checkpoint needs '{key}', which is not among the dataset's features {', '.join(features)}. "
                    f"""--rename_map='{{"name": "{key}"}}' renames one."""
                )
            shape = tuple(known[key]["shape"])
            if key != OBS_POINT_CLOUD and shape != tuple(before[key].shape):
                raise UserError(
                    f"'{key}' must have the checkpoint's shape {tuple(before[key].shape)}, got {shape} in the dataset."
                )

    def check_environment(self, env: Any, observation: str | None = None) -> None:
        """Raise a `UserError` if one of policy and environment sees the robot's own points and the other does not.

        Args:
            env: LeRobot's configuration of an environment, this package's or another's; None for none.
            observation: what training's clouds are, if the policy does not know it yet.
        """
        trained, given = observation or self.observation, getattr(env, "observation", POINT_CLOUD)
        if env is not None and trained != given and OBJECT_CLOUD in (trained, given):
            mend = f"add --env.observation={trained}" if hasattr(env, "observation") else "it has no other"
            raise UserError(
                f"The policy's training has clouds of env.observation={trained}, the environment gives {given}: {mend}."
            )

    @property
    def engine(self) -> str:
        """The backend that computes on this device."""
        return self.inference if self.inference in OF_ANY_DEVICE or self.device == "cpu" else EAGER

    @property
    def n_channels(self) -> int:
        """C, numbers of a point: xyz, and RGB if the policy sees colours."""
        return 6 if self.colour else 3

    @property
    def n_states(self) -> int:
        """S, dimensions of the robot state."""
        assert self.input_features is not None
        return self.input_features[OBS_STATE].shape[0]

    @property
    def n_actions(self) -> int:
        """A, dimensions of an action."""
        return self.output_features[ACTION].shape[0]

    @property
    def n_obs_features(self) -> int:
        """F, features of one observation step."""
        return self.n_point_features + self.n_state_features

    @property
    def obs_span(self) -> int:
        """Steps from the first observed one, where the prediction begins, to the current one."""
        return (self.n_obs_steps - 1) * self.obs_stride

    @property
    def executed(self) -> slice:
        """The executed entries of a prediction."""
        return slice(self.obs_span, self.obs_span + self.n_action_steps)

    @property
    def observation_delta_indices(self) -> list[int]:
        """Observed steps, relative to the current one."""
        return list(range(-self.obs_span, 1, self.obs_stride))

    @property
    def action_delta_indices(self) -> list[int]:
        """Predicted steps, relative to the current one."""
        return list(range(-self.obs_span, -self.obs_span + self.horizon))

    @property
    def reward_delta_indices(self) -> None:
        """Rewards are not used."""

    def get_optimizer_preset(self) -> FusedAdamWConfig:
        """AdamW with the values above."""
        return FusedAdamWConfig(
            lr=self.optimizer_lr,
            betas=self.optimizer_betas,
            eps=self.optimizer_eps,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> CosineAnnealingWithWarmupSchedulerConfig:
        """Warm-up, then cosine to zero at the last step."""
        return CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=self.scheduler_warmup_steps)
