"""Replacing LeRobot's functions and methods, once each."""

import functools
import sys
from collections.abc import Callable
from typing import Any

Wrap = Callable[[Callable[..., Any]], Callable[..., Any]]
"""Maps LeRobot's function to the one that replaces it."""


def _wrapped(original: Callable[..., Any], wrap: Wrap) -> Callable[..., Any]:
    new = functools.wraps(original)(wrap(original))
    new._is_patched = True  # type: ignore[attr-defined]
    return new


def replace(original: Callable[..., Any], wrap: Wrap) -> None:
    """Replace a function in every module that has imported it by its name."""
    if getattr(original, "_is_patched", False):
        return
    new = _wrapped(original, wrap)
    for module in list(sys.modules.values()):
        if getattr(module, "__dict__", {}).get(original.__name__) is original:
            setattr(module, original.__name__, new)


def replace_method(owner: type, name: str, wrap: Wrap) -> None:
    """Replace a method of a class."""
    original = getattr(owner, name)
    if not getattr(original, "_is_patched", False):
        setattr(owner, name, _wrapped(original, wrap))


def replace_class_method(owner: type, name: str, wrap: Wrap) -> None:
    """Replace a class method, whose function gets the class first."""
    original = getattr(owner, name).__func__
    if not getattr(original, "_is_patched", False):
        setattr(owner, name, classmethod(_wrapped(original, wrap)))
