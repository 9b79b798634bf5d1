"""Meta-World's 50 v3 tasks with point-cloud observations, seen by ray casting."""

import json
import warnings
from functools import cache
from importlib.resources import files
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_uca.envs.experts import metaworld_experts
from lerobot_uca.envs.point_cloud_env import Observation, PointCloudEnv
from lerobot_uca.envs.task_names import only_task, resolve_tasks
from lerobot_uca.point_clouds.cameras import Marker
from lerobot_uca.point_clouds.geometry import Array, Camera, Crop

# Meta-World's camera 'corner2' (euler 3.9 2.3 0.6), moved to where DP3, FlowPolicy and MP1 put it. Its axes are
# written out because the camera must exist before the simulator does; a test compares them with the model's.
CORNER2_ROTATION = (
    (-0.5499013297225573, 0.3762077406192429, 0.7457052121767203),
    (-0.8331827568227445, -0.30954914217001317, -0.45824210011200406),
    (0.058438183601257465, -0.8732966646449378, 0.4836712873610),
)


def corner2(width: int, height: int, fovy: float = 60.0) -> Camera:
    """The baselines' camera at a resolution [pixels] and a vertical field of view [deg], by default theirs."""
    return Camera.from_fovy("corner2", (0.6, 0.295, 0.8), CORNER2_ROTATION, fovy=fovy, size=(width, height))


CLOUD_CAMERA = corner2(128, 128)
PICTURE_CAMERA = corner2(160, 160)
# Three tasks have their goal above the baselines' picture (it hangs upside down). Theirs is as fine, and higher.
HIGH_CAMERA = corner2(128, 222, fovy=90.0)
HIGH_TASKS = ("stick-pull", "stick-push", "sweep")


def camera_of(task: str) -> Camera:
    """The camera of a task's cloud."""
    return HIGH_CAMERA if task in HIGH_TASKS else CLOUD_CAMERA


# The crop decides how well a policy learns, because every point on the table, the retaining wall around it or the
# upper arm is one fewer on the task: it is as tight as the 50 tasks' objects and goals allow.
CROP = Crop(low=(-0.5, 0.28, 0.005), high=(0.55, 0.97, 0.5))
# Three tasks have a hole in a raised table (its top at 0.05 m). In two the hole is seen by the table around it.
HOLE_CROP = Crop(low=(-0.25, 0.45, -0.1), high=(0.25, 0.97, 0.5))
# In the third, seen so, 99 of 128 points lie on that table and 1 on the block, and a policy grasps at the same place
# wherever the block is. Its cloud begins above the table, and the goal, down in the hole, is drawn there.
INSERT_CROP = Crop(low=(-0.25, 0.45, 0.0515), high=(0.25, 0.97, 0.5))
CROPS = {"hand-insert": INSERT_CROP, "pick-out-of-hole": HOLE_CROP, "sweep-into": HOLE_CROP}


def crop_of(task: str) -> Crop:
    """The box that holds a task's cloud."""
    return CROPS.get(task, CROP)


def drawn_goal(task: str, goal: Array) -> Array:
    """Where a task's cloud shows a goal (3,) [m]: where it is, but for hand-insert."""
    return goal + np.array([0.0, 0.0, 0.1 if task == "hand-insert" else 0.0])


ARM_JOINTS = ("right_j", "r_close", "l_close")  # how the names of the seven joints and two fingers begin
EPISODE_LENGTH = 200
FPS = 80  # 5 simulation steps of 2.5 ms

# FlowPolicy's list, which has the paper's counts: 21 easy, 4 medium, 4 hard, 5 very hard.
PAPER_TASKS = (
    *("button-press", "button-press-wall", "dial-turn", "door-close", "door-open", "door-unlock", "drawer-close"),
    *("faucet-close", "faucet-open", "handle-press", "handle-pull", "lever-pull", "peg-unplug-side", "plate-slide"),
    *("plate-slide-back", "plate-slide-back-side", "plate-slide-side", "reach", "reach-wall", "window-close"),
    *("window-open", "coffee-pull", "hammer", "peg-insert-side", "soccer", "assembly", "hand-insert", "pick-place"),
    *("push", "disassemble", "pick-place-wall", "shelf-place", "stick-pull", "stick-push"),
)


