"""The recipe's commands are LeRobot's and this package's: each one is read as its program reads it."""

import re
import shlex
from pathlib import Path

import draccus
import pytest
from lerobot.scripts.lerobot_record import RecordConfig
from lerobot.scripts.lerobot_replay import ReplayConfig

from lerobot_uca.robots.ur5e.sim.command import parse
from lerobot_uca.robots.ur5e.ur5e_follower import UR5eFollower

RECIPE = Path(__file__).parents[3] / "docs" / "real_robot.md"


def commands(name: str) -> list[list[str]]:
    blocks = re.findall(r"```bash\n(.*?)```", RECIPE.read_text(encoding="utf-8"), flags=re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    words = [shlex.split(line) for line in lines if name in line]
    assert words, name
    return [each[each.index(name) + 1 :] for each in words]


@pytest.mark.parametrize(("name", "kind"), [("lerobot-record", RecordConfig), ("lerobot-replay", ReplayConfig)])
def test_commands_of_a_robot_are_understood(name, kind, tmp_path):
    for arguments in commands(name):
        config = draccus.parse(kind, args=arguments)
        config.robot.calibration_dir = tmp_path
        robot = UR5eFollower(config.robot)
        if name == "lerobot-record":
            assert robot.observation_features["top_depth"] == (120, 160, 1)
            assert (config.teleop.fps, config.teleop.episode_time_s, config.teleop.reset_time_s) == (
                config.dataset.fps,
                config.dataset.episode_time_s,
                config.dataset.reset_time_s,
            )


def test_the_simulated_arms_command_is_understood():
    for arguments in commands("lerobot-uca-ur5e-sim"):
        assert parse(arguments).ip == "127.0.0.1"
