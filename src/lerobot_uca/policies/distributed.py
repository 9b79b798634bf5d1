"""Random draws when several processes train one policy together (`accelerate launch`, see docs/distributed.md)."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import distributed


@contextmanager
def independent_draws(device: torch.device) -> Iterator[None]:
    """Give each process random numbers of its own, reproducible from the seed that all share.

    LeRobot seeds all processes alike, so that noise and times would be the same for each process's share of a batch.
    Here all draw the same seeds, one for each process, from the generators they share, and each uses its own for as
    long as the block lasts. Afterwards the generators agree again: a resumed training, for which LeRobot restores the
    first process's generators everywhere, draws as an unbroken one. With one process nothing changes.
    """
    if not (distributed.is_available() and distributed.is_initialized()) or distributed.get_world_size() == 1:
        yield
        return
    seeds = torch.randint(2**62, (distributed.get_world_size(),))
    devices = [] if device.type == "cpu" else [device]
    with torch.random.fork_rng(devices, device_type="cuda" if device.type == "cpu" else device.type):
        torch.manual_seed(int(seeds[distributed.get_rank()]))
        yield
