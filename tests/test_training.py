"""What lerobot-train settles before it trains."""

import sys

import pytest
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig

import lerobot_policy_uca_flow  # noqa: F401  (installs it)
from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig


def n_workers_after_validation(
    monkeypatch, tmp_path, *arguments, policy=UCAFlowConfig, streaming=False, **chosen
) -> int:
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *arguments])
    config = TrainPipelineConfig(
        dataset=DatasetConfig(repo_id="local/x", streaming=streaming),
        policy=policy(device="cpu", push_to_hub=False),
        output_dir=tmp_path / "new",
        **chosen,
    )
    config.validate()
    return config.num_workers


def test_a_point_cloud_policy_trains_without_workers_unless_they_are_asked_for(monkeypatch, tmp_path):
    assert n_workers_after_validation(monkeypatch, tmp_path) == 0
    assert n_workers_after_validation(monkeypatch, tmp_path, num_workers=2) == 2
    assert n_workers_after_validation(monkeypatch, tmp_path, "--num_workers=4", num_workers=4) == 4


def test_what_is_read_the_stock_way_keeps_lerobots_workers(monkeypatch, tmp_path):
    assert n_workers_after_validation(monkeypatch, tmp_path, policy=ACTConfig) == 4
    assert n_workers_after_validation(monkeypatch, tmp_path, streaming=True) == 4
    monkeypatch.delattr(LeRobotDataset, "__getitems__")  # as with LEROBOT_UCA_BATCHED_READING=0
    assert n_workers_after_validation(monkeypatch, tmp_path) == 4


def test_an_output_folder_that_cannot_be_made_is_refused(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="file' is not a writable folder"):
        n_workers_after_validation(monkeypatch, tmp_path / "file")
