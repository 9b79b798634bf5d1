"""Everything that this package changes in LeRobot, in one place. `install()` is called when LeRobot loads the plugin.

Written for LeRobot 0.6.1. Each patch says what LeRobot does without it.
"""

import functools
import logging
import os
import sys
from collections.abc import Callable
from contextvars import ContextVar
from pathlib import Path
from types import TracebackType
from typing import Any

import torch
import yaml
from lerobot.common import train_utils
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import factory
from lerobot.policies import factory as policy_factory
from lerobot.processor import DataProcessorPipeline
from lerobot.utils import utils
from lerobot.utils.constants import ACTION, OBS_STATE
from tqdm import tqdm

from lerobot_uca import configs
from lerobot_uca.checkpoints.only_run import keep_others_out
from lerobot_uca.checkpoints.resuming import cycle_exactly, without_trace
from lerobot_uca.checkpoints.saving import save_whole, update_last
from lerobot_uca.checkpoints.steps import check_steps
from lerobot_uca.data.batched_dataset import BatchedDataset
from lerobot_uca.data.chosen_episodes import check_finite, chosen_statistics
from lerobot_uca.errors import UserError, reported
from lerobot_uca.features import (
    ENV_NAMES,
    OBS_POINT_CLOUD,
    POINT_CLOUD,
    cloud_observation,
    find_point_cloud,
    observation_info,
    valid_mask,
)
from lerobot_uca.hub import upload_command, uploading
from lerobot_uca.lerobot_version import is_supported
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig
from lerobot_uca.policies.precision import dtype_of_training
from lerobot_uca.policies.processor_base import PointCloudProcessorStep, load_processors
from lerobot_uca.policies.publishing import Evaluation, PublishedPolicy
from lerobot_uca.processes import end_by_signals

EVALUATION_MODULES = ("lerobot.scripts.lerobot_eval", "__main__")

USED_NAMES = (
    # Private names and functions without a promise: a port to another LeRobot starts here.
    "lerobot.common.train_utils.load_training_state",
    "lerobot.common.train_utils.push_checkpoint_to_hub",
    "lerobot.common.train_utils.save_checkpoint",
    "lerobot.common.train_utils.update_last_checkpoint",
    "lerobot.configs.eval.EvalPipelineConfig.__post_init__",
    "lerobot.configs.parser.parse_arg",
    "lerobot.configs.policies.PreTrainedConfig.from_pretrained",
    "lerobot.configs.train.TrainPipelineConfig.from_pretrained",
    "lerobot.configs.train.TrainPipelineConfig.validate",
    "lerobot.datasets.dataset_reader.DatasetReader.load_and_activate",
    "lerobot.datasets.factory.LeRobotDataset",
    "lerobot.datasets.factory.make_dataset",
    "lerobot.datasets.factory.make_train_eval_datasets",
    "lerobot.datasets.lerobot_dataset.LeRobotDataset._ensure_reader",
    "lerobot.datasets.sampler.EpisodeAwareSampler.state_dict",
    "lerobot.envs.utils._LazyAsyncVectorEnv",
    "lerobot.envs.utils._LazyAsyncVectorEnv._ensure",
    "lerobot.envs.utils.freeze_after_episode_end",
    "lerobot.policies.factory.make_pre_post_processors",
    "lerobot.policies.pretrained.PreTrainedPolicy._load_as_safetensor",
    "lerobot.policies.pretrained.PreTrainedPolicy.push_model_to_hub",
    "lerobot.processor.pipeline.DataProcessorPipeline._build_steps_from_config",
    "lerobot.processor.pipeline.DataProcessorPipeline.push_to_hub",
    "lerobot.scripts.lerobot_eval._build_raw_frame",
    "lerobot.scripts.lerobot_eval._env_features_to_dataset_features",
    "lerobot.scripts.lerobot_eval.eval_policy_all",
    "lerobot.utils.random_utils.get_rng_state",
    "lerobot.utils.random_utils.set_rng_state",
    "lerobot.utils.utils.cycle",
)
SWITCH = "LEROBOT_UCA_BATCHED_READING"

logger = logging.getLogger(__name__)


def install() -> None:
    """Apply all patches, each for itself. A second call changes nothing."""
    try:
        make_registered_steps_only()  # no line in a log: without it a checkpoint could run code
    finally:
        _install_conveniences()


