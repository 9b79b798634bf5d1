"""Running experts, on all cores. Light to import, without torch and LeRobot: each worker process does it."""

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from itertools import count
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.envs.expert import Expert

MIN_SUCCESSFUL_STEPS = 5
"""What makes an episode a demonstration (the baselines' rule for Meta-World)."""


class Demonstration(NamedTuple):
    """One episode: what was seen before each of L steps, what was done, and whether the step ended in success."""

    point_cloud: NDArray[np.float32]  # (L, N, 3)
    state: NDArray[np.float32]  # (L, S)
    action: NDArray[np.float32]  # (L, A), as executed
    success: NDArray[np.bool_]  # (L,)

    @property
    def is_successful(self) -> bool:
        """Whether it is worth keeping."""
        return self.success.sum() >= MIN_SUCCESSFUL_STEPS


def demonstrate(env_factory: Callable[[], gym.Env], expert_factory: Callable[[], Expert], seed: int) -> Demonstration:
    """Run the expert for a whole episode, also past its first success."""
    env, expert = env_factory(), expert_factory()
    observation, _ = env.reset(seed=seed)
    steps: list[tuple[Any, ...]] = []
    truncated = False
    while not truncated:
        action = expert(env)
        before = observation
        observation, _, _, truncated, info = env.step(action)
        steps.append((before["point_cloud"], before["agent_pos"], action, info["is_success"]))
    env.close()
    return Demonstration(*(np.stack(column) for column in zip(*steps, strict=True)))


def demonstrations(
    env_factory: Callable[[], gym.Env], expert_factory: Callable[[], Expert], *, first_seed: int, n_wanted: int
) -> Iterator[Demonstration]:
    """Episodes of seeds first_seed, first_seed + 1, ... in this order, until n_wanted of them were successful.

    They are made by one process a core.
    """
    n_workers = os.cpu_count() or 1
    with ProcessPoolExecutor(n_workers, mp_context=multiprocessing.get_context("forkserver")) as pool:
        seeds = count(first_seed)
        pending: deque[Future[Demonstration]] = deque()
        n_missing = n_wanted
        while n_missing:
            # Never more than may still be needed: leaving the pool waits for the episodes that are running.
            while len(pending) < min(n_missing, n_workers + 1):
                pending.append(pool.submit(demonstrate, env_factory, expert_factory, next(seeds)))
            episode = pending.popleft().result()
            n_missing -= episode.is_successful
            yield episode
