"""The changes that this package makes in LeRobot, and their limits."""

import ast
import importlib
import inspect
import json
import logging
import pkgutil
import sys
from contextvars import ContextVar
from pathlib import Path

import numpy as np
import pytest
import yaml
from accelerate import accelerator
from lerobot.common.train_utils import load_training_state
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import factory
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.scripts import lerobot_eval

from lerobot_uca import configs
from lerobot_uca.data import batched_dataset
from lerobot_uca.data.batched_dataset import BatchedDataset
from lerobot_uca.envs.configs import MetaworldPointCloudConfig
from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD, cloud_observation
from lerobot_uca.lerobot_patches import install, messages, reading, recording, settings
from lerobot_uca.policies import precision
from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.setting import Setting
from tests.builders import N_ACTIONS, N_POINTS, N_STATES, make_config
from tests.forked import run_code


def training(root: Path, output: Path, policy: type = UCAFlowConfig, **options: object) -> TrainPipelineConfig:
    return TrainPipelineConfig(
        dataset=DatasetConfig(repo_id="test/random", root=str(root)),
        policy=policy(device="cpu", push_to_hub=False),
        output_dir=output / "new",
        **options,
    )


def workers(monkeypatch, config: TrainPipelineConfig, *arguments: str) -> int:
    """The workers that lerobot-train would use: it validates, makes the dataset, then its loader."""
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *arguments])
    config.validate()
    factory.make_train_eval_datasets(config)
    return config.num_workers


# Workers ------------------------------------------------------------------------------------------------------------


