"""Demonstrators, and the starts of their episodes."""

from collections.abc import Callable, Iterator
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Expert = Callable[[Any], NDArray[np.float32]]
"""From an environment to the action that a demonstrator would take in its present state."""


class Attempt(NamedTuple):
    """One try at a demonstration: how its episode starts and who acts. Light to send to another process."""

    reset: dict[str, Any]
    """Arguments of the environment's `reset`."""
    expert: Callable[[], Expert]


def attempts_by_seed(expert: Callable[[], Expert], first_seed: int) -> Iterator[Attempt]:
    """The same expert in the episodes of seeds first_seed, first_seed + 1, ..., without end."""
    return (Attempt({"seed": seed}, expert) for seed in count(first_seed))
