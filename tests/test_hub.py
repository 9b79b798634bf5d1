"""Uploads and downloads, with the real Hub client against a server on this machine that keeps what it is given."""

import json
import re
import shutil
import sys
from pathlib import Path

import pytest
import torch
from huggingface_hub import HfApi, RepoCard, constants, hf_api
from huggingface_hub.errors import HfHubHTTPError
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts import lerobot_eval

from lerobot_uca.data.collect import CollectConfig, collect
from lerobot_uca.data.convert import ConvertConfig, convert
from lerobot_uca.deploy.export import export
from lerobot_uca.envs.configs import MetaworldPointCloudConfig
from lerobot_uca.envs.metaworld import MetaworldPointCloudEnv
from lerobot_uca.errors import UserError
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
from lerobot_uca.policies.publishing import retry_of
from tests.builders import N_POINTS, write_dataset
from tests.fake_hub import running_hub
from tests.trust.conftest import train, training_options


@pytest.fixture(scope="module")
def hub(tmp_path_factory):
    with running_hub(tmp_path_factory.mktemp("hub")) as hub, pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "ENDPOINT", hub.url)
        patch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", hub.url + "/{repo_id}/resolve/{revision}/{filename}")
        patch.setattr(constants, "HF_HUB_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setattr(hf_api.api, "endpoint", hub.url)
        patch.setattr(constants, "HF_HUB_OFFLINE", False)
        patch.setattr(constants, "HF_HUB_DISABLE_XET", True)
        patch.setenv("HF_TOKEN", "hf_test")
        # LeRobot's card of a dataset asks the public site, whatever the endpoint is.
        patch.setattr(RepoCard, "validate", lambda *_, **__: None)
        yield hub


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("data") / "random").root


def options(data: Path, output: Path, repository: str) -> list[str]:
    return [
        *(option for option in training_options(data, output) if "push_to_hub" not in option),
        *("--steps=2", "--save_checkpoint_to_hub=true", "--policy.push_to_hub=true", f"--policy.repo_id={repository}"),
    ]


@pytest.fixture(scope="module")
def pushed(hub, data, tmp_path_factory) -> Path:
    """The last checkpoint of a training that pushed its policy and its checkpoints."""
    output = tmp_path_factory.mktemp("run") / "out"
    train(*options(data, output, "tester/policy"))
    return output / "checkpoints" / "000002"


def test_a_policy_is_pushed_as_it_was_saved(hub, pushed):
    files = hub.files("models/tester/policy")
    for path in (pushed / "pretrained_model").iterdir():
        if path.name != "config.json":  # it says where the weights came from
            assert files[path.name] == path.read_bytes(), path.name


def test_every_checkpoint_is_pushed(hub, pushed):
    files, run = hub.files("models/tester/policy"), pushed.parents[1]
    for path in (path for step in ("000001", "000002") for path in (run / "checkpoints" / step).rglob("*.*")):
        assert files[str(path.relative_to(run))] == path.read_bytes()
    assert hub.tags["models/tester/policy"] == ["000001", "000002"]


def test_the_card_says_what_a_user_needs(hub, pushed):
    card = hub.files("models/tester/policy")["README.md"].decode()
    assert "Unified Condition-Action Modeling for Accurate One-Step Action Generation" in card
    assert "| `observation.point_cloud` | (32, 3) | xyz of each point [m], in the frame of the training data |" in card
    assert "| `action` | (4,) |" in card
    assert "- Dataset: `test/random`\n- 3 episodes, 39 frames at 80 Hz\n- Task: task 0\n- Task: task 1" in card
    assert "2 steps of batches of 8, seed 1000" in card
    assert re.search(r"Latency: \d+\.\d ms for a chunk of actions", card)
    assert "Success: not evaluated during training" in card
    assert "lerobot-eval --policy.path=tester/policy" in card
    assert "lerobot-rollout --policy.path=tester/policy" in card
    assert "license: apache-2.0" in card
    assert RepoCard(card).data.to_dict()["datasets"] == "test/random"