def test_batched_reading_needs_no_workers_and_says_so(monkeypatch, dataset_root, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    assert workers(monkeypatch, training(dataset_root, tmp_path)) == 0
    assert "Batched reading needs no workers: num_workers is 0. --num_workers=N asks for some." in caplog.messages


@pytest.mark.parametrize("split", [0.0, 0.4])
def test_datasets_of_a_training_are_read_in_batches(dataset_root, tmp_path, split):
    config = training(dataset_root, tmp_path)
    config.dataset.eval_split = split
    for dataset in factory.make_train_eval_datasets(config):
        assert dataset is None or (isinstance(dataset, BatchedDataset) and dataset.is_batched)


def test_chosen_workers_stay(monkeypatch, dataset_root, tmp_path):
    assert workers(monkeypatch, training(dataset_root, tmp_path), "--num_workers=4") == 4
    assert workers(monkeypatch, training(dataset_root, tmp_path, num_workers=4), "--num_workers", "4") == 4


@pytest.mark.parametrize(
    ("name", "text"), [("a.yaml", "num_workers: 4\n"), ("train_config.json", '{"num_workers": 4}')]
)
def test_workers_chosen_in_a_file_stay(monkeypatch, dataset_root, tmp_path, name, text):
    (tmp_path / name).write_text(text)
    config = training(dataset_root, tmp_path)
    assert workers(monkeypatch, config, f"--config_path={tmp_path / name}") == 4
    (tmp_path / "other.yaml").write_text("batch_size: 4\n")
    assert workers(monkeypatch, training(dataset_root, tmp_path), f"--config_path={tmp_path / 'other.yaml'}") == 0
    if name == "train_config.json":  # LeRobot takes the folder, too
        assert workers(monkeypatch, training(dataset_root, tmp_path), f"--config_path={tmp_path}") == 4


def test_other_policies_keep_lerobots_workers(monkeypatch, dataset_root, tmp_path):
    assert workers(monkeypatch, training(dataset_root, tmp_path, ACTConfig)) == 4


def test_a_streamed_dataset_has_a_worker(monkeypatch, dataset_root, tmp_path, caplog):
    """Without one LeRobot makes no shard and ends in a traceback; the small configurations ask for none."""
    config = training(dataset_root, tmp_path, num_workers=0)
    config.dataset.streaming = True
    assert workers(monkeypatch, config) == 1
    assert "A streamed dataset needs workers: num_workers is 1." in caplog.messages


def test_datasets_above_the_size_limit_keep_lerobots_workers(monkeypatch, dataset_root, tmp_path):
    monkeypatch.setattr(batched_dataset, "MAX_BYTES", 100)
    assert workers(monkeypatch, training(dataset_root, tmp_path)) == 4


@pytest.mark.parametrize(
    ("key", "feature", "value"),
    [
        (
            "observation.images.top",
            {"dtype": "image", "shape": (8, 8, 3), "names": None},
            np.zeros((8, 8, 3), np.uint8),
        ),
        ("note", {"dtype": "string", "shape": (1,), "names": None}, "a text"),
    ],
)
def test_datasets_with_images_or_text_keep_lerobots_workers(monkeypatch, tmp_path, key, feature, value):
    features = {
        OBS_POINT_CLOUD: {"dtype": "float32", "shape": (N_POINTS, 3), "names": None},
        "observation.state": {"dtype": "float32", "shape": (N_STATES,), "names": None},
        "action": {"dtype": "float32", "shape": (N_ACTIONS,), "names": None},
        key: feature,
    }
    dataset = LeRobotDataset.create("test/random", fps=10, features=features, root=tmp_path / "d", use_videos=False)
    for _ in range(3):
        numbers = {k: np.zeros(f["shape"], np.float32) for k, f in features.items() if f["dtype"] == "float32"}
        dataset.add_frame({**numbers, key: value, "task": "none"})
    dataset.save_episode()
    dataset.finalize()
    assert workers(monkeypatch, training(tmp_path / "d", tmp_path)) == 4


@pytest.mark.parametrize(("switch", "is_patched"), [("0", False), ("1", True)])
def test_switch(switch, is_patched):
    code = (
        "import lerobot_policy_uca_flow\nfrom lerobot.datasets import factory\n"
        "print(hasattr(factory.make_dataset, '__wrapped__'))"
    )
    assert run_code(code, **{reading.SWITCH: switch}).stdout.strip() == str(is_patched)


@pytest.mark.parametrize("split", [0.0, 0.4])
def test_other_policies_keep_lerobots_datasets(dataset_root, tmp_path, split):
    config = training(dataset_root, tmp_path, ACTConfig)
    config.dataset.eval_split = split
    assert {type(each) for each in factory.make_train_eval_datasets(cfg=config) if each} == {LeRobotDataset}
    assert factory.LeRobotDataset is LeRobotDataset
    assert not hasattr(LeRobotDataset, "__getitems__")


def test_a_newer_lerobot_is_left_alone():
    code = (
        "import lerobot; lerobot.__version__ = '0.7.0'\n"
        "import lerobot_policy_uca_flow\n"
        "from lerobot.datasets import factory\n"
        "print(hasattr(factory.make_dataset, '__wrapped__'))"
    )
    result = run_code(code)
    assert result.stdout.strip() == "False"
    assert "LeRobot 0.7.0 is too new: this package is made for 0.6.1." in result.stderr


def test_an_older_lerobot_that_lacks_modules_is_named_in_one_line():
    """0.6.0 has no lerobot.lerobot_types, among others."""
    code = (
        "import sys; sys.modules['lerobot.lerobot_types'] = None\n"
        "import lerobot; lerobot.__version__ = '0.6.0'\n"
        "import lerobot_policy_uca_flow"
    )
    (line,) = [line for line in run_code(code).stderr.splitlines() if "lerobot_uca" in line or "LeRobot" in line]
    assert "LeRobot 0.6.0 is too old: this package is made for 0.6.1. Not available: " in line
    assert "policies.processor_base" in line
    assert line.endswith("To mend it: pip install lerobot==0.6.1")


@pytest.mark.parametrize("name", install.USED_NAMES)
def test_lerobot_has_what_is_used_of_it(name):
    """A port to another LeRobot: this says which one is gone."""
    assert callable(pkgutil.resolve_name(name))


@pytest.mark.parametrize("name", install.USED_NAMES)
def test_what_is_replaced_is_called_as_before(name):
    """By names, too: parameters that a replacement names, LeRobot's function has in the same places."""
    function = pkgutil.resolve_name(name)
    function = getattr(function, "__func__", function)
    known = list(inspect.signature(inspect.unwrap(function)).parameters)
    while hasattr(function, "__wrapped__"):
        parameters = inspect.signature(function, follow_wrapped=False).parameters.values()
        named = [each.name for each in parameters if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)]
        assert named == known[: len(named)]
        function = function.__wrapped__


