"""What `lerobot-train` settles before it trains a policy of this package."""

import functools
import logging
import os
from pathlib import Path

from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig

from lerobot_uca.data.reading import is_batched
from lerobot_uca.errors import UserError
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig

LEROBOTS_WORKERS: int = TrainPipelineConfig.num_workers


def check_output_folder(config: TrainPipelineConfig) -> None:
    """Refuse a folder that cannot be written; LeRobot would only find out at its first checkpoint."""
    if config.job.is_remote:  # the folder is on another machine
        return
    parent = Path(config.output_dir).absolute()
    while not os.path.lexists(parent):
        parent = parent.parent
    if not (parent.is_dir() and os.access(parent, os.W_OK | os.X_OK)):
        raise UserError(f"output_dir '{config.output_dir}' cannot be written: '{parent}' is not a writable folder.")


def read_without_workers(config: TrainPipelineConfig) -> None:
    """Let this process read the batches, unless the user chose a number of workers.

    Batched reading takes less time than handing a batch from one process to another, and LeRobot's four workers
    each import everything anew: half a minute on two cores, which they then share with the training.
    """
    is_ours = isinstance(config.policy, PointCloudPolicyConfig) and is_batched() and not config.dataset.streaming
    is_default = config.num_workers == LEROBOTS_WORKERS and parser.parse_arg("num_workers") is None
    if is_ours and is_default:
        logging.getLogger(__name__).info("Reading without workers; --num_workers=N asks for some.")
        config.num_workers = 0


def install() -> None:
    """Let LeRobot do this with each training configuration it validates."""
    validate = TrainPipelineConfig.validate

    @functools.wraps(validate)
    def validate_and_settle(self: TrainPipelineConfig) -> None:
        validate(self)
        check_output_folder(self)
        read_without_workers(self)

    TrainPipelineConfig.validate = validate_and_settle


install()
