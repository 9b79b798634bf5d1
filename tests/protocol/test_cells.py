import pytest

from lerobot_uca.errors import UserError
from lerobot_uca.protocol.cells import PAPER_GROUPS, POLICIES, SUITES, Cell, grid


def test_the_papers_table_has_37_tasks_in_its_groups():
    assert {group: len(tasks) for group, tasks in PAPER_GROUPS.items()} == {
        "adroit": 3,
        "easy": 21,
        "medium": 4,
        "hard": 4,
        "very_hard": 5,
    }
    assert len(set(SUITES["paper"])) == 37
    assert set(SUITES["ablation"]) < set(SUITES["paper"]) < set(SUITES["all"])
    assert len(SUITES["all"]) == 54


def test_a_grid_goes_seed_by_seed():
    cells = grid("paper", "dial-turn,adroit", "uca_flow, adaln", "1,0")
    assert len(cells) == 4 * 2 * 2
    assert cells[0] == Cell("metaworld/dial-turn", "uca_flow", 1)
    assert cells[1] == Cell("metaworld/dial-turn", "adaln", 1)
    assert {cell.seed for cell in cells[:8]} == {1}
    assert cells[2].env_type == "adroit_pointcloud"
    assert cells[2].env_task == "hammer"


def test_the_whole_grid_is_888_trainings():
    assert len(grid("paper", None, ",".join(POLICIES), "0,1,2")) == 888


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("papr", None, "uca_flow", "0"), "Unknown suite 'papr'. Suites: paper, ablation, all."),
        (("paper", "dial-tun", "uca_flow", "0"), "Unknown task 'dial-tun' in suite 'paper'. Did you mean 'dial-turn'?"),
        (("ablation", "basketball", "uca_flow", "0"), "Tasks: adroit/door, adroit/pen, metaworld/dial-turn"),
        (("paper", "hammer", "uca_flow", "0"), "write adroit/hammer or metaworld/hammer"),
        (("paper", " , ", "uca_flow", "0"), "No task given."),
        (("paper", None, "uca", "0"), "Unknown policy 'uca'. Policies: uca_flow, without_dual_pass, cross_attention"),
        (("paper", None, "", "0"), "No policy given."),
        (("paper", None, "uca_flow", "0,x"), "--seeds must be whole numbers separated by commas, got '0,x'."),
        (("paper", None, "uca_flow", "-1"), "--seeds must be at least 0"),
    ],
)
def test_unknown_names(arguments, message):
    with pytest.raises(UserError) as caught:
        grid(*arguments)
    assert message in str(caught.value)
