import numpy as np
import pytest

from lerobot_uca.robots.ur5e.kinematics import (
    flange_pose,
    inverse_kinematics,
    jacobian,
    pose_error,
    pose_from_vector,
    pose_to_vector,
    rotation_matrix,
    rotation_vector,
    turned_inside,
)

rng = np.random.default_rng(0)
CONFIGURATIONS = rng.uniform(-2, 2, (20, 6))
HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])


def test_the_stretched_arm_is_as_long_as_the_data_sheet_says():
    pose = flange_pose(np.zeros(6))
    np.testing.assert_allclose(pose[:3, 3], [-0.8172, -0.2329, 0.0628], atol=1e-9)
    upright = flange_pose([0, -np.pi / 2, 0, -np.pi / 2, 0, 0])
    np.testing.assert_allclose(upright[:3, 3], [0, -0.2329, 1.0794], atol=1e-9)


@pytest.mark.parametrize("q", CONFIGURATIONS[:5], ids=range(5))
def test_the_jacobian_is_the_derivative(q):
    step = 1e-6
    numeric = np.stack(
        [pose_error(flange_pose(q + step * unit), flange_pose(q - step * unit)) / (2 * step) for unit in np.eye(6)],
        axis=1,
    )
    np.testing.assert_allclose(jacobian(q), numeric, atol=1e-8)


@pytest.mark.parametrize("q", CONFIGURATIONS, ids=range(20))
def test_inverse_kinematics_inverts(q):
    seed = q + rng.uniform(-0.1, 0.1, 6)
    solution = inverse_kinematics(flange_pose(q), seed)
    assert solution is not None
    np.testing.assert_allclose(flange_pose(solution), flange_pose(q), atol=1e-5)
    assert np.abs(solution - seed).max() < 1  # the seed's branch


def test_no_joint_turns_the_long_way_round():
    """A tool that points down, at any place and turned by any angle, as a first action may be."""
    for _ in range(100):
        yaw = rng.uniform(-np.pi, np.pi)
        goal = pose_from_vector([*rng.uniform([-0.5, -0.3, 0.1], [-0.3, 0.3, 0.3]), np.pi, 0, 0])
        goal[:3, :3] = rotation_matrix(np.array([0, 0, yaw])) @ goal[:3, :3]
        solution = inverse_kinematics(goal, HOME)
        if solution is None:
            continue
        assert np.abs(solution - HOME).max() <= np.pi + 1e-9
        np.testing.assert_allclose(flange_pose(solution), goal, atol=1e-5)
        low, high = np.full(6, -np.pi), np.full(6, np.pi)
        inside = turned_inside(solution, low, high)
        assert ((low <= inside) & (inside <= high)).all()
        np.testing.assert_allclose(flange_pose(inside), goal, atol=1e-5)
    np.testing.assert_array_equal(turned_inside(np.full(6, 3.5), [-1] * 6, [1] * 6), np.full(6, 3.5))  # it cannot be


def test_a_pose_out_of_reach_has_no_solution():
    far = flange_pose(HOME)
    far[:3, 3] = [2.0, 0.0, 0.3]
    assert inverse_kinematics(far, HOME) is None


def test_rotation_vectors_invert_rotation_matrices():
    vectors = rng.normal(size=(50, 3))
    vectors *= (rng.uniform(0, np.pi, 50) / np.linalg.norm(vectors, axis=1))[:, None]
    for vector in [*vectors, np.zeros(3), *np.pi * np.eye(3), [1e-9, 0, 0]]:
        np.testing.assert_allclose(rotation_vector(rotation_matrix(np.asarray(vector))), vector, atol=1e-9)


def test_rotation_vectors_stay_continuous_where_the_angle_passes_pi():
    """A tool that points down turns about an axis by about pi: the controller's own vectors jump there."""
    previous = np.array([0.3, 0.1, 0.2, np.pi - 0.02, 0, 0])
    for angle in np.linspace(np.pi - 0.02, np.pi + 0.02, 9):
        pose = pose_from_vector([0.3, 0.1, 0.2, angle, 0, 0])
        vector = pose_to_vector(pose, near=previous)
        np.testing.assert_allclose(vector, [0.3, 0.1, 0.2, angle, 0, 0], atol=1e-9)
        previous = vector
