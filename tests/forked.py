"""Commands and code in processes of their own, forked from one that has imported LeRobot.

Importing LeRobot takes 6 to 12 seconds of a core, once for all tests instead of once a command. Of this package nothing
is imported before the fork: each process loads the plugin as a fresh one does.
"""

import importlib.metadata
import multiprocessing
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

_processes = multiprocessing.get_context("forkserver")
_processes.set_forkserver_preload(["lerobot.scripts.lerobot_eval", "lerobot.scripts.lerobot_train"])


def run_command(program: str, *arguments: str | Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a console command to its end, with changed environment variables."""
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name=program)
    module, function = entry.value.split(":")
    code = f"import sys, {module}\nsys.exit({module}.{function}())"
    return _run(code, [program, *map(str, arguments)], variables)


def run_code(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run Python code to its end, as `python -c` does, with changed environment variables."""
    return _run(code, ["-c"], variables)


def _run(code: str, argv: Sequence[str], variables: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    with tempfile.TemporaryDirectory() as folder:
        out, err = (Path(folder) / name for name in ("out", "err"))
        arguments = (code, argv, {**os.environ, **variables}, Path.cwd(), out, err)
        process = _processes.Process(target=_interpret, args=arguments)
        process.start()
        process.join()
        return subprocess.CompletedProcess(argv, process.exitcode, out.read_text(), err.read_text())


def _interpret(code: str, argv: list[str], environment: dict[str, str], folder: Path, out: Path, err: Path) -> None:
    """What a new interpreter does with the code, in this process: it prints into the files, and ends as that would."""
    for stream, path in ((sys.stdout, out), (sys.stderr, err)):
        with path.open("wb") as file:
            os.dup2(file.fileno(), stream.fileno())
        stream.reconfigure(line_buffering=True)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    sys.argv[:] = argv
    try:
        exec(compile(code, "<string>", "exec"), {"__name__": "__main__"})
    except Exception:  # noqa: BLE001 (an interpreter prints whatever ends it)
        sys.excepthook(*sys.exc_info())
        sys.exit(1)
