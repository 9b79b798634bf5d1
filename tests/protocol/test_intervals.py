import numpy as np
import pytest
from scipy import stats

from lerobot_uca.protocol.intervals import _variances, mean_difference, mean_rate, wilson


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


def test_with_one_task_and_seed_a_differences_interval_is_students():
    estimate = mean_difference([seeds(70)])
    assert estimate.mean == pytest.approx(0.7)
    assert estimate[1:] == pytest.approx(stats.t.interval(0.95, 99, loc=0.7, scale=np.sqrt(0.7 * 0.3 / 99)))


def test_with_one_task_and_seed_a_rates_interval_is_wilsons_but_for_students_quantile():
    assert mean_rate([seeds(70)]) == pytest.approx(wilson(0.7, 99, stats.t.ppf(0.975, 99)))


def test_tasks_count_alike_whatever_their_episodes():
    assert mean_rate([seeds(10, n_episodes=10), seeds(0, n_episodes=1000)]).mean == 0.5
    assert mean_difference([seeds(10, n_episodes=10), seeds(0, n_episodes=1000)]).mean == 0.5


def test_without_a_failure_the_interval_is_that_of_all_episodes():
    assert mean_rate([seeds(100)] * 4) == pytest.approx(wilson(1.0, 400))
    assert mean_rate([seeds(100, 100)] * 4) == pytest.approx(wilson(1.0, 400))  # seeds share their episodes
    assert mean_rate([seeds(0, n_episodes=50)]) == pytest.approx(wilson(0.0, 50))


def test_where_nothing_differs_a_difference_is_as_uncertain_as_so_many_episodes():
    assert mean_difference([np.zeros((1, 100), int)]) == pytest.approx((0, -0.07398, 0.07398), abs=1e-5)
    assert not mean_difference([np.ones((1, 1), int)]).is_decided  # of a single episode


@pytest.mark.parametrize("mean", [mean_rate, mean_difference])
def test_seeds_in_the_same_episodes_tell_nothing_of_others(mean):
    once, thrice = mean([seeds(50)]), mean([seeds(50, 50, 50)])
    assert thrice == pytest.approx(once)


def test_seeds_that_differ_widen_the_interval():
    """Of seeds that differ as a whole, by all their episodes, the interval is that of so few numbers."""
    whole = np.repeat([[0], [1], [1]], 100, axis=1)
    low, high = stats.t.interval(0.95, 2, loc=2 / 3, scale=1 / 3)
    assert mean_difference([whole, whole * 0]) == pytest.approx((1 / 3, low / 2, min(1, high / 2)))
    n = (2 / 3) * (1 / 3) / (1 / 3) ** 2
    assert mean_rate([whole]) == pytest.approx(wilson(2 / 3, n, stats.t.ppf(0.975, 2)))


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
        estimate = mean_rate(list((rng.random(p.shape) < p).astype(int)))
        return estimate.low <= truth <= estimate.high

    assert np.mean([holds() for _ in range(400)]) > 0.93


@pytest.mark.parametrize(("n_tasks", "lowest"), [(4, 0.99), (4, 0.97), (21, 0.99)])
def test_also_near_100_percent_the_interval_holds_the_truth(n_tasks, lowest):
    """In 400 draws. Student's does in 83 % with four tasks from 0.99 up."""
    rng = np.random.default_rng(0)

    def holds() -> bool:
        rates = rng.uniform(lowest, 1, n_tasks)
        estimate = mean_rate(list((rng.random((n_tasks, 1, 100)) < rates[:, None, None]).astype(int)))
        return estimate.low <= rates.mean() <= estimate.high

    assert np.mean([holds() for _ in range(400)]) > 0.93


def test_of_equal_policies_few_are_called_better():
    """In 1000 draws of three tasks near 100 %, at most one in twenty but for chance."""
    rng = np.random.default_rng(0)

    def is_decided() -> bool:
        rates = rng.uniform(0.97, 1, (3, 1, 1))
        first, second = (rng.random((2, 3, 1, 100)) < rates).astype(int)
        return mean_difference(list(first - second)).is_decided

    assert np.mean([is_decided() for _ in range(1000)]) < 0.07


def test_a_strata_s_mean_is_narrower_than_its_parts():
    one, sixteen = mean_rate([seeds(50)]), mean_rate([seeds(50)] * 16)
    assert (one.high - one.low) / (sixteen.high - sixteen.low) == pytest.approx(4, rel=0.02)


def test_an_order_is_decided_only_where_the_interval_holds_no_zero():
    differences = np.array([[1] * 12 + [-1] * 2 + [0] * 86])
    assert mean_difference([differences]).is_decided
    assert mean_difference([-differences]).is_decided
    assert not mean_difference([np.array([[1] * 8 + [-1] * 6 + [0] * 86])]).is_decided


def test_the_variances_are_those_of_crossed_seeds_and_episodes():
    """The means by episode are 1, 1/2, 1/2, 0, by seed 3/4 and 1/4; each of the eight residuals is 1/4 in size."""
    within = 8 / 16 / (3 * 1) / 8  # their mean square, of the mean over all
    episodes, seeds_part = _variances(np.array([[1, 1, 1, 0], [1, 0, 0, 0]]))
    assert episodes == (pytest.approx(0.5 / 3 / 4), 3)
    assert seeds_part == (pytest.approx(0.125 / 2 - within), 1)


def test_seeds_that_differ_by_chance_add_nothing_mostly():
    rng = np.random.default_rng(0)
    parts = [_variances(rng.random((3, 100)) < 0.5)[1][0] for _ in range(500)]
    assert np.mean(np.equal(parts, 0)) > 0.5
