import numpy as np
import pytest
from scipy import stats

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
    assert wilson(n_successes / n_episodes, n_episodes) == pytest.approx(expected, abs=1e-5)


def seeds(*n_successes, n_episodes=100):
    """Of one task; a seed's first episodes succeed."""
    return np.array([[1] * n + [0] * (n_episodes - n) for n in n_successes])


def test_with_one_task_and_seed_the_interval_is_students():
    estimate = mean_over_tasks([seeds(70)])
    assert estimate.mean == pytest.approx(0.7)
    assert estimate[1:] == pytest.approx(stats.t.interval(0.95, 99, loc=0.7, scale=np.sqrt(0.7 * 0.3 / 99)))


def test_tasks_count_alike_whatever_their_episodes():
    assert mean_over_tasks([seeds(10, n_episodes=10), seeds(0, n_episodes=1000)]) == (0.5, 0.5, 0.5)


def test_seeds_in_the_same_episodes_tell_nothing_of_others():
    once, thrice = mean_over_tasks([seeds(50)]), mean_over_tasks([seeds(50, 50, 50)])
    assert thrice == pytest.approx(once)


def test_seeds_that_differ_widen_the_interval():
    """Of seeds that differ as a whole, by all their episodes, the interval is that of so few numbers."""
    whole = np.repeat([[0], [1], [1]], 100, axis=1)
    low, high = stats.t.interval(0.95, 2, loc=2 / 3, scale=1 / 3)
    assert mean_over_tasks([whole, whole * 0], bounds=(-1, 1)) == pytest.approx((1 / 3, low / 2, min(1, high / 2)))
    assert mean_over_tasks([whole]) == pytest.approx((2 / 3, 0, 1))


@pytest.mark.parametrize("harder", [0, 2], ids="episodes apart by {}".format)
@pytest.mark.parametrize("spread", [0, 1], ids="seeds apart by {}".format)
@pytest.mark.parametrize("n_seeds", [2, 3], ids="{} seeds".format)
def test_the_interval_holds_the_truth_in_95_percent_of_cases(n_seeds, spread, harder):
    """In 400 draws of eight tasks, whose seeds meet the same episodes. Few seeds make it wider than need be."""
    rng = np.random.default_rng(0)
    middle = np.linspace(-0.4, 1.4, 8)  # logits

    def rates(n_seeds, n_episodes):  # (tasks, seeds, episodes)
        of_seeds, of_episodes = rng.normal(size=(8, n_seeds, 1)), rng.normal(size=(8, 1, n_episodes))
        return 1 / (1 + np.exp(-(middle[:, None, None] + spread * of_seeds + harder * of_episodes)))

    truth = rates(1000, 1000).mean()

    def holds() -> bool:
        p = rates(n_seeds, 100)
        estimate = mean_over_tasks(list((rng.random(p.shape) < p).astype(int)))
        return estimate.low <= truth <= estimate.high

    assert np.mean([holds() for _ in range(400)]) > 0.93


def test_a_strata_s_mean_is_narrower_than_its_parts():
    one, sixteen = mean_over_tasks([seeds(50)]), mean_over_tasks([seeds(50)] * 16)
    assert (one.high - one.low) / (sixteen.high - sixteen.low) == pytest.approx(4, rel=0.02)


def test_an_order_is_decided_only_where_the_interval_holds_no_zero():
    differences = np.array([[1] * 12 + [-1] * 2 + [0] * 86])
    assert mean_over_tasks([differences], bounds=(-1, 1)).is_decided
    assert mean_over_tasks([-differences], bounds=(-1, 1)).is_decided
    assert not mean_over_tasks([np.array([[1] * 8 + [-1] * 6 + [0] * 86])], bounds=(-1, 1)).is_decided
