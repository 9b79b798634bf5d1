"""Demonstrators of Adroit's tasks: trained policies, or the episodes of a Minari dataset."""

import logging
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.envs.adroit import ACTION_REPEAT, AdroitPointCloudEnv, make_simulator
from lerobot_uca.envs.experts.dapg import DAPGExpert, DAPGWeights
from lerobot_uca.envs.experts.expert import Attempt, attempts_by_seed
from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.geometry import Array

logger = logging.getLogger(__name__)

MINARI = "minari:"
HOW_TO_GET_ONE = (
    "weights as .npz or as an original DAPG pickle (dapg/policies/*.pickle of aravindr93/hand_dapg on GitHub), "
    "or a Minari dataset such as minari:D4RL/door/expert-v2"
)


def attempts(task: str, source: str | None, first_seed: int) -> Iterator[Attempt]:
    """Tries at demonstrations of a task.

    Args:
        task: its name, which replaces '{task}' in `source`.
        source: a file of weights, or 'minari:' and the id of a dataset.
        first_seed: of the episodes; those of a dataset bring their own start.

    Raises:
        UserError: if no source is given, or it does not fit this task.
    """
    if not source:
        raise UserError(f"Adroit has no expert built in. Give one with --expert=...: {HOW_TO_GET_ONE}.")
    source = source.replace("{task}", task)
    if source.startswith(MINARI):
        logger.warning(
            "The episodes of a Minari dataset start as they were recorded, in their order: --seed is not used."
        )
        return replays(task, source.removeprefix(MINARI))
    path = Path(source)
    weights = DAPGWeights.read(path)
    weights.check_task(task, path)
    return attempts_by_seed(partial(DAPGExpert, weights), first_seed)


def replays(task: str, dataset_id: str) -> Iterator[Attempt]:
    """The episodes of a Minari dataset of a task, downloaded if need be: its starts and its actions.

    Raises:
        UserError: if the dataset is missing, or holds another task.
    """
    dataset = _load(dataset_id)
    simulator = make_simulator(task)
    for name in ("observation_space", "action_space"):
        got, needed = getattr(dataset, name).shape, getattr(simulator, name).shape
        if got != needed:
            raise UserError(
                f"Minari dataset '{dataset_id}' does not fit {task}: its {name} has shape {got}, {task} needs {needed}."
            )
    return (_replay(dataset, dataset_id, index) for index in map(int, dataset.episode_indices))


def _load(dataset_id: str) -> Any:
    try:
        import minari
    except ImportError as error:
        raise UserError("Minari's datasets need minari: pip install 'lerobot_policy_uca_flow[minari]'.") from error
    if not re.search(r"-v\d+$", dataset_id):
        raise UserError(f"A Minari dataset is named as 'D4RL/door/expert-v2', with its version, got '{dataset_id}'.")
    try:
        return minari.load_dataset(dataset_id, download=True)
    except Exception as error:  # of almost any kind: its remotes raise what their HTTP libraries do
        reason = " ".join(str(error).split())
        raise UserError(
            f"Minari dataset '{dataset_id}' is not on this computer and could not be downloaded: {reason}"
        ) from error


def _replay(dataset: Any, dataset_id: str, index: int) -> Attempt:
    (episode,) = dataset.iterate_episodes([index])
    (metadata,) = dataset.storage.get_episode_metadata([index])
    # As it was started when it was recorded: Minari keeps what `reset` was called with.
    start = {name: metadata[name] for name in ("seed", "options") if metadata.get(name) is not None}
    name = f"episode {index} of Minari dataset '{dataset_id}'"
    if not start:
        raise UserError(f"Cannot replay {name}: it records neither its seed nor its initial state.")
    return Attempt(start, partial(Replay, name, episode.observations[0], episode.actions))


class Replay:
    """Repeats recorded actions.

    They were taken every 10 ms, an environment's action lasts 20 ms: it is the mean of two, with which nearly all
    episodes still succeed. Every second action alone would not do where the recorded policy was noisy.

    Args:
        name: of the episode, for errors.
        observation: the simulator's own at the start.
        actions: (L, A). After the last one, it is held.
    """

    def __init__(self, name: str, observation: Array, actions: Array) -> None:
        self._name, self._observation = name, observation
        n_whole = len(actions) // ACTION_REPEAT * ACTION_REPEAT
        self._actions = actions[:n_whole].reshape(-1, ACTION_REPEAT, actions.shape[1]).mean(axis=1)
        self._n_steps = 0

    def __call__(self, env: AdroitPointCloudEnv) -> NDArray[np.float32]:
        """The next action."""
        if self._n_steps == 0 and not np.allclose(env.expert_observation, self._observation, atol=1e-3):
            raise UserError(
                f"Cannot replay {self._name}: {env.task} starts in a state that differs from the recorded one."
            )
        action = self._actions[min(self._n_steps, len(self._actions) - 1)]
        self._n_steps += 1
        return env.from_own(action)
