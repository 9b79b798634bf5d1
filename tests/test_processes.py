"""Commands end by signals in one line, and their workers end with them, whatever ended them."""

import os
import signal
import subprocess
import sys
from multiprocessing.connection import Listener, wait
from pathlib import Path

import pytest

from lerobot_uca.errors import UserError
from lerobot_uca.processes import worker_pool

HEED = (
    "import signal\n"
    "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "for number in (signal.SIGTERM, signal.SIGHUP):\n    signal.signal(number, signal.SIG_DFL)\n"
)
"""Whoever runs these tests may ignore signals, as nohup does."""
COMMAND = f"""{HEED}
import sys, time
from lerobot_uca.processes import end_by_signals
end_by_signals()
try:
    print("started", flush=True)
    time.sleep(60)
finally:
    print("cleaned up", flush=True)
"""


@pytest.mark.parametrize(
    ("number", "line"),
    [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "ended by SIGTERM"), (signal.SIGHUP, "ended by SIGHUP")],
)
def test_a_command_ends_in_one_line(number, line):
    process = subprocess.Popen([sys.executable, "-c", COMMAND], stdout=-1, stderr=-1, text=True)
    assert process.stdout.readline() == "started\n"
    process.send_signal(number)
    out, err = process.communicate()
    assert (process.returncode, out, err.strip()) == (128 + number, "cleaned up\n", line)


def test_a_library_that_swallows_the_end_changes_nothing():
    """Arrow calls Python back, prints what is raised there, and then raises an error of its own."""
    code = (
        "import os, signal\n"
        "from lerobot_uca.processes import end_by_signals; end_by_signals()\n"
        "try:\n    os.kill(os.getpid(), signal.SIGTERM)\n    signal.pause()\n"
        "except BaseException:\n    raise ValueError('other') from None"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr.strip()) == (143, "ended by SIGTERM")


@pytest.mark.parametrize(("unbuffered", "code"), [("1", 128 + signal.SIGPIPE), ("", 0)])  # 0: printed at its end
def test_a_command_whose_reader_ends_ends_without_a_line(unbuffered, code):
    lines = "from lerobot_uca.processes import end_by_signals; end_by_signals(); input(); print('x')"
    env = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    process = subprocess.Popen([sys.executable, "-c", lines], stdin=-1, stdout=-1, stderr=-1, text=True, env=env)
    process.stdout.close()
    _, err = process.communicate("\n")
    assert (process.returncode, err) == (code, "")


@pytest.mark.parametrize("stdout", ["sys.stdout = None", "sys.stdout.close()", "sys.stdout = io.StringIO()"])
def test_a_command_without_standard_output_ends_as_ever(stdout):
    lines = f"import io, sys; from lerobot_uca.processes import end_by_signals; end_by_signals(); {stdout}"
    result = subprocess.run([sys.executable, "-c", lines], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    result = subprocess.run(
        [sys.executable, "-c", f"{lines}; raise BrokenPipeError"], capture_output=True, text=True, check=False
    )
    assert (result.returncode, result.stderr.count("Traceback")) == (1, 1)


def test_another_broken_pipe_is_told():
    lines = (
        "from lerobot_uca.processes import end_by_signals; end_by_signals()\n"
        "import socket; a, b = socket.socketpair(); b.close(); a.send(b'x')"
    )
    result = subprocess.run([sys.executable, "-c", lines], capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert "BrokenPipeError" in result.stderr


def test_a_signal_that_is_ignored_stays_ignored():
    code = (
        "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "from lerobot_uca.processes import end_by_signals; end_by_signals()\n"
        "assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_signal_while_workers_are_started_comes_when_they_know_what_to_do():
    code = (
        "import os, signal\n"
        "from lerobot_uca.processes import end_by_signals, signals_put_off; end_by_signals()\n"
        "with signals_put_off():\n    os.kill(os.getpid(), signal.SIGTERM); print('started', flush=True)\n"
        "print('not reached')"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout, result.stderr.strip()) == (143, "started\n", "ended by SIGTERM")


def pool_of_workers(address: str) -> None:
    """A parent with two idle workers, each of which holds a connection to the test as long as it lives."""
    with worker_pool(2) as pool:
        list(pool.map(connect, [address] * 2))
        signal.pause()


def connect(address: str) -> None:
    from multiprocessing.connection import Client

    connect.connection = Client(address)
    connect.connection.send(os.getpid())


def test_workers_end_with_their_parent_also_by_kill(tmp_path):
    address = str(tmp_path / "socket")
    with Listener(address) as listener:
        code = f"from tests.test_processes import pool_of_workers; pool_of_workers({address!r})"
        parent = subprocess.Popen([sys.executable, "-c", code], cwd=Path(__file__).parents[1])
        connections = [listener.accept() for _ in range(2)]
        for connection in connections:
            connection.recv()
        parent.kill()
        parent.wait()
        for connection in connections:  # closed by the system when the worker has ended
            assert wait([connection], timeout=30)
            with pytest.raises(EOFError):
                connection.recv()


def test_a_worker_that_is_killed_is_one_line():
    with pytest.raises(UserError, match="A worker process was ended from outside"), worker_pool(1) as pool:
        pool.submit(os._exit, 9).result()
