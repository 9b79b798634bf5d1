"""The squared error that all baselines share."""

from torch import Tensor


def mean_square(error: Tensor, mask: Tensor) -> Tensor:
    """The mean squared error of each sample, (B,), of error (B, T, A) over the steps that count, mask (B, T).

    It is 0 where no step counts.
    """
    return (error.square().mean(dim=2) * mask).sum(dim=1) / mask.sum(dim=1).clamp(min=1)
