"""The observations that a policy remembers, and which of them its plans see.

Letters: B samples, O observation steps, N points, S state dimensions, F features.
"""

from collections import deque
from dataclasses import dataclass

from torch import Tensor


@dataclass
class Frame:
    """One step's point cloud (B, N, 3), its state (B, S) and, once a plan needs them, its features (B, 1, F)."""

    cloud: Tensor
    state: Tensor
    features: Tensor | None = None


class ObservationHistory:
    """The frames from the first observed step to the current one. A plan sees every stride-th of them.

    Args:
        n_obs_steps: O, frames that a plan sees.
        stride: steps between two of them.
    """

    def __init__(self, n_obs_steps: int, stride: int) -> None:
        self._stride = stride
        self._length = (n_obs_steps - 1) * stride + 1
        self._frames: deque[Frame] = deque(maxlen=self._length)

    def append(self, frame: Frame) -> None:
        """Remember the newest frame. The first one of an episode also stands for those before it."""
        self._frames.extend([frame] * (1 if self._frames else self._length))

    @property
    def observed(self) -> list[Frame]:
        """The O frames that a plan sees now, oldest first; none before the first frame."""
        return list(self._frames)[:: self._stride]

    @property
    def batch_size(self) -> int | None:
        """B, or None before the first frame."""
        return self._frames[-1].state.shape[0] if self._frames else None

    def is_seen_again(self, n_steps: int, period: int) -> bool:
        """Whether the newest frame is seen by a plan made in n_steps, or by one of those every period steps later."""
        return any(age % self._stride == 0 for age in range(n_steps, self._length, period))
