"""Replacing LeRobot's functions and methods, once by each patch."""

import functools
import sys
from collections.abc import Callable
from typing import Any

Wrap = Callable[[Callable[..., Any]], Callable[..., Any]]
"""Maps LeRobot's function to the one that replaces it, whose parameters have the same names."""


def _wrapped(original: Callable[..., Any], wrap: Wrap) -> Callable[..., Any]:
    """The new function, or the original where this patch has been applied already."""
    applied = getattr(original, "_patches", ())
    if wrap.__qualname__ in applied:
        return original
    new = functools.wraps(original)(wrap(original))
    new._patches = (*applied, wrap.__qualname__)  # type: ignore[attr-defined]
    return new


def replace(original: Callable[..., Any], wrap: Wrap) -> None:
    """Replace a function in every module that has imported it by its name."""
    new = _wrapped(original, wrap)
    for module in list(sys.modules.values()):
        if getattr(module, "__dict__", {}).get(original.__name__) is original:
            setattr(module, original.__name__, new)


def replace_method(owner: type, name: str, wrap: Wrap) -> None:
    """Replace a method of a class."""
    setattr(owner, name, _wrapped(getattr(owner, name), wrap))


def replace_class_method(owner: type, name: str, wrap: Wrap) -> None:
    """Replace a class method, whose function gets the class first."""
    setattr(owner, name, classmethod(_wrapped(getattr(owner, name).__func__, wrap)))
