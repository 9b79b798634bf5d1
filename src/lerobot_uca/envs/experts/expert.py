"""Demonstrators, and the starts of their episodes."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.errors import UserError

Expert = Callable[[Any], NDArray[np.float32]]
"""Maps an environment to the action that a demonstrator would take in its present state."""
Disturbance = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""Maps the expert's action to what is executed."""


def undisturbed() -> Disturbance:
    """A disturbance that changes nothing."""
    return _as_it_is


def _as_it_is(action: NDArray[np.float32]) -> NDArray[np.float32]:
    return action


class Attempt(NamedTuple):
    """One try at a demonstration: how its episode starts and who acts. Light to send to another process."""

    reset: dict[str, Any]
    """Arguments of the environment's `reset`."""
    expert: Callable[[], Expert]
    disturbance: Callable[[], Disturbance] = undisturbed


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
    return (attempt._replace(expert=partial(Smoothed, attempt.expert, smoothing)) for attempt in attempts)


PUSH_STEPS = (5, 10)
"""Fewest and most steps of a push."""
GRIPPER_SHARE = 1 / 3
"""Of the pushes, those that take the gripper as well."""


class Pushes:
    """Perturbs a demonstration now and then, so that the expert shows how to recover.

    For 5 to 10 steps a push replaces the expert's motion of the hand by a random one, and in one of three pushes that
    of the gripper, which may close on nothing or let go. What the expert would have done is recorded: a policy errs,
    comes where an undisturbed expert never is, and must know what to do there. DART (Laskey et al. 2017) adds noise to
    every action for the same reason.

    Args:
        axes: dimensions of the action that move the hand, in [-1, 1].
        gripper: dimensions that move the gripper, in [-1, 1].
        probability: that a push begins, in each step without one.
        seed: of the pushes.
    """

    def __init__(self, axes: Sequence[int], gripper: Sequence[int], probability: float, seed: int) -> None:
        self._axes, self._gripper, self._probability = list(axes), list(gripper), probability
        self._rng = np.random.default_rng([seed, 1])  # not the environment's numbers, which the seed alone gives
        self._pushed: list[int] = []
        self._push: NDArray[np.float32] = np.zeros(0, np.float32)
        self._n_left = 0

    def __call__(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """The action to execute instead of the expert's (A,)."""
        if self._n_left == 0 and self._rng.random() < self._probability:
            self._n_left = int(self._rng.integers(*PUSH_STEPS, endpoint=True))
            takes_gripper = self._rng.random() < GRIPPER_SHARE
            self._pushed = self._axes + (self._gripper if takes_gripper else [])
            self._push = self._rng.uniform(-1, 1, len(self._pushed)).astype(np.float32)
        if self._n_left == 0:
            return action
        self._n_left -= 1
        executed = action.copy()
        executed[self._pushed] = self._push
        return executed


def pushed(attempts: Iterator[Attempt], probability: float, action_names: Sequence[str]) -> Iterator[Attempt]:
    """The same attempts with pushes, other ones in each episode.

    Args:
        attempts: by seed.
        probability: that a push begins, in each step without one; 0 changes nothing.
        action_names: of the environment; x, y, z and gripper are pushed.

    Raises:
        UserError: if the probability is not in [0, 1), or no action moves a hand.
    """
    if not 0 <= probability < 1:
        raise UserError(f"--pushes must be at least 0 (which changes nothing) and below 1, got {probability}.")
    if probability == 0:
        return attempts
    axes, gripper = (
        [index for index, name in enumerate(action_names) if name in names] for names in (("x", "y", "z"), ("gripper",))
    )
    if not axes:
        raise UserError(
            f"--pushes={probability} needs actions x, y and z that move the hand, as metaworld_pointcloud has; these "
            f"move {action_names[0]} to {action_names[-1]}."
        )
    return (
        attempt._replace(disturbance=partial(Pushes, axes, gripper, probability, attempt.reset["seed"]))
        for attempt in attempts
    )
