"""Everything that this package changes in LeRobot, in one place. `install()` is called when LeRobot loads the plugin.

Written for LeRobot 0.6.1. Each patch says what LeRobot does without it.
"""

import functools
import logging
import os
import sys
from pathlib import Path
from types import TracebackType
from typing import Any

import lerobot
import yaml
from lerobot.configs import parser
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import factory

from lerobot_uca import configs
from lerobot_uca.data.batched_dataset import BatchedDataset
from lerobot_uca.errors import UserError
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig
from lerobot_uca.processes import end_by_signals

SUPPORTED_LEROBOT = "0.6.1"
SWITCH = "LEROBOT_UCA_BATCHED_READING"

logger = logging.getLogger(__name__)


def install() -> None:
    """Apply all patches. A second call changes nothing."""
    report_user_errors()
    if Path(sys.argv[0]).stem.startswith("lerobot"):  # one of LeRobot's commands, not somebody's own program
        end_by_signals()
    shorten_decoder_warning()
    if lerobot.__version__ == SUPPORTED_LEROBOT:
        check_output_folders()
        find_configs_by_name()
        read_in_batches()


def report_user_errors() -> None:
    """A `UserError` ends the process with its message in one line, also when draccus has wrapped it.

    Python prints a traceback for it.
    """
    previous = sys.excepthook
    if getattr(previous, "_reports_user_errors", False):
        return

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
    """LeRobot prints a page of torchcodec's traceback for each dataset where there is no FFmpeg."""
    target = logging.getLogger("lerobot.utils.import_utils")
    if not any(isinstance(each, _DecoderWarning) for each in target.filters):
        target.addFilter(_DecoderWarning())


def check_output_folders() -> None:
    """A folder that cannot be written is refused at once. LeRobot finds out at the first checkpoint or video."""

    def check_training(config: TrainPipelineConfig) -> None:
        if isinstance(config.policy, PointCloudPolicyConfig) and not config.job.is_remote:
            check_output_folder(config.output_dir)

    def check_evaluation(config: EvalPipelineConfig) -> None:
        if isinstance(config.policy, PointCloudPolicyConfig):
            check_output_folder(config.output_dir)

    _call_after(TrainPipelineConfig, "validate", check_training)
    _call_after(EvalPipelineConfig, "__post_init__", check_evaluation)


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
    original = TrainPipelineConfig.from_pretrained
    if getattr(original, "_is_patched", False):
        return

    @functools.wraps(original)
    def from_pretrained(cls: type[TrainPipelineConfig], pretrained_name_or_path: str | Path, **kwargs: Any) -> Any:
        path = configs.path_of(str(pretrained_name_or_path)) or pretrained_name_or_path
        return original.__func__(cls, path, **kwargs)

    from_pretrained._is_patched = True  # type: ignore[attr-defined]
    TrainPipelineConfig.from_pretrained = classmethod(from_pretrained)


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
        dataset = make_dataset(config)
        _read_without_workers(config, dataset)
        return dataset

    factory.make_dataset = make_and_settle


def _read_without_workers(config: TrainPipelineConfig, dataset: Any) -> None:
    """Let this process read the batches, unless the user has chosen a number of workers.

    Batched reading takes less time than handing a batch from one process to another, and LeRobot's four workers
    each import everything anew: half a minute on two cores, which they then share with the training.
    """
    is_ours = isinstance(config.policy, PointCloudPolicyConfig)
    if is_ours and isinstance(dataset, BatchedDataset) and dataset.is_batched and config.num_workers:
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


def _call_after(owner: type, method: str, action: Any) -> None:
    original = getattr(owner, method)
    if getattr(original, "_is_patched", False):
        return

    @functools.wraps(original)
    def patched(self: Any, *args: Any, **kwargs: Any) -> Any:
        result = original(self, *args, **kwargs)
        action(self)
        return result

    patched._is_patched = True  # type: ignore[attr-defined]
    setattr(owner, method, patched)