def test_every_private_name_is_listed():
    """The list covers imports from LeRobot; methods are called on its objects by their names."""
    listed = set(install.USED_NAMES)
    for path in Path(configs.__file__).parents[1].rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "lerobot":
                private = {f"{node.module}.{alias.name}" for alias in node.names if alias.name.startswith("_")}
                assert private <= listed, path


def test_every_patched_name_is_listed():
    listed = set(install.USED_NAMES)
    names = {"evaluation": lerobot_eval, "accelerate": accelerator}
    n_patches = 0
    for found in pkgutil.iter_modules([Path(install.__file__).parent]):
        module = importlib.import_module(f"{install.__package__}.{found.name}")
        nodes = ast.walk(ast.parse(Path(module.__file__).read_text()))
        calls = [(ast.unparse(node.func), node.args) for node in nodes if isinstance(node, ast.Call)]
        for function, arguments in calls:
            if function in ("replace", "replace_method", "replace_class_method"):
                target = eval(ast.unparse(arguments[0]), {**vars(module), **names})
                method = f".{arguments[1].value}" if function != "replace" else ""
                assert f"{target.__module__}.{target.__qualname__}{method}" in listed
                n_patches += 1
    assert n_patches > 10


def test_installing_twice_changes_nothing():
    install.install()  # again: another test may have loaded a library that sets the hook, as Ray does
    before = (factory.make_dataset, factory.make_train_eval_datasets, TrainPipelineConfig.validate, sys.excepthook)
    install.install()
    after = (factory.make_dataset, factory.make_train_eval_datasets, TrainPipelineConfig.validate, sys.excepthook)
    assert before == after


# Errors and noise ---------------------------------------------------------------------------------------------------


def test_a_users_error_is_one_line():
    result = run_code(
        "import lerobot_policy_uca_flow\nfrom lerobot_uca.errors import UserError\nraise UserError('mend it')"
    )
    assert result.returncode == 1
    assert result.stderr.strip() == "error: mend it"


@pytest.mark.parametrize("error", ["PermissionError(13, 'no')", "OSError(28, 'no space')", "ValueError('other')"])
def test_other_errors_keep_their_traceback(error):
    result = run_code(f"import lerobot_policy_uca_flow\nraise {error}")
    assert result.returncode == 1
    assert result.stderr.startswith("Traceback")


def test_the_decoders_warning_is_one_line_and_once(caplog):
    target = logging.getLogger("lerobot.utils.import_utils")
    messages.shorten_decoder_warning()
    for each in target.filters:
        each._said = False
    for _ in range(3):
        target.warning("Traceback\n" * 40 + "'torchcodec' is installed but cannot be loaded (see above)")
        target.warning("something else")
    (line,) = [message for message in caplog.messages if "torchcodec" in message]
    assert line == "torchcodec cannot be loaded (no FFmpeg?): pyav decodes videos, if there are any."
    assert caplog.messages.count("something else") == 3


def test_an_output_folder_that_cannot_be_made_is_refused(dataset_root, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="file' is not a writable folder"):
        training(dataset_root, tmp_path / "file").validate()
    training(dataset_root, tmp_path / "file", ACTConfig).validate()  # LeRobot's own policies find out as before


def test_a_policy_is_not_uploaded_without_being_saved(dataset_root, tmp_path):
    """LeRobot uploads from a temporary folder: a failed upload would lose the training."""
    config = training(dataset_root, tmp_path, save_checkpoint=False)
    config.policy.push_to_hub, config.policy.repo_id = True, "tester/policy"
    with pytest.raises(UserError, match="--save_checkpoint=false saves nothing"):
        config.validate()
    config.save_checkpoint = True
    config.validate()


