"""A policy's inputs: float32 on its device whatever came in, checked, and named where something is wrong with them.

All inference backends and training take them from here, so that all of them follow the same rule. Letters: B samples,
O observation steps, N points, S state dimensions.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig

LARGEST = 1e6
"""Normalised values lie near [-1, 1]. From about 1e19 on their squares are infinite: PyTorch then computes NaN, other
runtimes arbitrary actions."""

SQUARES_ARE_FINITE = 1e18
"""So large that no action reaches it, and so small that float32 holds the sum of its squares."""

SUMMED_AT_ONCE = 10_000
"""Of more values BLAS wakes threads of its own, which then spin on a core that the network needs."""


class Observations(NamedTuple):
    """Point clouds (B, N, 3) and states (B, S), or (B, O, N, 3) and (B, O, S), as float32; with colours (..., N, 6)."""

    cloud: Tensor
    state: Tensor

    def checked(self) -> "Observations":
        """Themselves, or a `UserError` that names the input with NaN, infinite or huge values."""
        check_values(OBS_POINT_CLOUD, self.cloud)
        check_values(OBS_STATE, self.state)
        return self


def get(batch: Mapping[str, Any], key: str) -> Any:
    """batch[key], or a `UserError`."""
    if key not in batch:
        raise UserError(f"The batch must hold '{key}', got {', '.join(map(str, batch)) or 'nothing'}.")
    return batch[key]


def as_float32(name: str, value: Any, device: torch.device) -> Tensor:
    """A tensor or an array of any real numbers as a float32 tensor on the device."""
    if isinstance(value, Tensor):
        if value.dtype is torch.float32 and value.device == device:
            return value  # as in every tick: `to` takes longer to see it
        if value.is_complex():
            raise UserError(f"'{name}' must hold real numbers, got {value.dtype}.")
        return value.to(device, torch.float32)
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        raise UserError(f"'{name}' must be a tensor or an array of real numbers, got {type(value).__name__}.")
    with np.errstate(over="ignore"):
        return torch.from_numpy(array.astype(np.float32)).to(device)  # a copy: the array may be read-only


def read_observations(
    batch: Mapping[str, Any], config: PointCloudPolicyConfig, device: torch.device, *, n_obs: int | None
) -> Observations:
    """Clouds, the policy's points of them, and states of a batch. Their values are not checked yet.

    Args:
        n_obs: how many observation steps they must have, or None for one step without a dimension of its own.

    Raises:
        UserError: if one is missing, has a wrong shape or does not hold real numbers, or if the batch is empty.
    """
    cloud = as_float32(OBS_POINT_CLOUD, get(batch, OBS_POINT_CLOUD), device)
    state = as_float32(OBS_STATE, get(batch, OBS_STATE), device)
    steps = () if n_obs is None else (n_obs,)
    n_points = config.n_points or 1
    shape = tuple(cloud.shape)
    if len(shape) != len(steps) + 3 or shape[1:-2] != steps or shape[-2] < n_points or shape[-1] != config.n_channels:
        expected = ", ".join(("B", *map(str, steps), "N", str(config.n_channels)))
        hint = " A single sample needs a dimension for the batch: value[None]." if len(shape) == len(steps) + 2 else ""
        raise UserError(
            f"'{OBS_POINT_CLOUD}' must have shape ({expected}) with N at least {n_points}, got {shape}.{hint}"
        )
    if not shape[0]:
        raise UserError(f"The batch must hold at least one sample, got '{OBS_POINT_CLOUD}' of shape {shape}.")
    check_shape(OBS_STATE, state, (shape[0], *steps, config.n_states))
    return Observations(cloud.narrow(-2, 0, config.n_points or shape[-2]), state)


def check_shape(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    """Raise a `UserError` for another shape."""
    if tuple(value.shape) != shape:
        raise UserError(f"'{name}' must have shape {shape}, got {tuple(value.shape)}.")


def check_values(name: str, value: Tensor) -> None:
    """Raise a `UserError` for NaN, infinite and huge values."""
    if _lie_within(value, LARGEST):
        return
    # NumPy looks on a CPU: for 64 clouds PyTorch wakes a second thread, which spins like BLAS's.
    values: Any = value.detach().numpy() if value.is_cpu else value
    if values.min() >= -LARGEST and values.max() <= LARGEST:  # neither holds for NaN
        return
    n_bad = int((~torch.isfinite(value)).sum())
    if n_bad:
        raise UserError(f"'{name}' must be finite, got {n_bad} of {value.numel()} values NaN or infinite.")
    raise UserError(
        f"'{name}' must lie within +-{LARGEST:.0e}, got {float(value.abs().max()):.1e}: normalised values lie near "
        "[-1, 1]. Check the sensor, and the statistics that the preprocessor normalises with."
    )


def is_finite(values: Tensor) -> bool:
    """Whether all values are finite."""
    return _lie_within(values, SQUARES_ARE_FINITE) or bool(torch.isfinite(values).all())


def _lie_within(value: Tensor, largest: float) -> bool:
    """Whether the sum of squares shows that no value is larger, NaN or infinite. False says nothing.

    One operation in a tick, in which each costs ten times what it costs in a loop of its own: the network has driven
    its instructions out of the cache.
    """
    if not value.is_cpu:
        return bool(value.square().sum() <= largest**2)
    if value.numel() > SUMMED_AT_ONCE:
        return False
    values = value.detach().numpy()
    return bool(np.vdot(values, values) <= largest**2)
