"""Rates and their intervals, by formulas and a bootstrap of our own.

Letters: S training seeds, N episodes, D draws. Rates and intervals are shares of 1.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Z_95 = 1.959963984540054  # of the standard normal distribution
N_DRAWS = 4000

Successes = Sequence[NDArray[np.int64]]
"""Episodes of each training seed of a task, (N,): 1 a success, 0 a failure; or differences of two policies."""


class Estimate(NamedTuple):
    """A mean and its 95 % interval."""

    mean: float
    low: float
    high: float

    @property
    def is_decided(self) -> bool:
        """Whether the interval holds no 0: of a difference, that there is one."""
        return self.low > 0 or self.high < 0


def wilson(n_successes: int, n_episodes: int) -> Estimate:
    """A success rate with Wilson's interval, which stays inside [0, 1] also at 0 and 1.

    It is that of independent episodes: of one training, or of several taken together.
    """
    rate, squared = n_successes / n_episodes, Z_95**2
    centre = (rate + squared / (2 * n_episodes)) / (1 + squared / n_episodes)
    spread = rate * (1 - rate) / n_episodes + squared / (4 * n_episodes**2)
    half = Z_95 * math.sqrt(spread) / (1 + squared / n_episodes)
    return Estimate(rate, min(rate, max(0.0, centre - half)), max(rate, min(1.0, centre + half)))


def mean_over_tasks(tasks: Sequence[Successes], *, n_draws: int = N_DRAWS) -> Estimate:
    """The mean over tasks of the mean over seeds of the mean over episodes, with a bootstrap interval.

    Stratified by task: each draw holds every task once, with its seeds drawn anew and, of each, its episodes. With one
    seed the interval shows only what other episodes would change, not what another training would.
    """
    rng = np.random.default_rng(0)
    means = [np.mean([np.mean(seed) for seed in seeds]) for seeds in tasks]
    drawn = np.mean([_draw_task(rng, seeds, n_draws) for seeds in tasks], axis=0)  # (D,)
    low, high = np.quantile(drawn, (0.025, 0.975))
    return Estimate(float(np.mean(means)), float(low), float(high))


def _draw_task(rng: np.random.Generator, seeds: Successes, n_draws: int) -> NDArray[np.float64]:
    """Means (D,) of a task whose seeds and episodes are drawn with replacement.

    To draw N episodes is to draw how often each value occurs: -1, 0 and 1 are the only ones.
    """
    values = np.array([-1, 0, 1])
    shares = np.array([[np.mean(seed == value) for value in values] for seed in seeds])  # (S, 3)
    n_episodes = np.array([len(seed) for seed in seeds])
    which = rng.integers(len(seeds), size=(n_draws, len(seeds)))
    counts = rng.multinomial(n_episodes[which], shares[which])  # (D, S, 3)
    return (counts @ values / n_episodes[which]).mean(axis=1)
