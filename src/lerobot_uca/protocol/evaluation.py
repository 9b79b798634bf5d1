"""Evaluation episodes of a policy, many at once: the results of `lerobot-eval` in a fraction of its time.

Four things save time. No picture is made. Observations that the policy does not look at are left out: with two
observation steps and three actions a plan, a third of the clouds. Episodes share the policy's calls, and where one has
ended the next begins, so that none waits for the longest. Environments are kept.

Each episode draws its noise from a generator of its own, seeded as the episode is: an episode depends on the policy
and its seed, not on which others ran beside it (rounding apart: a matrix product may add in another order).
"""

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import OBS_STATE, OBS_STR
from numpy.typing import NDArray
from torch import Tensor

from lerobot_uca.envs.point_cloud_env import Observation, PointCloudEnv
from lerobot_uca.features import ENV_NAMES
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig
from lerobot_uca.policies.modeling_base import PointCloudPolicy

Plan = Callable[[list["Running"]], NDArray[np.float32]]
Watch = Callable[[PointCloudEnv, int], None]
"""Is shown an environment when it is reset and after each action, and how many actions were executed."""


def not_watched(env: PointCloudEnv, step: int) -> None:
    """Look at nothing."""


class Episode(NamedTuple):
    """The result of an episode."""

    seed: int
    success: bool
    episode_return: float
    length: int
    ms: float
    """Wall-clock milliseconds an action took, the episode's share of the plans included."""


class Running:
    """An episode that is not over: its environment and what the policy has seen of it.

    Args:
        env: which is reset.
        seed: of the episode.
        config: says which steps the policy looks at.
        watch: is shown each step.
    """

    def __init__(self, env: PointCloudEnv, seed: int, config: PointCloudPolicyConfig, watch: Watch) -> None:
        self.env, self.seed, self._watch = env, seed, watch
        self.noise = torch.Generator().manual_seed(seed)
        self.is_over = self.success = False
        self._total, self._length, self.seconds = 0.0, 0, 0.0
        self._deltas, self._n_planned = config.observation_delta_indices, config.n_action_steps
        observation, _ = env.reset(seed=seed)
        watch(env, 0)
        self._observed: dict[int, Observation] = {0: observation}  # by step

    def history(self) -> list[Observation]:
        """The policy's present observations, oldest first; the first observation stands for those before it."""
        return [self._observed[max(0, self._length + delta)] for delta in self._deltas]

    def execute(self, actions: NDArray[np.float32]) -> None:
        """Act as planned, (n_action_steps, A), until the plan or the episode ends."""
        begin = time.perf_counter()
        for action in actions:
            reward, terminated, truncated, info = self.env.act(action)
            self._length += 1
            self._watch(self.env, self._length)
            self._total += reward
            self.success |= bool(info["is_success"])
            self.is_over = terminated or truncated
            if self.is_over:
                break
            if self._is_looked_at(self._length):
                self._observed[self._length] = self.env.observe()
        for step in [step for step in self._observed if 0 < step < self._length + min(self._deltas)]:
            del self._observed[step]
        self.seconds += time.perf_counter() - begin

    def result(self) -> Episode:
        """The episode's result."""
        return Episode(self.seed, self.success, self._total, self._length, 1e3 * self.seconds / self._length)

    def _is_looked_at(self, step: int) -> bool:
        """Whether one of the plans made at steps 0, n_action_steps, ... sees this step."""
        return any((step - delta) % self._n_planned == 0 for delta in self._deltas)


def run_episodes(
    make_env: Callable[[], PointCloudEnv],
    config: PointCloudPolicyConfig,
    plan: Plan,
    seeds: Iterable[int],
    *,
    n_envs: int,
    watch: Watch = not_watched,
) -> Generator[Episode]:
    """Episodes of the seeds, as they end.

    Args:
        make_env: makes one environment.
        config: of the policy.
        plan: the policy's actions for some episodes E, (E, n_action_steps, A).
        seeds: of the episodes.
        n_envs: how many run at once.
        watch: is shown each step of each.
    """
    waiting = deque(seeds)
    idle = [make_env() for _ in range(min(n_envs, len(waiting)))]
    running: list[Running] = []
    try:
        while waiting or running:
            while idle and waiting:
                running.append(Running(idle.pop(), waiting.popleft(), config, watch))
            begin = time.perf_counter()
            planned = plan(running)
            share = (time.perf_counter() - begin) / len(running)
            for episode, actions in zip(running, planned, strict=True):
                episode.seconds += share
                episode.execute(actions)
                if episode.is_over:
                    idle.append(episode.env)
                    yield episode.result()
            running = [episode for episode in running if not episode.is_over]
    finally:
        for env in [*idle, *(episode.env for episode in running)]:
            env.close()


class PolicyPlan:
    """Plans of a policy in eval mode, between its processors.

    Args:
        policy: on its device.
        preprocess: from a batch of observations to a normalised one.
        postprocess: from normalised actions to the environment's.
    """

    def __init__(
        self, policy: PointCloudPolicy, preprocess: Callable[..., Any], postprocess: Callable[..., Any]
    ) -> None:
        self.policy, self.config = policy.eval(), policy.config
        self.preprocess, self.postprocess = preprocess, postprocess

    @classmethod
    def from_checkpoint(cls, checkpoint: Path) -> Self:
        """The policy in LeRobot's folder pretrained_model, computed by PyTorch."""
        config = PreTrainedConfig.from_pretrained(checkpoint)
        assert isinstance(config, PointCloudPolicyConfig)
        config.inference = "eager"  # the reference, and next to the simulation its time does not count
        policy_class: Any = get_policy_class(config.type)
        with redirect_stdout(None):  # LeRobot says that it loads
            policy = policy_class.from_pretrained(checkpoint, config=config)
        return cls(policy, *make_pre_post_processors(config, pretrained_path=str(checkpoint)))

    def __call__(self, running: list[Running]) -> NDArray[np.float32]:
        """Actions (E, n_action_steps, A) of E episodes, in the environment's units."""
        config = self.config
        histories = [episode.history() for episode in running]
        noise = [torch.randn(config.horizon, config.n_actions, generator=episode.noise) for episode in running]
        with torch.inference_mode():
            observed = {  # such as (E, O, N, 3) and (E, O, S)
                ENV_NAMES.get(name, f"{OBS_STR}.{name}"): _stack(histories, name) for name in histories[0][0]
            }
            batch = self.preprocess(observed)
            noise_on_device = torch.stack(noise).to(batch[OBS_STATE].device)
            actions = self.policy.predict_action_chunk(batch, noise=noise_on_device)
            return self.postprocess(actions).to("cpu", torch.float32).numpy()


def _stack(histories: list[list[Observation]], key: str) -> Tensor:
    return torch.from_numpy(np.stack([[frame[key] for frame in history] for history in histories]))
