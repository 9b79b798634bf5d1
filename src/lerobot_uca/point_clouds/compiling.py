"""Compiling the rays' functions by Numba, and keeping what was compiled as long as the modules stay as they are."""

import hashlib
import os
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba

NUMBA: Any = numba.config
FORGOTTEN_AFTER = 7 * 24 * 3600  # [s]


def _cache() -> Path:
    """Where compiled functions are kept: a folder for each state of this package's modules.

    Numba looks at a function's own file, its time and size, and not at what of its neighbours is compiled into it: an
    update that changed these alone would go unheeded.
    """
    modules = Path(__file__).parent
    base = Path(NUMBA.CACHE_DIR or modules / "__pycache__")
    if not NUMBA.CACHE_DIR and not os.access(base if base.exists() else modules, os.W_OK):
        with suppress(RuntimeError):  # there is no home; then Numba finds no folder either
            base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lerobot_uca"
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in sorted(modules.glob("[!.]*.py"))))
    cache = base / f"rays_{digest.hexdigest()[:16]}"
    with suppress(OSError):  # another process may tidy up, too
        if cache.exists():
            os.utime(cache)
        else:
            _forget(base)
    return cache


def _forget(base: Path) -> None:
    """Remove what was compiled from other states of the modules and has not been used for long."""
    for other in base.glob("rays_*"):
        if time.time() - other.stat().st_mtime > FORGOTTEN_AFTER:
            shutil.rmtree(other, ignore_errors=True)


CACHE = _cache()


def compiled(function: Callable[..., Any]) -> Any:
    """The function, compiled at its first call, and for good where a folder for that can be written."""
    users, NUMBA.CACHE_DIR = NUMBA.CACHE_DIR, str(CACHE)
    try:
        return numba.njit(cache=True, nogil=True)(function)
    except RuntimeError:  # no folder
        return numba.njit(nogil=True)(function)
    finally:
        NUMBA.CACHE_DIR = users