def test_what_is_missing_stays_so_for_programs_that_handle_it(tmp_path):
    with pytest.raises(FileNotFoundError, match="does not hold a policy that can be loaded") as no_file:
        PreTrainedConfig.from_pretrained(tmp_path)
    with pytest.raises(NotADirectoryError, match="Training cannot go on from") as no_folder:
        load_training_state(tmp_path / "none", None, None)
    assert isinstance(no_file.value, UserError)
    assert isinstance(no_folder.value, UserError)


def test_an_error_that_a_program_makes_of_another_keeps_its_traceback():
    """Not in a command, where it is LeRobot that wraps an error of this package."""
    code = (
        "import sys, lerobot_policy_uca_flow\nfrom lerobot_uca.errors import UserError\n"
        "raise RuntimeError('stage 3 failed') from UserError('mend it')"
    )
    assert "RuntimeError: stage 3 failed" in run_code(code).stderr
    command = code.replace("import sys, ", "import sys; sys.argv[0] = 'bin/lerobot-train'; import ")
    assert run_code(command).stderr.strip() == "error: mend it"


def test_bfloat16_is_for_processors_that_have_it(monkeypatch, caplog, dataset_root, tmp_path):
    def dtype(*, is_there: bool) -> str:
        monkeypatch.setattr(precision, "has_bfloat16", lambda device: is_there)
        config = training(dataset_root, tmp_path)
        config.policy.dtype = "bfloat16"
        config.validate()
        return config.policy.dtype

    caplog.set_level(logging.WARNING)
    assert dtype(is_there=True) == "bfloat16"
    assert not caplog.messages
    assert dtype(is_there=False) == "float32"
    assert caplog.messages == ["This processor has no instructions for policy.dtype=bfloat16: training is in float32."]


def test_a_policy_that_cannot_be_loaded_is_named_with_its_options(tmp_path):
    UCAFlowPolicy(make_config()).save_pretrained(tmp_path)

    def load(*options: str) -> PreTrainedConfig:
        return PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=list(options))

    assert load("--use_amp=true", "--n_action_steps=2").n_action_steps == 2
    with pytest.raises(UserError, match=r"loaded with policy\.use_amp=maybe, policy\.dim=8: .*`use_amp`.*'maybe'"):
        load("--use_amp=maybe", "--dim=8")
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(UserError, match="does not hold a policy that can be loaded: JSONDecodeError"):
        load()


def test_a_training_does_not_leave_use_amp_aside_silently(dataset_root, tmp_path):
    """LeRobot would train in float32, and lerobot-eval then evaluate the checkpoint in bfloat16."""

    def validate(**changes: object) -> None:
        dataset = DatasetConfig(repo_id="test/random", root=str(dataset_root))
        policy = make_config(use_amp=True, **changes)
        TrainPipelineConfig(dataset=dataset, policy=policy, output_dir=tmp_path / "training").validate()

    with pytest.raises(UserError, match=r"policy\.use_amp is lerobot-eval's, .* --policy\.dtype=bfloat16 trains in bf"):
        validate()
    validate(dtype="bfloat16")


def test_an_evaluation_imitates_no_bfloat16(monkeypatch, caplog, tmp_path):
    UCAFlowPolicy(make_config()).save_pretrained(tmp_path / "policy")

    def use_amp(*, wanted: bool, is_there: bool) -> bool:
        monkeypatch.setattr(precision, "has_bfloat16", lambda device: is_there)
        options = [f"--policy.path={tmp_path / 'policy'}", f"--policy.use_amp={str(wanted).lower()}"]
        monkeypatch.setattr(sys, "argv", ["lerobot-eval", *options])
        return EvalPipelineConfig(env=MetaworldPointCloudConfig(), output_dir=tmp_path / "eval").policy.use_amp

    caplog.set_level(logging.WARNING, logger=precision.__name__)
    assert use_amp(wanted=True, is_there=True)
    assert not use_amp(wanted=False, is_there=False)
    line = "This processor has no instructions for policy.use_amp=true: the evaluation is in float32."
    assert line not in caplog.messages
    assert not use_amp(wanted=True, is_there=False)
    assert line in caplog.messages


