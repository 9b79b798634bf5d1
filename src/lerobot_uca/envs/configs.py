"""LeRobot's configurations of the environments: what `--env.type=...` finds."""

import logging
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, override

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, _LazyAsyncVectorEnv, freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_STATE, OBS_STR

from lerobot_uca.bounds import check_bounds, within
from lerobot_uca.envs import adroit, metaworld
from lerobot_uca.envs.experts import adroit_experts, metaworld_experts
from lerobot_uca.envs.experts.expert import Attempt, attempts_by_seed
from lerobot_uca.envs.observers import depth_name, observer_of
from lerobot_uca.envs.point_cloud_env import PointCloudEnv
from lerobot_uca.errors import UserError
from lerobot_uca.features import OBJECT_CLOUD, OBS_POINT_CLOUD, POINT_CLOUD
from lerobot_uca.point_clouds.calibration import Calibration
from lerobot_uca.point_clouds.geometry import Camera, Crop
from lerobot_uca.point_clouds.recipe import SIMULATED, CloudRecipe, DepthSource
from lerobot_uca.processes import kill_at_the_end, signals_put_off
from lerobot_uca.registry import register

logger = logging.getLogger(__name__)


@dataclass
class PointCloudEnvConfig(EnvConfig):
    """Base of the point-cloud environments: features, task names and vector environments."""

    # Points of each cloud.
    n_points: int = within(512, least=1, most=100_000)
    # The observation besides the robot's state: point_cloud; object_cloud, which leaves out the robot's own points; or
    # depth, the image that a point_cloud is made from.
    observation: str = POINT_CLOUD

    def __post_init__(self) -> None:
        with suppress(UserError):  # of wrong tasks; validate() tells it, here draccus would swallow the message
            self.features = {
                ACTION: PolicyFeature(FeatureType.ACTION, (len(self.action_names()),)),
                "agent_pos": PolicyFeature(FeatureType.STATE, (len(self.state_names()),)),
            }
            self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE}
            if self.observation == "depth":
                for camera, _ in self._views():
                    name = depth_name(camera)
                    self.features[name] = PolicyFeature(FeatureType.VISUAL, (camera.height, camera.width, 1))
                    self.features_map[name] = f"{OBS_STR}.{name}"
            else:
                self.features["point_cloud"] = PolicyFeature(FeatureType.STATE, (self.n_points, 3))
                self.features_map["point_cloud"] = OBS_POINT_CLOUD

    @abstractmethod
    def tasks(self) -> dict[str, tuple[str, ...]]:
        """The tasks by suite: each entry of `task` is one."""

    @abstractmethod
    def env_factory(self, task: str) -> Callable[[], PointCloudEnv]:
        """Makes one environment of one task; light to send to another process."""

    @abstractmethod
    def attempts(
        self, task: str, expert: str | None, first_seed: int, *, straight_paths: bool = False
    ) -> Iterator[Attempt]:
        """Tries at demonstrations of one task, by the expert that a user has named, from a seed upwards.

        Raises:
            UserError: if there is no such expert, or straight paths are asked of one that moves no hand.
        """

    @abstractmethod
    def view(self, task: str) -> tuple[Camera, Crop]:
        """The camera that sees a task, and the crop of its cloud."""

    def _views(self) -> list[tuple[Camera, Crop]]:
        """The different views of all tasks."""
        return list(dict.fromkeys(self.view(task) for tasks in self.tasks().values() for task in tasks))

    def recipe(self) -> CloudRecipe | None:
        """The recipe for clouds from depth images; None if the tasks differ in camera or crop, or clouds are others."""
        views = self._views()
        if len(views) != 1 or self.observation == OBJECT_CLOUD:
            return None
        ((camera, crop),) = views
        calibration = Calibration(camera, serial=SIMULATED, method=SIMULATED)
        return CloudRecipe((DepthSource(f"{OBS_STR}.{depth_name(camera)}", calibration),), crop, self.n_points)

    @abstractmethod
    def task_description(self, task: str) -> str:
        """A task's instruction, in English."""

    @abstractmethod
    def action_names(self) -> list[str]:
        """Names of an action's numbers."""

    @abstractmethod
    def state_names(self) -> list[str]:
        """Names of the numbers of `agent_pos`."""

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Unused: these environments are not made by name."""
        return {}

    def validate(self) -> None:
        """Raise a `UserError` for what cannot be made."""
        check_bounds(self, "env")
        if self.fps != type(self).fps:  # datasets would tell the wrong time
            raise UserError(f"env.fps of {self.type} is {type(self).fps}, the simulation's own; got {self.fps}.")
        if self.max_parallel_tasks != 1:
            raise UserError(
                f"env.max_parallel_tasks must be 1, got {self.max_parallel_tasks}: LeRobot's parallel tasks are "
                "threads that share one policy, which remembers one episode. eval.batch_size runs episodes at once."
            )
        observer_of(self.observation)
        self.tasks()
        if self.observation == "depth" and self.recipe() is None:
            raise UserError(
                f"env.observation=depth needs tasks of one camera and one crop, got {len(self._views())} in "
                f"'{self.task}'."
            )

    @override
    def get_env_processors(self) -> tuple[Any, Any]:
        """Empty processors. Training asks for them before its first step, so that a wrong task is refused at once."""
        self.validate()
        return super().get_env_processors()

    @override
    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """{suite: {task_id: n_envs environments}}. Processes start, and simulators load, at the first reset."""
        self.validate()
        return {
            suite: {
                task_id: _vectorize(self.env_factory(task), n_envs, use_async_envs)
                for task_id, task in enumerate(tasks)
            }
            for suite, tasks in self.tasks().items()
        }


def _vectorize(make: Callable[[], gym.Env], n_envs: int, use_async_envs: bool) -> gym.vector.VectorEnv:
    # LeRobot waits for the slowest of a batch; an environment that has finished must not go on simulating.
    if use_async_envs and n_envs > 1:
        return _AsyncVectorEnv([make] * n_envs)  # freezes by itself
    return _SyncVectorEnv([freeze_after_episode_end(make)] * n_envs)


class _ResetsAll:
    """A vector environment whose reset begins episodes in all of its environments, also in those that are frozen.

    Unfrozen they are by LeRobot's option alone, which a loop of somebody else does not pass.
    """

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None) -> Any:
        parent: Any = super()
        return parent.reset(seed=seed, options={**(options or {}), NEW_ROLLOUT_OPTION: True})


class _SyncVectorEnv(_ResetsAll, gym.vector.SyncVectorEnv):
    """Gymnasium's."""


