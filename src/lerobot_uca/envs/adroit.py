"""Adroit's dexterous tasks (gymnasium-robotics) with point-cloud observations, seen by ray casting.

A Shadow hand of 24 joints on an arm of 0 to 6 joints. The physics is that of the papers' environment.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.envs.point_cloud_env import Observation, PointCloudEnv
from lerobot_uca.envs.task_names import only_task, resolve_tasks
from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.cameras import Marker
from lerobot_uca.point_clouds.geometry import Array, Camera, Crop

ACTION_REPEAT = 2
FPS = 50  # 2 environment steps of 10 ms

ARM = ("ARTx", "ARTy", "ARTz", "ARRx", "ARRy", "ARRz")  # translation [m] and rotation [rad]; most tasks have fewer
HAND = (
    *("WRJ1", "WRJ0", "FFJ3", "FFJ2", "FFJ1", "FFJ0", "MFJ3", "MFJ2", "MFJ1", "MFJ0", "RFJ3", "RFJ2", "RFJ1", "RFJ0"),
    *("LFJ4", "LFJ3", "LFJ2", "LFJ1", "LFJ0", "THJ4", "THJ3", "THJ2", "THJ1", "THJ0"),
)

DOWN = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_C = np.sqrt(0.5)
TILTED = ((1.0, 0.0, 0.0), (0.0, _C, -_C), (0.0, _C, _C))  # 45 deg about x: forward and down

PICTURE_CAMERA = Camera.from_fovy("vil_camera", (0.0, -1.2, 1.2), TILTED, fovy=45.0, size=(160, 160))


class Outcome(NamedTuple):
    """The result of an action, as the simulator reports it."""

    observation: Array
    """The simulator's own."""
    is_reached: bool
    """The simulator calls the goal reached."""
    is_last: bool
    """The episode's time is over."""


class Task(NamedTuple):
    """One task's simulator, camera and measures of success.

    Args:
        description: what it asks for, in English.
        simulator: the class in gymnasium-robotics.
        arm: the arm's joints, in the order of its actions.
        camera, crop: what the cloud is seen with, and what belongs to it.
        papers_goal: whether the papers' environment calls the goal reached.
        papers_end: whether the papers' environment ends the episode before its time.
        episode_length: in actions.
    """

    description: str
    simulator: str
    arm: tuple[str, ...]
    camera: Camera
    crop: Crop
    papers_goal: Callable[[Outcome], bool] = lambda outcome: outcome.is_reached
    papers_end: Callable[[Outcome], bool] = lambda _: False
    episode_length: int = 100

    @property
    def joints(self) -> tuple[str, ...]:
        """The joint that each number of the task's action moves."""
        return self.arm + HAND


def top(height: float, pixels: int) -> Camera:
    """The baselines' camera above the table at a height [m], looking down."""
    return Camera.from_fovy("top", (0.0, 0.0, height), DOWN, fovy=45.0, size=(pixels, pixels))


# The baselines cast 84 x 84 rays and fill up with zeros where too few points are left of a hammer or a pen. More rays
# are cast here: as many as give 1024 different points. The crops hold what hand and objects reach in the experts'
# episodes, with a margin, without the table (its top is at z = 0) and most of the forearm.
TASKS = {
    "hammer": Task(
        "pick up the hammer and drive the nail into the board",
        "AdroitHandHammerEnv",
        ARM[3:5],
        top(1.1, 160),
        Crop((-0.35, -0.38, 0.005), (0.3, 0.12, 0.4)),
    ),
    "door": Task(
        "undo the latch and open the door",
        "AdroitHandDoorEnv",
        ARM[2:],
        top(1.5, 96),
        Crop((-0.25, -0.65, 0.005), (0.6, 0.52, 0.65)),
        papers_goal=lambda outcome: bool(outcome.observation[28] > 1.4),  # hinge [rad]
    ),
    "pen": Task(
        "turn the pen in the hand until it points where the other pen points",
        "AdroitHandPenEnv",
        (),
        Camera.from_fovy("tilted", (0.0, -0.8, 0.8), TILTED, fovy=45.0, size=(192, 192)),
        Crop((-0.17, -0.34, 0.05), (0.28, -0.04, 0.4)),
        # cosine of the angle between the axes of both pens
        papers_goal=lambda outcome: bool(outcome.observation[33:36] @ outcome.observation[36:39] > 0.95),
        papers_end=lambda outcome: bool(outcome.observation[26] < 0.075),  # height of the pen [m]: it was dropped
        episode_length=50,
    ),
    "relocate": Task(
        "pick up the ball and carry it to the target in the air",
        "AdroitHandRelocateEnv",
        ARM,
        top(1.1, 180),
        Crop((-0.35, -0.45, 0.005), (0.35, 0.45, 0.5)),
    ),
}
PAPER_TASKS = ("hammer", "door", "pen")


def resolve(spec: str | None) -> dict[str, tuple[str, ...]]:
    """Tasks for each comma-separated entry, a task or a group: {entry: tasks}.

    Raises:
        UserError: for an empty or unknown entry.
    """
    return resolve_tasks(spec, benchmark="Adroit", tasks=TASKS, groups={"paper": PAPER_TASKS, "all": tuple(TASKS)})


class Verdict(NamedTuple):
    """An environment's report on an outcome."""

    terminated: bool
    is_success: bool


