"""Checkpoints: saving, resuming and uploading them."""

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot.common import train_utils
from lerobot.configs import PreTrainedConfig
from lerobot.processor import DataProcessorPipeline
from lerobot.utils import utils

from lerobot_uca.checkpoints.resuming import cycle_exactly, without_trace
from lerobot_uca.checkpoints.saving import save_whole, update_last
from lerobot_uca.errors import UserError, reported
from lerobot_uca.hub import upload_command, uploading
from lerobot_uca.lerobot_patches.replacing import replace, replace_class_method, replace_method
from lerobot_uca.policies.publishing import PublishedPolicy, retry_of

logger = logging.getLogger(__name__)


class MissingFileError(UserError, FileNotFoundError):
    """A checkpoint's missing file, also for programs that then do something else."""


class MissingFolderError(UserError, NotADirectoryError):
    """A missing checkpoint, also for programs that then do something else."""


@contextmanager
def _reported_part(what: str) -> Iterator[None]:
    try:
        with reported(what):
            yield
    except UserError as error:
        cause = error.__cause__
        if isinstance(cause, FileNotFoundError):
            raise MissingFileError(str(error)) from cause
        if isinstance(cause, NotADirectoryError):
            raise MissingFolderError(str(error)) from cause
        raise


def report_damaged_checkpoints() -> None:
    """One line names the missing or damaged part, or the wrong option. LeRobot shows a library's traceback."""

    def policy(load: Callable[..., Any]) -> Callable[..., Any]:
        def from_pretrained(cls: type, pretrained_name_or_path: Path | str, **kwargs: Any) -> Any:
            options = ", ".join(f"policy.{option.lstrip('-')}" for option in kwargs.get("cli_overrides") or ())
            changed = f" with {options}" if options else ""
            with _reported_part(f"'{pretrained_name_or_path}' does not hold a policy that can be loaded{changed}"):
                return load(cls, pretrained_name_or_path, **kwargs)

        return from_pretrained

    def state(load: Callable[..., Any]) -> Callable[..., Any]:
        def load_training_state(checkpoint_dir: Path, *args: Any, **kwargs: Any) -> Any:
            with _reported_part(f"Training cannot go on from '{checkpoint_dir}'"):
                return load(checkpoint_dir, *args, **kwargs)

        return load_training_state

    replace_class_method(PreTrainedConfig, "from_pretrained", policy)
    replace(train_utils.load_training_state, state)


def save_checkpoints_whole() -> None:
    """See `checkpoints/saving.py`."""
    replace(train_utils.save_checkpoint, save_whole)
    replace(train_utils.update_last_checkpoint, update_last)


def resume_exactly() -> None:
    """See `checkpoints/resuming.py`."""
    replace(utils.cycle, cycle_exactly)
    evaluation = sys.modules.get("lerobot.scripts.lerobot_eval")  # where training has it from
    if evaluation is not None:
        replace(evaluation.eval_policy_all, lambda evaluate: _remember_success(without_trace(evaluate)))


def _remember_success(evaluate: Callable[..., Any]) -> Callable[..., Any]:
    """Remember the success rate for the policy's page on the Hub."""

    def eval_policy_all(*args: Any, **kwargs: Any) -> Any:
        info = evaluate(*args, **kwargs)
        policy = kwargs.get("policy")
        if isinstance(policy, PublishedPolicy):
            policy.remember_success(info, kwargs.get("start_seed"))
        return info

    return eval_policy_all


def report_failed_uploads() -> None:
    """A checkpoint that cannot be uploaded is a warning, a policy an error in one line. LeRobot ends in a traceback."""

    def checkpoint(push: Callable[..., None]) -> Callable[..., None]:
        def push_checkpoint_to_hub(checkpoint_dir: Path, repo_id: str, *, private: bool | None = None) -> None:
            retry = upload_command(repo_id, checkpoint_dir, f"checkpoints/{checkpoint_dir.name}", private=private)
            try:
                with uploading(f"Checkpoint '{checkpoint_dir}'", retry):
                    push(checkpoint_dir, repo_id, private=private)
            except UserError as error:
                logger.warning("%s", error)  # the training goes on

        return push_checkpoint_to_hub

    def processors(push: Callable[..., Any]) -> Callable[..., Any]:
        def push_to_hub(self: DataProcessorPipeline, repo_id: str, **kwargs: Any) -> Any:
            retry = retry_of.get().get(repo_id)
            if retry is None:  # another policy's
                return push(self, repo_id, **kwargs)
            with uploading(f"Pipeline '{self.name}'", retry):
                return push(self, repo_id, **kwargs)

        return push_to_hub

    replace(train_utils.push_checkpoint_to_hub, checkpoint)
    replace_method(DataProcessorPipeline, "push_to_hub", processors)
