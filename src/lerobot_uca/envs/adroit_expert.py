"""Adroit's demonstrators: the trained DAPG policies of github.com/aravindr93/hand_dapg (Apache-2.0)."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.envs.adroit import AdroitPointCloudEnv
from lerobot_uca.envs.expert import Attempt, attempts_by_seed
from lerobot_uca.errors import UserError

Weights = NDArray[np.float32]

WHERE_TO_GET_ONE = (
    "weights as .npz or as an original DAPG pickle (dapg/policies/*.pickle of the GitHub repository "
    "aravindr93/hand_dapg), or a Minari dataset such as minari:D4RL/door/expert-v2"
)


def attempts(task: str, source: str | None, first_seed: int) -> Iterator[Attempt]:
    """Tries at demonstrations of a task.

    Args:
        task: its name, which also replaces '{task}' in `source`.
        source: a file of weights, or 'minari:' and the id of a dataset.
        first_seed: of the episodes. A dataset brings its own.

    Raises:
        UserError: if there is no source, or it is none for this task.
    """
    if not source:
        raise UserError(f"Adroit has no demonstrator of its own. Give --expert=...: {WHERE_TO_GET_ONE}.")
    path = Path(source.replace("{task}", task))
    weights = read_npz(path)
    return attempts_by_seed(partial(DAPGExpert, weights), first_seed)


class DAPGWeights(NamedTuple):
    """A DAPG policy: an MLP with two hidden layers between two affine maps.

    Its noise (`log_std` in the files) is left out: demonstrations follow the mean action.
    """

    W0: Weights
    b0: Weights
    W1: Weights
    b1: Weights
    W2: Weights
    b2: Weights
    in_shift: Weights
    in_scale: Weights
    out_shift: Weights
    out_scale: Weights


def read_npz(path: Path) -> DAPGWeights:
    """Weights from NumPy's format, which can hold arrays only."""
    with np.load(path, allow_pickle=False) as file:
        return DAPGWeights(*(file[name] for name in DAPGWeights._fields))


class DAPGExpert:
    """Runs the mean action of a DAPG policy on the simulator's own observation."""

    def __init__(self, weights: DAPGWeights) -> None:
        self._weights = weights

    def __call__(self, env: AdroitPointCloudEnv) -> NDArray[np.float32]:
        """The action in [-1, 1]."""
        w = self._weights
        hidden = np.tanh(w.W0 @ ((env.expert_observation - w.in_shift) / (w.in_scale + 1e-8)) + w.b0)
        hidden = np.tanh(w.W1 @ hidden + w.b1)
        return env.from_own((w.W2 @ hidden + w.b2) * w.out_scale + w.out_shift)