def _install_conveniences() -> None:
    patches = [report_user_errors, shorten_decoder_warning]
    if Path(sys.argv[0]).stem.startswith("lerobot"):  # one of LeRobot's commands, not somebody's own program
        patches.append(end_by_signals)
    if is_supported():
        patches += [
            check_settings,
            find_configs_by_name,
            read_in_batches,
            report_damaged_checkpoints,
            save_checkpoints_whole,
            resume_exactly,
            report_failed_uploads,
            normalise_what_is_trained,
            record_what_can_be_trained,
        ]
    for patch in patches:
        try:
            patch()
        except Exception as error:  # noqa: BLE001 (one that fails must not take the others down)
            logger.warning("lerobot_patches.%s is missing: %s: %s", patch.__name__, type(error).__name__, error)


def report_user_errors() -> None:
    """A `UserError` ends the process with its message in one line, also when draccus has wrapped it.

    Python prints a traceback for it.
    """
    previous = sys.excepthook
    if getattr(previous, "_reports_user_errors", False):
        return

    @functools.wraps(previous)  # with what it says of itself
    def hook(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, UserError):
            cause = cause.__cause__
        if cause is not None:
            print(f"error: {cause}", file=sys.stderr)
        else:
            previous(kind, error, traceback)

    hook._reports_user_errors = True  # type: ignore[attr-defined]
    sys.excepthook = hook


class _DecoderWarning(logging.Filter):
    """One line, once, instead of a page with every dataset."""

    def __init__(self) -> None:
        super().__init__()
        self._said = False

    def filter(self, record: logging.LogRecord) -> bool:
        if "'torchcodec' is installed but cannot be loaded" not in record.getMessage():
            return True
        record.msg, record.args = "torchcodec cannot be loaded (no FFmpeg?): pyav decodes videos, if there are any.", ()
        first, self._said = not self._said, True
        return first


def shorten_decoder_warning() -> None:
    """Without FFmpeg, LeRobot prints a page of torchcodec's traceback for each dataset."""
    target = logging.getLogger("lerobot.utils.import_utils")
    if not any(isinstance(each, _DecoderWarning) for each in target.filters):
        target.addFilter(_DecoderWarning())


# Limits of a checkpoint -----------------------------------------------------------------------------------------------

_of_point_cloud_policy: ContextVar[bool] = ContextVar("of_point_cloud_policy", default=False)


def make_registered_steps_only() -> None:
    """A checkpoint cannot name code to run; see `checkpoints/steps.py`. LeRobot imports and calls whatever it names."""

    def checked(build: Callable[..., Any]) -> Callable[..., Any]:
        def build_steps(cls: type, loaded_config: dict[str, Any], overrides: dict[str, Any]) -> Any:
            check_steps(loaded_config, of_point_cloud_policy=_of_point_cloud_policy.get())
            return build(cls, loaded_config, overrides)

        return build_steps

    def known(make: Callable[..., Any]) -> Callable[..., Any]:
        def make_pre_post_processors(policy_cfg: Any, pretrained_path: Any = None, *args: Any, **kwargs: Any) -> Any:
            if pretrained_path is None or not isinstance(policy_cfg, PointCloudPolicyConfig):
                return make(policy_cfg, pretrained_path, *args, **kwargs)
            token = _of_point_cloud_policy.set(True)
            try:
                with reported(f"The processors of '{pretrained_path}' cannot be loaded"):
                    return load_processors(make, policy_cfg, pretrained_path, *args, **kwargs)
            finally:
                _of_point_cloud_policy.reset(token)

        return make_pre_post_processors

    _replace_class_method(DataProcessorPipeline, "_build_steps_from_config", checked)
    _replace(policy_factory.make_pre_post_processors, known)


def report_damaged_checkpoints() -> None:
    """One line names the missing or damaged part. LeRobot shows a library's traceback."""

    def policy(load: Callable[..., Any]) -> Callable[..., Any]:
        def from_pretrained(cls: type, pretrained_name_or_path: Path | str, **kwargs: Any) -> Any:
            with reported(f"'{pretrained_name_or_path}' does not hold a policy that can be loaded"):
                return load(cls, pretrained_name_or_path, **kwargs)

        return from_pretrained

    def state(load: Callable[..., Any]) -> Callable[..., Any]:
        def load_training_state(checkpoint_dir: Path, *args: Any, **kwargs: Any) -> Any:
            with reported(f"Training cannot go on from '{checkpoint_dir}'"):
                return load(checkpoint_dir, *args, **kwargs)

        return load_training_state

    _replace_class_method(PreTrainedConfig, "from_pretrained", policy)
    _replace(train_utils.load_training_state, state)


