"""A checkpoint comes from somewhere else. It cannot choose code to run, nor files outside its folder."""

import importlib
import json
import shutil
import sys
from pathlib import Path

import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.processor import IdentityProcessorStep, PolicyProcessorPipeline
from lerobot.scripts import lerobot_eval
from tests.trust.conftest import N_STEPS, train

from lerobot_uca.deploy.export import export
from lerobot_uca.errors import UserError


@pytest.fixture
def checkpoint(trained, tmp_path) -> Path:
    """A copy of a good one, to damage."""
    return shutil.copytree(trained / "checkpoints" / f"{N_STEPS:06d}", tmp_path / "copy") / "pretrained_model"


def add_step(checkpoint: Path, step: object, file: str = "policy_preprocessor.json") -> None:
    pipeline = json.loads((checkpoint / file).read_text())
    pipeline["steps"].insert(0, step)
    (checkpoint / file).write_text(json.dumps(pipeline))


def load(checkpoint: Path) -> None:
    make_pre_post_processors(PreTrainedConfig.from_pretrained(checkpoint), pretrained_path=str(checkpoint))


def evaluate(checkpoint: Path) -> None:
    """Run `lerobot-eval` in this process."""
    with pytest.MonkeyPatch.context() as patch:
        options = ["--env.type=metaworld_pointcloud", "--env.n_points=32", "--eval.n_episodes=1", "--eval.batch_size=1"]
        output = f"--output_dir={checkpoint / 'evaluation'}"
        patch.setattr(sys, "argv", ["lerobot-eval", f"--policy.path={checkpoint}", output, *options])
        patch.setattr(lerobot_eval, "init_logging", lambda **_: None)
        lerobot_eval.eval_main()


def fine_tune(checkpoint: Path) -> None:
    data = checkpoint.parents[1] / "data"
    options = ["--policy.device=cpu", "--policy.push_to_hub=false", "--steps=1", "--batch_size=4"]
    train(f"--policy.path={checkpoint}", "--dataset.repo_id=test/random", f"--dataset.root={data}", *options)


def resume(checkpoint: Path) -> None:
    train(f"--config_path={checkpoint / 'train_config.json'}", "--resume=true", f"--steps={N_STEPS + 1}")


WAYS = {
    "load": load,
    "eval": evaluate,
    "export": lambda checkpoint: export(str(checkpoint), checkpoint / "policy.onnx"),
    "resume": resume,
}


@pytest.mark.parametrize("file", ["policy_preprocessor.json", "policy_postprocessor.json"])
@pytest.mark.parametrize("use", WAYS.values(), ids=WAYS)
def test_a_step_that_names_code_is_refused_by_name(checkpoint, tmp_path, use, file):
    add_step(checkpoint, {"class": "os.system", "config": {"command": f"touch {tmp_path / 'ran'}"}}, file)
    with pytest.raises(UserError, match=r"step 'os\.system' is not registered .* was not run"):
        use(checkpoint)
    assert not (tmp_path / "ran").exists()


def test_fine_tuning_refuses_it_too(checkpoint, trained, tmp_path):
    shutil.copytree(trained.parent / "data", tmp_path / "data")
    add_step(checkpoint, {"class": "os.system", "config": {"command": f"touch {tmp_path / 'ran'}"}})
    with pytest.raises(UserError, match=r"step 'os\.system' is not registered"):
        fine_tune(checkpoint)
    assert not (tmp_path / "ran").exists()


def test_nothing_is_imported(checkpoint):
    add_step(checkpoint, {"class": "this.Zen"})
    with pytest.raises(UserError, match=r"step 'this\.Zen' is not registered"):
        load(checkpoint)
    assert "this" not in sys.modules


@pytest.mark.parametrize(
    "step",
    [
        {"class": "subprocess.Popen", "config": {"args": "false"}},
        {"class": "builtins.eval"},
        {"class": ""},
        {"class": None},
        {"class": ["os", "system"]},
        {"registry_name": "no_such_step"},
        {"registry_name": ["device_processor"]},
        {"registry_name": None, "class": "os.system"},
        {"class": "lerobot.processor.pipeline.os.system"},
    ],
)
def test_what_is_not_registered_is_refused(checkpoint, step):
    add_step(checkpoint, step)
    with pytest.raises(UserError, match="is not registered by LeRobot or an installed plugin"):
        load(checkpoint)


