"""Bounds of a configuration's numbers, declared where the field is and checked by `check_bounds`.

    horizon: int = within(4, least=1, most=1024)

The check sees what was set in code, on a command line or by a checkpoint. NaN and infinity are never valid.
"""

import math
from dataclasses import Field, dataclass, field, fields
from numbers import Integral, Real
from typing import Any, get_args

from lerobot_uca.errors import UserError

BOUNDS = "bounds"
"""Key of a field's metadata."""


@dataclass(frozen=True)
class Bounds:
    """The range of valid numbers; None for no limit."""

    least: float | None
    above: float | None
    most: float | None
    below: float | None
    is_optional: bool

    def fault(self, value: Any) -> str | None:
        """The rule that the value breaks, such as 'at least 1'; None if it is valid."""
        limits = (
            (self.least, "at least", lambda limit: value >= limit),
            (self.above, "above", lambda limit: value > limit),
            (self.most, "at most", lambda limit: value <= limit),
            (self.below, "below", lambda limit: value < limit),
        )
        for limit, words, holds in limits:
            if limit is not None and not holds(limit):
                return f"{words} {limit}"
        return None


def within(
    default: Any,
    *,
    least: float | None = None,
    above: float | None = None,
    most: float | None = None,
    below: float | None = None,
) -> Any:
    """A dataclass field with bounds, which hold for each number of a tuple. None is valid where it is the default."""
    return field(default=default, metadata={BOUNDS: Bounds(least, above, most, below, is_optional=default is None)})


def check_bounds(config: Any, group: str = "") -> None:
    """Raise a `UserError` for the first field of a dataclass that is not of its type or outside its bounds.

    Args:
        config: the dataclass.
        group: what a user writes before its options, such as 'policy'; empty for none.
    """
    for each in fields(config):
        value, option = getattr(config, each.name), f"{group}.{each.name}" if group else each.name
        if each.type is bool and not isinstance(value, bool):
            raise UserError(f"{option} must be true or false, got {value}.")
        if BOUNDS in each.metadata:
            fault = _fault(each, value)
            if fault:
                raise UserError(f"{option} must be {fault}, got {value}.")


def _fault(declared: Field[Any], value: Any) -> str | None:
    bounds: Bounds = declared.metadata[BOUNDS]
    suffix = " or null" if bounds.is_optional else ""
    if value is None and bounds.is_optional:
        return None
    if not isinstance(declared.default, tuple):
        fault = _fault_of_number(value, bounds, is_whole=int in (declared.type, *get_args(declared.type)))
        return fault and fault + suffix
    numbers = get_args(declared.type)
    if not isinstance(value, tuple | list) or not value or (... not in numbers and len(value) != len(numbers)):
        return "a list of numbers" if ... in numbers else f"a list of {len(numbers)} numbers"
    faults = (_fault_of_number(each, bounds, is_whole=int in numbers) for each in value)
    return next((f"a list of numbers, each {fault}" for fault in faults if fault), None)


def _fault_of_number(value: Any, bounds: Bounds, *, is_whole: bool) -> str | None:
    if isinstance(value, bool) or not isinstance(value, Integral if is_whole else Real):
        return "a whole number" if is_whole else "a number"
    return bounds.fault(value) if math.isfinite(value) else "finite"