def test_an_evaluation_in_clouds_other_than_the_trainings_is_refused(monkeypatch, dataset_root, tmp_path):
    """By lerobot-eval, whose recordings say what they are, and by a training that evaluates on the way."""
    mine = ContextVar("evaluated_observation", default="point_cloud")
    for module in (recording, settings):
        monkeypatch.setattr(module, "evaluated_observation", mine)
    recording.record_what_can_be_trained()  # as when lerobot-eval loads the plugin
    clouds, objects = (MetaworldPointCloudConfig(observation=name) for name in ("point_cloud", "object_cloud"))
    UCAFlowPolicy(make_config(observation="object_cloud")).save_pretrained(tmp_path / "policy")
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", f"--policy.path={tmp_path / 'policy'}"])
    assert EvalPipelineConfig(env=objects, output_dir=tmp_path / "eval").policy.observation == "object_cloud"
    with pytest.raises(UserError, match=r"environment gives point_cloud: add --env.observation=object_cloud"):
        EvalPipelineConfig(env=clouds, output_dir=tmp_path / "eval")
    recorded = lerobot_eval._env_features_to_dataset_features(objects.features)
    assert cloud_observation(recorded) == "object_cloud"
    factory.make_train_eval_datasets(training(dataset_root, tmp_path, env=clouds))
    with pytest.raises(UserError, match=r"environment gives object_cloud: add --env.observation=point_cloud"):
        factory.make_train_eval_datasets(training(dataset_root, tmp_path, env=objects))


def test_the_settings_of_a_training_are_saved_as_they_were_used(monkeypatch, dataset_root, tmp_path):
    config = training(dataset_root, tmp_path)
    assert workers(monkeypatch, config) == 0
    config.save_pretrained(tmp_path)
    assert json.loads((tmp_path / "train_config.json").read_text())["num_workers"] == 0


def test_a_configuration_is_found_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    by_name = TrainPipelineConfig.from_pretrained("uca_flow_small", cli_args=["--dataset.repo_id=test/data"])
    assert (by_name.policy.type, by_name.policy.dim, by_name.steps) == ("uca_flow", 128, 600)
    (tmp_path / "simple_dp3_small" / "checkpoints").mkdir(parents=True)  # of a training that is called so
    beside = TrainPipelineConfig.from_pretrained("simple_dp3_small", cli_args=["--dataset.repo_id=test/data"])
    assert beside.policy.type == "simple_dp3"
    (tmp_path / "uca_flow_small").write_text('{"steps": 7, "dataset": {"repo_id": "test/data"}}')
    own = TrainPipelineConfig.from_pretrained("uca_flow_small", cli_args=[])
    assert own.steps == 7, "the user's own file of that name comes first"


@pytest.mark.parametrize("name", ["uca_flow_smal", "configs/mine.yaml"])
def test_a_misspelt_configuration_is_one_line(name):
    with pytest.raises(UserError, match=rf"Unknown configuration '{name}'\. This package's: .*uca_flow_small"):
        TrainPipelineConfig.from_pretrained(name, cli_args=[])


@pytest.mark.parametrize("path", sorted(configs.FOLDER.glob("*.yaml")), ids=lambda path: path.stem)
def test_a_configuration_holds_only_what_lerobot_reads(path):
    config = TrainPipelineConfig.from_pretrained(path, cli_args=["--dataset.repo_id=test/data"])
    settings = yaml.safe_load(path.read_text())
    assert config.steps == settings["steps"]
    assert config.policy.type == settings["policy"]["type"]


def test_metaworlds_configuration_is_the_benchmarks_setting():
    """Besides the engine: the benchmark computes by PyTorch."""
    settings = yaml.safe_load((configs.FOLDER / "uca_flow_metaworld.yaml").read_text())
    setting = Setting.load("small")
    options = setting.policy_options(Cell("metaworld/reach", "uca_flow", 0))
    turn = {f"scene_turn.{key}": value for key, value in settings["policy"]["scene_turn"].items()}
    policy = {**settings["policy"], **turn}
    assert {key: value for key, value in policy.items() if key in options} == options
    assert policy.keys() - options.keys() == {"push_to_hub", "inference", "scene_turn"}
    assert (settings["batch_size"], settings["steps"]) == (setting.batch_size, setting.lengths["metaworld"].steps)
