"""The base of the point-cloud policies: observation history, action queue, averaged weights.

A method adds its own network, loss and sampler.

Letters: B samples, O observation steps, N points, S state dimensions, T horizon, A action dimensions, F features.
"""

import functools
import math
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from textwrap import shorten
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION
from safetensors import SafetensorError
from torch import Tensor, nn

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.inference.backends import make_backend
from lerobot_uca.networks.observation_encoder import ObservationEncoder
from lerobot_uca.policies import (
    inputs,
    processor_base,  # noqa: F401 (registers the steps that checkpoints name)
)
from lerobot_uca.policies.configuration_base import NO_PEFT, PointCloudPolicyConfig
from lerobot_uca.policies.distributed import independent_draws
from lerobot_uca.policies.history import Frame, ObservationHistory
from lerobot_uca.policies.publishing import PublishedPolicy


class Model(nn.Module):
    """The trained networks: an encoder of observations and a generator of actions from its features."""

    def __init__(self, encoder: nn.Module, generator: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder
        self.generator = generator


def without_gradients[**P, R](method: Callable[P, R]) -> Callable[P, R]:
    """`torch.no_grad`, left out where gradients are off already, as in LeRobot's loops: it costs 1 % of a plan."""
    in_no_grad = torch.no_grad()(method)

    @functools.wraps(method)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        return in_no_grad(*args, **kwargs) if torch.is_grad_enabled() else method(*args, **kwargs)

    return call


@contextmanager
def _without_inference_mode() -> Iterator[None]:
    """In PyTorch's inference mode, which keeps no tangents, go on without gradients: UCA-Flow's loss has some."""
    if not torch.is_inference_mode_enabled():
        yield
        return
    with torch.inference_mode(mode=False), torch.no_grad():
        yield


class MethodLoss(NamedTuple):
    """A method's loss for each sample, (B,), and its parts to log, each (B,)."""

    total: Tensor
    parts: dict[str, Tensor]


class PointCloudPolicy(PublishedPolicy, PreTrainedPolicy):
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

    def __init__(self, config: PointCloudPolicyConfig, dataset_meta: Any = None, **_: Any) -> None:
        # `make_policy` passes the dataset's statistics and metadata as well; normalisation is the processors' task.
        if not isinstance(config, self.config_class):
            raise UserError(
                f"{type(self).__name__} needs a configuration or checkpoint of policy type '{self.name}', got one of "
                f"type '{getattr(config, 'type', type(config).__name__)}'."
            )
        super().__init__(config)
        config.validate_features()
        if dataset_meta is not None and dataset_meta.stats:
            config.depth.add_statistics(dataset_meta.stats)
        encoder = ObservationEncoder(
            config.n_states, config.point_widths, config.n_point_features, config.n_state_features, config.n_channels
        )
        self.model = Model(encoder, self.make_generator())
        self.ema_model = deepcopy(self.model).requires_grad_(False)
        self.register_buffer("ema_step", torch.zeros((), dtype=torch.long))
        computed = make_backend(config.inference)
        self._encode_frame = computed(_encode_frame)
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
            UserError: for wrong shapes, and if the loss is NaN or infinite: naming the input that is, or is huge.
        """
        if reduction not in ("mean", "none"):
            raise UserError(f"reduction must be 'mean' or 'none', got '{reduction}'.")
        observations = self._read(batch, self.config.n_obs_steps)
        x = inputs.as_float32(ACTION, inputs.get(batch, ACTION), self.ema_step.device)
        inputs.check_shape(ACTION, x, (len(observations.state), self.config.horizon, self.config.n_actions))
        mask = self._mask(batch, x)
        model = self.active_model
        with independent_draws(x.device), _without_inference_mode():
            o = model.encoder(*observations)
            loss = self.compute_loss(model.generator, x, o, mask)
        mean = loss.total.mean()
        # All at once: each reading of a number waits for the GPU.
        total, *values = torch.stack([mean.detach(), *(part.mean() for part in loss.parts.values())]).tolist()
        if not math.isfinite(total):
            observations.checked()
            inputs.check_values(ACTION, x)
            raise self._diverged()
        return (mean if reduction == "mean" else loss.total), dict(zip(loss.parts, values, strict=True))

    def wrap_with_peft(self, peft_config: Any = None, peft_cli_overrides: dict[str, Any] | None = None) -> Any:  # noqa: ARG002
        """LeRobot's `--peft`: refused."""
        raise UserError(NO_PEFT)

    def _mask(self, batch: Mapping[str, Tensor], x: Tensor) -> Tensor:
        """True (B, T) for the actions that count."""
        key = f"{ACTION}_is_pad"
        if batch.get(key) is None:
            return torch.ones(x.shape[:2], dtype=torch.bool, device=x.device)
        is_pad = inputs.as_float32(key, batch[key], x.device)
        inputs.check_shape(key, is_pad, tuple(x.shape[:2]))
        return is_pad == 0

    @torch.no_grad()
    def update(self) -> None:
        """Let the averaged weights follow; LeRobot calls it after each optimiser step."""
        self.ema_step += 1
        step = max(0, self.ema_step.item() - 2)  # as the baselines count: the first two updates copy the weights
        decay = min(1 - (1 + step) ** -self.config.ema_power, self.config.ema_max_decay)
        torch._foreach_lerp_(list(self.ema_model.parameters()), list(self.model.parameters()), 1 - decay)

    # Inference --------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget observations and planned actions: an episode begins."""
        self._history = ObservationHistory(self.config.n_obs_steps, self.config.obs_stride)
        self._action_queue: deque[Tensor] = deque()

    @without_gradients
    def select_action(self, batch: Mapping[str, Tensor], noise: Tensor | None = None) -> Tensor:
        """The next action (B, A), normalised. Every n_action_steps calls the policy plans anew.

        Args:
            batch: the newest observation, normalised; point cloud (B, N, 3), state (B, S). Each call's is remembered,
                and the first one stands for those before it.
            noise: (B, T, A), drawn if not given.
        """
        frame = self._remember(batch)
        if not self._action_queue:
            self._action_queue.extend(self._plan_from(self._history.observed, noise).unbind(dim=1))
        elif self._history.is_seen_again(len(self._action_queue), self.config.n_action_steps):
            self._features(frame)  # now, so that the plan itself takes less time
        return self._action_queue.popleft()

    @without_gradients
    def predict_action_chunk(self, batch: Mapping[str, Tensor], noise: Tensor | None = None) -> Tensor:
        """The actions to execute from now on, (B, n_action_steps, A), normalised.

        Args:
            batch: normalised; either the newest observation, (B, N, 3) and (B, S), which is remembered for the
                next call, or the observed steps, (B, O, N, 3) and (B, O, S), oldest first, which are not.
            noise: (B, T, A), drawn if not given.
        """
        if np.ndim(inputs.get(batch, OBS_POINT_CLOUD)) != 4:
            self._remember(batch)
            return self._plan_from(self._history.observed, noise)
        cloud, state = self._read(batch, self.config.n_obs_steps).checked()
        pairs = zip(cloud.unbind(dim=1), state.unbind(dim=1), strict=True)
        return self._plan_from([Frame(*pair) for pair in pairs], noise)

    @property
    def active_model(self) -> Model:
        """The trained model in training mode, its moving average in eval mode."""
        return self.model if self.training else self.ema_model

    def _read(self, batch: Mapping[str, Tensor], n_obs: int | None) -> inputs.Observations:
        return inputs.read_observations(batch, self.config, self.ema_step.device, n_obs=n_obs)

    def _remember(self, batch: Mapping[str, Tensor]) -> Frame:
        cloud, state = self._read(batch, None).checked()
        if self._history.batch_size not in (None, state.shape[0]):
            raise UserError(
                f"The batch must have {self._history.batch_size} samples, as since the last reset(), got {len(state)}."
            )
        frame = Frame(cloud, state)
        self._history.append(frame)
        return frame

    def _features(self, frame: Frame) -> Tensor:
        if frame.features is None:
            (frame.features,) = self._encode_frame(self.active_model.encoder, frame.cloud, frame.state)
        return frame.features

    def _plan_from(self, observed: Sequence[Frame], noise: Tensor | None) -> Tensor:
        *earlier, newest = observed
        shape = (newest.state.shape[0], self.config.horizon, self.config.n_actions)
        if noise is None:
            noise = torch.randn(shape, device=newest.state.device)
        else:
            noise = inputs.as_float32("noise", noise, newest.state.device)
            inputs.check_shape("noise", noise, shape)
            inputs.check_values("noise", noise)
        actions, newest.features = self._plan(
            self.active_model, newest.cloud, newest.state, noise, *map(self._features, earlier)
        )
        if not inputs.is_finite(actions):  # a robot must never get them
            raise self._diverged()
        return actions

    def _encode_and_generate(
        self, model: Model, cloud: Tensor, state: Tensor, noise: Tensor, *earlier: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The actions to execute and the newest frame's features (B, 1, F), from it and the features of earlier ones.

        One function, because between two a CPU loses as much time as a tenth of a small network takes.
        """
        (newest,) = _encode_frame(model.encoder, cloud, state)
        actions = self.generate(model.generator, noise, torch.cat([*earlier, newest], dim=1))
        return actions[:, self.config.executed], newest

    def _diverged(self) -> UserError:
        return UserError(
            f"Policy '{self.name}' computes NaN or infinite values from good inputs: its training diverged. Go back to "
            "an earlier checkpoint, or train with a lower policy.optimizer_lr."
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
        """Load weights, all of them: LeRobot would only warn of missing ones and evaluate a half-random policy.

        A new training that starts from them begins its average anew. With the old one's slow decay what is evaluated
        would remain mostly what the checkpoint was: of 16000 steps, 66 % of it after 600 more.
        """
        if not Path(model_file).is_file():
            raise UserError(f"The checkpoint has no weights: '{model_file}' does not exist.")
        try:
            loaded = super()._load_as_safetensor(model, model_file, map_location, strict=True)
        except (SafetensorError, RuntimeError) as error:
            reason = " ".join(str(error).split())
            if isinstance(error, RuntimeError) and "state_dict" not in reason:
                raise
            raise UserError(
                f"'{model_file}' does not hold the weights of this '{cls.name}' policy: {shorten(reason, 300)}"
            ) from error
        if loaded.config.is_new_training:
            loaded.ema_step.zero_()
        return loaded


def _encode_frame(encoder: nn.Module, cloud: Tensor, state: Tensor) -> tuple[Tensor]:
    return (encoder(cloud.unsqueeze(1), state.unsqueeze(1)),)
