"""Runs a command that ends when the process which started it ends: `python -m lerobot_uca.protocol.tied COMMAND ...`.

A benchmark that is killed must not leave a training behind that writes into the folder of the next one.
"""

import ctypes
import os
import signal
import sys

PARENT = "LEROBOT_UCA_PARENT"
PR_SET_PDEATHSIG = 1  # linux/prctl.h; it outlives exec


def tied() -> dict[str, str]:
    """What a parent adds to the environment of a child that calls `tie_to_parent`."""
    return {PARENT: str(os.getpid())}


def tie_to_parent() -> None:
    """Be killed as soon as the parent dies. Linux only: elsewhere a child goes on, and keeps its cell claimed."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.environ.get(PARENT, str(os.getppid())) != str(os.getppid()):  # it died before this was said
            os._exit(1)


if __name__ == "__main__":
    tie_to_parent()
    os.execv(sys.argv[1], sys.argv[1:])  # noqa: S606
