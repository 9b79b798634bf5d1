"""A policy can be trained on what an evaluation records."""

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts import lerobot_eval

from lerobot_uca.envs.configs import MetaworldPointCloudConfig
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.lerobot_patches.recording import record_what_can_be_trained
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
from tests.builders import N_POINTS, make_config, make_statistics
from tests.test_normalisation import train


def test_a_recording_trains(tmp_path):
    record_what_can_be_trained()  # as when lerobot-eval loads the plugin
    config = MetaworldPointCloudConfig(task="drawer-close", n_points=N_POINTS)
    env = next(iter(config.create_envs(n_envs=1).values()))[0]
    policy = UCAFlowPolicy(make_config()).eval()
    pre, post = make_pre_post_processors(policy.config, dataset_stats=make_statistics())
    nothing = PolicyProcessorPipeline(steps=[], to_transition=lambda batch: batch, to_output=lambda batch: batch)
    lerobot_eval.rollout(
        env, policy, nothing, nothing, pre, post, seeds=[0], recording_dir=tmp_path / "r", env_features=config.features
    )
    env.close()
    dataset = LeRobotDataset("test/random", root=tmp_path / "r")
    assert {OBS_POINT_CLOUD, "observation.state", "action"} <= set(dataset.features)
    checkpoint = train(tmp_path / "r", tmp_path / "new")
    pre, _ = make_pre_post_processors(policy.config, pretrained_path=str(checkpoint))
    assert torch.isfinite(pre(dataset[0])[OBS_POINT_CLOUD]).all()


def test_other_environments_are_recorded_as_ever():
    record_what_can_be_trained()
    features = {"agent_pos": MetaworldPointCloudConfig(task="drawer-close").features["agent_pos"]}
    assert "agent_pos" in lerobot_eval._env_features_to_dataset_features(features)
