import numpy as np
import pytest

from lerobot_uca.protocol.intervals import mean_over_tasks, wilson


@pytest.mark.parametrize(
    ("n_successes", "n_episodes", "expected"),
    [
        (0, 100, (0, 0, 0.03699)),  # tables of Wilson's interval
        (50, 100, (0.5, 0.40383, 0.59617)),
        (100, 100, (1, 0.96301, 1)),
        (9, 10, (0.9, 0.59585, 0.98213)),
    ],
)
def test_wilsons_interval(n_successes, n_episodes, expected):
    assert wilson(n_successes, n_episodes) == pytest.approx(expected, abs=1e-5)


def episodes(n_successes, n_episodes):
    return np.array([1] * n_successes + [0] * (n_episodes - n_successes))


def test_with_one_task_and_seed_the_bootstrap_is_a_binomials():
    estimate = mean_over_tasks([[episodes(70, 100)]], n_draws=50_000)
    half = 1.96 * np.sqrt(0.7 * 0.3 / 100)
    assert estimate.mean == pytest.approx(0.7)
    assert estimate.low == pytest.approx(0.7 - half, abs=0.011)
    assert estimate.high == pytest.approx(0.7 + half, abs=0.011)


def test_tasks_count_alike_whatever_their_episodes():
    estimate = mean_over_tasks([[episodes(10, 10)], [episodes(0, 1000)]])
    assert estimate.mean == 0.5
    assert (estimate.low, estimate.high) == (0.5, 0.5)


def test_seeds_that_differ_widen_the_interval():
    """Three seeds at 0, 50 and 100 %: the seeds' own deviation, sqrt(1/6) / sqrt(3), decides."""
    apart = mean_over_tasks([[episodes(0, 100), episodes(50, 100), episodes(100, 100)]])
    alike = mean_over_tasks([[episodes(50, 100)] * 3])
    assert apart.mean == alike.mean == 0.5
    assert apart.low == pytest.approx(0.5 - 1.96 * np.sqrt(1 / 6 / 3), abs=0.06)
    assert alike.high - alike.low == pytest.approx(2 * 1.96 * np.sqrt(0.25 / 300), abs=0.01)


def test_a_strata_s_mean_is_narrower_than_its_parts():
    one = mean_over_tasks([[episodes(50, 100)]])
    sixteen = mean_over_tasks([[episodes(50, 100)]] * 16)
    assert (one.high - one.low) / (sixteen.high - sixteen.low) == pytest.approx(4, rel=0.15)


def test_an_order_is_decided_only_where_the_interval_holds_no_zero():
    differences = np.array([1] * 12 + [-1] * 2 + [0] * 86)
    assert mean_over_tasks([[differences]]).is_decided
    assert mean_over_tasks([[-differences]]).is_decided
    assert not mean_over_tasks([[np.array([1] * 8 + [-1] * 6 + [0] * 86)]]).is_decided
