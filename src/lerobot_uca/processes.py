"""The end of processes: of a command by a signal, of a worker when its parent has ended."""

import functools
import multiprocessing
import os
import signal
import sys
import threading
from multiprocessing.connection import wait
from types import FrameType, TracebackType


def end_by_signals() -> None:
    """Let Ctrl-C, SIGTERM and SIGHUP end this command cleanly: one line, files removed, exit code 128 + number.

    Python prints a traceback for Ctrl-C, and the others end it without leaving any `with` block. To be called in the
    main thread. A signal that something else handles already, or that is ignored (nohup), stays as it is.
    """
    _report_interruption()
    for name in ("SIGTERM", "SIGHUP"):  # Windows has no SIGHUP
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _end)


_received: list[int] = []
"""The signal that ends this command. A library may swallow the exception, called back from C, and raise another."""


def _end(number: int, _: FrameType | None) -> None:
    signal.signal(number, signal.SIG_DFL)  # a second one ends it at once
    _received.append(number)
    # A print could fail: the signal may have come while something was being printed.
    os.write(2, f"\nended by {signal.Signals(number).name}\n".encode())
    for worker in multiprocessing.active_children():
        worker.kill()  # before its pipe is closed, at which an environment's worker prints a traceback
    raise SystemExit(128 + number)


def _report_interruption() -> None:
    previous = sys.excepthook
    if getattr(previous, "_reports_interruption", False):
        return

    @functools.wraps(previous)  # with what it says of itself
    def hook(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        if _received:
            raise SystemExit(128 + _received[0])
        if not issubclass(kind, KeyboardInterrupt):
            previous(kind, error, traceback)
            return
        print("\ninterrupted", file=sys.stderr)
        raise SystemExit(128 + signal.SIGINT)

    hook._reports_interruption = True  # type: ignore[attr-defined]
    sys.excepthook = hook


def end_with_parent() -> None:
    """Let this worker process end as soon as its parent has ended, however that was: also by SIGKILL.

    Give it to a pool as its initializer: a pool's idle workers would wait for good, as they hold the pipe open that
    they read from. Ctrl-C, which a terminal sends to all processes, is left to the parent.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None, "not a worker process"
    threading.Thread(target=_exit_after, args=(parent.sentinel,), daemon=True).start()


def _exit_after(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
