"""Rates and their intervals.

Letters: N episodes. Rates and intervals are shares of 1.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

Z_95 = 1.959963984540054  # of the standard normal distribution

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


def mean_over_tasks(tasks: Sequence[Successes], bounds: tuple[float, float] = (0.0, 1.0)) -> Estimate:
    """The mean over tasks of the mean over seeds of the mean over episodes, with Student's interval.

    Stratified by task. A task's variance is that between its seeds, with their episodes' chance in it, or that of their
    episodes alone where the seeds happen to differ less. With one seed the interval shows only what other episodes
    would change, not what another training would. The degrees of freedom are Welch's and Satterthwaite's.

    Args:
        tasks: at least one, each with at least one seed.
        bounds: what a mean can be: 0 to 1 of rates, -1 to 1 of differences.
    """
    mean = float(np.mean([np.mean([seed.mean() for seed in seeds]) for seeds in tasks]))
    parts = [_variance(seeds) for seeds in tasks]
    variance = sum(part for part, _ in parts)
    if variance == 0:
        return Estimate(mean, mean, mean)
    freedom = variance**2 / sum(part**2 / degrees for part, degrees in parts)
    half = float(stdtrit(freedom, 0.975)) * math.sqrt(variance) / len(tasks)
    return Estimate(mean, max(bounds[0], mean - half), min(bounds[1], mean + half))


def _variance(seeds: Successes) -> tuple[float, int]:
    """The variance of a task's mean over seeds, and its degrees of freedom."""
    of_episodes = float(
        np.mean([np.square(seed - seed.mean()).sum() / max(1, len(seed) - 1) / len(seed) for seed in seeds])
    )
    of_seeds = float(np.var([seed.mean() for seed in seeds], ddof=1)) if len(seeds) > 1 else 0.0
    if of_seeds > of_episodes:
        return of_seeds / len(seeds), len(seeds) - 1
    return of_episodes / len(seeds), max(1, sum(len(seed) - 1 for seed in seeds))
