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

    LeRobot tells a teleoperator nothing about episodes. So both last the times that the recording was given, from the
    first action that is asked for in each: demonstration, holding still, then home with new places for the things.
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
        self._episode = -1
        self._is_demonstrating = False
        self._began = -np.inf
        self._n_sent = 0
        self._path: Array = np.array([[*HOME, 0.0]])
        self._last: Array = self._path[-1]

    @property
    def action_features(self) -> dict[str, type]:
        """As the robot's."""
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
        if now - self._began > lasts - 0.5 / config.fps:
            self._begin_reset() if self._is_demonstrating else self._begin_demonstration()
            self._began = self._clock()  # planning takes its time
            self._n_sent = 0
        # A row for each call, not for each moment: a computer that falls behind makes the motion slower, never jerky.
        row = self._last = self._path[min(self._n_sent, len(self._path) - 1)]
        self._n_sent += 1
        return dict(zip((*JOINT_KEYS, GRIPPER_KEY), row.tolist(), strict=True))

    def _begin_demonstration(self) -> None:
        assert self._client is not None
        self._is_demonstrating = True
        self._episode += 1
        objects = self._client.ask(request="reset", task=self.config.task, seed=self.config.seed + self._episode)
        self._path = plan(self.config.task, objects, self.config.fps)
        longest = self.config.episode_time_s
        if len(self._path) > longest * self.config.fps:
            raise UserError(
                f"The demonstration takes {len(self._path) / self.config.fps:.1f} s: episode_time_s has to be longer, "
                f"got {longest}."
            )

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
