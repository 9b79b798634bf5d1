import numpy as np
import pytest

from lerobot_uca.robots.ur5e.limits import Interpolator, JointLimits, clip_target, is_followed, step_towards
from lerobot_uca.robots.ur5e.sim.motion import Servo

LIMITS = JointLimits(lower=(-1.0,) * 6, upper=(1.0,) * 6, velocity=0.8, acceleration=4.0, step=0.2)
REST, ONE = np.zeros(6), np.ones(6)
DT = 0.008


@pytest.mark.parametrize("seed", range(5))
def test_no_stream_of_targets_breaks_a_limit(seed):
    rng = np.random.default_rng(seed)
    interpolator = Interpolator(REST, LIMITS)
    path = [REST]
    for _ in range(150):
        interpolator.set_target(rng.uniform(-3, 3, 6), duration=rng.choice([0.001, 0.03, 0.5]))
        path += [interpolator.step(DT).copy() for _ in range(rng.integers(1, 60))]
    velocity = np.diff(path, axis=0) / DT
    assert np.abs(path).max() <= 1.0 + 1e-12
    assert np.abs(velocity).max() <= LIMITS.velocity + 1e-9
    assert np.abs(np.diff(velocity, axis=0)).max() <= LIMITS.acceleration * DT + 1e-9


def test_a_joint_that_stands_outside_the_range_comes_back_as_slowly_as_it_is_told():
    """As when the range was narrowed while the arm stood there: the driver's easing, a small step every 1/30 s."""
    start, target, speed = np.full(6, 1.8), np.array([0.9, -0.9, 0.9, 0.0, 0.9, 0.9]), 0.25
    interpolator = Interpolator(start, LIMITS)
    n_steps = int(30 * 2.7 / speed)
    path = [start]
    for step in range(1, n_steps + 1):
        interpolator.set_target(start + step / n_steps * (target - start), 1 / 30)
        path += [interpolator.step(1 / 240).copy() for _ in range(8)]
    velocity = np.diff(path, axis=0) * 240
    assert np.abs(velocity).max() < 1.1 * speed
    assert velocity.max() < 1e-9  # all joints go down, never out
    share = (np.array(path) - start) / (target - start)
    assert np.ptp(share, axis=1).max() < 0.02  # straight: all joints are as far
    np.testing.assert_allclose(path[-1], target, atol=0.02)


def test_a_joint_outside_the_range_goes_no_farther_out():
    interpolator = Interpolator(np.full(6, 1.5), LIMITS)
    interpolator.set_target(np.full(6, 3.0), duration=0.1)
    assert max(interpolator.step(DT).max() for _ in range(100)) == 1.5


def test_joints_arrive_stop_and_never_pass_the_target():
    target = np.array([0.5, -0.5, 0.1, 0.001, 0.0, 0.9])
    q, qd = REST, REST
    for _ in range(400):
        q, qd = step_towards(q, qd, target, LIMITS, DT)
        assert np.all(np.abs(q) <= np.abs(target) + 1e-12)
    np.testing.assert_allclose(q, target, atol=1e-9)
    np.testing.assert_allclose(qd, 0, atol=1e-9)


def test_the_time_optimal_motion_takes_the_time_it_must():
    q, qd, n = REST, REST, 0
    while np.abs(q - 0.8).max() > 1e-6:
        q, qd = step_towards(q, qd, np.full(6, 0.8), LIMITS, DT)
        n += 1
    assert n * DT == pytest.approx(0.8 / 0.8 + 0.8 / 4.0, abs=0.03)  # way / v + v / a


def test_a_steady_stream_is_followed_smoothly():
    """30 targets a second along a line: no stop and go between them, and the documented lag."""
    interpolator = Interpolator(REST, LIMITS)
    velocity, path = 0.4, []
    for step in range(1, 60):
        interpolator.set_target(np.full(6, velocity * step / 30), duration=1 / 30)
        path += [interpolator.step(1 / 240).copy() for _ in range(8)]
    speeds = np.diff(path, axis=0)[120:] * 240
    np.testing.assert_allclose(speeds, velocity, rtol=0.02)
    lag = velocity * 59 / 30 - interpolator.q
    np.testing.assert_allclose(lag, velocity**2 / (2 * LIMITS.acceleration), atol=0.003)


def test_after_a_gap_it_goes_on_from_where_the_controller_stands():
    interpolator = Interpolator(REST, LIMITS)
    interpolator.set_target(np.full(6, 0.9), duration=0.1)
    for _ in range(60):
        interpolator.step(DT)
    there = interpolator.q - 0.1  # the controller has not heard of the last ones
    interpolator.go_on_from(there, REST, lookahead=0.1)
    path = [there, there, *(interpolator.step(DT).copy() for _ in range(200))]
    velocity = np.diff(path, axis=0) / DT
    assert np.abs(np.diff(velocity, axis=0)).max() <= LIMITS.acceleration * DT + 1e-9
    assert np.abs(velocity).max() <= LIMITS.velocity + 1e-9
    np.testing.assert_allclose(path[-1], 0.9, atol=1e-6)


