"""The public commands, end to end and tiny, as a user types them."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from lerobot.scripts import lerobot_eval, lerobot_train
from safetensors.torch import load_file

from lerobot_uca.deploy.onnx_runner import OnnxPolicy
from lerobot_uca.envs.metaworld import MetaworldPointCloudEnv
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.precision import has_bfloat16
from tests.builders import N_ACTIONS, N_POINTS, N_STATES, TINY_UNET, write_dataset
from tests.forked import run_command

ENVIRONMENT = ["--env.type=metaworld_pointcloud", "--env.task=drawer-close", f"--env.n_points={N_POINTS}"]
TINY = [
    *("--policy.type=uca_flow", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.dim=16"),
    *("--policy.n_layers=1", "--policy.n_heads=2", "--batch_size=4", "--steps=2", "--num_workers=0", "--log_freq=1"),
]


def succeed(*command: str | Path) -> str:
    result = run_command(*command)
    assert result.returncode == 0, result.stderr[-3000:]
    return result.stdout + result.stderr


def fail(*command: str | Path) -> str:
    """The one line in which a failing command says what is wrong; there must be no traceback."""
    result = run_command(*command)
    assert result.returncode != 0
    assert "Traceback" not in result.stderr, result.stderr[-3000:]
    (line,) = re.findall(r"error: .*", result.stderr)
    return line


def train(root: Path, output: Path, *options: str) -> list[str | Path]:
    return [
        "lerobot-train",
        *TINY,
        "--dataset.repo_id=test/data",
        f"--dataset.root={root}",
        f"--output_dir={output}",
        *options,
    ]


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """Folder in which demonstrations were collected and a policy trained for two steps, by the commands."""
    folder = tmp_path_factory.mktemp("run")
    output = succeed(
        "lerobot-uca-collect", *ENVIRONMENT, "--repo_id=test/data", f"--root={folder}/data", "--n_episodes=1"
    )
    assert "1 episodes, 200 frames: " in output
    assert "Traceback" not in output
    log = succeed(*train(folder / "data", folder / "train"))
    assert "Traceback" not in log
    assert re.search(r"loss_u:\d", log)
    assert re.search(r"loss_v:\d", log)
    return folder


@pytest.fixture(scope="module")
def checkpoint(trained) -> Path:
    return trained / "train" / "checkpoints" / "last" / "pretrained_model"


def test_a_checkpoint_is_safetensors_with_processors_and_both_sets_of_weights(checkpoint):
    names = {path.name for path in checkpoint.iterdir()}
    assert {"config.json", "model.safetensors", "policy_preprocessor.json", "policy_postprocessor.json"} <= names
    assert not [name for name in names if name.endswith((".bin", ".pkl", ".pt", ".ckpt"))]
    weights = load_file(checkpoint / "model.safetensors")
    assert weights["ema_step"] == 2
    assert {key.split(".")[0] for key in weights} == {"model", "ema_model", "ema_step"}


def test_the_checkpoints_preprocessor_normalises_with_the_datasets_statistics(trained, checkpoint):
    dataset = LeRobotDataset("test/data", root=trained / "data")
    config = PreTrainedConfig.from_pretrained(checkpoint)
    preprocess, _ = make_pre_post_processors(config, pretrained_path=str(checkpoint))
    cloud = dataset[7][OBS_POINT_CLOUD]
    low, high = (
        torch.as_tensor(dataset.meta.stats[OBS_POINT_CLOUD][key], dtype=torch.float32) for key in ("min", "max")
    )
    got = preprocess({OBS_POINT_CLOUD: cloud[None]})[OBS_POINT_CLOUD]
    torch.testing.assert_close(got, 2 * (cloud[None] - low) / (high - low) - 1)
    assert got.abs().max() <= 1 + 1e-6


def test_evaluation_reports_success_and_videos(checkpoint, tmp_path):
    log = succeed(
        "lerobot-eval", f"--policy.path={checkpoint}", *ENVIRONMENT, "--eval.n_episodes=1", f"--output_dir={tmp_path}"
    )
    assert "Traceback" not in log
    overall = json.loads((tmp_path / "eval_info.json").read_text())["overall"]
    assert overall["n_episodes"] == 1
    assert overall["pc_success"] in (0.0, 100.0)
    assert Path(overall["video_paths"][0]).stat().st_size > 1000


def test_an_exported_checkpoint_acts_without_torch(checkpoint, tmp_path):
    output = succeed("lerobot-uca-export", checkpoint, "--format=onnx", f"--output={tmp_path}/policy.onnx")
    assert f"inputs point_cloud (2, {N_POINTS}, 3), state (2, {N_STATES}), noise (4, {N_ACTIONS})" in output
    policy = OnnxPolicy(tmp_path / "policy.onnx")
    assert policy.select_action(np.zeros((N_POINTS, 3)), np.zeros(N_STATES)).shape == (N_ACTIONS,)


def test_training_resumes_with_its_averaged_weights(trained):
    config = trained / "train" / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    succeed("lerobot-train", f"--config_path={config}", "--resume=true", "--steps=3")
    weights = load_file(trained / "train" / "checkpoints" / "000003" / "pretrained_model" / "model.safetensors")
    assert weights["ema_step"] == 3


def test_training_evaluates_in_the_environment(trained, tmp_path):
    evaluation = [*ENVIRONMENT, "--env_eval_freq=2", "--eval.n_episodes=1", "--policy.dtype=bfloat16"]
    log = succeed(*train(trained / "data", tmp_path / "train", *evaluation))
    assert "pc_success" in log
    assert has_bfloat16("cpu") == ("training is in float32" not in log)


def test_help_lists_and_teaches():
    assert "uca_flow" in succeed("lerobot-train", "--help")
    scoped = succeed("lerobot-train", "--policy.type=uca_flow", "--env.type=metaworld_pointcloud", "--help")
    for taught in ("Supervise the instantaneous velocity", "Points of each cloud", "Predicted actions T"):
        assert taught in " ".join(scoped.split())
    assert "def " not in scoped
    collect = succeed("lerobot-uca-collect", "--help")
    for option in ("--repo_id", "--n_episodes", "--overwrite", "--push_to_hub", "--seed", "--expert"):
        assert option in collect


# Bad input: one line, an exit code that is not 0, nothing half-written. ---------------------------------------------


def test_an_unknown_task(tmp_path):
    line = fail(
        "lerobot-uca-collect",
        "--env.type=metaworld_pointcloud",
        "--env.task=hamer",
        "--repo_id=a/b",
        f"--root={tmp_path}/d",
    )
    assert line.startswith("error: Unknown task 'hamer'. Meta-World tasks: hammer, ")
    assert list(tmp_path.iterdir()) == []


def test_exporting_a_folder_without_a_checkpoint(tmp_path):
    assert "has no config.json. A checkpoint is a folder like" in fail("lerobot-uca-export", tmp_path)


def test_adroit_without_an_expert(tmp_path):
    adroit = ("--env.type=adroit_pointcloud", "--env.task=door", "--repo_id=a/b", f"--root={tmp_path}/d")
    assert fail("lerobot-uca-collect", *adroit).startswith(
        "error: Adroit has no expert built in. Give one with --expert"
    )
    line = fail("lerobot-uca-collect", *adroit, "--expert=none.npz")
    assert line == "error: Cannot read the expert's weights: [Errno 2] No such file or directory: 'none.npz'"
    assert list(tmp_path.iterdir()) == []


def test_training_finds_an_unknown_task_before_its_first_step(dataset_root, tmp_path):
    line = fail(*train(dataset_root, tmp_path / "train", "--env.type=metaworld_pointcloud", "--env.task=dial-tun"))
    assert line.startswith("error: Unknown task 'dial-tun'. Meta-World tasks: dial-turn, ")
    assert not (tmp_path / "train").exists()


def test_a_dataset_without_a_cloud(tmp_path):
    features = {
        "observation.state": {"dtype": "float32", "shape": (N_STATES,), "names": None},
        "action": {"dtype": "float32", "shape": (N_ACTIONS,), "names": None},
    }
    write_dataset(tmp_path / "data", features=features)
    line = fail(*train(tmp_path / "data", tmp_path / "train"))
    expected = f"error: Policy 'uca_flow' needs the feature '{OBS_POINT_CLOUD}' of shape (N, 3), got observation.state."
    assert line == expected
    assert not (tmp_path / "train").exists()


def test_a_dataset_with_nan_points(tmp_path):
    def spoil(frame, episode, index):
        if (episode, index) == (1, 4):
            frame[OBS_POINT_CLOUD][3, 1] = np.nan

    write_dataset(tmp_path / "data", change=spoil)
    line = fail(*train(tmp_path / "data", tmp_path / "train"))
    assert line == (
        f"error: '{OBS_POINT_CLOUD}' must be finite, got 1 of {3 * N_POINTS} values NaN or infinite in episode 1, "
        "frame 4. --dataset.episodes=[0,2] leaves these episodes out."
    )
    assert not (tmp_path / "train").exists()


def test_a_short_horizon(dataset_root, tmp_path):
    line = fail(*train(dataset_root, tmp_path / "train", "--policy.horizon=3"))
    assert line.startswith(
        "error: policy.horizon must be at least (n_obs_steps - 1) * obs_stride + n_action_steps = 4, got 3"
    )


def test_training_into_an_unwritable_folder(dataset_root, tmp_path):
    (tmp_path / "file").write_text("")
    line = fail(*train(dataset_root, tmp_path / "file" / "train"))
    assert line.startswith(f"error: output_dir '{tmp_path}/file/train' cannot be written: '{tmp_path}/file' is not")


def test_evaluation_into_an_unwritable_folder(checkpoint, tmp_path):
    (tmp_path / "file").write_text("")
    command = ["lerobot-eval", f"--policy.path={checkpoint}", *ENVIRONMENT, "--eval.n_episodes=1"]
    line = fail(*command, f"--output_dir={tmp_path}/file/evaluation")
    assert line.endswith(f"cannot be written: '{tmp_path}/file' is not a writable folder.")


def test_collecting_into_an_unwritable_folder(tmp_path):
    (tmp_path / "file").write_text("")
    command = ["lerobot-uca-collect", *ENVIRONMENT, "--repo_id=a/b", "--n_episodes=1", f"--root={tmp_path}/file/data"]
    assert fail(*command).startswith(f"error: Cannot write '{tmp_path}/file/data'")


def test_an_upload_that_fails_says_that_the_dataset_is_safe(tmp_path):
    command = ["lerobot-uca-collect", *ENVIRONMENT, "--repo_id=a/b", "--n_episodes=1", f"--root={tmp_path}/data"]
    line = fail(*command, "--push_to_hub")
    assert line.startswith(f"error: The dataset in '{tmp_path}/data' is complete but could not be uploaded: ")
    assert (tmp_path / "data" / "meta" / "info.json").exists()


def test_collected_data_opens_as_any_lerobot_dataset(trained):
    dataset = LeRobotDataset("test/data", root=trained / "data")
    assert dataset.num_episodes == 1
    assert dataset[0][OBS_POINT_CLOUD].shape == (N_POINTS, 3)


@pytest.mark.parametrize("name", ["dp3", "simple_dp3", "flowpolicy", "mp1"])
def test_baselines_are_trained_and_evaluated_by_the_same_commands(name, dataset_root, tmp_path, monkeypatch):
    """They run in this process, which has imported everything, and in episodes of 5 steps."""
    monkeypatch.setattr(MetaworldPointCloudEnv, "_max_episode_steps", 5)
    sizes = [f"--policy.{key}={list(size) if isinstance(size, tuple) else size}" for key, size in TINY_UNET.items()]
    common = ["--policy.device=cpu", *ENVIRONMENT, "--eval.n_episodes=1", "--eval.use_async_envs=false"]
    policy = [f"--policy.type={name}", "--policy.push_to_hub=false", *sizes]
    data = ["--dataset.repo_id=test/data", f"--dataset.root={dataset_root}", "--batch_size=4", "--num_workers=0"]
    steps = ["--steps=2", "--env_eval_freq=2", f"--output_dir={tmp_path}/training"]
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *common, *policy, *data, *steps])
    lerobot_train.main()
    checkpoint = tmp_path / "training" / "checkpoints" / "last" / "pretrained_model"
    assert PreTrainedConfig.from_pretrained(checkpoint).type == name
    arguments = [f"--policy.path={checkpoint}", *common, f"--output_dir={tmp_path}/evaluation"]
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *arguments])
    lerobot_eval.main()
    assert json.loads((tmp_path / "evaluation" / "eval_info.json").read_text())["overall"]["n_episodes"] == 1