def save_checkpoints_whole() -> None:
    """See `checkpoints/saving.py`."""
    _replace(train_utils.save_checkpoint, save_whole)
    _replace(train_utils.update_last_checkpoint, update_last)


def resume_exactly() -> None:
    """See `checkpoints/resuming.py`."""
    _replace(utils.cycle, cycle_exactly)
    evaluation = sys.modules.get("lerobot.scripts.lerobot_eval")  # where training has it from
    if evaluation is not None:
        _replace(evaluation.eval_policy_all, lambda evaluate: _remember_success(without_trace(evaluate)))


def _remember_success(evaluate: Callable[..., Any]) -> Callable[..., Any]:
    """Remember the success rate for the policy's page on the Hub."""

    def eval_policy_all(*args: Any, **kwargs: Any) -> Any:
        info = evaluate(*args, **kwargs)
        policy = kwargs.get("policy")
        if isinstance(policy, PublishedPolicy):
            n_episodes = info["overall"]["n_episodes"]
            policy.evaluation = Evaluation(info["overall"]["pc_success"], n_episodes, kwargs.get("start_seed"))
        return info

    return eval_policy_all


def report_failed_uploads() -> None:
    """A checkpoint that cannot be uploaded is a warning, a policy an error in one line. LeRobot ends in a traceback."""

    def checkpoint(push: Callable[..., None]) -> Callable[..., None]:
        def push_checkpoint_to_hub(checkpoint_dir: Path, repo_id: str, **kwargs: Any) -> None:
            retry = upload_command(repo_id, checkpoint_dir, f"checkpoints/{checkpoint_dir.name}")
            try:
                with uploading(f"Checkpoint '{checkpoint_dir}'", retry):
                    push(checkpoint_dir, repo_id, **kwargs)
            except UserError as error:
                logger.warning("%s", error)  # the training goes on

        return push_checkpoint_to_hub

    def processors(push: Callable[..., Any]) -> Callable[..., Any]:
        def push_to_hub(self: DataProcessorPipeline, repo_id: str, **kwargs: Any) -> Any:
            with uploading(f"Pipeline '{self.name}'", upload_command(repo_id, Path(".../last/pretrained_model"))):
                return push(self, repo_id, **kwargs)

        return push_to_hub

    _replace(train_utils.push_checkpoint_to_hub, checkpoint)
    _replace_method(DataProcessorPipeline, "push_to_hub", processors)


# Folders and reading --------------------------------------------------------------------------------------------------


def check_settings() -> None:
    """A folder that cannot be written, or that another training writes, is refused at once, wrong settings in one line.

    LeRobot finds the first out at the first checkpoint or video, the second never, and shows a traceback for the third.
    Nor does it ask whether an environment's clouds are those of the training, or use float32 where the processor lacks
    bfloat16.
    """

    def validated(validate: Callable[..., None]) -> Callable[..., None]:
        def validate_and_check(self: TrainPipelineConfig) -> None:
            try:
                validate(self)
            except (OSError, ValueError, NotImplementedError) as error:
                if isinstance(error, UserError) or not isinstance(self.policy, PointCloudPolicyConfig):
                    raise
                raise UserError(" ".join(str(error).split())) from error
            if isinstance(self.policy, PointCloudPolicyConfig):
                self.policy.validate_sizes()  # before the dataset is read: a horizon of 10^9 would fill the memory
                if not self.job.is_remote:
                    check_output_folder(self.output_dir)
                    keep_others_out(Path(self.output_dir))
                    self.policy.dtype = dtype_of_training(self.policy.dtype, self.policy.device)

        return validate_and_check

    def made(make: Callable[..., None]) -> Callable[..., None]:
        def make_and_check(self: EvalPipelineConfig) -> None:
            make(self)
            if isinstance(self.policy, PointCloudPolicyConfig):
                _check_evaluation(self, self.policy)

        return make_and_check

    _replace_method(TrainPipelineConfig, "validate", validated)
    _replace_method(EvalPipelineConfig, "__post_init__", made)


