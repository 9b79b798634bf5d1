from datetime import date
from itertools import combinations

import pytest
import yaml

from lerobot_uca.errors import UserError
from lerobot_uca.protocol.cells import POLICIES, SUITES, Cell
from lerobot_uca.protocol.folder import RunFolder
from lerobot_uca.protocol.setting import FIRST_TUNING_SEED, Setting

PEN, DOOR, REACH = (Cell(task, "uca_flow", 0) for task in ("adroit/pen", "adroit/door", "metaworld/reach"))


def test_the_papers_training_lengths():
    """1000 and 3000 epochs of 2000, 1000 and 500 windows at batch 128, evaluated every 200 epochs."""
    paper = Setting.load("paper")
    for cell, frames, epochs in ((REACH, 2000, 1000), (DOOR, 1000, 3000), (PEN, 500, 3000)):
        batches = -(-frames // 128)
        assert paper.length(cell).steps == epochs * batches
        assert paper.length(cell).interval == 200 * batches
    assert paper.batch_size == 128
    assert paper.policy_options(REACH) == {"type": "uca_flow"}


@pytest.mark.parametrize("name", ["paper", "small"])
def test_a_setting_of_the_package_trains_every_task_and_policy(name):
    setting = Setting.load(name)
    assert all(setting.length(Cell(task, "uca_flow", 0)).steps for task in SUITES["all"])
    options = {policy: setting.policy_options(Cell("adroit/pen", policy, 0)) for policy in POLICIES}
    assert len({str(each) for each in options.values()}) == len(POLICIES)
    assert options["adaln"]["conditioning"] == "adaln"
    assert options["without_dual_pass"]["dual_pass"] is False


def test_options_of_a_benchmark_are_its_tasks_alone():
    setting = Setting.load("small")
    assert setting.policy_options(REACH)["hand_position"] == [0, 1, 2]
    assert setting.policy_options(REACH._replace(policy="dp3"))["hand_position"] == [0, 1, 2]
    assert "hand_position" not in setting.policy_options(PEN)


def test_no_episode_is_used_twice():
    """Evaluations, demonstrations, LeRobot's evaluations and the choice of a setting use different episodes."""
    setting = Setting.load("small")
    tuning = REACH._replace(seed=FIRST_TUNING_SEED)
    used = [range(1000, 2000), range(1_000_000, 1_100_000)]
    for cell in (REACH, tuning):
        used += [setting.interim_seeds(cell, index) for index in range(15)]
        used.append(setting.final_seeds(cell))
    assert all(set(first).isdisjoint(second) for first, second in combinations(used, 2))


def test_policies_and_training_seeds_see_the_same_episodes():
    setting = Setting.load("small")
    other = REACH._replace(policy="dp3", seed=2)
    assert setting.final_seeds(REACH) == setting.final_seeds(other)
    assert setting.interim_seeds(REACH, 3) == setting.interim_seeds(other, 3)


GOOD = {"description": "-", "batch_size": 8, "lengths": {"metaworld": {"steps": 4, "evaluations": 2}}}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ("text", "may hold name, description, batch_size,"),
        ({**GOOD, "batchsize": 8}, "may hold name, description, batch_size"),
        ({"batch_size": 8}, "is not complete"),
        ({**GOOD, "batch_size": 0}, "batch_size must be a whole number above 0, got 0"),
        ({**GOOD, "batch_size": True}, "batch_size must be a whole number above 0, got True"),
        (
            {**GOOD, "lengths": {"metaworld": {"steps": 5, "evaluations": 2}}},
            "a multiple of its evaluations, got 5 and 2",
        ),
        (
            {**GOOD, "lengths": {"metaworld": {"steps": "2e3", "evaluations": 2}}},
            "a whole number above 0 and a multiple",
        ),
        ({**GOOD, "lengths": {"metaworld": {"steps": 4.0, "evaluations": 2}}}, "evaluations, got 4.0 and 2"),
        (
            {**GOOD, "lengths": {"metaworld/raech": {"steps": 4, "evaluations": 2}}},
            "by benchmark (adroit, metaworld) or 'benchmark/task', got 'metaworld/raech'",
        ),
        ({**GOOD, "pushes": 0.1}, "pushes must hold values by name, got 0.1"),
        ({**GOOD, "smoothing": None}, "smoothing must hold values by name, got None"),
        ({**GOOD, "benchmarks": 3}, "benchmarks must hold values by name, got 3"),
        ({**GOOD, "policies": {"uca_flow": 128}}, "policies.uca_flow must hold values by name, got 128"),
        ({**GOOD, "straight_paths": True}, "straight_paths must hold values by name, got True"),
        ({**GOOD, "straight_paths": {"adroit": True}}, "metaworld alone, got adroit: True"),
        ({**GOOD, "straight_paths": {"metaworld": 1}}, "true or false by benchmark, metaworld alone, got metaworld: 1"),
        ({**GOOD, "pushes": {"adroit": 0.1}}, "metaworld alone, got adroit: 0.1"),
        ({**GOOD, "pushes": {"metaworld": 1}}, "from 0 and below 1 by benchmark, metaworld alone, got metaworld: 1"),
        ({**GOOD, "successful_steps": 10}, "successful_steps must hold values by name, got 10"),
        (
            {**GOOD, "successful_steps": {"metaworld": 0}},
            "a whole number above 0 by benchmark, metaworld alone, got metaworld: 0",
        ),
        ({**GOOD, "successful_steps": {"adroit": 5}}, "by benchmark, metaworld alone, got adroit: 5"),
        ({**GOOD, "observation": "object_cloud"}, "observation must hold values by name, got 'object_cloud'"),
        (
            {**GOOD, "observation": {"metaworld": "depth"}},
            "point_cloud or object_cloud by benchmark (adroit, metaworld)",
        ),
        ({**GOOD, "observation": {"libero": "point_cloud"}}, "(adroit, metaworld), got libero: 'point_cloud'"),
        (
            {**GOOD, "benchmarks": {"libero": {}}},
            "benchmarks holds options by benchmark (adroit, metaworld), got 'libero'",
        ),
        ({**GOOD, "name": None}, "name must be text, got None"),
        ({**GOOD, "policy": {"since": date(2024, 1, 1)}}, "what no setting can hold: Object of type date is not JSON"),
        ({**GOOD, "policy": {"optimizer_lr": float("nan")}}, "what no setting can hold: Out of range float values"),
        (
            {**GOOD, "policy": {"type": "simple_dp3"}},
            "policy may hold any option but type, which --policies names, got",
        ),
        ({**GOOD, "benchmarks": {"metaworld": {"type": "dp3"}}}, "benchmarks.metaworld may hold any option but type"),
        ({**GOOD, "policies": {"mp1": {"type": "dp3"}}}, "policies.mp1 may hold any option but type"),
        ({**GOOD, "smoothing": {"adroit/pen": True}}, "above 0 and up to 1 by 'benchmark/task', got adroit/pen: True"),
        ({**GOOD, "pushes": {"metaworld": False}}, "by benchmark, metaworld alone, got metaworld: False"),
        (
            {**GOOD, "policies": {"uca": {}}},
            "policies holds options by type (dp3, flowpolicy, mp1, simple_dp3, uca_flow",
        ),
    ],
)
def test_a_wrong_file(tmp_path, values, message):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(values))
    with pytest.raises(UserError) as caught:
        Setting.load(str(path))
    assert "'mine'" in str(caught.value)
    assert message in str(caught.value)


def test_an_unknown_setting():
    with pytest.raises(UserError, match=r"Unknown setting 'big'. Settings: paper, small, or a file's path."):
        Setting.load("big")


def test_a_runs_setting_json_is_a_setting(tmp_path):
    """So that results say how to make them again."""
    made = RunFolder.create(tmp_path / "run", Setting.from_values("mine", {**GOOD, "policy": {"optimizer_lr": 5e-5}}))
    assert (
        Setting.load(str(tmp_path / "run" / "setting.json")) == made.setting == RunFolder.open(tmp_path / "run").setting
    )


def test_a_task_without_length(tmp_path):
    setting = Setting.from_values("mine", GOOD)
    with pytest.raises(UserError, match="Setting 'mine' has no length for adroit/pen: lengths of metaworld"):
        setting.length(PEN)