def judge_final(task: Task, outcome: Outcome) -> Verdict:
    """The papers' success: the goal is reached when the episode's time is over.

    Their code also counts a pen that points the right way in the very step in which it falls; here it does not.
    """
    failed = task.papers_end(outcome)
    return Verdict(failed, outcome.is_last and not failed and task.papers_goal(outcome))


def judge_any(_: Task, outcome: Outcome) -> Verdict:
    """gymnasium-robotics' success: the goal is reached after any action."""
    return Verdict(outcome.is_reached, outcome.is_reached)


SUCCESS = {"final": judge_final, "any": judge_any}


def judge_of(success: str) -> Callable[[Task, Outcome], Verdict]:
    """The measure of success of that name in `SUCCESS`.

    Raises:
        UserError: for another name.
    """
    if success not in SUCCESS:
        raise UserError(f"env.success must be one of {', '.join(SUCCESS)}, got '{success}'.")
    return SUCCESS[success]


class AdroitPointCloudEnv(PointCloudEnv):
    """One Adroit task, observed as the baselines observe it: a point cloud and the hand's joints.

    `agent_pos` (24,) [rad]: positions of the joints `HAND`.
    Action: targets of the joints, [-1, 1] for each joint's range, held for 20 ms of simulated time.
    An episode is truncated after 100 actions (pen: 50) and terminates when the pen is dropped (`final`) or at the
    first success (`any`). Stepping past a success is allowed.

    Args:
        task: hammer, door, pen or relocate.
        n_points: points of the cloud.
        success: a key of `SUCCESS`.
        joints: what each number of an action moves, if it shall be more than the task's own joints, as in a dataset
            of several tasks. Numbers for joints that the task does not have are ignored.
    """

    benchmark = "Adroit"
    robot = "forearm"
    min_successful_steps = 1
    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012 (Gymnasium's own declaration)

    def __init__(
        self,
        task: str,
        n_points: int = 1024,
        success: str = "final",
        joints: Sequence[str] | None = None,
        observation: str = "point_cloud",
    ) -> None:
        task = only_task(task, resolve(task))
        self._task = TASKS[task]
        joints = self._task.joints if joints is None else joints
        super().__init__(
            task,
            self._task.description,
            n_points=n_points,
            observation=observation,
            n_states=len(HAND),
            n_actions=len(joints),
            camera=self._task.camera,
            crop=self._task.crop,
            picture_camera=PICTURE_CAMERA,
        )
        self._own_joints = [joints.index(joint) for joint in self._task.joints]
        self._judge = judge_of(success)
        self.succeeds_at_the_end = success == "final"
        self._max_episode_steps = self._task.episode_length  # LeRobot reads it

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode. The seed decides which, or `initial_state_dict` in the options: gymnasium-robotics' own."""
        super().reset(seed=seed, options=options)
        if self._simulator is None:
            self._simulator = make_simulator(self.task)
        simulator = self._simulator
        state = (options or {}).get("initial_state_dict")
        if state is not None and not simulator._state_space.contains(state):
            fields, got = (_fields(arrays) for arrays in (simulator._state_space.sample(), state))
            raise UserError(f"Adroit {self.task}: an initial state has {fields}, got {got}.")
        self.expert_observation, _ = simulator.reset(seed=seed, options=options)
        self._n_steps = 0
        return self.observe(), {"is_success": False}

    def act(self, action: NDArray[np.float32]) -> tuple[float, bool, bool, dict[str, Any]]:
        """Execute an action for 20 ms of simulated time."""
        own_action = self._clipped(action)[self._own_joints]
        simulator = self._running_simulator()
        rewards = 0.0
        for _ in range(ACTION_REPEAT):
            self.expert_observation, reward, _, _, info = simulator.step(own_action)
            rewards += reward
        # MuJoCo leaves the bodies where they were one substep before the joints.
        mujoco.mj_kinematics(simulator.model, simulator.data)
        self._n_steps += 1
        truncated = self._n_steps >= self._max_episode_steps
        verdict = self._judge(self._task, Outcome(self.expert_observation, bool(info["success"]), truncated))
        return float(rewards), verdict.terminated, truncated, {"is_success": verdict.is_success}

    def from_own(self, action: Array) -> NDArray[np.float32]:
        """The environment's action for one of the task's own joints: clipped, and 0 for joints of other tasks."""
        wide = np.zeros(self.n_actions, dtype=np.float32)
        wide[self._own_joints] = np.clip(action, -1, 1)
        return wide

    def _agent_pos(self) -> Array:
        n_arm = len(self._task.arm)
        return self._simulator.data.qpos[n_arm : n_arm + len(HAND)]

    def _markers(self) -> list[Marker]:
        """The target of relocate, which no geom shows.

        It is drawn smaller than its site of 7 cm, which would hide the ball that has arrived.
        """
        if self.task != "relocate":
            return []
        site = self._simulator.data.site("target")
        return [Marker(site.xpos, 0.02, np.array([0.0, 1.0, 0.0]))]


def _fields(state: Any) -> str:
    if not isinstance(state, dict):
        return type(state).__name__
    return ", ".join(f"{name} ({np.size(state[name])})" for name in sorted(state))


def make_simulator(task: str) -> Any:
    """gymnasium-robotics' environment of a task, without its wrappers."""
    # Slow to import, and not needed to read a configuration.
    from farama_notifications import notifications

    notifications.pop("gymnasium_robotics", None)  # printed at each import, about rewards, which nothing here uses
    from gymnasium_robotics.envs import adroit_hand

    return getattr(adroit_hand, TASKS[task].simulator)()