def test_a_pushed_policy_is_evaluated_and_exported_from_the_hub(pushed, tmp_path, monkeypatch):
    environment = ["--env.type=metaworld_pointcloud", f"--env.n_points={N_POINTS}"]
    arguments = [*environment, "--eval.n_episodes=1", "--eval.batch_size=1", f"--output_dir={tmp_path / 'eval'}"]
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", "--policy.path=tester/policy", *arguments])
    monkeypatch.setattr(lerobot_eval, "init_logging", lambda **_: None)
    monkeypatch.setattr(MetaworldPointCloudEnv, "_max_episode_steps", 3)
    lerobot_eval.eval_main()
    info = json.loads((tmp_path / "eval" / "eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == 1
    assert export("tester/policy", tmp_path / "policy.onnx")["state"] == (2, 9)
    fetched = {path.parent.name for path in Path(constants.HF_HUB_CACHE).rglob("*.safetensors")}
    assert not fetched & {"pretrained_model", "training_state"}  # its checkpoints, which may be many times as large


def test_a_training_goes_on_from_the_hub(pushed, data, tmp_path):
    train("--config_path=tester/policy", "--resume=true", f"--output_dir={tmp_path}", "--steps=3")
    assert (tmp_path / "checkpoints" / "last").readlink() == Path("000003")


def test_a_hostile_repository_cannot_choose_code(hub, pushed, tmp_path):
    folder = hub.folder / "models" / "evil" / "policy"
    shutil.copytree(pushed / "pretrained_model", folder)
    pipeline = json.loads((folder / "policy_preprocessor.json").read_text())
    pipeline["steps"].append({"class": "os.system", "config": {"command": f"touch {tmp_path / 'ran'}"}})
    (folder / "policy_preprocessor.json").write_text(json.dumps(pipeline))
    config = PreTrainedConfig.from_pretrained("evil/policy")
    with pytest.raises(UserError, match=r"step 'os\.system' is not registered"):
        make_pre_post_processors(config, pretrained_path="evil/policy")
    with pytest.raises(UserError, match=r"step 'os\.system' is not registered"):
        export("evil/policy", tmp_path / "policy.onnx")
    assert list(tmp_path.iterdir()) == []


def test_a_push_that_fails_leaves_the_checkpoint_and_says_how_to_push_again(hub, data, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(hub, "is_full", True)
    with pytest.raises(UserError, match=r"could not be uploaded: .*Your storage is full") as error:
        train(*options(data, tmp_path / "run", "tester/full"), "--policy.private=true")
    folder = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    assert str(error.value).startswith(f"The policy in '{folder}' is complete but could not be uploaded")
    assert str(error.value).endswith(f"To upload it: hf upload tester/full {folder} . --private")
    warned = [message for message in caplog.messages if "could not be uploaded" in message]
    assert [re.search(r"hf upload tester/full \S+ (.+)", message)[1] for message in warned] == [
        "checkpoints/000001 --private",
        "checkpoints/000002 --private",
    ]
    assert folder.resolve().parent.name == "000002"
    assert PreTrainedConfig.from_pretrained(folder).type == "uca_flow"


def test_a_push_that_fails_after_the_weights_says_so_too(hub, data, tmp_path, monkeypatch):
    push_model = UCAFlowPolicy.push_model_to_hub

    def push(self, *args, **kwargs):
        push_model(self, *args, **kwargs)
        monkeypatch.setattr(hub, "is_full", True)

    monkeypatch.setattr(UCAFlowPolicy, "push_model_to_hub", push)
    with pytest.raises(UserError, match="could not be uploaded") as error:
        train(*options(data, tmp_path / "run", "tester/half"))
    folder = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    assert str(error.value).startswith("Pipeline 'policy_preprocessor' is complete")
    assert str(error.value).endswith(f"To upload it: hf upload tester/half {folder} .")


def test_other_policies_processors_are_uploaded_as_lerobot_does(hub, monkeypatch):
    """A line would name a folder that is another policy's."""
    retry_of.set({"tester/half": "hf upload ..."})
    monkeypatch.setattr(hub, "is_full", True)
    with pytest.raises(HfHubHTTPError, match="Your storage is full"):
        PolicyProcessorPipeline([], name="policy_preprocessor").push_to_hub("tester/act")


def test_without_a_network_nothing_is_lost_either(data, tmp_path, monkeypatch):
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(UserError, match="is complete but could not be uploaded"):
        train(*options(data, tmp_path / "run", "tester/offline"))
    assert (tmp_path / "run" / "checkpoints" / "last").readlink() == Path("000002")


def test_a_collected_dataset_is_pushed_and_trained_on_from_the_hub(hub, tmp_path):
    env = MetaworldPointCloudConfig(task="drawer-close", n_points=16)
    collect(CollectConfig(env=env, repo_id="tester/data", root=tmp_path / "data", n_episodes=1, push_to_hub=True))
    pushed = hub.files("datasets/tester/data")
    local = {str(path.relative_to(tmp_path / "data")) for path in (tmp_path / "data").rglob("*.*") if path.is_file()}
    assert local <= set(pushed)
    assert b"metaworld_pointcloud" in pushed["README.md"]
    fetched = [f"--dataset.root={tmp_path / 'fetched'}", "--dataset.repo_id=tester/data", "--steps=1"]
    train(*training_options(tmp_path / "unused", tmp_path / "run"), *fetched)
    original, copy = (LeRobotDataset("tester/data", root=tmp_path / name)[7] for name in ("data", "fetched"))
    assert torch.equal(original["observation.point_cloud"], copy["observation.point_cloud"])
    assert HfApi().list_repo_refs("tester/data", repo_type="dataset").tags[0].name == "v3.0"


def test_a_converted_dataset_is_pushed_and_read_back(hub, data, tmp_path):
    made = convert(
        ConvertConfig(source=data, repo_id="tester/converted", root=tmp_path / "made", n_points=16, push_to_hub=True)
    )
    assert b"point-cloud" in hub.files("datasets/tester/converted")["README.md"]
    fetched = LeRobotDataset("tester/converted", root=tmp_path / "fetched")
    assert len(fetched) == len(made) == 39
    for key in ("observation.point_cloud", "observation.state", "action"):
        assert torch.equal(fetched[20][key], made[20][key])


def test_a_converted_dataset_that_cannot_be_pushed_stays(hub, data, tmp_path, monkeypatch):
    monkeypatch.setattr(hub, "is_full", True)
    options = {"root": tmp_path / "made", "n_points": 16, "push_to_hub": True, "private": True}
    said = r"The dataset in '.*made' is complete but could not be uploaded: .*full"
    with pytest.raises(UserError, match=said + r".*push_to_hub\(private=True, tags=\['point-cloud'\]\) in Python$"):
        convert(ConvertConfig(source=data, repo_id="tester/more", **options))
    assert len(LeRobotDataset("tester/more", root=tmp_path / "made")) == 39