@cache
def _lerobot_table() -> dict[str, dict[str, Any]]:
    """LeRobot's own table of Meta-World's tasks; read as data, because LeRobot's module loads the simulator."""
    return json.loads(files("lerobot").joinpath("envs", "metaworld_config.json").read_text(encoding="utf-8"))


@cache
def task_descriptions() -> dict[str, str]:
    """The instruction of each of the 50 tasks, in English, by name without '-v3'."""
    return {name.removesuffix("-v3"): text for name, text in _lerobot_table()["TASK_DESCRIPTIONS"].items()}


@cache
def task_groups() -> dict[str, tuple[str, ...]]:
    """Names that stand for several tasks: Meta-World's difficulties, the paper's 34 and all 50."""
    difficulties = {
        group: tuple(name.removesuffix("-v3") for name in names)
        for group, names in _lerobot_table()["DIFFICULTY_TO_TASKS"].items()
    }
    return {**difficulties, "paper": PAPER_TASKS, "all": tuple(task_descriptions())}


def resolve(spec: str | None) -> dict[str, tuple[str, ...]]:
    """Tasks for each comma-separated entry, a task with or without '-v3' or a group: {entry: tasks}.

    Raises:
        UserError: for an empty or unknown entry.
    """
    entries = ",".join(entry.strip().removesuffix("-v3") for entry in (spec or "").split(","))
    return resolve_tasks(entries, benchmark="Meta-World", tasks=task_descriptions(), groups=task_groups())


