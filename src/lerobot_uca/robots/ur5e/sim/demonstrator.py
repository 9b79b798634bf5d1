"""Demonstrations of the simulated tasks: joint paths from what is where. Pure functions."""

import math
from dataclasses import dataclass

import numpy as np

from lerobot_uca.errors import UserError
from lerobot_uca.robots.ur5e.kinematics import (
    Array,
    flange_pose,
    inverse_kinematics,
    rotation_matrix,
)
from lerobot_uca.robots.ur5e.sim.robot import HOME
from lerobot_uca.robots.ur5e.sim.scene import BOX_POSITION, DRAWER_POSITION, TOOL_LENGTH

SPEED = 0.2  # [m/s]
TURNING_SPEED = 0.8  # [rad/s]
OPEN, CLOSED = 0.0, 1.0
GRASP_HEIGHT, TRAVEL_HEIGHT, RELEASE_HEIGHT = 0.02, 0.16, 0.09  # [m], of the point between the fingertips
DRAWER_HEIGHT = 0.08  # [m]
FRONT = 0.106  # [m], from the cabinet's middle to the closed drawer's front
FINGERS = 0.02  # [m], how thick closed fingers are where they push, from their middle


@dataclass(frozen=True)
class Waypoint:
    """A pose of the tool, which points down, and the gripper's action there."""

    position: tuple[float, float, float]  # [m], base frame
    yaw: float = 0.0  # [rad], about the base's z axis, from the tool's direction at home
    gripper: float = OPEN
    wait: float = 0.0  # [s], there


def waypoints(task: str, objects: dict[str, list[float]]) -> list[Waypoint]:
    """The way that solves a task.

    Args:
        task: pick_place or drawer_close.
        objects: as `Scene.objects` gives them.
    """
    if task == "drawer_close":
        x = float(DRAWER_POSITION[0])
        closed = float(DRAWER_POSITION[1]) + FRONT
        before = closed + objects["drawer"][0] + 0.07
        return [
            Waypoint((x, before, TRAVEL_HEIGHT), gripper=CLOSED),
            Waypoint((x, before, DRAWER_HEIGHT), gripper=CLOSED),
            Waypoint((x, closed + FINGERS - 0.01, DRAWER_HEIGHT), gripper=CLOSED, wait=0.3),
            Waypoint((x, closed + 0.06, DRAWER_HEIGHT), gripper=CLOSED),
        ]
    x, y, _, yaw = objects["cube"]
    yaw = (yaw + math.pi / 4) % (math.pi / 2) - math.pi / 4  # a cube looks the same after a quarter turn
    to = (float(BOX_POSITION[0]), float(BOX_POSITION[1]))
    return [
        Waypoint((x, y, TRAVEL_HEIGHT), yaw),
        Waypoint((x, y, GRASP_HEIGHT), yaw, wait=0.2),
        Waypoint((x, y, GRASP_HEIGHT), yaw, CLOSED, wait=0.7),
        Waypoint((x, y, TRAVEL_HEIGHT), yaw, CLOSED),
        Waypoint((*to, TRAVEL_HEIGHT), 0.0, CLOSED),
        Waypoint((*to, RELEASE_HEIGHT), 0.0, CLOSED, wait=0.2),
        Waypoint((*to, RELEASE_HEIGHT), 0.0, OPEN, wait=0.5),
        Waypoint((*to, TRAVEL_HEIGHT), 0.0, OPEN),
    ]


def plan(task: str, objects: dict[str, list[float]], rate: float) -> Array:
    """Joint angles and the gripper's position from home to the task's end, (n, 7), `rate` of them a second."""
    position, rotation = _home_tool()
    home, yaw = rotation, 0.0
    q, rows = np.array(HOME), []
    for point in waypoints(task, objects):
        target = np.array(point.position)
        duration = max(np.linalg.norm(target - position) / SPEED, abs(point.yaw - yaw) / TURNING_SPEED)
        n_steps = max(1, math.ceil(duration * rate))
        for step in range(1, n_steps + 1):
            share = _eased(step / n_steps)
            turn = rotation_matrix(np.array([0.0, 0.0, yaw + share * (point.yaw - yaw)]))
            q = _solve(position + share * (target - position), turn @ home, q)
            rows.append([*q, point.gripper])
        rows += [[*q, point.gripper]] * math.ceil(point.wait * rate)
        position, yaw = target, point.yaw
    return np.array(rows)


def way_home(q: Array, rate: float, speed: float = 0.6) -> Array:
    """Joint angles and an open gripper from q to home, (n, 7)."""
    way = np.array(HOME) - q
    n_steps = max(1, math.ceil(np.abs(way).max() / speed * rate))
    return np.array([[*(q + _eased(step / n_steps) * way), OPEN] for step in range(1, n_steps + 1)])


def _eased(share: float) -> float:
    """A share from 0 to 1 with a gentle start and end."""
    return share * share * (3 - 2 * share)


def _home_tool() -> tuple[Array, Array]:
    """Position (3,) and rotation (3, 3) of the tool at home, where it points down but for a milliradian."""
    pose = flange_pose(HOME)
    return pose[:3, 3] + pose[:3, 2] * TOOL_LENGTH, pose[:3, :3]


def _solve(position: Array, rotation: Array, seed: Array) -> Array:
    flange = np.eye(4)
    flange[:3, :3] = rotation
    flange[:3, 3] = position - rotation[:, 2] * TOOL_LENGTH
    q = inverse_kinematics(flange, seed)
    if q is None:
        raise UserError(f"The tool cannot get to {np.round(position, 3).tolist()} m.")
    return q