@pytest.mark.parametrize("name", ["action_tokenizer_processor", "tokenizer_processor", "reward_classifier_processor"])
def test_steps_that_run_the_code_beside_a_model_are_refused(checkpoint, name):
    """They are LeRobot's own and registered, and run what lies in the repository that they name."""
    add_step(checkpoint, {"registry_name": name, "config": {"trust_remote_code": True}})
    with pytest.raises(UserError, match=f"'{name}' must not be part of a point-cloud policy"):
        load(checkpoint)


@pytest.mark.parametrize("file", ["/etc/secret.safetensors", "../other.safetensors", "..", "a/b", "a\\b", 3])
def test_files_outside_the_checkpoint_are_refused(checkpoint, file):
    add_step(checkpoint, {"registry_name": "normalizer_processor", "config": {}, "state_file": file})
    with pytest.raises(UserError, match="asks for a file outside its folder"):
        load(checkpoint)


def test_other_policies_keep_steps_that_a_program_has_imported_itself():
    config = {"name": "x", "steps": [{"class": "lerobot.processor.pipeline.IdentityProcessorStep"}]}
    assert isinstance(PolicyProcessorPipeline.from_config(config).steps[0], IdentityProcessorStep)
    with pytest.raises(UserError, match=r"os\.system"):
        PolicyProcessorPipeline.from_config({"name": "x", "steps": [{"class": "os.system"}]})


def test_a_checkpoint_of_another_policy_loads_as_before(tmp_path):
    config = ACTConfig(device="cpu", push_to_hub=False)
    config.save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path).type == "act"


PLUGIN_STEP = """
from pathlib import Path
from lerobot.processor import IdentityProcessorStep

Path(__file__).with_name("imported").touch()

class Step(IdentityProcessorStep):
    pass
"""


@pytest.mark.parametrize("is_loaded", [True, False])
def test_other_policies_keep_the_steps_of_plugins_that_lerobot_has_loaded(tmp_path, monkeypatch, is_loaded):
    """LeRobot imports a step's module itself, which the plugin need not have done."""
    package = tmp_path / "lerobot_policy_theirs"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "steps.py").write_text(PLUGIN_STEP)
    monkeypatch.syspath_prepend(tmp_path)
    config = {"name": "x", "steps": [{"class": "lerobot_policy_theirs.steps.Step"}]}
    names = ("lerobot_policy_theirs", "lerobot_policy_theirs.steps")
    for name in names:
        monkeypatch.delitem(sys.modules, name, raising=False)
    if is_loaded:
        importlib.import_module(names[0])
        assert isinstance(PolicyProcessorPipeline.from_config(config).steps[0], IdentityProcessorStep)
    else:
        with pytest.raises(UserError, match=r"step 'lerobot_policy_theirs\.steps\.Step' is not registered"):
            PolicyProcessorPipeline.from_config(config)
    assert (package / "imported").exists() == is_loaded
    for name in names:
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("step", "is_made", "said"),
    [
        ({"registry_name": "device_processor", "class": "lerobot_policy_tool.tool.X"}, True, None),
        ({"class": "lerobot_policy_tool.__main__.X"}, False, r"__main__\.X' is not registered"),
        (
            {"class": "lerobot_policy_tool.broken.X"},
            False,
            "cannot be imported from its plugin: RuntimeError: needs CUDA",
        ),
        ({"class": "lerobot_policy_tool.none.X"}, False, "cannot be imported from its plugin: ModuleNotFoundError"),
    ],
)
def test_of_a_plugin_nothing_else_is_imported(tmp_path, monkeypatch, step, is_made, said):
    package = tmp_path / "lerobot_policy_tool"
    package.mkdir()
    (package / "__init__.py").touch()
    for name in ("tool", "__main__"):
        (package / f"{name}.py").write_text(PLUGIN_STEP)
    (package / "broken.py").write_text("raise RuntimeError('needs CUDA')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, package.name, importlib.import_module(package.name))
    config = {"name": "x", "steps": [step]}
    if is_made:
        PolicyProcessorPipeline.from_config(config)
    else:
        with pytest.raises(UserError, match=said):
            PolicyProcessorPipeline.from_config(config)
    assert not (package / "imported").exists()
