"""The data of a training: reading it in batches, checking and normalising it."""

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch
import yaml
from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import factory
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STATE
from tqdm import tqdm

from lerobot_uca import configs
from lerobot_uca.data.batched_dataset import BatchedDataset
from lerobot_uca.data.chosen_episodes import check_finite, chosen_statistics
from lerobot_uca.data.recorded_calibrations import calibrations_of_depth
from lerobot_uca.errors import reported
from lerobot_uca.features import cloud_observation, find_point_cloud, valid_mask
from lerobot_uca.lerobot_patches.replacing import replace
from lerobot_uca.policies.configuration_base import PointCloudPolicyConfig
from lerobot_uca.policies.processor_base import PointCloudProcessorStep

logger = logging.getLogger(__name__)

SWITCH = "LEROBOT_UCA_BATCHED_READING"


def read_in_batches() -> None:
    """A point-cloud policy's training reads datasets without cameras in batches.

    LeRobot reads row by row (issues 2315, 2895, 4392). LEROBOT_UCA_BATCHED_READING=0 switches it off.
    """
    if os.environ.get(SWITCH, "1") == "0":
        return

    def split(make: Callable[..., Any]) -> Callable[..., Any]:
        def make_train_eval_datasets(cfg: TrainPipelineConfig) -> Any:
            with _batched_datasets() if isinstance(cfg.policy, PointCloudPolicyConfig) else nullcontext():
                return make(cfg)

        return make_train_eval_datasets

    def one(make: Callable[..., Any]) -> Callable[..., Any]:
        def make_dataset(cfg: TrainPipelineConfig) -> Any:
            if not isinstance(cfg.policy, PointCloudPolicyConfig):
                return make(cfg)
            if cfg.dataset.streaming and cfg.num_workers == 0:  # LeRobot would make no shard
                logger.warning("A streamed dataset needs workers: num_workers is 1.")
                cfg.num_workers = 1
            with _batched_datasets(), reported(f"Dataset '{cfg.dataset.repo_id}' cannot be read"):
                dataset = make(cfg)
            _read_without_workers(cfg, dataset)
            return dataset

        return make_dataset

    replace(factory.make_dataset, one)
    replace(factory.make_train_eval_datasets, split)


@contextmanager
def _batched_datasets() -> Iterator[None]:
    stock = factory.LeRobotDataset
    factory.LeRobotDataset = BatchedDataset
    try:
        yield
    finally:
        factory.LeRobotDataset = stock


def normalise_what_is_trained() -> None:
    """The data of a training is finite, and its statistics are those of the chosen episodes.

    LeRobot's are those of all episodes, held-out ones included; and a value that is not finite makes all of them NaN.
    Fine-tuning a checkpoint, it asks neither whether the dataset has its features nor how many points a cloud has now.
    """

    def checked(make: Callable[..., Any]) -> Callable[..., Any]:
        def make_train_eval_datasets(cfg: TrainPipelineConfig) -> Any:
            datasets = make(cfg)
            if isinstance(cfg.policy, PointCloudPolicyConfig):
                _begin(cfg, cfg.policy, datasets[0])
                for dataset in filter(None, datasets):
                    _normalise_by_chosen_episodes(cfg, cfg.policy, dataset)
            return datasets

        return make_train_eval_datasets

    replace(factory.make_train_eval_datasets, checked)


def _begin(config: TrainPipelineConfig, policy: PointCloudPolicyConfig, dataset: Any) -> None:
    """Tell the policy whether this is a new training, and which calibrations depth images bring along."""
    policy.is_new_training = not config.resume
    if config.resume:
        policy.depth.keep_calibrations()
    else:
        is_needed = isinstance(dataset, LeRobotDataset) and not policy.depth.calibration  # not streamed
        policy.depth.know_calibrations(calibrations_of_depth(dataset, config.rename_map) if is_needed else {})


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
    check_finite(dataset, masks, config.dataset.episodes)
    cloud_name = find_point_cloud(renamed)
    if dataset.meta.stats:
        dataset.meta.stats = {**dataset.meta.stats, **chosen_statistics(dataset, masks)}
    if policy.n_points is not None and cloud_name is not None and isinstance(dataset, BatchedDataset):
        key = key_of[cloud_name]
        _sample_clouds(PointCloudProcessorStep(policy.n_points, policy.colour), dataset, key, masks[key])


def _sample_clouds(step: PointCloudProcessorStep, dataset: BatchedDataset, key: str, mask_key: str | None) -> None:
    """Sample all clouds once: the processor's step would sample them again in every epoch."""
    columns, n_points = dataset.columns(), step.n_points
    if columns is None or n_points is None or columns.tensors[key].shape[1] <= n_points:
        return
    mask = columns.tensors.pop(mask_key, None) if mask_key else None
    clouds = columns.tensors[key]
    rows = tqdm(range(len(clouds)), desc=f"Sampling {n_points} of {clouds.shape[1]} points", unit="cloud")
    sampled = [step.uniform(clouds[row].float(), None if mask is None else mask[row]) for row in rows]
    columns.tensors[key] = torch.stack(sampled)


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
