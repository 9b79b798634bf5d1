"""Demonstrators, and the starts of their episodes."""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.errors import UserError

Expert = Callable[[Any], NDArray[np.float32]]
"""Maps an environment to the action that a demonstrator would take in its present state."""


class Attempt(NamedTuple):
    """One try at a demonstration: how its episode starts and who acts. Light to send to another process."""

    reset: dict[str, Any]
    """Arguments of the environment's `reset`."""
    expert: Callable[[], Expert]


def attempts_by_seed(expert: Callable[[], Expert], first_seed: int) -> Iterator[Attempt]:
    """The same expert in the episodes of seeds first_seed, first_seed + 1, ..., without end."""
    return (Attempt({"seed": seed}, expert) for seed in count(first_seed))


class Smoothed:
    """An expert whose actions pass through a first-order filter.

    a_t = smoothing * expert(s_t) + (1 - smoothing) * a_(t-1), and a_0 = expert(s_0). The expert sees what the smoothed
    actions lead to.

    Args:
        expert: makes the expert.
        smoothing: in (0, 1]; 1 changes nothing.
    """

    def __init__(self, expert: Callable[[], Expert], smoothing: float) -> None:
        self._expert, self._smoothing = expert(), smoothing
        self._last: NDArray[np.float32] | None = None

    def __call__(self, env: Any) -> NDArray[np.float32]:
        """The next action."""
        action = self._expert(env)
        if self._last is not None:
            action = np.float32(self._smoothing) * action + np.float32(1 - self._smoothing) * self._last
        self._last = action
        return action


def smoothed(attempts: Iterator[Attempt], smoothing: float) -> Iterator[Attempt]:
    """The same attempts with smoothed experts.

    Raises:
        UserError: if the smoothing is not in (0, 1].
    """
    if not 0 < smoothing <= 1:
        raise UserError(f"--smoothing must be above 0 and at most 1 (which changes nothing), got {smoothing}.")
    if smoothing == 1:
        return attempts
    return (Attempt(attempt.reset, partial(Smoothed, attempt.expert, smoothing)) for attempt in attempts)
