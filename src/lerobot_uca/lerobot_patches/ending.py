"""The end of a training by several processes."""

import sys
import time
from collections.abc import Callable
from typing import Any

from torch import distributed

from lerobot_uca.lerobot_patches.replacing import replace_method

RELEASE_TIME = 0.5
"""Seconds for PyTorch's thread to release the last barrier."""


def end_together() -> None:
    """Processes that train on CPUs end. Without it one was seen to hang when all was saved (PyTorch 2.11).

    LeRobot waits at a barrier and ends. Gloo's thread has then to release the barrier's tensors, which takes Python's
    lock; the main thread holds that lock while it waits for gloo's thread to end.
    """

    def released(end: Callable[..., None]) -> Callable[..., None]:
        def end_training(self: Any) -> None:
            if distributed.is_available() and distributed.is_initialized() and distributed.get_backend() == "gloo":
                time.sleep(RELEASE_TIME)  # without Python's lock
            end(self)

        return end_training

    accelerate = sys.modules.get("accelerate.accelerator")  # where training has it from
    if accelerate is not None:
        replace_method(accelerate.Accelerator, "end_training", released)
