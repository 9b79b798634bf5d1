"""Base of the simulated tasks with point-cloud observations. A benchmark adds its simulator and its data."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.envs.observers import Observer, observer_of
from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.cameras import Marker, PictureCamera
from lerobot_uca.point_clouds.geometry import Array, Camera, Crop

PICTURE_ZOOM = 2  # each ray becomes 2 x 2 pixels: 320 x 320 is large enough to look at, and four times cheaper

Observation = dict[str, NDArray[Any]]


class PointCloudEnv(gym.Env[Any, Any]):
    """One task of a MuJoCo benchmark, observed as a point cloud, or a depth image, and the robot's own state.

    Observation:
        point_cloud: (n_points, 3) float32, world frame [m], with or without the robot, or
        images.<camera>_depth: (1, height, width) uint16 [mm]; see `OBSERVERS`.
        agent_pos: (n_states,) float32, the robot's own state, in the benchmark's units.
    Action: (n_actions,) float32 in [-1, 1]; what lies outside is clipped.
    The simulator is created at the first reset, so that vector environments build it in their workers.

    Args:
        task: its name.
        description: what it asks for, in English.
        n_points, n_states, n_actions: lengths of cloud, agent_pos and action.
        observation: what is observed besides agent_pos, a key of `OBSERVERS`.
        camera: what the scene is observed with.
        crop: what belongs to the cloud.
        picture_camera: what people see the task with.
    """

    benchmark: ClassVar[str]
    robot: ClassVar[str]
    """The body that the whole robot hangs on."""
    min_successful_steps: ClassVar[int]
    """Successful steps that make an episode a demonstration."""
    succeeds_at_the_end: bool = False
    """Whether success is decided after the last action alone."""
    render_mode = "rgb_array"

    def __init__(
        self,
        task: str,
        description: str,
        *,
        n_points: int,
        n_states: int,
        n_actions: int,
        observation: str,
        camera: Camera,
        crop: Crop,
        picture_camera: Camera,
    ) -> None:
        self.task, self.task_description = task, description
        self.n_points, self.crop = n_points, crop
        self.observer: Observer = observer_of(observation)(camera, crop, n_points, self.robot)
        self.observation_space = gym.spaces.Dict(
            {
                self.observer.key: self.observer.space,
                "agent_pos": gym.spaces.Box(-np.inf, np.inf, (n_states,), np.float32),
            }
        )
        self.n_actions = n_actions
        self.action_space = gym.spaces.Box(-1, 1, (n_actions,), np.float32)
        self.expert_observation: Any = None
        """The simulator's own observation after the last reset or step, goal included: for experts."""
        self._simulator: Any = None
        self._picture_camera = picture_camera
        self._picture: PictureCamera | None = None
        self._n_steps = 0

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Execute an action and observe what it has led to."""
        reward, terminated, truncated, info = self.act(action)
        return self.observe(), reward, terminated, truncated, info

    @abstractmethod
    def act(self, action: NDArray[np.float32]) -> tuple[float, bool, bool, dict[str, Any]]:
        """Execute an action without observing: reward, terminated, truncated and info, as `step` returns them.

        Observing takes most of a step, and a policy that plans several actions ahead does not look at all of them.
        """

    def observe(self) -> Observation:
        """The present state. Asking twice gives the same twice."""
        simulator = self._running_simulator()
        try:
            seen = self.observer(simulator.model, simulator.data, self._markers())
        except UserError as error:
            raise UserError(f"{self.benchmark} {self.task}: {error}") from error
        return {self.observer.key: seen, "agent_pos": self._agent_pos().astype(np.float32)}

    def render(self) -> NDArray[np.uint8]:
        """The scene as a shaded ray-cast picture, (320, 320, 3) uint8."""
        simulator = self._running_simulator()
        self._picture = self._picture or PictureCamera(self._picture_camera)
        picture = self._picture.capture(simulator.model, simulator.data, self._markers())
        return picture.repeat(PICTURE_ZOOM, axis=0).repeat(PICTURE_ZOOM, axis=1)

    def close(self) -> None:
        """Free the simulator; a later reset makes a new one."""
        self._simulator = None

    @abstractmethod
    def _agent_pos(self) -> Array:
        """The robot's own state, (n_states,)."""

    def _markers(self) -> Sequence[Marker]:
        """Goals that no geom shows."""
        return ()

    def _clipped(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """The action as it is executed."""
        if np.shape(action) != (self.n_actions,) or not np.all(np.isfinite(action)):
            raise UserError(
                f"{self.benchmark} {self.task}: an action must be {self.n_actions} finite numbers, got {action}."
            )
        return np.clip(action, -1, 1)

    def _running_simulator(self) -> Any:
        if self._simulator is None:
            raise UserError(f"{self.benchmark} {self.task}: call reset() first.")
        return self._simulator