class _AsyncVectorEnv(_ResetsAll, _LazyAsyncVectorEnv):
    """LeRobot's, whose workers do not complain when a signal ends the command."""

    def _ensure(self) -> None:
        if self._env is None:
            with signals_put_off():
                super()._ensure()
            env: Any = self._env
            kill_at_the_end(env.processes)


@register(EnvConfig, "metaworld_pointcloud")
@dataclass
class MetaworldPointCloudConfig(PointCloudEnvConfig):
    """Meta-World's v3 tasks, by name with or without '-v3', or easy, medium, hard, very_hard, paper, all."""

    # One task, several separated by commas, or a group.
    task: str | None = "drawer-close"
    # The simulation's own rate; it cannot be changed.
    fps: int = metaworld.FPS

    @override
    def tasks(self) -> dict[str, tuple[str, ...]]:
        return metaworld.resolve(self.task)

    @override
    def env_factory(self, task: str) -> Callable[[], PointCloudEnv]:
        return partial(metaworld.MetaworldPointCloudEnv, task, n_points=self.n_points, observation=self.observation)

    @override
    def view(self, task: str) -> tuple[Camera, Crop]:
        return metaworld.camera_of(task), metaworld.crop_of(task)

    @override
    def attempts(
        self, task: str, expert: str | None, first_seed: int, *, straight_paths: bool = False
    ) -> Iterator[Attempt]:
        if expert:
            raise UserError(f"Meta-World's experts are built in. Leave --expert out, got '{expert}'.")
        if task in metaworld_experts.EXPERTS:
            logger.warning("%s is demonstrated by this package's expert; Meta-World's does worse.", task)
        return attempts_by_seed(partial(metaworld.ScriptedExpert, task, straight_paths=straight_paths), first_seed)

    @override
    def task_description(self, task: str) -> str:
        return metaworld.task_descriptions()[task]

    @override
    def action_names(self) -> list[str]:
        return ["x", "y", "z", "gripper"]

    @override
    def state_names(self) -> list[str]:
        return [f"{part}_{axis}" for part in ("hand", "right_finger", "left_finger") for axis in "xyz"]


@register(EnvConfig, "adroit_pointcloud")
@dataclass
class AdroitPointCloudConfig(PointCloudEnvConfig):
    """Adroit's dexterous tasks: hammer, door, pen, relocate, or paper (the first three), all."""

    # One task, several separated by commas, or a group.
    task: str | None = "door"
    # Points of each cloud.
    n_points: int = within(1024, least=1, most=100_000)
    # The rate of actions, each of which is repeated twice; it cannot be changed.
    fps: int = adroit.FPS
    # The measure of success. final: the goal is reached when the episode's time is over, as in the papers.
    # any: the goal is reached at any time, as in gymnasium-robotics.
    success: str = "final"

    @override
    def validate(self) -> None:
        super().validate()
        adroit.judge_of(self.success)

    @override
    def tasks(self) -> dict[str, tuple[str, ...]]:
        return adroit.resolve(self.task)

    @override
    def env_factory(self, task: str) -> Callable[[], PointCloudEnv]:
        return partial(
            adroit.AdroitPointCloudEnv,
            task,
            n_points=self.n_points,
            success=self.success,
            joints=self.action_names(),
            observation=self.observation,
        )

    @override
    def view(self, task: str) -> tuple[Camera, Crop]:
        return adroit.TASKS[task].camera, adroit.TASKS[task].crop

    @override
    def attempts(
        self, task: str, expert: str | None, first_seed: int, *, straight_paths: bool = False
    ) -> Iterator[Attempt]:
        if straight_paths:
            raise UserError(
                "--straight_paths needs an expert that moves a hand along x and y, as metaworld_pointcloud's do; "
                "Adroit's move joints."
            )
        return adroit_experts.attempts(task, expert, first_seed)

    @override
    def task_description(self, task: str) -> str:
        return adroit.TASKS[task].description

    @override
    def action_names(self) -> list[str]:
        """The joints of all the tasks, since several tasks share one action."""
        used = {joint for tasks in self.tasks().values() for task in tasks for joint in adroit.TASKS[task].joints}
        return [joint for joint in adroit.ARM + adroit.HAND if joint in used]

    @override
    def state_names(self) -> list[str]:
        return list(adroit.HAND)
