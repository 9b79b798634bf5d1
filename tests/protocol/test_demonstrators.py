import csv

import numpy as np
import pytest

from lerobot_uca.envs.experts.expert import Attempt, Smoothed, smoothed
from lerobot_uca.envs.metaworld import MetaworldPointCloudEnv
from lerobot_uca.errors import UserError
from lerobot_uca.protocol.command import main


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


def test_a_table_of_experts(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(MetaworldPointCloudEnv, "observe", None)  # nobody looks
    path = tmp_path / "table.csv"
    main(["demonstrators", "--tasks=drawer-close", "--episodes=2", f"--output={path}"])
    with path.open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["task"], row["episodes"], row["demonstrations"]) == ("metaworld/drawer-close", "2", "2")
    assert 0 < float(row["roughness"]) < 1
    assert "metaworld/drawer-close: 2 of 2 (any success: 2)" in capsys.readouterr().out


def test_a_table_needs_episodes(tmp_path):
    with pytest.raises(UserError, match="--episodes must be at least 1, got 0"):
        main(["demonstrators", "--episodes=0", f"--output={tmp_path}/table.csv"])