class MetaworldPointCloudEnv(PointCloudEnv):
    """One Meta-World task, observed as the baselines observe it: a point cloud and the gripper's position.

    Where starts, crops and three tasks' pictures differ from theirs stands in docs/differences.md.

    `agent_pos` (9,) [m, world frame]: positions of the hand, the right and the left finger.
    Action (4,): a motion of the hand by up to 1 cm along x, y and z, and the gripper's effort.
    An episode terminates at the first success and is truncated after 200 steps. Stepping past a success is allowed
    (the demonstrations do), as the simulation itself goes on.

    Args:
        task: a name from `task_descriptions()`, with or without '-v3'.
        n_points: points of the cloud.
        observation: point_cloud, object_cloud or depth.
    """

    benchmark = "Meta-World"
    robot = "base"
    min_successful_steps = 5  # the baselines' rule
    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012 (Gymnasium's own declaration)
    _max_episode_steps = EPISODE_LENGTH  # LeRobot reads it

    def __init__(self, task: str, n_points: int = 512, observation: str = "point_cloud") -> None:
        task = only_task(task, resolve(task))
        super().__init__(
            task,
            task_descriptions()[task],
            n_points=n_points,
            n_states=9,
            n_actions=4,
            observation=observation,
            camera=camera_of(task),
            crop=crop_of(task),
            picture_camera=PICTURE_CAMERA,
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode, which the seed alone decides. Without a seed, one is drawn. Options are ignored."""
        super().reset(seed=seed, options=options)
        # A fresh simulator each time: some tasks keep state of the last episode, and the seed alone must decide.
        self._simulator = _make_simulator(self.task)
        self._simulator.seed(seed if seed is not None else int(self.np_random.integers(2**31)))
        self._simulator.reset()
        _put_at_rest(self._simulator)
        self.expert_observation = self._simulator._get_obs()
        self._n_steps = 0
        return self.observe(), {"is_success": False}

    def act(self, action: NDArray[np.float32]) -> tuple[float, bool, bool, dict[str, Any]]:
        """Execute an action for 12.5 ms of simulated time."""
        action = self._clipped(action)
        self.expert_observation, reward, _, _, info = self._running_simulator().step(action)
        self._n_steps += 1
        success = bool(info["success"])
        return float(reward), success, self._n_steps >= EPISODE_LENGTH, {"is_success": success}

    def render(self) -> NDArray[np.uint8]:
        """The scene as a shaded ray-cast picture, (320, 320, 3) uint8."""
        return super().render()[::-1, ::-1]  # corner2 hangs upside down; people look at this picture, so turn it

    def _agent_pos(self) -> Array:
        fingers = (self._simulator.data.site(name).xpos for name in ("rightEndEffector", "leftEndEffector"))
        return np.concatenate([self._simulator.get_endeff_pos(), *fingers])

    def _markers(self) -> list[Marker]:
        """Meta-World's goal sites. In push, pick-place or reach nothing else shows the goal.

        The baselines' clouds hold them too, since MuJoCo's renderer draws sites.
        """
        model = self._simulator.model
        return [
            Marker(drawn_goal(self.task, np.asarray(centre)), model.site(name).size[0], model.site(name).rgba[:3])
            for name, centre in self._simulator._target_site_config
            if model.site(name).rgba[3] > 0
        ]


class ScriptedExpert:
    """The scripted demonstrator of a task: Meta-World's, without noise, or one of ours.

    It sees the simulator's state, not the cloud.

    Args:
        task: its name, without '-v3'.
        straight_paths: whether the hand goes horizontally straight to where it wants to be, at most at full speed, the
            same in all directions. Otherwise x and y are limited one by one, as the environment does: far from its aim
            the hand goes diagonally, up to 1.4 times as fast, and the last part along one axis.
    """

    def __init__(self, task: str, *, straight_paths: bool = False) -> None:
        from metaworld.policies import ENV_POLICY_MAP  # slow to import, and not needed to read a configuration

        experts: Any = ENV_POLICY_MAP
        self._policy: Any = (metaworld_experts.EXPERTS.get(task) or experts[f"{task}-v3"])()
        self._straight_paths = straight_paths

    def __call__(self, env: MetaworldPointCloudEnv) -> NDArray[np.float32]:
        """The action (4,) in [-1, 1], limited as the environment would or, for straight paths, (x, y) to length 1."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # 'constants may be too high': that is what the clip is for
            action = np.array(self._policy.get_action(env.expert_observation), np.float64)
        if self._straight_paths:
            action[:2] /= max(1.0, np.hypot(*action[:2]))
        return np.clip(action, -1, 1).astype(np.float32)


def _put_at_rest(simulator: Any) -> None:
    """Let an episode begin with its objects upright and still, where Meta-World's reset has put them.

    It resets twice, the second time with the model as the first has edited it, where things may collide while the hand
    finds its place, and then sets positions: a ring stays turned by up to 143 degrees (disassemble, 7 of 25 starts), a
    plug keeps turning, and the thermos slides by 19 cm because its velocity is addressed by its position's index.
    """
    model, data = simulator.model, simulator.data
    for joint in map(model.joint, range(model.njnt)):
        if joint.name.startswith(ARM_JOINTS):
            continue
        state = data.joint(joint.id)
        state.qvel[:] = 0
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            state.qpos[3:] = joint.qpos0[3:]  # its quaternion
    # Meta-World moves bodies by editing the model and leaves the poses in the data behind.
    mujoco.mj_forward(model, data)
    simulator._prev_obs = simulator._get_curr_obs_combined_no_goal()  # the expert sees no motion either


def _make_simulator(task: str) -> Any:
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS  # slow to import, and not needed to read a configuration

    simulator = ALL_V3_ENVIRONMENTS[f"{task}-v3"]()
    simulator._set_task_called = True  # set_task() would freeze the objects; the seed decides instead
    simulator._freeze_rand_vec = False
    simulator.seeded_rand_vec = True
    simulator._partially_observable = False  # the expert needs the goal; the policy sees only cloud and gripper
    simulator.__dict__.pop("sawyer_observation_space", None)  # computed before, with the goal's bounds at zero
    return simulator
