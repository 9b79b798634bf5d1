"""Priority before other work of a computer."""

import contextlib
import os


def prefer_this_thread() -> None:
    """Let this thread, and those that it starts, run before ordinary ones, where the system allows it.

    Linux allows it root, and users with an `rtprio` limit (docs/real_robot.md). Without, a busy computer makes an arm
    hold or stop, never go astray.
    """
    if hasattr(os, "sched_setscheduler"):
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
