"""The end of processes: of a command by a signal, of a worker when its parent has ended."""

import atexit
import functools
import logging
import multiprocessing
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from types import FrameType, TracebackType
from weakref import WeakSet

from lerobot_uca.errors import UserError


def end_by_signals() -> None:
    """Let Ctrl-C, SIGTERM and SIGHUP end this command cleanly: one line, files removed, exit code 128 + number.

    Python prints a traceback for Ctrl-C, and the others end it without leaving any `with` block. To be called in the
    main thread. A signal that something else handles already, or that is ignored (nohup), stays as it is. If whoever
    reads its output ends (`| head`), it ends as well, without a line: SIGPIPE, which Python turns into an exception.
    """
    _report_interruption()
    atexit.register(_hand_on)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    for name in ("SIGTERM", "SIGHUP"):  # Windows has no SIGHUP
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _end)


_received: list[int] = []
"""The signal that ends this command. A library may swallow the exception, called back from C, and raise another."""

_expendable: WeakSet[BaseProcess] = WeakSet()


def kill_at_the_end(workers: Iterable[BaseProcess]) -> None:
    """Kill these workers as soon as a signal ends this command: before their pipes close, at which they complain."""
    _expendable.update(workers)


def _kill_workers() -> None:
    for worker in _expendable:
        with suppress(ValueError):  # it was closed
            worker.kill()


def _interrupt(number: int, frame: FrameType | None) -> None:
    _kill_workers()
    signal.default_int_handler(number, frame)


def _end(number: int, _: FrameType | None) -> None:
    signal.signal(number, signal.SIG_DFL)  # a second one ends it at once
    _received.append(number)
    # A print could fail: the signal may have come while something was being printed.
    os.write(2, f"\nended by {signal.Signals(number).name}\n".encode())
    _kill_workers()
    raise SystemExit(128 + number)


def _hand_on() -> None:
    """Hand on what has been printed, as Python does at its end, but drop it if nobody reads it."""
    try:
        if sys.stdout is not None and not sys.stdout.closed:
            sys.stdout.flush()
    except BrokenPipeError:
        _drop_output()


def _drop_output() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _nobody_reads() -> bool:
    if not hasattr(select, "poll"):  # Windows
        return False
    poll = select.poll()
    try:
        poll.register(sys.stdout, 0)  # a pipe without a reader is told in any case
    except (TypeError, ValueError, OSError):  # there is no standard output, or it is not a file
        return False
    return bool(poll.poll(0))


def _report_interruption() -> None:
    previous = sys.excepthook
    if getattr(previous, "_reports_interruption", False):
        return

    @functools.wraps(previous)  # with what it says of itself
    def hook(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        if _received:
            raise SystemExit(128 + _received[0])
        if issubclass(kind, BrokenPipeError) and _nobody_reads():  # it is not a robot's connection
            _drop_output()
            raise SystemExit(128 + signal.SIGPIPE)
        if not issubclass(kind, KeyboardInterrupt):
            previous(kind, error, traceback)
            return
        print("\ninterrupted", file=sys.stderr)
        raise SystemExit(128 + signal.SIGINT)

    hook._reports_interruption = True  # type: ignore[attr-defined]
    sys.excepthook = hook


@contextmanager
def signals_put_off() -> Iterator[None]:
    """Let signals wait until the block ends, in which workers are started.

    A worker whose parent leaves before it has been told what to do ends in a traceback.
    """
    if threading.current_thread() is not threading.main_thread():  # signals are the main thread's
        yield
        return
    received: list[int] = []
    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    handlers = {number: signal.getsignal(number) for number in numbers}
    for number in numbers:
        signal.signal(number, lambda number, _: received.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler or signal.SIG_DFL)  # None: not Python's
        for number in received:
            signal.raise_signal(number)


def n_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def worker_pool(n_workers: int, begin: Callable[[], None] | None = None) -> Iterator[ProcessPoolExecutor]:
    """A pool of worker processes. When it is left, what they are doing is finished, and what waits is dropped.

    They end with this process, however that ends.

    Args:
        n_workers: how many.
        begin: what each does first.

    Raises:
        UserError: if one of them was ended from outside.
    """
    context = multiprocessing.get_context("forkserver")
    pool = ProcessPoolExecutor(n_workers, mp_context=context, initializer=_begin_worker, initargs=(begin,))
    try:
        with signals_put_off():
            for _ in range(n_workers):
                pool.submit(os.getpid)  # which starts a worker, as none is idle yet
        yield pool
    except BrokenProcessPool as error:
        raise UserError("A worker process was ended from outside; was there too little memory?") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _begin_worker(begin: Callable[[], None] | None) -> None:
    """End with the parent, and leave to it what LeRobot says of missing video decoders: a page in each process."""
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
    _end_with_parent()
    if begin is not None:
        begin()


def _end_with_parent() -> None:
    """Let this worker process end as soon as its parent has ended, however that was: also by SIGKILL.

    A pool's idle workers would wait for good, as they hold the pipe open that they read from. Ctrl-C, which a terminal
    sends to all processes, is left to the parent.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None, "not a worker process"
    threading.Thread(target=_exit_after, args=(parent.sentinel,), daemon=True).start()


def _exit_after(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
