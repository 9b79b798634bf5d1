"""Trained DAPG policies (github.com/aravindr93/hand_dapg, Apache-2.0): reading their weights, running them."""

import pickle
import struct
import zipfile
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.envs.adroit import AdroitPointCloudEnv, make_simulator
from lerobot_uca.envs.experts.dapg_pickle import read_policy
from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.geometry import Array

Weights = NDArray[np.float32]

# The errors from reading a file that is damaged or made to do harm.
DAMAGE = (
    *(AttributeError, EOFError, LookupError, MemoryError, OverflowError, RecursionError, RuntimeError, TypeError),
    *(ValueError, pickle.UnpicklingError, struct.error, zipfile.BadZipFile),
)


class DAPGWeights(NamedTuple):
    """An MLP with two hidden layers between two affine maps, float32.

    The noise that is stored with it is left out: demonstrations follow the mean action.
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

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read an `.npz` file with these names, or an original pickle.

        Raises:
            UserError: if the file is missing or does not contain a DAPG policy.
        """
        try:
            if path.exists() and not path.is_file():
                raise UserError(f"'{path}' is not a file.")
            if path.suffix == ".npz":
                with np.load(path, allow_pickle=False) as file:
                    arrays = [file[name] for name in cls._fields]
            else:
                arrays = read_policy(path)
            weights = cls(*(np.asarray(array, dtype=np.float32) for array in arrays))
        except OSError as error:
            raise UserError(f"Cannot read the expert's weights: {error}") from error
        except UserError:
            raise
        except DAMAGE as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise UserError(f"'{path}' does not contain a DAPG policy: {reason}") from error
        weights._check(path)
        return weights

    def _check(self, path: Path) -> None:
        n_in, n_first, n_second, n_out = self.in_shift.size, self.b0.size, self.b1.size, self.out_shift.size
        layers = (n_first, n_in), (n_first,), (n_second, n_first), (n_second,), (n_out, n_second), (n_out,)
        shapes = (*layers, (n_in,), (n_in,), (n_out,), (n_out,))
        for name, array, shape in zip(self._fields, self, shapes, strict=True):
            if array.shape != shape:
                raise UserError(
                    f"'{path}' does not contain a DAPG policy: {name} must have shape {shape}, got {array.shape}."
                )
            if not np.all(np.isfinite(array)):
                raise UserError(f"'{path}' does not contain a DAPG policy: {name} must be finite.")

    def check_task(self, task: str, path: Path) -> None:
        """Raise a `UserError` unless the policy fits a task."""
        simulator = make_simulator(task)
        fits = simulator.observation_space.shape + simulator.action_space.shape
        got = (len(self.in_shift), len(self.out_shift))
        if got != fits:
            raise UserError(
                f"'{path}' does not fit {task}: it maps {got[0]} observations to {got[1]} actions, "
                f"{task} has {fits[0]} and {fits[1]}."
            )


class DAPGExpert:
    """Runs the mean action of a DAPG policy on the simulator's own observation."""

    def __init__(self, weights: DAPGWeights) -> None:
        self._weights = weights

    def __call__(self, env: AdroitPointCloudEnv) -> NDArray[np.float32]:
        """The action in [-1, 1]."""
        return env.from_own(self.mean_action(env.expert_observation))

    def mean_action(self, observation: Array) -> Array:
        """The action before it is clipped, for the simulator's own observation."""
        w = self._weights
        hidden = np.tanh(w.W0 @ ((observation - w.in_shift) / (w.in_scale + 1e-8)) + w.b0)
        hidden = np.tanh(w.W1 @ hidden + w.b1)
        return (w.W2 @ hidden + w.b2) * w.out_scale + w.out_shift
