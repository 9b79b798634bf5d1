"""Running experts, one a core. Light to import, without torch and LeRobot: each worker process does it."""

from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.envs.experts.expert import Attempt
from lerobot_uca.envs.point_cloud_env import PointCloudEnv
from lerobot_uca.processes import n_cores, worker_pool


class Demonstration(NamedTuple):
    """One episode of L steps: the observation before each step, the action, and whether to keep it."""

    seen: NDArray[Any]  # (L, N, 3) point clouds or (L, 1, H, W) depth images
    state: NDArray[np.float32]  # (L, S)
    action: NDArray[np.float32]  # (L, A), the expert's
    is_successful: bool


def demonstrate(
    env_factory: Callable[[], PointCloudEnv], attempt: Attempt, successful_steps: int | None = None
) -> Demonstration:
    """Run an expert past its first success, to the end of the episode or until so many steps were successful."""
    env, expert, executed = env_factory(), attempt.expert(), attempt.disturbance()
    observation, _ = env.reset(**attempt.reset)
    steps: list[tuple[Any, ...]] = []
    n_successful = 0
    is_over = False
    while not is_over:
        action = expert(env)
        steps.append((observation[env.observer.key], observation["agent_pos"], action))
        observation, _, terminated, truncated, info = env.step(executed(action))
        n_successful += info["is_success"]
        is_over = truncated or (terminated and not info["is_success"]) or n_successful == successful_steps
    env.close()
    seen, state, actions = (np.stack(column) for column in zip(*steps, strict=True))
    return Demonstration(seen, state, actions, n_successful >= env.min_successful_steps)


def demonstrations(
    env_factory: Callable[[], PointCloudEnv],
    attempts: Iterator[Attempt],
    *,
    n_wanted: int,
    successful_steps: int | None = None,
) -> Generator[Demonstration]:
    """Episodes of the attempts in order, until n_wanted were successful or the attempts are used up.

    One process a core that this one may use runs them, each as `demonstrate` does, but no more than there are episodes
    wanted: each takes some 300 MB.
    """
    n_workers = max(1, min(n_cores(), n_wanted))
    pending: deque[Future[Demonstration]] = deque()
    n_missing = n_wanted
    with worker_pool(n_workers) as pool:
        while n_missing:
            # Never more than may still be needed: leaving the pool waits for running episodes.
            n_idle = max(0, min(n_missing, n_workers + 1) - len(pending))
            new = islice(attempts, n_idle)
            pending.extend(pool.submit(demonstrate, env_factory, attempt, successful_steps) for attempt in new)
            if not pending:
                return
            episode = pending.popleft().result()
            n_missing -= episode.is_successful
            yield episode
