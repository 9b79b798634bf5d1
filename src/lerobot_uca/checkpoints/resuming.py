"""A resumed training repeats the unbroken one bit for bit.

LeRobot 0.6.1's does not, for three reasons: accelerate's loader starts again at epoch 0, whatever epoch LeRobot has
set in the sampler; making the loader's iterator draws from the generator after its state was loaded; and an
evaluation draws from it between a checkpoint and the next step, which a resumed run leaves out.
"""

from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any

import torch
from lerobot.datasets import EpisodeAwareSampler
from lerobot.utils.random_utils import get_rng_state, set_rng_state


def cycle_exactly(cycle: Callable[[Any], Iterator[Any]]) -> Callable[[Any], Iterator[Any]]:
    """LeRobot's `cycle`, going on in the epoch and with the random state that a checkpoint has set."""

    def cycle_from_checkpoint(iterable: Any) -> Iterator[Any]:
        sampler = _sampler(iterable)
        if not isinstance(sampler, EpisodeAwareSampler):
            return cycle(iterable)
        state = sampler.state_dict()
        iterable.iteration = state["epoch"]  # the loader sets the sampler's epoch to it
        batches = cycle(iterable)
        if state["start_index"] == 0:
            return batches
        with torch.random.fork_rng(devices=[]):  # the unbroken run made this epoch's iterator before the checkpoint
            first = next(batches)
        return chain([first], batches)

    return cycle_from_checkpoint


def _sampler(loader: Any) -> Any:
    sampler: Any = getattr(loader, "batch_sampler", None)
    while hasattr(sampler, "batch_sampler"):  # several processes
        sampler = sampler.batch_sampler
    return getattr(sampler, "sampler", None)


def without_trace(evaluate: Callable[..., Any]) -> Callable[..., Any]:
    """A function that leaves the random state as it was."""

    def evaluate_without_trace(*args: Any, **kwargs: Any) -> Any:
        state = get_rng_state()
        try:
            return evaluate(*args, **kwargs)
        finally:
            set_rng_state(state)

    return evaluate_without_trace
