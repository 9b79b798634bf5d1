"""Statistics for LeRobot's normalisers: those of a dataset made fit for them, and those of a checkpoint checked.

Letters: D dimensions of a feature (of a point cloud 3, or 6 with colours: its statistics are per channel).
"""

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
from lerobot.configs import NormalizationMode
from lerobot.utils.constants import ACTION, OBS_STATE
from numpy.typing import NDArray

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD, find_point_cloud
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig

logger = logging.getLogger(__name__)

Statistics = dict[str, dict[str, NDArray[np.float64]]]
"""Statistics by feature and name (min, max, mean, std, q01, ...), each (D,)."""

MIN_RANGE = 1e-4
"""A range below it, in the feature's unit, counts as constant, as in DP3 and the other baselines (of states, a policy's
`min_state_range` does) ..."""
MIN_RELATIVE_RANGE = 1e-6
"""... and so does one below this share of the values: it is float32's rounding."""
SUSPICIOUS_SHARE = 0.01
"""A state's dimension that moves by less than this share of the widest may be a sensor's noise, which is said."""

BOUNDS = {
    NormalizationMode.MIN_MAX: ("min", "max"),
    NormalizationMode.QUANTILES: ("q01", "q99"),
    NormalizationMode.QUANTILE10: ("q10", "q90"),
}
"""The statistics that become -1 and 1."""
NEEDED = {**BOUNDS, NormalizationMode.MEAN_STD: ("mean", "std"), NormalizationMode.IDENTITY: ()}


def needed_statistics(config: PointCloudPolicyConfig) -> dict[str, tuple[int, tuple[str, ...]]]:
    """D and the names of the statistics that the normalisation of each feature needs."""
    state, action = (
        NEEDED[config.normalization_mapping.get(kind, NormalizationMode.IDENTITY)] for kind in ("STATE", "ACTION")
    )
    return {
        OBS_POINT_CLOUD: (config.n_channels, state),
        OBS_STATE: (config.n_states, state),
        ACTION: (config.n_actions, action),
    }


def settled_statistics(
    stats: Mapping[str, Mapping[str, Any]] | None,
    config: PointCloudPolicyConfig,
    rename_map: Mapping[str, str] | None = None,
) -> Statistics:
    """A dataset's statistics as the policy's normalisers take them: under the policy's names, in float, not degenerate.

    A (nearly) constant dimension is not stretched: its bounds become one unit below and above the constant, which is
    normalised to 0. LeRobot would map it to -1, and a reading that is 1 mm off to 2e5.

    Args:
        stats: of the dataset, `dataset.meta.stats`.
        config: of the policy, with its features.
        rename_map: new names of the dataset's features, as LeRobot's `--rename_map`.

    Raises:
        UserError: if there are none, or a feature's are missing, have a wrong shape or are not finite.
    """
    if not stats:
        raise UserError(
            "Normalisation needs the dataset's statistics, got none: meta/stats.json is missing or empty. "
            "lerobot-uca-edit-dataset --operation.type=recompute_stats makes it."
        )
    named = {(rename_map or {}).get(key, key): values for key, values in stats.items()}
    cloud_key = find_point_cloud(named)
    if cloud_key is not None:
        channels = {name: _vector(values) for name, values in named[cloud_key].items()}
        named[OBS_POINT_CLOUD] = {
            name: values if name == "count" else values[: config.n_channels] for name, values in channels.items()
        }
    settled: Statistics = {}
    constant: list[str] = []
    for key, (_, names) in needed_statistics(config).items():
        settled[key] = {name: _vector(values) for name, values in named.get(key, {}).items()}
        check_statistics(key, settled[key], config, where=f"the dataset's ({', '.join(stats)})")
        if names:
            ranges = _ranges(settled[key])
            least = config.min_state_range if key == OBS_STATE else MIN_RANGE
            dimensions = _widen(settled[key], least)
            constant += [f"{key}{dimensions.tolist()}"] if len(dimensions) else []
            if key == OBS_STATE and ranges is not None:
                _say_if_noise(np.delete(ranges, dimensions), np.delete(np.arange(len(ranges)), dimensions))
    if constant:
        logger.warning("(Nearly) constant in the data, so not stretched by normalisation: %s", ", ".join(constant))
    return settled


def _ranges(stats: Mapping[str, NDArray[np.float64]]) -> NDArray[np.float64] | None:
    return stats["max"] - stats["min"] if {"min", "max"} <= set(stats) else None


def _say_if_noise(ranges: NDArray[np.float64], dimensions: NDArray[np.intp]) -> None:
    """Of dimensions that normalisation stretches: those that hardly move beside the widest."""
    small = ranges < SUSPICIOUS_SHARE * ranges.max(initial=0)
    if small.any():
        logger.warning(
            "%s%s moves by %.2g or less, another dimension by %.2g. If that is a sensor's noise, a greater "
            "--policy.min_state_range (its unit) keeps normalisation from stretching it to [-1, 1].",
            *(OBS_STATE, dimensions[small].tolist(), ranges[small].max(), ranges.max()),
        )


def check_statistics(key: str, stats: Mapping[str, Any], config: PointCloudPolicyConfig, *, where: str) -> None:
    """Raise a `UserError` if one of a feature's statistics that normalisation needs is missing, misshapen or NaN."""
    n_dimensions, names = needed_statistics(config)[key]
    for name in names:
        if name not in stats:
            raise UserError(f"Normalisation needs '{name}' of '{key}', which is not among {where} statistics.")
        values = np.asarray(stats[name], dtype=np.float64)
        if values.shape != (n_dimensions,):
            raise UserError(f"'{name}' of '{key}' in {where} statistics must be {n_dimensions} numbers, got {values}.")
        if not np.isfinite(values).all():
            raise UserError(f"'{name}' of '{key}' in {where} statistics must be finite, got {values}.")


def _widen(stats: dict[str, NDArray[np.float64]], least: float) -> NDArray[np.intp]:
    """Replace degenerate bounds and deviations, ranges below `least`, in place. Returns the constant dimensions."""
    constant: NDArray[np.bool_] | None = None
    for low, high in BOUNDS.values():
        if low not in stats or high not in stats:
            continue
        centre = (stats[low] + stats[high]) / 2
        unit = np.maximum(
            1.0, 1e3 * MIN_RELATIVE_RANGE * np.abs(centre)
        )  # of 1e8 - 1 and 1e8 + 1 float32 keeps nothing
        degenerate = stats[high] - stats[low] < np.maximum(least, MIN_RELATIVE_RANGE * np.abs(centre))
        stats[low] = np.where(degenerate, centre - unit, stats[low])
        stats[high] = np.where(degenerate, centre + unit, stats[high])
        if low == "min":
            constant = degenerate
    if "std" in stats:
        degenerate = stats["std"] < np.maximum(MIN_RANGE, MIN_RELATIVE_RANGE * np.abs(stats["mean"]))
        if constant is not None:
            degenerate |= constant  # their deviation is rounding
        stats["std"] = np.where(degenerate, 1.0, stats["std"])
        constant = degenerate if constant is None else constant
    return np.flatnonzero(constant) if constant is not None else np.zeros(0, dtype=np.intp)


def _vector(values: Any) -> NDArray[np.float64]:
    """Statistics come as arrays, tensors or lists, of any dtype."""
    array = np.asarray(values)
    return array.astype(np.float64).reshape(-1) if array.dtype != object else np.concatenate([*map(_vector, array)])
