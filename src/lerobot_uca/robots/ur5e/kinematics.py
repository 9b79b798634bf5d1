"""The UR5e's kinematics: poses of the flange from joint angles and back. Pure functions.

Poses are (4, 4), T_base_flange: base frame of the controller, metres. q: the six joint angles [rad], base to wrist 3.
Source: Universal Robots' published Denavit-Hartenberg parameters of the UR5e. An arm's own calibration differs from
them by up to some millimetres; `UR5eFollower` measures the difference where the arm stands.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
A = (0.0, -0.425, -0.3922, 0.0, 0.0, 0.0)  # [m]
D = (0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996)  # [m]
ALPHA = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)  # [rad]

DAMPING = 1e-3
"""Damping of the least squares; it keeps steps finite near singular poses."""


def _link_poses(q: ArrayLike) -> Array:
    """Frames 0 to 6 in the base frame, (7, 4, 4); the last one is the flange."""
    poses = np.empty((7, 4, 4))
    poses[0] = np.eye(4)
    for joint, angle in enumerate(np.asarray(q, dtype=np.float64)):
        c, s = math.cos(angle), math.sin(angle)
        ca, sa = math.cos(ALPHA[joint]), math.sin(ALPHA[joint])
        a, d = A[joint], D[joint]
        link = np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
        poses[joint + 1] = poses[joint] @ link
    return poses


def flange_pose(q: ArrayLike) -> Array:
    """T_base_flange, (4, 4)."""
    return _link_poses(q)[-1]


def jacobian(q: ArrayLike) -> Array:
    """The flange's Jacobian (6, 6): velocity [m/s] over angular velocity [rad/s], base frame, by joint [rad/s]."""
    poses = _link_poses(q)
    axes, origins = poses[:-1, :3, 2], poses[:-1, :3, 3]
    return np.vstack([np.cross(axes, poses[-1, :3, 3] - origins).T, axes.T])


def inverse_kinematics(target: Array, seed: ArrayLike, *, n_steps: int = 30, tolerance: float = 1e-6) -> Array | None:
    """Joint angles (6,) near the seed at which the flange has the target's pose, or None if none are found.

    Damped Gauss-Newton steps: the solution stays in the seed's branch (elbow up stays elbow up). No joint turns by more
    than pi.

    Args:
        target: T_base_flange.
        seed: where to start, usually where the arm is.
        n_steps: how often to improve.
        tolerance: of the pose [m and rad].
    """
    start = np.array(seed, dtype=np.float64)
    q = start.copy()
    for _ in range(n_steps):
        error = pose_error(target, flange_pose(q))
        if np.abs(error).max() < tolerance:
            return start + np.remainder(q - start + math.pi, 2 * math.pi) - math.pi  # without turns that lead nowhere
        J = jacobian(q)
        q += np.clip(J.T @ np.linalg.solve(J @ J.T + DAMPING**2 * np.eye(6), error), -0.5, 0.5)
    return None


def turned_inside(q: Array, lower: ArrayLike, upper: ArrayLike) -> Array:
    """The same pose's angles (6,), each a turn more or less where that brings it inside its range."""
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    turned = q - 2 * math.pi * np.sign(q)
    is_better = ((q < low) | (q > high)) & (low <= turned) & (turned <= high)
    return np.where(is_better, turned, q)


def pose_error(target: Array, pose: Array) -> Array:
    """The twist (6,) [m, rad], base frame, that leads from the pose to the target in unit time."""
    return np.concatenate([target[:3, 3] - pose[:3, 3], rotation_vector(target[:3, :3] @ pose[:3, :3].T)])


def pose_from_vector(vector: ArrayLike) -> Array:
    """(4, 4) from the controller's notation: x, y, z [m] and a rotation vector [rad]."""
    vector = np.asarray(vector, dtype=np.float64)
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix(vector[3:])
    pose[:3, 3] = vector[:3]
    return pose


def pose_to_vector(pose: Array, near: ArrayLike | None = None) -> Array:
    """The controller's notation (6,) of a pose. The inverse of `pose_from_vector`.

    Args:
        pose: (4, 4).
        near: a vector (6,). A rotation has two rotation vectors below 2 pi; the nearer one keeps a motion's vectors
            continuous where its angle passes pi, which a tool that points down always is close to.
    """
    rotation = rotation_vector(pose[:3, :3])
    if near is not None and (angle := np.linalg.norm(rotation)) > 0:
        other = rotation * (1 - 2 * math.pi / angle)
        wanted = np.asarray(near, dtype=np.float64)[3:]
        if np.linalg.norm(other - wanted) < np.linalg.norm(rotation - wanted):
            rotation = other
    return np.concatenate([pose[:3, 3], rotation])


def rotation_matrix(vector: Array) -> Array:
    """Rodrigues' formula: (3, 3) from axis times angle (3,) [rad]."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K


def rotation_vector(R: Array) -> Array:
    """Axis times angle (3,) [rad], angle in [0, pi], of a rotation (3, 3)."""
    # The quaternion is exact at pi, too.
    # The largest of the four ways to start divides by no small number.
    w = 1 + R[0, 0] + R[1, 1] + R[2, 2]
    diagonal = 1 + 2 * np.diag(R) - np.trace(R)
    if w >= diagonal.max():
        q = np.array([w, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    else:
        i = int(diagonal.argmax())
        j, k = (i + 1) % 3, (i + 2) % 3
        q = np.empty(4)
        q[0] = R[k, j] - R[j, k]
        q[1 + i] = diagonal[i]
        q[1 + j] = R[i, j] + R[j, i]
        q[1 + k] = R[i, k] + R[k, i]
    q /= np.linalg.norm(q) * (-1 if q[0] < 0 else 1)
    sine = float(np.linalg.norm(q[1:]))
    return np.zeros(3) if sine < 1e-12 else q[1:] / sine * (2 * math.atan2(sine, q[0]))
