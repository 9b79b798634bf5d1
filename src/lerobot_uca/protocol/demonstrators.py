"""`lerobot-uca-benchmark demonstrators`: how well the experts themselves do their tasks.

Without clouds, which no expert looks at, but for an episode's first: it takes as long as its simulation.
"""

import csv
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from lerobot.envs.configs import EnvConfig
from tqdm import tqdm

from lerobot_uca.data.collect import FIRST_SEED
from lerobot_uca.envs.configs import PointCloudEnvConfig
from lerobot_uca.envs.experts.expert import Attempt, pushed, smoothed
from lerobot_uca.envs.point_cloud_env import PointCloudEnv
from lerobot_uca.errors import UserError
from lerobot_uca.processes import n_cores, worker_pool
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.whole_file import whole_file


class Trial(NamedTuple):
    """One episode of an expert."""

    n_successful: int
    """Steps in which the task was successful."""
    roughness: float
    """Mean change of an action's numbers from step to step, each in [-1, 1]."""


class Demonstrator(NamedTuple):
    """An expert's results on a task: a row of the table."""

    task: str
    straight_paths: bool
    smoothing: float
    pushes: float
    episodes: int
    demonstrations: int
    """Episodes that are kept as demonstrations: with as many successful steps as the benchmark's rule asks for."""
    any_success: int
    """Episodes with a successful step."""
    roughness: float
    """The median roughness of the demonstrations."""
    first_seed: int
    mujoco: str
    """Version."""


class Demonstrating(NamedTuple):
    """How experts demonstrate, as for lerobot-uca-collect."""

    expert: str | None = None
    """Who demonstrates Adroit's tasks."""
    straight_paths: bool = False
    smoothing: float = 1.0
    pushes: float = 0.0


def demonstrators(tasks: Sequence[str], path: Path, how: Demonstrating, n_episodes: int) -> list[Demonstrator]:
    """Write a table of experts as CSV, task by task, so that what is there stays when it is stopped.

    Raises:
        UserError: if there is no expert, or the file cannot be written.
    """
    import mujoco

    with _writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    rows: list[Demonstrator] = []
    prepared = [(task, *_of_task(task, how)) for task in tasks]  # wrong options are told at once
    for task, make_env, attempts in tqdm(prepared, desc="Experts", unit="task"):
        needed = make_env().min_successful_steps
        trials = list(_trials(make_env, islice(attempts, n_episodes)))
        kept = [trial for trial in trials if trial.n_successful >= needed]
        rows.append(
            Demonstrator(
                task=task,
                straight_paths=how.straight_paths,
                smoothing=how.smoothing,
                pushes=how.pushes,
                episodes=len(trials),
                demonstrations=len(kept),
                any_success=sum(trial.n_successful > 0 for trial in trials),
                roughness=round(float(np.median([trial.roughness for trial in kept])), 4) if kept else float("nan"),
                first_seed=FIRST_SEED,
                mujoco=mujoco.__version__,
            )
        )
        _write(path, rows)
    return rows


def try_once(make_env: Callable[[], PointCloudEnv], attempt: Attempt) -> Trial:
    """Run an expert for a whole episode, also past its first success, as it is demonstrated."""
    env, expert, executed = make_env(), attempt.expert(), attempt.disturbance()
    env.reset(**attempt.reset)
    actions, n_successful, is_over = [], 0, False
    while not is_over:
        actions.append(expert(env))
        _, terminated, truncated, info = env.act(executed(actions[-1]))
        n_successful += bool(info["is_success"])
        is_over = truncated or (terminated and not info["is_success"])
    env.close()
    return Trial(n_successful, float(np.abs(np.diff(actions, axis=0)).mean()))


def _trials(make_env: Callable[[], PointCloudEnv], attempts: Iterator[Attempt]) -> Iterator[Trial]:
    with worker_pool(n_cores()) as pool:
        pending = [pool.submit(try_once, make_env, attempt) for attempt in attempts]
        for future in pending:
            yield future.result()


def _of_task(task: str, how: Demonstrating) -> tuple[Callable[[], PointCloudEnv], Iterator[Attempt]]:
    cell = Cell(task, "uca_flow", 0)
    config = EnvConfig.get_choice_class(cell.env_type)(task=cell.env_task)
    assert isinstance(config, PointCloudEnvConfig)
    source = how.expert if cell.benchmark == "adroit" else None
    attempts = config.attempts(cell.env_task, source, FIRST_SEED, straight_paths=how.straight_paths)
    attempts = pushed(smoothed(attempts, how.smoothing), how.pushes, config.action_names())
    return config.env_factory(cell.env_task), attempts


def _write(path: Path, rows: Sequence[Demonstrator]) -> None:
    with _writing(path), whole_file(path) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([Demonstrator._fields, *rows])


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UserError(f"--output '{path}' cannot be written: {error}") from error
