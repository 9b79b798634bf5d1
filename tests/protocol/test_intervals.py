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
    assert wilson(n_successes, n_episodes) == pytest.approx(expected, abs=1e-5)


def episodes(n_successes, n_episodes):
    return np.array([1] * n_successes + [0] * (n_episodes - n_successes))


def test_with_one_task_and_seed_the_interval_is_students():
    estimate = mean_over_tasks([[episodes(70, 100)]])
    assert estimate.mean == pytest.approx(0.7)
    t = stats.t.interval(0.95, 99, loc=0.7, scale=np.sqrt(0.7 * 0.3 / 99))
    assert estimate[1:] == pytest.approx(t)


def test_tasks_count_alike_whatever_their_episodes():
    estimate = mean_over_tasks([[episodes(10, 10)], [episodes(0, 1000)]])
    assert estimate.mean == 0.5
    assert (estimate.low, estimate.high) == (0.5, 0.5)


def test_seeds_that_differ_widen_the_interval():
    """Where seeds differ more than their episodes would make them, the interval is that of so few numbers."""
    apart = mean_over_tasks([[episodes(40, 100), episodes(50, 100), episodes(60, 100)]])
    assert apart[1:] == pytest.approx(stats.t.interval(0.95, 2, loc=0.5, scale=0.1 / np.sqrt(3)))
    alike = mean_over_tasks([[episodes(50, 100)] * 3])
    assert alike[1:] == pytest.approx(stats.t.interval(0.95, 297, loc=0.5, scale=np.sqrt(0.25 / 99 / 3)))
    assert mean_over_tasks([[episodes(0, 100), episodes(100, 100)]]) == (0.5, 0, 1)


@pytest.mark.parametrize("spread", [0, 0.05, 0.2], ids="seeds apart by {}".format)
@pytest.mark.parametrize("n_seeds", [2, 3], ids="{} seeds".format)
def test_the_interval_holds_the_truth_in_95_percent_of_cases(n_seeds, spread):
    """In 600 draws of eight tasks. Few seeds make it wider than need be, never much narrower."""
    rng = np.random.default_rng(0)
    rates = np.linspace(0.4, 0.8, 8)

    def holds() -> bool:
        trainings = np.clip(rng.normal(rates[:, None], spread / 2, (8, n_seeds)), 0, 1)
        tasks = [[rng.random(100) < rate for rate in seeds] for seeds in trainings]
        estimate = mean_over_tasks([[seed.astype(int) for seed in seeds] for seeds in tasks])
        return estimate.low <= rates.mean() <= estimate.high

    assert np.mean([holds() for _ in range(600)]) > 0.93


def test_a_strata_s_mean_is_narrower_than_its_parts():
    one = mean_over_tasks([[episodes(50, 100)]])
    sixteen = mean_over_tasks([[episodes(50, 100)]] * 16)
    assert (one.high - one.low) / (sixteen.high - sixteen.low) == pytest.approx(4, rel=0.15)


def test_an_order_is_decided_only_where_the_interval_holds_no_zero():
    differences = np.array([1] * 12 + [-1] * 2 + [0] * 86)
    assert mean_over_tasks([[differences]]).is_decided
    assert mean_over_tasks([[-differences]]).is_decided
    assert not mean_over_tasks([[np.array([1] * 8 + [-1] * 6 + [0] * 86)]]).is_decided
