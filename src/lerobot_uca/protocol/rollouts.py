"""Strips of pictures of evaluation episodes, the paper's qualitative figure: a row is a policy on a task.

Rows of results hold no pictures, so an episode that they tell of is run again, with the cell's last checkpoint.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.envs.point_cloud_env import PointCloudEnv
from lerobot_uca.errors import UserError
from lerobot_uca.protocol import training
from lerobot_uca.protocol.cells import POLICIES, Cell
from lerobot_uca.protocol.figures import pyplot, write
from lerobot_uca.protocol.folder import RunFolder
from lerobot_uca.protocol.results import Results
from lerobot_uca.protocol.rows import Row
from lerobot_uca.protocol.run_cell import load_lerobot, make_env

N_PICTURES = 6

Picture = NDArray[np.uint8]


class Strip(NamedTuple):
    """Pictures of an episode, from its start to its end."""

    cell: Cell
    episode_seed: int
    success: bool
    pictures: dict[int, Picture]
    """By the actions executed before."""


def strips_of(runs: Sequence[Path], results: Results, tasks: Sequence[str]) -> list[Strip]:
    """The strips of these tasks, of each policy's first training seed.

    Raises:
        UserError: if no cell of them has its last checkpoint, as in a report's folder.
    """
    cells = [cell for cell in results.first_cells() if cell.task in tasks]
    load_lerobot()
    ordered = sorted(cells, key=lambda cell: tasks.index(cell.task))
    strips = [strip for cell in ordered for strip in _film(runs, results, cell)]
    if not strips:
        raise UserError(
            f"No finished cell of {', '.join(tasks)} has its last checkpoint in {', '.join(map(str, runs))}."
        )
    return strips


def _film(runs: Sequence[Path], results: Results, cell: Cell) -> Iterator[Strip]:
    """The strip of a cell, if its last checkpoint is there."""
    for folder in map(RunFolder.open, runs):
        checkpoint = training.checkpoint(folder.cell(cell), folder.setting.length(cell).steps)
        if checkpoint is not None:
            yield film(checkpoint, cell, results.typical_episode(cell))
            return


def film(checkpoint: Path, cell: Cell, row: Row) -> Strip:
    """The episode of a row, run again. It is the same but for rounding, as it shares no call with others now."""
    from lerobot_uca.protocol.evaluation import PolicyPlan, run_episodes

    plan = PolicyPlan.from_checkpoint(checkpoint)
    steps = np.linspace(0, row.length, N_PICTURES).round().astype(int)[:-1].tolist()
    pictures: dict[int, Picture] = {}
    latest: list[Any] = []

    def watch(env: PointCloudEnv, step: int) -> None:
        latest[:] = env, step
        if step in steps:
            pictures[step] = env.render()

    episodes = run_episodes(make_env(cell, plan), plan.config, plan, [row.episode_seed], n_envs=1, watch=watch)
    episode = next(episodes)
    env, last_step = latest
    pictures[last_step] = env.render()
    episodes.close()
    return Strip(cell, episode.seed, episode.success, pictures)


def draw(strips: Sequence[Strip], folder: Path) -> Path:
    """Write rollouts.png and rollouts.svg, a row a strip; the SVG file."""
    size = (1.6 * N_PICTURES, 1.75 * len(strips))
    figure, axes = pyplot().subplots(len(strips), N_PICTURES, figsize=size, squeeze=False, layout="constrained")
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[], frame_on=False)
    for row, strip in zip(axes, strips, strict=True):
        verdict = "success" if strip.success else "failure"
        row[0].set_ylabel(f"{strip.cell.task}\n{POLICIES[strip.cell.policy].title}\n{verdict}", fontsize=7)
        for axis, (step, picture) in zip(row, strip.pictures.items(), strict=False):
            axis.imshow(picture)
            axis.set_title(f"step {step}", fontsize=7)
    return write(figure, folder / "rollouts")
