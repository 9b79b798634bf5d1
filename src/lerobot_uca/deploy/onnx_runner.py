"""Runs what `lerobot-uca-export` wrote: needs onnxruntime and numpy alone, so copy this file to the robot's computer.

    policy = OnnxPolicy("policy.onnx")
    while True:
        robot.move(policy.select_action(point_cloud, state))

Letters: K steps from the first observed one to the current one, N points, S state dimensions, T horizon, A action
dimensions.
"""

import logging
from collections import deque
from pathlib import Path

import numpy as np
import onnxruntime

logger = logging.getLogger(__name__)

INPUTS = ("point_cloud", "state", "noise")
OUTPUTS = ("action", "largest")  # the latter of the normalised observation
MIN_ONNXRUNTIME = (1, 12)  # the first with opset 17
LARGEST = 1e12  # of far larger values onnxruntime makes NaN or arbitrary actions, since their squares are infinite
LARGEST_NORMALISED = 1e6  # as the policy's: normalised values lie near [-1, 1]


class OnnxPolicy:
    """An exported policy. Observations are raw, in the units of the training data; actions are in the robot's.

    Args:
        path: the file.
        seed: of the noise that actions are made from; without one it is drawn.
        n_threads: cores to use; 0 for all. A small network is fastest with one.

    Raises:
        ValueError: if the file is not such a policy or keeps weights in other files; if an observation has a wrong
            shape, if it is not finite or is huge beside training's, or if an action is not finite.
        RuntimeError: if onnxruntime is too old.
    """

    def __init__(self, path: str | Path, seed: int | None = None, n_threads: int = 1) -> None:
        self._session = open_session(Path(path).read_bytes(), str(path), n_threads)
        self._shapes = shapes = {tensor.name: tuple(tensor.shape) for tensor in self._session.get_inputs()}
        if set(shapes) != set(INPUTS):
            raise ValueError(f"'{path}' must have the inputs {', '.join(INPUTS)}, got {', '.join(shapes)}.")
        outputs = [tensor.name for tensor in self._session.get_outputs()]
        if outputs != list(OUTPUTS):
            raise ValueError(
                f"'{path}' must have the outputs {', '.join(OUTPUTS)}, got {', '.join(outputs)}: export anew."
            )
        self._n_steps, *self._cloud_shape = shapes["point_cloud"]
        self._state_shape = shapes["state"][1:]
        self._random = np.random.default_rng(seed)
        self._has_said = False
        self.reset()

    def reset(self) -> None:
        """Forget observations and planned actions: an episode begins."""
        self._history: list[tuple[np.ndarray, np.ndarray]] = []
        self._action_queue: deque[np.ndarray] = deque()

    def select_action(self, point_cloud: np.ndarray, state: np.ndarray) -> np.ndarray:
        """The next action (A,), from the newest point cloud and state (S,). Call it once every step.

        The cloud is (N, 3), or (N, 6) if the policy sees colours. The first of more channels are taken. More points
        are sampled farthest point by farthest point, as a policy with n_points does; of more than 1024 it starts from
        another one. A policy without n_points, which looks at all there are, is exported for as many as training's
        clouds had.

        What is refused is forgotten: the next call goes on as if this one had not been.
        """
        n_channels = np.shape(point_cloud)[-1] if np.ndim(point_cloud) == 2 else 0
        if n_channels > self._cloud_shape[1] and not self._has_said:
            self._has_said = True
            logger.warning("The cloud has %d channels: the first %d are taken.", n_channels, self._cloud_shape[1])
        cloud = _sampled(point_cloud, *self._cloud_shape)
        frame = (_checked("point_cloud", cloud, self._cloud_shape), _checked("state", state, self._state_shape))
        history = [*self._history[1:], frame] if self._history else [frame] * self._n_steps
        if self._action_queue:  # a frame that only a later plan sees would spoil that, and be executed upon until then
            self._run(*(np.stack([part] * self._n_steps) for part in frame), np.zeros(self._shapes["noise"]))
        else:
            clouds, states = zip(*history, strict=True)
            self._action_queue.extend(self.plan(np.stack(clouds), np.stack(states)))
        self._history = history
        return self._action_queue.popleft()

    def plan(self, point_clouds: np.ndarray, states: np.ndarray, noise: np.ndarray | None = None) -> np.ndarray:
        """Actions (n_action_steps, A), to be executed from now on, from the latest steps, oldest first.

        Args:
            point_clouds: (K, N, 3) or (K, N, 6).
            states: (K, S).
            noise: (T, A), Gaussian; drawn if not given.
        """
        if noise is None:
            noise = self._random.standard_normal(self._shapes["noise"], dtype=np.float32)
        return self._run(point_clouds, states, noise)

    def _run(self, *inputs: np.ndarray) -> np.ndarray:
        values = {name: _checked(name, value, self._shapes[name]) for name, value in zip(INPUTS, inputs, strict=True)}
        actions, largest = self._session.run(None, values)
        if not largest <= LARGEST_NORMALISED:
            raise ValueError(
                f"The observation is unlike training's: normalised it must lie within +-{LARGEST_NORMALISED:.0e}, "
                f"got {float(largest):.1e}. Check the sensor."
            )
        if not np.isfinite(actions).all():  # a robot must never get them
            raise ValueError("The actions are NaN or infinite, the inputs are not: the policy's training diverged.")
        return actions


