"""Uploads, with the real Hub client against a server on this machine."""

import pytest
from huggingface_hub import RepoCard, constants, hf_api
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_uca.data.collect import CollectConfig, collect
from lerobot_uca.envs.configs import MetaworldPointCloudConfig
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
from tests.builders import make_config
from tests.fake_hub import running_hub


@pytest.fixture
def hub(monkeypatch):
    with running_hub() as hub:
        monkeypatch.setattr(constants, "ENDPOINT", hub.url)
        monkeypatch.setattr(hf_api.api, "endpoint", hub.url)
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
        monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
        monkeypatch.setenv("HF_TOKEN", "hf_test")
        # It asks the public site, whatever the endpoint is.
        monkeypatch.setattr(RepoCard, "validate", lambda *_, **__: None)
        yield hub


def test_a_dataset_is_pushed(hub, tmp_path):
    env = MetaworldPointCloudConfig(task="drawer-close", n_points=16)
    collect(CollectConfig(env=env, repo_id="tester/data", root=tmp_path / "data", n_episodes=1, push_to_hub=True))
    pushed = {name.removeprefix("tester/data/") for name in hub.files}
    local = {str(path.relative_to(tmp_path / "data")) for path in (tmp_path / "data").rglob("*.*") if path.is_file()}
    assert local <= pushed
    assert b"metaworld_pointcloud" in hub.files["tester/data/README.md"]


def test_a_policy_is_pushed_and_is_the_one_that_was_evaluated(hub, tmp_path):
    policy = UCAFlowPolicy(make_config(repo_id="tester/policy")).eval()
    policy.push_model_to_hub(TrainPipelineConfig(dataset=DatasetConfig(repo_id="tester/data"), policy=policy.config))
    policy.save_pretrained(tmp_path)
    assert hub.files["tester/policy/model.safetensors"] == (tmp_path / "model.safetensors").read_bytes()
    assert {"tester/policy/config.json", "tester/policy/train_config.json"} <= set(hub.files)
    assert b"uca_flow" in hub.files["tester/policy/README.md"]
