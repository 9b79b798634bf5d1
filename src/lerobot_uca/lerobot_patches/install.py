"""All patches, applied when LeRobot loads the plugin, and the names of LeRobot that this package relies on."""

import logging

from lerobot_uca.lerobot_patches.checkpoints import (
    report_damaged_checkpoints,
    report_failed_uploads,
    resume_exactly,
    save_checkpoints_whole,
)
from lerobot_uca.lerobot_patches.ending import end_together
from lerobot_uca.lerobot_patches.guard import make_registered_steps_only
from lerobot_uca.lerobot_patches.messages import is_command, report_user_errors, shorten_decoder_warning
from lerobot_uca.lerobot_patches.reading import normalise_what_is_trained, read_in_batches
from lerobot_uca.lerobot_patches.recording import record_what_can_be_trained
from lerobot_uca.lerobot_patches.settings import check_settings, find_configs_by_name
from lerobot_uca.lerobot_version import is_supported
from lerobot_uca.processes import end_by_signals

USED_NAMES = (
    # Private names and functions without a promise: a port to another LeRobot starts here.
    "accelerate.accelerator.Accelerator.end_training",
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

logger = logging.getLogger(__name__)


def install() -> None:
    """Apply all patches, each for itself. A second call changes nothing."""
    try:
        make_registered_steps_only()  # no line in a log: without it a checkpoint could run code
    finally:
        _install_conveniences()


def _install_conveniences() -> None:
    patches = [report_user_errors, shorten_decoder_warning]
    if is_command():
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
            end_together,
            normalise_what_is_trained,
            record_what_can_be_trained,
        ]
    for patch in patches:
        try:
            patch()
        except Exception as error:  # noqa: BLE001 (one that fails must not take the others down)
            name = f"{patch.__module__}.{patch.__name__}"
            logger.warning("%s is missing: %s: %s", name, type(error).__name__, error)
