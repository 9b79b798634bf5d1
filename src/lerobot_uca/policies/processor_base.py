"""Pre- and postprocessing of all point-cloud policies, and the step that makes their inputs uniform.

Letters: B samples, O observation steps, N points, S state dimensions, T horizon, A action dimensions.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, override

import torch
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, PolicyAction, TransitionKey
from lerobot.processor import (
    NormalizerProcessorStep,
    PolicyProcessorPipeline,
    ProcessorStep,
    ProcessorStepRegistry,
    RenameObservationsProcessorStep,
    UnnormalizerProcessorStep,
)
from lerobot.processor.factory import make_default_policy_processor_steps, make_policy_processor_pipelines
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBJECT_CLOUD, OBS_POINT_CLOUD, find_point_cloud, valid_mask
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig
from lerobot_uca.policies.processor_augmentation import CloudAugmentationProcessorStep, augmentation_steps
from lerobot_uca.policies.processor_depth import DepthToCloudProcessorStep
from lerobot_uca.policies.processor_hand_frame import HandFrameProcessorStep, hand_frame_steps
from lerobot_uca.policies.processor_scene_turn import SceneTurnProcessorStep, scene_turn_steps
from lerobot_uca.policies.statistics import check_statistics, settled_statistics

logger = logging.getLogger(__name__)

Processors = tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]


def make_processors(
    config: PointCloudPolicyConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> Processors:
    """LeRobot's pipelines (rename, batch, device, normalise; and back), with a uniform point cloud before the batch.

    The cloud is made from depth images if there are any.

    Raises:
        UserError: as `settled_statistics`.
    """
    config.validate_features()
    stats = settled_statistics(dataset_stats, config)
    steps = make_default_policy_processor_steps(config, stats)
    depth_step = DepthToCloudProcessorStep(recipe=config.depth.recipe)
    if config.depth.is_settled:
        depth_step.keep()
    return make_policy_processor_pipelines(
        [
            steps.rename_observations,
            depth_step,
            PointCloudProcessorStep(config.n_points, config.colour),
            *_own_steps(config, stats[OBS_STATE]),
            steps.add_batch_dim,
            steps.to_device,
            steps.normalize,
        ],
        [steps.unnormalize, steps.to_cpu],
    )


def load_processors(
    make: Callable[..., Processors], config: PointCloudPolicyConfig, checkpoint: str, *args: Any, **options: Any
) -> Processors:
    """A checkpoint's pipelines: settled statistics in, checked pipelines out.

    LeRobot passes a feature on as it is if its normaliser does not know it.

    Args:
        make: LeRobot's `make_pre_post_processors`.
        config: of the policy.
        checkpoint: where the pipelines are saved.
        args, options: LeRobot's.

    Raises:
        UserError: if they would let something pass unnormalised, and as `settled_statistics`.
    """
    config.validate_features()
    before = {key: dict(each) for key, each in (options.pop("preprocessor_overrides", None) or {}).items()}
    after = {key: dict(each) for key, each in (options.pop("postprocessor_overrides", None) or {}).items()}
    before.setdefault("device_processor", {"device": config.device})  # the saved one may be another machine's
    if "stats" in before.get("normalizer_processor", {}):
        rename_map = before.get("rename_observations_processor", {}).get("rename_map")
        stats = settled_statistics(before["normalizer_processor"]["stats"], config, rename_map)
        before["normalizer_processor"]["stats"] = stats
        after.setdefault("unnormalizer_processor", {})["stats"] = stats
    overrides = {"preprocessor_overrides": before, "postprocessor_overrides": after}
    processors = make(config, checkpoint, *args, **options, **overrides)
    for step in processors[0].steps:
        if isinstance(step, DepthToCloudProcessorStep):
            # A further training's, where that has another one; depth images show the robot.
            step.recipe = None if config.observation == OBJECT_CLOUD else config.depth.recipe or step.recipe
            if config.depth.is_settled:
                step.keep()
            else:
                step.install(config.depth.calibration)
    _check_pipelines(config, checkpoint, *processors)
    return processors


def _check_pipelines(
    config: PointCloudPolicyConfig, checkpoint: str, pre: PolicyProcessorPipeline, post: PolicyProcessorPipeline
) -> None:
    """Check that all data reaches the policy and the robot normalised, and put the configuration's own steps in.

    Old checkpoints lack the point-cloud step, and a training that starts from a checkpoint may augment otherwise.
    """
    state_statistics: dict[str, Any] = {}
    for pipeline, kind, keys in (
        (pre, NormalizerProcessorStep, (OBS_POINT_CLOUD, OBS_STATE, ACTION)),
        (post, UnnormalizerProcessorStep, (ACTION,)),
    ):
        step = next((each for each in pipeline.steps if isinstance(each, kind)), None)
        if step is None:
            raise UserError(f"'{pipeline.name}' of checkpoint '{checkpoint}' has no {kind._registry_name}.")
        for key in keys:
            if key not in step.features:
                raise UserError(f"The {kind._registry_name} of checkpoint '{checkpoint}' does not know '{key}'.")
            stats = {name.rpartition("."): value for name, value in step.state_dict().items()}
            stats = {name: value for (of, _, name), value in stats.items() if of == key}
            check_statistics(key, stats, config, where=f"the {kind._registry_name}'s in '{checkpoint}'")
            state_statistics = stats if key == OBS_STATE else state_statistics
    own = CloudAugmentationProcessorStep, SceneTurnProcessorStep, HandFrameProcessorStep
    steps = [each for each in pre.steps if not isinstance(each, own)]
    kinds = [type(each) for each in steps]
    if PointCloudProcessorStep not in kinds:
        before = RenameObservationsProcessorStep
        kinds.insert(kinds.index(before) + 1 if before in kinds else 0, PointCloudProcessorStep)
        steps.insert(kinds.index(PointCloudProcessorStep), PointCloudProcessorStep())
    place = kinds.index(PointCloudProcessorStep)
    steps[place] = PointCloudProcessorStep(config.n_points, config.colour)
    pre.steps = [*steps[: place + 1], *_own_steps(config, state_statistics), *steps[place + 1 :]]


def _own_steps(config: PointCloudPolicyConfig, state_statistics: dict[str, Any]) -> list[ProcessorStep]:
    """The steps that the configuration asks for, in metres."""
    return [
        *augmentation_steps(config),
        *scene_turn_steps(config),
        *hand_frame_steps(config, state_statistics),
    ]


@dataclass
@ProcessorStepRegistry.register(name="point_cloud_processor")
class PointCloudProcessorStep(ProcessorStep):
    """Makes what datasets, environments and robots give into what the policies take.

    - The cloud may stand under other plugins' names (`POINT_CLOUD_KEYS`) and have more channels than the policy sees,
      such as colours; points that its mask calls invalid are replaced by valid ones.
    - A cloud of more than n_points is sampled farthest point by farthest point. One that is in this order already (as
      those of this package's environments are) keeps its first n_points.
    - Everything becomes float32: LeRobot's normaliser takes on its input's type, statistics included.
    - A single frame or window gets a batch dimension, and a state or action of one dimension, which LeRobot reads as
      numbers, its last one: the action (T,) of a single window is T numbers.

    Args:
        n_points: points of a cloud that the policy looks at; None for all.
        colour: whether the policy looks at RGB after xyz.
    """

    n_points: int | None = None
    colour: bool = False
    _has_said: bool = field(default=False, init=False, repr=False, compare=False)

    @override
    def __call__(self, transition: EnvTransition) -> EnvTransition:
        observation = dict(transition.get(TransitionKey.OBSERVATION) or {})
        key = find_point_cloud(observation)
        if key is None:  # the policy says what is missing
            return transition
        cloud = _as_float(observation.pop(key))
        n_channels = self._n_channels
        if cloud.ndim < 2 or cloud.shape[-1] < n_channels:
            raise UserError(
                f"'{key}' must have shape (..., N, {n_channels}) or more channels, got {tuple(cloud.shape)}."
            )
        if not self._has_said and (key != OBS_POINT_CLOUD or cloud.shape[-1] > n_channels):
            self._has_said = True
            shape, taken = tuple(cloud.shape[-2:]), "six" if self.colour else "three"
            what = "xyz and RGB" if self.colour else "xyz"
            logger.warning("'%s' %s: its first %s channels are taken as the point cloud's %s.", key, shape, taken, what)
        mask_key = valid_mask(key, observation)
        mask = None if mask_key is None else torch.as_tensor(observation.pop(mask_key))
        observation[OBS_POINT_CLOUD] = self.uniform(cloud, mask)
        transition = transition.copy()
        transition[TransitionKey.OBSERVATION] = observation
        is_single = _is_single(transition)
        if OBS_STATE in observation:
            observation[OBS_STATE] = _with_last_dimension(_as_float(observation[OBS_STATE]), cloud, is_single)
        action = transition.get(TransitionKey.ACTION)
        if action is not None:
            transition[TransitionKey.ACTION] = _with_last_dimension(_as_float(action), cloud, is_single)
        return _with_batch(transition) if is_single else transition

    def uniform(self, cloud: Tensor, mask: Tensor | None = None) -> Tensor:
        """Valid points, (..., N, 3) or of more points (..., n_points, 3), with colour 6, of clouds (..., N, C).

        Args:
            cloud: float32, xyz and perhaps RGB in the first of its C channels.
            mask: which points are valid, (..., N); None for all.
        """
        n_points = self.n_points
        cloud = (cloud if mask is None else _with_valid_points(cloud, mask.bool()))[..., : self._n_channels]
        if n_points is None or cloud.shape[-2] <= n_points:
            return cloud
        from lerobot_uca.point_clouds.geometry import subsample_farthest

        points = cloud.detach().cpu().numpy().reshape(-1, *cloud.shape[-2:])
        sampled = [torch.from_numpy(subsample_farthest(each, n_points)) for each in points]
        return torch.stack(sampled).reshape(*cloud.shape[:-2], n_points, cloud.shape[-1]).to(cloud.device)

    @override
    def get_config(self) -> dict[str, Any]:
        return {"n_points": self.n_points, "colour": self.colour}

    @property
    def _n_channels(self) -> int:
        return 6 if self.colour else 3

    @override
    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        observations = dict(features[PipelineFeatureType.OBSERVATION])
        key = find_point_cloud(observations)
        if key is not None:
            n_given = observations.pop(key).shape[0]
            n_points = n_given if self.n_points is None else self.n_points
            observations[OBS_POINT_CLOUD] = PolicyFeature(FeatureType.STATE, (n_points, self._n_channels))
        return {**features, PipelineFeatureType.OBSERVATION: observations}


def _as_float(values: Any) -> Tensor:
    return torch.as_tensor(values).to(torch.float32)


def _with_last_dimension(values: Tensor, cloud: Tensor, is_single: bool) -> Tensor:
    """A vector of one dimension, which LeRobot reads as a number, as a vector again.

    To a cloud (..., N, C) belong vectors (..., D), so here numbers (...); an action has T where it has O. Beside
    a batch of another size stands a vector that has none.
    """
    is_of_batch = is_single or values.shape[:1] == cloud.shape[: min(values.ndim, 1)]
    return values.unsqueeze(-1) if values.ndim == cloud.ndim - 2 and is_of_batch else values


def _with_valid_points(cloud: Tensor, mask: Tensor) -> Tensor:
    """Clouds (..., N, C) with the valid points of a mask (..., N) in their order, repeated in turn up to N."""
    if mask.shape == (*cloud.shape[:-1], 1):
        mask = mask.squeeze(-1)
    if mask.shape != cloud.shape[:-1]:
        raise UserError(f"The mask of valid points must have shape {tuple(cloud.shape[:-1])}, got {tuple(mask.shape)}.")
    n_valid = mask.sum(dim=-1, keepdim=True)
    if not n_valid.all():
        raise UserError("A point cloud must hold at least one valid point, got one whose mask is false everywhere.")
    valid_first = (~mask).to(torch.uint8).argsort(dim=-1, stable=True)
    chosen = valid_first.gather(-1, torch.arange(mask.shape[-1], device=mask.device) % n_valid)
    return cloud.gather(-2, chosen[..., None].expand_as(cloud))


def _is_single(transition: EnvTransition) -> bool:
    """Whether this is one frame or one window without a batch dimension, such as `dataset[0]`."""
    index = (transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}).get("index")
    is_single_row = isinstance(index, Tensor) and index.ndim == 0
    return is_single_row or transition[TransitionKey.OBSERVATION][OBS_POINT_CLOUD].ndim == 2


def _with_batch(transition: EnvTransition) -> EnvTransition:
    observation = {**transition[TransitionKey.OBSERVATION]}
    for key in (OBS_POINT_CLOUD, OBS_STATE):
        if key in observation:
            observation[key] = observation[key][None]
    transition[TransitionKey.OBSERVATION] = observation
    if transition.get(TransitionKey.ACTION) is not None:
        transition[TransitionKey.ACTION] = transition[TransitionKey.ACTION][None]
    rest = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
    padding = {key: value[None] for key, value in rest.items() if key.endswith("_is_pad")}
    transition[TransitionKey.COMPLEMENTARY_DATA] = {**rest, **padding}
    return transition
