"""The base of the point-cloud policies: observation history, action queue, averaged weights.

A method adds its own network, loss and sampler.

Letters: B samples, O observation steps, N points, S state dimensions, T horizon, A action dimensions, F features.
"""

import math
from abc import abstractmethod
from collections import deque
from collections.abc import Iterable, Mapping
from copy import deepcopy
from pathlib import Path
from textwrap import shorten
from typing import Any, NamedTuple, NoReturn, Self

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from safetensors import SafetensorError
from torch import Tensor, nn

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.inference.backends import make_backend
from lerobot_uca.networks.observation_encoder import ObservationEncoder
from lerobot_uca.policies import processor_base  # noqa: F401 (registers the steps that checkpoints name)
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig
from lerobot_uca.policies.history import Frame, ObservationHistory

OBSERVATION_KEYS = (OBS_POINT_CLOUD, OBS_STATE)


class Model(nn.Module):
    """What is trained: an encoder of observations and a network that makes actions from its features."""

    def __init__(self, encoder: nn.Module, generator: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder
        self.generator = generator


class MethodLoss(NamedTuple):
    """A method's loss for each sample, (B,), and its parts to log, each (B,)."""

    total: Tensor
    parts: dict[str, Tensor]


class PointCloudPolicy(PreTrainedPolicy):
    """A LeRobot policy that makes chunks of actions from point clouds and robot states.

    A subclass says which network makes the actions (`make_generator`), how it is trained (`compute_loss`) and how
    it is sampled (`generate`).

    In training mode the trained weights are used, in eval mode their exponential moving average. Both are saved, so
    that a checkpoint can be resumed and is, when loaded, what was evaluated.
    """

    config_class = PointCloudPolicyConfig
    name = "point_cloud_base"
    config: PointCloudPolicyConfig
    ema_step: Tensor

    def __init__(self, config: PointCloudPolicyConfig, **_: Any) -> None:
        # `make_policy` passes the dataset's statistics and metadata as well; normalisation is the processors' task.
        if not isinstance(config, self.config_class):
            raise UserError(
                f"{type(self).__name__} needs a configuration or checkpoint of policy type '{self.name}', got one of "
                f"type '{getattr(config, 'type', type(config).__name__)}'."
            )
        super().__init__(config)
        config.validate_features()
        encoder = ObservationEncoder(
            config.n_states, config.point_widths, config.n_point_features, config.n_state_features
        )
        self.model = Model(encoder, self.make_generator())
        self.ema_model = deepcopy(self.model).requires_grad_(False)
        self.register_buffer("ema_step", torch.zeros((), dtype=torch.long))
        computed = make_backend(config.inference)
        self._encode_frames = computed(_encode_frames)
        self._plan = computed(self._encode_and_generate)
        self.reset()

    @abstractmethod
    def make_generator(self) -> nn.Module:
        """The network that makes actions from observation features (B, O, F)."""

    @abstractmethod
    def compute_loss(self, generator: nn.Module, x: Tensor, o: Tensor, mask: Tensor) -> MethodLoss:
        """The loss for expert actions x (B, T, A), features o (B, O, F) and mask (B, T), True for steps that count."""

    @abstractmethod
    def generate(self, generator: nn.Module, noise: Tensor, o: Tensor) -> Tensor:
        """Actions (B, T, A) from noise (B, T, A) and features o (B, O, F)."""

    # Training ---------------------------------------------------------------------------------------------------

    def get_optim_params(self) -> Iterable[nn.Parameter]:
        """The trained parameters; the averaged ones follow by `update`."""
        return self.model.parameters()

    def forward(self, batch: Mapping[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """The loss of a batch of windows, as a mean or, with reduction='none', for each sample (B,).

        Args:
            batch: normalised; point cloud (B, O, N, 3), state (B, O, S), action (B, T, A) and, if there is
                padding, action_is_pad (B, T). Padded steps do not count.

        Raises:
            UserError: for wrong shapes, and for NaN or infinite values.
        """
        if reduction not in ("mean", "none"):
            raise UserError(f"reduction must be 'mean' or 'none', got '{reduction}'.")
        self._check_shapes(batch, self.config.n_obs_steps)
        x = batch[ACTION]
        expected = (self.config.horizon, self.config.n_actions)
        if x.shape[1:] != expected:
            raise UserError(f"'{ACTION}' must have shape (B, {expected[0]}, {expected[1]}), got {tuple(x.shape)}.")
        padded = batch.get(f"{ACTION}_is_pad")
        mask = torch.ones(x.shape[:2], dtype=torch.bool, device=x.device) if padded is None else ~padded
        model = self.active_model
        loss = self.compute_loss(model.generator, x, self._encode(model, batch), mask)
        parts = {name: value.mean().item() for name, value in loss.parts.items()}
        mean = loss.total.mean()
        if not torch.isfinite(mean):
            self._check_finite(batch, (*OBSERVATION_KEYS, ACTION))
            self._raise_diverged()
        return (mean if reduction == "mean" else loss.total), parts

    @torch.no_grad()
    def update(self) -> None:
        """Let the averaged weights follow; LeRobot calls it after each optimiser step."""
        self.ema_step += 1
        decay = min(1 - (1 + self.ema_step.item()) ** -self.config.ema_power, self.config.ema_max_decay)
        torch._foreach_lerp_(list(self.ema_model.parameters()), list(self.model.parameters()), 1 - decay)

    # Inference --------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget observations and planned actions: an episode begins."""
        self._history = ObservationHistory(self.config.n_obs_steps, self.config.obs_stride)
        self._action_queue: deque[Tensor] = deque()

    @torch.no_grad()
    def select_action(self, batch: Mapping[str, Tensor], noise: Tensor | None = None) -> Tensor:
        """The next action (B, A), normalised. Every n_action_steps calls the policy plans anew.

        Args:
            batch: the newest observation, normalised; point cloud (B, N, 3), state (B, S). Each call's is remembered,
                and the first one stands for those before it.
            noise: (B, T, A), drawn if not given.
        """
        frame = self._remember(batch)
        if not self._action_queue:
            self._action_queue.extend(self._plan_from_remembered(noise).unbind(dim=1))
        elif self._history.is_seen_again(len(self._action_queue), self.config.n_action_steps):
            self._features(frame)  # now, so that the plan itself takes less time
        return self._action_queue.popleft()

    @torch.no_grad()
    def predict_action_chunk(self, batch: Mapping[str, Tensor], noise: Tensor | None = None) -> Tensor:
        """The actions to execute from now on, (B, n_action_steps, A), normalised.

        Args:
            batch: normalised; either the newest observation, (B, N, 3) and (B, S), which is remembered for the
                next call, or the observed steps, (B, O, N, 3) and (B, O, S), oldest first, which are not.
            noise: (B, T, A), drawn if not given.
        """
        if _get(batch, OBS_POINT_CLOUD).ndim == 3:
            self._remember(batch)
            return self._plan_from_remembered(noise)
        self._check_shapes(batch, self.config.n_obs_steps)
        self._check_finite(batch, OBSERVATION_KEYS)
        cloud, state = batch[OBS_POINT_CLOUD][..., : self.config.n_points, :], batch[OBS_STATE]
        earlier: tuple[Tensor, ...] = ()
        if self.config.n_obs_steps > 1:
            (features,) = self._encode_frames(self.active_model.encoder, cloud[:, :-1], state[:, :-1])
            earlier = features.split(1, dim=1)
        return self._plan_from(Frame(cloud[:, -1:], state[:, -1:]), earlier, noise)

    @property
    def active_model(self) -> Model:
        """The trained model in training mode, its moving average in eval mode."""
        return self.model if self.training else self.ema_model

    def _remember(self, batch: Mapping[str, Tensor]) -> Frame:
        observation = {key: _get(batch, key)[:, None] for key in OBSERVATION_KEYS}
        self._check_shapes(observation, n_obs=1)
        self._check_finite(observation, OBSERVATION_KEYS)
        if self._history.batch_size not in (None, len(observation[OBS_STATE])):
            raise UserError(
                f"The batch must have {self._history.batch_size} samples, as since the last reset(), "
                f"got {len(observation[OBS_STATE])}."
            )
        frame = Frame(observation[OBS_POINT_CLOUD][..., : self.config.n_points, :], observation[OBS_STATE])
        self._history.append(frame)
        return frame

    def _features(self, frame: Frame) -> Tensor:
        if frame.features is None:
            (frame.features,) = self._encode_frames(self.active_model.encoder, frame.cloud, frame.state)
        return frame.features

    def _plan_from_remembered(self, noise: Tensor | None) -> Tensor:
        *earlier, newest = self._history.observed
        return self._plan_from(newest, map(self._features, earlier), noise)

    def _plan_from(self, newest: Frame, earlier: Iterable[Tensor], noise: Tensor | None) -> Tensor:
        if noise is None:
            size = (len(newest.state), self.config.horizon, self.config.n_actions)
            noise = torch.randn(size, device=newest.state.device)
        actions, newest.features = self._plan(self.active_model, newest.cloud, newest.state, noise, *earlier)
        if not _is_finite(actions):  # a robot must never get them
            self._raise_diverged()
        return actions

    def _encode_and_generate(
        self, model: Model, cloud: Tensor, state: Tensor, noise: Tensor, *earlier: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The actions to execute and the newest frame's features (B, 1, F), from it and the features of earlier ones.

        One function, because between two a CPU loses as much time as a tenth of a small network takes.
        """
        newest = model.encoder(cloud, state)
        actions = self.generate(model.generator, noise, torch.cat([*earlier, newest], dim=1))
        return actions[:, self.config.executed], newest

    def _encode(self, model: Model, batch: Mapping[str, Tensor]) -> Tensor:
        cloud = batch[OBS_POINT_CLOUD][..., : self.config.n_points, :]
        return model.encoder(cloud, batch[OBS_STATE])

    # Bad input --------------------------------------------------------------------------------------------------

    def _check_shapes(self, batch: Mapping[str, Tensor], n_obs: int) -> None:
        cloud, state = _get(batch, OBS_POINT_CLOUD), _get(batch, OBS_STATE)
        n_points = self.config.n_points or 1
        if cloud.ndim != 4 or cloud.shape[1] != n_obs or cloud.shape[2] < n_points or cloud.shape[3] != 3:
            raise UserError(
                f"'{OBS_POINT_CLOUD}' must have shape (B, {n_obs}, N, 3) with N at least {n_points}, "
                f"got {tuple(cloud.shape)}."
            )
        expected = (len(cloud), n_obs, self.config.n_states)
        if tuple(state.shape) != expected:
            raise UserError(f"'{OBS_STATE}' must have shape {expected}, got {tuple(state.shape)}.")

    def _check_finite(self, batch: Mapping[str, Tensor], keys: Iterable[str]) -> None:
        for key in keys:
            if not _is_finite(batch[key]):
                n_bad = int((~torch.isfinite(batch[key])).sum())
                raise UserError(f"'{key}' must be finite, got {n_bad} of {batch[key].numel()} values NaN or infinite.")

    def _raise_diverged(self) -> NoReturn:
        raise FloatingPointError(
            f"Policy '{self.name}' made NaN or infinite values from finite observations: the training diverged."
        )

    # Checkpoints ------------------------------------------------------------------------------------------------

    @classmethod
    def _load_as_safetensor(
        cls,
        model: Self,
        model_file: str,
        map_location: str,
        strict: bool,  # noqa: ARG003 (LeRobot passes False)
    ) -> Self:
        """Load weights, all of them: LeRobot would only warn of missing ones and evaluate a half-random policy."""
        if not Path(model_file).is_file():
            raise UserError(f"The checkpoint has no weights: '{model_file}' does not exist.")
        try:
            return super()._load_as_safetensor(model, model_file, map_location, strict=True)
        except (SafetensorError, RuntimeError) as error:
            reason = " ".join(str(error).split())
            if isinstance(error, RuntimeError) and "state_dict" not in reason:
                raise
            raise UserError(
                f"'{model_file}' does not hold the weights of this '{cls.name}' policy: {shorten(reason, 300)}"
            ) from error


def _get(batch: Mapping[str, Tensor], key: str) -> Tensor:
    if key not in batch:
        raise UserError(f"The batch must hold '{key}', got {', '.join(batch) or 'nothing'}.")
    return batch[key]


def _encode_frames(encoder: nn.Module, cloud: Tensor, state: Tensor) -> tuple[Tensor]:
    return (encoder(cloud, state),)


def _is_finite(values: Tensor) -> bool:
    """Whether all values are finite. A finite sum, one operation instead of five, shows it; it may also overflow.

    On a CPU NumPy sums: of 64 clouds PyTorch's sum wakes a second thread, which then spins on a core the network needs.
    """
    for_numpy = values.device.type == "cpu" and values.dtype is not torch.bfloat16
    with np.errstate(over="ignore", invalid="ignore"):
        total = values.detach().numpy().sum() if for_numpy else values.sum()
    return math.isfinite(total) or bool(torch.isfinite(values).all())
