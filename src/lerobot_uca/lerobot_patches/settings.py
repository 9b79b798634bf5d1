"""Checking and finding the settings of a training or an evaluation."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_uca import configs
from lerobot_uca.checkpoints.only_run import keep_others_out
from lerobot_uca.errors import UserError
from lerobot_uca.lerobot_patches.recording import evaluated_observation
from lerobot_uca.lerobot_patches.replacing import replace_class_method, replace_method
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig
from lerobot_uca.policies.precision import amp_of_evaluation, dtype_of_training


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
                _check_precision(self.policy)
                _check_upload(self, self.policy)
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

    replace_method(TrainPipelineConfig, "validate", validated)
    replace_method(EvalPipelineConfig, "__post_init__", made)


def _check_precision(policy: PointCloudPolicyConfig) -> None:
    """LeRobot trains in `dtype`; lerobot-eval would then evaluate with the `use_amp` that training has left aside."""
    if policy.use_amp and policy.dtype == "float32":
        raise UserError(
            "policy.use_amp is lerobot-eval's, training does not look at it: "
            "--policy.dtype=bfloat16 trains in bfloat16."
        )


def _check_upload(config: TrainPipelineConfig, policy: PointCloudPolicyConfig) -> None:
    """LeRobot uploads from a temporary folder: where that fails, the whole training would be lost."""
    if policy.push_to_hub and not config.save_checkpoint:
        raise UserError(
            "--policy.push_to_hub=true uploads what has been saved, but --save_checkpoint=false saves nothing: leave "
            "the latter out, or say --policy.push_to_hub=false."
        )


def _check_evaluation(config: EvalPipelineConfig, policy: PointCloudPolicyConfig) -> None:
    check_output_folder(config.output_dir)
    policy.check_environment(config.env)
    policy.use_amp = amp_of_evaluation(policy.use_amp, policy.device)
    evaluated_observation.set(policy.observation)


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
            path = configs.path_of(str(pretrained_name_or_path)) or Path(pretrained_name_or_path)
            # A repository of the Hub is "user/name".
            is_file_name = len(path.parts) == 1 or path.suffix in (".yaml", ".yml", ".json")
            if is_file_name and not path.exists():
                raise UserError(
                    f"Unknown configuration '{pretrained_name_or_path}'. This package's: {', '.join(configs.NAMES)}; "
                    "or the path of a file."
                )
            return load(cls, path if path.exists() else pretrained_name_or_path, **kwargs)

        return from_pretrained

    replace_class_method(TrainPipelineConfig, "from_pretrained", named)
