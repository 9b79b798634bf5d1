"""Running experts, on all cores. Light to import, without torch and LeRobot: each worker process does it."""

import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import count
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.envs.expert import Expert


class Demonstration(NamedTuple):
    """One episode: what was seen before each of L steps, what was done, and whether the step ended in success."""

    point_cloud: NDArray[np.float32]  # (L, N, 3)
    state: NDArray[np.float32]  # (L, S)
    action: NDArray[np.float32]  # (L, A), as executed
    success: NDArray[np.bool_]  # (L,)


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
    env_factory: Callable[[], gym.Env], expert_factory: Callable[[], Expert], first_seed: int
) -> Iterator[Demonstration]:
    """Episodes of seeds first_seed, first_seed + 1, ... in this order, made by one process a core."""
    n_workers = os.cpu_count() or 1
    with ProcessPoolExecutor(n_workers, mp_context=multiprocessing.get_context("forkserver")) as pool:
        seeds = count(first_seed)
        pending = [pool.submit(demonstrate, env_factory, expert_factory, next(seeds)) for _ in range(n_workers + 1)]
        try:
            while True:
                pending.append(pool.submit(demonstrate, env_factory, expert_factory, next(seeds)))
                yield pending.pop(0).result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