def open_session(model: bytes, name: str, n_threads: int = 1) -> onnxruntime.InferenceSession:
    """Open an ONNX model; a `ValueError` if parts of it lie in other files, which may be any files of the machine."""
    check_version(onnxruntime.__version__)
    if b"location" in model:  # ONNX's word before the path of a weight's file; an exported policy is one file
        raise ValueError(f"'{name}' keeps weights in other files (external data). A policy must be one file.")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = n_threads
    options.add_session_config_entry("session.force_spinning_stop", "1")  # between calls the cores belong to others
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has a class for each reason, and no common one
        raise ValueError(f"'{name}' cannot be opened as an ONNX model: {error}") from error


def check_version(version: str) -> None:
    """Raise a `RuntimeError` if this version of onnxruntime is too old."""
    if tuple(int(part) for part in version.split(".")[:2]) < MIN_ONNXRUNTIME:
        minimum = ".".join(map(str, MIN_ONNXRUNTIME))
        raise RuntimeError(f"onnxruntime must be at least {minimum}, got {version}.")


def _sampled(point_cloud: np.ndarray, n_points: int, n_channels: int) -> np.ndarray:
    points = np.asarray(point_cloud, dtype=np.float32)
    if points.ndim != 2 or points.shape[1] < n_channels or not np.isfinite(points[:, :n_channels]).all():
        return points  # refused by the check that follows
    points = points[:, :n_channels]
    if len(points) <= n_points:
        return points
    xyz = points[:, :3]
    order = np.zeros(n_points, dtype=np.int64)
    distances = np.full(len(points), np.inf, dtype=np.float32)
    for i in range(1, n_points):
        distances = np.minimum(distances, np.square(xyz - xyz[order[i - 1]]).sum(axis=1))
        order[i] = distances.argmax()
    return points[order]


def _checked(name: str, value: np.ndarray, shape: tuple[int, ...] | list[int]) -> np.ndarray:
    array = np.asarray(value, dtype=np.float32)
    if array.shape != tuple(shape):
        raise ValueError(f"'{name}' must have shape {tuple(shape)}, got {array.shape}.")
    if not np.isfinite(array).all():
        raise ValueError(f"'{name}' must be finite, got NaN or infinite values.")
    if np.abs(array).max() > LARGEST:
        raise ValueError(f"'{name}' must lie within +-{LARGEST:.0e}, got {np.abs(array).max():.1e}.")
    return array