def _check_evaluation(config: EvalPipelineConfig, policy: PointCloudPolicyConfig) -> None:
    check_output_folder(config.output_dir)
    policy.check_environment(config.env)
    _evaluated.set(policy.observation)


def check_output_folder(output_dir: Path | str | None) -> None:
    """Raise a `UserError` if the folder cannot be made or written."""
    if output_dir is None:
        return
    parent = Path(output_dir).absolute()
    while not os.path.lexists(parent):
        parent = parent.parent
    if not (parent.is_dir() and os.access(parent, os.W_OK | os.X_OK)):
        raise UserError(f"output_dir '{output_dir}' cannot be written: '{parent}' is not a writable folder.")


def find_configs_by_name() -> None:
    """`--config_path=uca_flow_small` finds the file of that name in this package. LeRobot asks the Hub for it."""

    def named(load: Callable[..., Any]) -> Callable[..., Any]:
        def from_pretrained(cls: type, pretrained_name_or_path: str | Path, **kwargs: Any) -> Any:
            return load(cls, configs.path_of(str(pretrained_name_or_path)) or pretrained_name_or_path, **kwargs)

        return from_pretrained

    _replace_class_method(TrainPipelineConfig, "from_pretrained", named)


def read_in_batches() -> None:
    """Training reads datasets without cameras in batches. LeRobot reads row by row (issues 2315, 2895, 4392).

    LEROBOT_UCA_BATCHED_READING=0 switches it off.
    """
    if os.environ.get(SWITCH, "1") == "0" or factory.LeRobotDataset is BatchedDataset:
        return
    factory.LeRobotDataset = BatchedDataset
    make_dataset = factory.make_dataset

    @functools.wraps(make_dataset)
    def make_and_settle(config: TrainPipelineConfig) -> Any:
        if not isinstance(config.policy, PointCloudPolicyConfig):
            return make_dataset(config)
        with reported(f"Dataset '{config.dataset.repo_id}' cannot be read"):
            dataset = make_dataset(config)
        _read_without_workers(config, dataset)
        return dataset

    factory.make_dataset = make_and_settle


def normalise_what_is_trained() -> None:
    """The data of a training is finite, and its statistics are those of the chosen episodes.

    LeRobot's are those of all episodes, held-out ones included; and a value that is not finite makes all of them NaN.
    Fine-tuning a checkpoint, it asks neither whether the dataset has its features nor how many points a cloud has now.
    """

    def checked(make: Callable[..., Any]) -> Callable[..., Any]:
        def make_train_eval_datasets(config: TrainPipelineConfig) -> Any:
            datasets = make(config)
            if isinstance(config.policy, PointCloudPolicyConfig):
                for dataset in filter(None, datasets):
                    _normalise_by_chosen_episodes(config, config.policy, dataset)
            return datasets

        return make_train_eval_datasets

    _replace(factory.make_train_eval_datasets, checked)


def _normalise_by_chosen_episodes(config: TrainPipelineConfig, policy: PointCloudPolicyConfig, dataset: Any) -> None:
    features, rename_map = dataset.meta.features, config.rename_map
    renamed = {rename_map.get(key, key): feature for key, feature in features.items()}
    policy.check_environment(config.env, cloud_observation(renamed))
    if policy.pretrained_path:
        policy.set_dataset_feature_metadata(renamed)  # LeRobot's own call does not rename
        policy.check_dataset(renamed)
    key_of = {rename_map.get(key, key): key for key in features}
    used = {find_point_cloud(renamed), OBS_STATE, ACTION} & renamed.keys()
    masks = {key_of[name]: key_of.get(valid_mask(name, renamed) or "") for name in used if name}
    check_finite(dataset, masks)
    cloud_name = find_point_cloud(renamed)
    if policy.n_points is not None and cloud_name is not None and isinstance(dataset, BatchedDataset):
        _sample_clouds(PointCloudProcessorStep(policy.n_points, policy.colour), dataset, key_of[cloud_name])
    if dataset.meta.stats:
        dataset.meta.stats = {**dataset.meta.stats, **chosen_statistics(dataset, masks)}


def _sample_clouds(step: PointCloudProcessorStep, dataset: BatchedDataset, key: str) -> None:
    """Sample all clouds once: the processor's step would sample them again in every epoch."""
    columns, n_points = dataset.columns(), step.n_points
    if columns is None or n_points is None or columns.tensors[key].shape[1] <= n_points:
        return
    mask = columns.tensors.pop(valid_mask(key, columns.tensors) or "", None)
    clouds = columns.tensors[key]
    rows = tqdm(range(len(clouds)), desc=f"Sampling {n_points} of {clouds.shape[1]} points", unit="cloud")
    sampled = [step.uniform(clouds[row].float(), None if mask is None else mask[row]) for row in rows]
    columns.tensors[key] = torch.stack(sampled)


