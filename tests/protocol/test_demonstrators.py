import csv

import numpy as np
import pytest

from lerobot_uca.envs.configs import MetaworldPointCloudConfig
from lerobot_uca.envs.experts.expert import Attempt, Pushes, Smoothed, pushed, smoothed
from lerobot_uca.envs.metaworld import MetaworldPointCloudEnv
from lerobot_uca.errors import UserError
from lerobot_uca.protocol.command import main
from lerobot_uca.protocol.demonstrators import try_once


def steps_of(values):
    """Makes an expert that gives these numbers in turn."""
    numbers = iter(np.array(values, np.float32)[:, None])
    return lambda: lambda _: next(numbers)


def test_smoothing_is_a_first_order_filter():
    expert = Smoothed(steps_of([1, 0, 0, 1]), 0.25)
    assert [expert(None).item() for _ in range(4)] == pytest.approx([1, 0.75, 0.5625, 0.671875])


def test_smoothing_by_one_changes_nothing():
    attempts = iter([Attempt({"seed": 1}, steps_of([1, 0]))])
    assert smoothed(attempts, 1) is attempts


@pytest.mark.parametrize("smoothing", [0, -0.1, 1.5, float("nan")])
def test_wrong_smoothing(smoothing):
    with pytest.raises(UserError, match="--smoothing must be above 0 and at most 1"):
        smoothed(iter([]), smoothing)


def test_a_push_takes_the_hand_for_some_steps_and_sometimes_the_gripper():
    pushes = Pushes([0, 1, 2], [3], 0.1, seed=3)
    wanted = np.random.default_rng(0).uniform(-1, 1, (4000, 5)).astype(np.float32)
    executed = np.stack([pushes(action) for action in wanted])
    is_pushed = (executed != wanted).any(axis=1)
    np.testing.assert_array_equal(executed[:, 4], wanted[:, 4])  # what is neither
    assert (executed[is_pushed, :3] != wanted[is_pushed, :3]).all()
    _, first, lengths = np.unique(executed[is_pushed, :3], axis=0, return_index=True, return_counts=True)
    assert abs(executed).max() <= 1
    assert set(lengths) == {5, 6, 7, 8, 9, 10}  # one motion in each
    n_free = len(wanted) - is_pushed.sum()
    assert len(lengths) == pytest.approx(0.1 * n_free, rel=0.2)  # of the steps without one
    takes_gripper = executed[is_pushed, 3][first] != wanted[is_pushed, 3][first]
    assert takes_gripper.mean() == pytest.approx(1 / 3, abs=0.1)


def test_a_seed_decides_the_pushes():
    action = np.zeros(4, np.float32)

    def of(seed):
        pushes = Pushes([0, 1, 2], [3], 0.2, seed)
        return np.stack([pushes(action) for _ in range(100)])

    np.testing.assert_array_equal(of(1), of(1))
    assert not np.array_equal(of(1), of(2))


def test_without_probability_nothing_is_pushed():
    attempts = iter([Attempt({"seed": 1}, steps_of([1, 0]))])
    assert pushed(attempts, 0, ["x"]) is attempts
    action = np.ones(1, np.float32)
    assert next(attempts).disturbance()(action) is action


@pytest.mark.parametrize("probability", [-0.1, 1, float("nan")])
def test_wrong_pushes(probability):
    with pytest.raises(UserError, match="--pushes must be at least 0"):
        pushed(iter([]), probability, ["x", "y", "z"])


def test_pushes_need_a_hand_that_actions_move():
    rule = "needs actions x, y and z that move the hand, as metaworld_pointcloud has; these move WRJ1 to LFJ0"
    with pytest.raises(UserError, match=rule):
        pushed(iter([]), 0.1, ["WRJ1", "WRJ0", "LFJ0"])


def test_an_episode_is_looked_at_once(monkeypatch):
    """Clouds take most of a step, and no expert looks at them."""
    looks = []
    monkeypatch.setattr(MetaworldPointCloudEnv, "observe", lambda _: looks.append(1))
    config = MetaworldPointCloudConfig(task="drawer-close")
    attempt = next(config.attempts("drawer-close", None, 0))
    trial = try_once(config.env_factory("drawer-close"), attempt)
    assert trial.n_successful > 10
    assert len(looks) == 1


def test_a_table_of_experts(tmp_path, capsys):
    path = tmp_path / "table.csv"
    main(["demonstrators", "--tasks=drawer-close", "--episodes=2", f"--output={path}"])
    with path.open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["task"], row["episodes"], row["demonstrations"]) == ("metaworld/drawer-close", "2", "2")
    assert row["pushes"] == "0.0"
    assert 0 < float(row["roughness"]) < 1
    assert "metaworld/drawer-close: 2 of 2 (any success: 2)" in capsys.readouterr().out


def test_a_table_of_experts_that_are_pushed_all_the_time(tmp_path):
    path = tmp_path / "table.csv"
    options = ["--episodes=1", "--straight_paths=true", "--pushes=0.99"]
    main(["demonstrators", "--tasks=pick-place", *options, f"--output={path}"])
    with path.open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["straight_paths"] == "True"
    assert (row["pushes"], row["demonstrations"]) == ("0.99", "0")


def test_joints_have_no_table_of_straight_experts(tmp_path):
    with pytest.raises(UserError, match="--straight_paths needs an expert that moves a hand"):
        main(["demonstrators", "--tasks=door", "--expert=x.npz", "--straight_paths", f"--output={tmp_path}/table.csv"])


def test_a_table_needs_episodes(tmp_path):
    with pytest.raises(UserError, match="--episodes must be at least 1, got 0"):
        main(["demonstrators", "--episodes=0", f"--output={tmp_path}/table.csv"])


def test_a_table_that_cannot_be_written(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"--output '.*/file/table\.csv' cannot be written"):
        main(["demonstrators", "--tasks=reach", f"--output={tmp_path}/file/table.csv"])
