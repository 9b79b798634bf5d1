import numpy as np
import pytest

from lerobot_uca.robots.ur5e.sim.motion import MAX_ACCELERATION, Move, Servo, Speed

DT = 0.002
REST = np.zeros(6)


def run(motion, q, qd, n):
    path = []
    for _ in range(n):
        q, qd = motion.step(q, qd, DT)
        path.append((q, qd))
    return np.array(path)


@pytest.mark.parametrize(("lookahead", "gain"), [(0.1, 300), (0.03, 2000), (0.2, 100)])
def test_servoj_follows_a_ramp_at_lookahead_times_velocity(lookahead, gain):
    """The tracking error of the documented law, a = gain (target - q - lookahead qd), where a is zero."""
    velocity, q, qd = 0.4, REST, REST
    for step in range(2500):
        target = np.full(6, velocity * step * DT)
        q, qd = Servo(target, lookahead, gain).step(q, qd, DT)
    np.testing.assert_allclose(target - q, lookahead * velocity, atol=velocity * DT)
    np.testing.assert_allclose(qd, velocity, rtol=1e-3)


@pytest.mark.parametrize(("lookahead", "gain"), [(0.1, 300), (0.03, 2000), (0.2, 100)])
def test_servoj_arrives_and_respects_the_acceleration(lookahead, gain):
    target = np.array([0.1, -0.1, 0.05, 0.0, 0.2, -0.2])
    path = run(Servo(target, lookahead, gain), REST, REST, 2000)
    np.testing.assert_allclose(path[-1], [target, REST], atol=1e-6)
    assert np.abs(np.diff(path[:, 1], axis=0)).max() <= MAX_ACCELERATION * DT * (1 + 1e-9)
    assert np.abs(path[:, 0]).max() < np.abs(target).max() * 1.15  # little overshoot


def test_movej_is_straight_and_reaches_no_more_than_its_speed_and_acceleration():
    target = np.array([0.8, -0.4, 0.0, 0.2, 0.0, 0.1])
    path = run(Move(target, speed=0.5, acceleration=2.0), REST, REST, 1500)
    np.testing.assert_array_equal(path[-1], [target, REST])
    np.testing.assert_allclose(path[:, 0] @ np.array([1, 2, 0, 0, 0, 0]), 0, atol=1e-12)
    assert np.abs(path[:, 1]).max() <= 0.5 + 1e-9
    assert np.abs(np.diff(path[:, 1], axis=0)).max() <= 2.0 * DT * 1.5
    arrival = np.argmax(np.all(path[:, 0] == target, axis=1)) * DT
    assert arrival == pytest.approx(0.8 / 0.5 + 0.5 / 2.0, abs=0.02)  # a trapezoid's duration


def test_stopping_brakes_all_joints_together():
    moving = np.array([1.0, -0.5, 0.0, 0.2, 0.0, 0.0])
    stop = Speed(REST, acceleration=4.0)
    path = run(stop, REST, moving, 130)
    assert stop.is_done
    braking = path[path[:, 1, 0] > 0, 1]
    np.testing.assert_allclose(braking[:, 0], 1 - 4 * DT * np.arange(1, len(braking) + 1))
    np.testing.assert_allclose(braking / braking[:, :1], np.tile(moving, (len(braking), 1)))
