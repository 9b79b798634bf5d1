"""The demonstrator as a LeRobot teleoperator."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from lerobot.lerobot_types import RobotAction
from lerobot.teleoperators import Teleoperator
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from lerobot_uca.errors import UserError
from lerobot_uca.robots.ur5e.kinematics import Array
from lerobot_uca.robots.ur5e.sim.config_scripted_teleoperator import ScriptedTeleoperatorConfig
from lerobot_uca.robots.ur5e.sim.demonstrator import plan, way_home
from lerobot_uca.robots.ur5e.sim.robot import HOME
from lerobot_uca.robots.ur5e.sim.scene import TASKS
from lerobot_uca.robots.ur5e.sim.scene_service import SceneClient
from lerobot_uca.robots.ur5e.ur5e_follower import GRIPPER_KEY, JOINT_KEYS


class ScriptedTeleoperator(Teleoperator):
    """Alternates between a demonstration and a reset, as `lerobot-record` does.

    LeRobot tells a teleoperator nothing about episodes. So both last the times that the recording was given:
    demonstration, holding still, then home with new places for the things. A phase that begins two steps late leaves
    the arm still for so long. One that began a step early, in the reset's last one, would be over by the time that
    LeRobot needs to save before the episode's end, and the next ones ever earlier. Hence late ones, which are counted
    from their second step.
    """

    config_class = ScriptedTeleoperatorConfig
    name = "ur5e_scripted"

    def __init__(self, config: ScriptedTeleoperatorConfig, clock: Callable[[], float] = time.perf_counter) -> None:
        if config.task not in TASKS:
            raise UserError(f"teleop.task is one of {', '.join(TASKS)}, got '{config.task}'.")
        super().__init__(config)
        self.config = config
        self._clock = clock
        self._client: SceneClient | None = None
        self._episode = 0
        self._prepared: Array | None = None
        self._is_demonstrating = False
        self._began = -np.inf
        self._n_sent = 0
        self._path: Array = np.array([[*HOME, 0.0]])
        self._last: Array = self._path[-1]

    @property
    def action_features(self) -> dict[str, type]:
        """The same as the robot's."""
        return dict.fromkeys((*JOINT_KEYS, GRIPPER_KEY), float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """It feels nothing."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether it knows where the things are."""
        return self._client is not None

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Look at the simulated world."""
        del calibrate
        self._client = SceneClient(self.config.ip)
        self._prepared = self._prepare()

    @property
    def is_calibrated(self) -> bool:
        """Always."""
        return True

    def calibrate(self) -> None:
        """It needs none."""

    def configure(self) -> None:
        """It needs nothing."""

    @check_if_not_connected
    def get_action(self) -> RobotAction:
        """The next row of the path; its last one until the time is over."""
        config, now = self.config, self._clock()
        lasts = config.episode_time_s if self._is_demonstrating else config.reset_time_s
        if now - self._began > lasts + 1 / config.fps:
            self._begin_reset() if self._is_demonstrating else self._begin_demonstration()
            self._n_sent = 0
        if self._n_sent <= 1:
            self._began = now
        # A row for each call, not for each moment: a computer that falls behind makes the motion slower, never jerky.
        row = self._last = self._path[min(self._n_sent, len(self._path) - 1)]
        self._n_sent += 1
        if not self._is_demonstrating and self._n_sent == len(self._path):
            self._prepared = (
                self._prepare()
            )  # at home, where it is in no thing's way; not in the episode, which would begin late
        return dict(zip((*JOINT_KEYS, GRIPPER_KEY), row.tolist(), strict=True))

    def _prepare(self) -> Array:
        """Put the things where the next episode begins, and plan it."""
        assert self._client is not None
        config = self.config
        objects = self._client.ask(request="reset", task=config.task, seed=config.seed + self._episode)
        self._episode += 1
        path = plan(config.task, objects, config.fps)
        if len(path) > config.episode_time_s * config.fps:
            raise UserError(
                f"The demonstration takes {len(path) / config.fps:.1f} s: episode_time_s has to be longer, "
                f"got {config.episode_time_s}."
            )
        return path

    def _begin_demonstration(self) -> None:
        # The path is not prepared if the reset was too short for the way home.
        self._path = self._prepare() if self._prepared is None else self._prepared
        self._is_demonstrating, self._prepared = True, None

    def _begin_reset(self) -> None:
        self._is_demonstrating = False
        self._path = way_home(self._last[:6], self.config.fps)

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """It feels nothing."""

    def disconnect(self) -> None:
        """Look away."""
        if self._client is not None:
            self._client.close()
            self._client = None