@pytest.mark.parametrize("target", [-0.9, 0.45, 0.9], ids=["back", "short", "on"])
@pytest.mark.parametrize("gap", [0.06, 0.1, 0.15, 0.3])
@pytest.mark.parametrize("lookahead", [0.1, 0.2])
def test_after_a_gap_an_arm_that_still_moves_brakes_no_harder_than_it_may(gap, target, lookahead):
    """As the limit says, and as the servo does by itself in the gap. It counts as following all the time."""
    cycle = 0.002
    interpolator, servo = Interpolator(REST, LIMITS), Servo(REST, lookahead, gain=300)
    q, qd, path = REST, REST, [0.0]

    def send_setpoints(duration):
        for _ in range(round(duration / DT)):
            servo.target = interpolator.step(DT)
            assert is_followed(servo.target, interpolator.qd, q, qd, lookahead + 0.05)
            coast(DT)

    def coast(duration):
        nonlocal q, qd
        for _ in range(round(duration / cycle)):
            q, qd = servo.step(q, qd, cycle)
            path.append(q[0])

    interpolator.set_target(np.full(6, 0.9), duration=0.1)
    send_setpoints(0.64)
    begin = len(path)
    assert qd[0] > 0.7
    coast(gap)
    end = len(path)
    interpolator.go_on_from(q, qd, lookahead)
    interpolator.set_target(np.full(6, target), duration=0.1)
    send_setpoints(3)
    acceleration = np.abs(np.diff(path, n=2)) / cycle**2
    assert acceleration[end - 2 :].max() < 1.2 * max(acceleration[begin - 2 : end - 2].max(), LIMITS.acceleration)
    assert path[-1] == pytest.approx(target, abs=0.001)


@pytest.mark.parametrize("speed", [0.0, 0.05])
def test_an_arm_that_is_held_does_not_follow(speed):
    """Of a setpoint that moves on it is behind by more and more."""
    interpolator = Interpolator(REST, LIMITS)
    interpolator.set_target(np.full(6, 0.9), duration=0.1)
    follows = [
        is_followed(interpolator.step(DT), interpolator.qd, speed * n * DT * ONE, speed * ONE, 0.15) for n in range(99)
    ]
    assert follows[0]
    assert not follows[-1]


def test_a_gap_does_not_lead_out_of_the_range():
    interpolator = Interpolator(REST, LIMITS)
    interpolator.go_on_from(np.full(6, 0.98), np.full(6, 0.5), lookahead=0.1)
    np.testing.assert_array_equal(interpolator.q, 1.0)
    interpolator.go_on_from(np.full(6, 1.02), np.full(6, 0.5), lookahead=0.1)
    np.testing.assert_array_equal(interpolator.q, 1.02)


def test_a_target_may_have_a_velocity_of_its_own():
    interpolator = Interpolator(REST, LIMITS)
    interpolator.set_target(np.full(6, 0.5), duration=0.01, velocity=0.2)
    path = [interpolator.step(DT).copy() for _ in range(100)]
    assert np.diff(path, axis=0).max() / DT == pytest.approx(0.2)
    interpolator.set_target(np.full(6, 0.9), duration=0.01, velocity=5.0)
    path = [interpolator.step(DT).copy() for _ in range(100)]
    assert np.diff(path, axis=0).max() / DT == pytest.approx(LIMITS.velocity)


def test_a_target_inside_the_limits_is_untouched():
    target = np.array([0.02, -0.01, 0, 0, 0, 0])
    np.testing.assert_array_equal(clip_target(target, REST, LIMITS, elapsed=1 / 30), target)


def test_a_target_outside_the_range_ends_at_its_edge():
    previous = np.full(6, 0.99)
    np.testing.assert_allclose(clip_target(np.full(6, 1.5), previous, LIMITS, elapsed=1.0), 1.0)


@pytest.mark.parametrize(("elapsed", "allowed"), [(0.1, 0.08), (10.0, 0.2)], ids=["velocity", "step"])
def test_a_target_too_far_away_is_shortened_in_its_direction(elapsed, allowed):
    wanted = np.array([0.8, -0.4, 0.2, 0, 0, 0])
    target = clip_target(wanted, REST, LIMITS, elapsed)
    np.testing.assert_allclose(target, wanted * (allowed / 0.8))