_evaluated: ContextVar[str] = ContextVar("evaluated", default=POINT_CLOUD)
"""The observation of the policy that this process evaluates."""


def record_what_can_be_trained() -> None:
    """`lerobot-eval --eval.recording=true` names features as policies do. LeRobot takes the environment's names.

    With those (point_cloud, agent_pos) nothing can be trained, and nothing renames them. Nor would the dataset say that
    its clouds are without the robot.
    """
    evaluation = next((sys.modules[name] for name in EVALUATION_MODULES if name in sys.modules), None)
    if evaluation is None or not hasattr(evaluation, "_build_raw_frame"):  # no evaluation in this process
        return

    def features(make: Callable[..., Any]) -> Callable[..., Any]:
        return lambda env_features: _labelled(_renamed(make(env_features)))

    def frame(build: Callable[..., Any]) -> Callable[..., Any]:
        return lambda raw_obs, *args, **kwargs: build(_renamed(raw_obs), *args, **kwargs)

    _replace(evaluation._env_features_to_dataset_features, features)
    _replace(evaluation._build_raw_frame, frame)


def _renamed(values: dict[str, Any]) -> dict[str, Any]:
    """Observations or features of this package's environments under the policies' names; others' as they are."""
    is_ours = values.keys() >= ENV_NAMES.keys()
    return {ENV_NAMES.get(key, key) if is_ours else key: value for key, value in values.items()}


def _labelled(features: dict[str, Any]) -> dict[str, Any]:
    if OBS_POINT_CLOUD in features:
        features[OBS_POINT_CLOUD]["info"] = observation_info(_evaluated.get())
    return features


def _read_without_workers(config: TrainPipelineConfig, dataset: Any) -> None:
    """Let this process read the batches, unless the user has chosen a number of workers.

    Batched reading takes less time than handing a batch from one process to another, and LeRobot's four workers
    each import everything anew: half a minute on two cores, which they then share with the training.
    """
    if isinstance(dataset, BatchedDataset) and dataset.is_batched and config.num_workers:
        if _is_given("num_workers"):
            return
        logger.info("Batched reading needs no workers: num_workers is 0. --num_workers=N asks for some.")
        config.num_workers = 0


def _is_given(option: str) -> bool:
    """Whether a user has given an option, on the command line or in the configuration file."""
    if parser.parse_arg(option) is not None:
        return True
    path = parser.parse_arg("config_path")
    if path is None:
        return False
    file = configs.path_of(path) or Path(path)
    if file.is_dir():
        file /= "train_config.json"
    if not file.is_file():  # from the Hub: a whole configuration, which holds every option
        return True
    settings = yaml.safe_load(file.read_text(encoding="utf-8"))  # JSON is YAML
    return isinstance(settings, dict) and option in settings


# Replacing ------------------------------------------------------------------------------------------------------------

Wrap = Callable[[Callable[..., Any]], Callable[..., Any]]
"""Maps LeRobot's function to the one that replaces it."""


def _wrapped(original: Callable[..., Any], wrap: Wrap) -> Callable[..., Any]:
    new = functools.wraps(original)(wrap(original))
    new._is_patched = True  # type: ignore[attr-defined]
    return new


def _replace(original: Callable[..., Any], wrap: Wrap) -> None:
    """Replace a function in every module that has imported it by its name."""
    if getattr(original, "_is_patched", False):
        return
    new = _wrapped(original, wrap)
    for module in list(sys.modules.values()):
        if getattr(module, "__dict__", {}).get(original.__name__) is original:
            setattr(module, original.__name__, new)


def _replace_method(owner: type, name: str, wrap: Wrap) -> None:
    original = getattr(owner, name)
    if not getattr(original, "_is_patched", False):
        setattr(owner, name, _wrapped(original, wrap))


def _replace_class_method(owner: type, name: str, wrap: Wrap) -> None:
    original = getattr(owner, name).__func__
    if not getattr(original, "_is_patched", False):
        setattr(owner, name, classmethod(_wrapped(original, wrap)))
