"""`lerobot-uca-collect`: demonstrations of a simulated task, as a LeRobot dataset.

Example:
    lerobot-uca-collect --env.type=metaworld_pointcloud --env.task=dial-turn --repo_id=local/dial-turn
"""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs import FeatureType, parser
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.utils import SuppressProgressBars
from numpy.typing import NDArray
from tqdm import tqdm

from lerobot_uca.bounds import check_bounds, within
from lerobot_uca.data.demonstrations import demonstrations
from lerobot_uca.data.new_dataset import new_dataset_root
from lerobot_uca.data.whole_folder import whole_folder
from lerobot_uca.envs.configs import PointCloudEnvConfig
from lerobot_uca.envs.experts.expert import Attempt, pushed, smoothed
from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD, observation_info
from lerobot_uca.hub import push_dataset
from lerobot_uca.point_clouds.recipe import RECIPE_INFO

FIRST_SEED = 1_000_000
"""First seed of the demonstrations. LeRobot evaluates from seed 1000 upwards unless told otherwise."""

MAX_ATTEMPTS = 20
"""Attempts for each wanted episode before the collector gives up."""


@dataclass
class CollectConfig:
    """Make demonstrations of a simulated task with an expert, as a LeRobot dataset.

    lerobot-uca-collect --env.type=metaworld_pointcloud --env.task=reach --repo_id=local/reach --root=data/reach

    Add --env.type=... to --help to see the environment's options. With several tasks, the dataset holds all of them.
    """

    # The environment and its task or tasks.
    env: EnvConfig
    # Name of the dataset, 'user/name'.
    repo_id: str
    # Folder to write; by default where LeRobot looks for it, $HF_LEROBOT_HOME/repo_id.
    root: Path | None = None
    # The demonstrator. Meta-World's experts are built in; Adroit's are files: weights as .npz or as an original DAPG
    # pickle, or a Minari dataset such as minari:D4RL/door/expert-v2. '{task}' stands for each task.
    expert: str | None = None
    # Weight of the expert's new action against the last one, a first-order filter: 1 for the expert as it is. An expert
    # that chatters is easier to imitate when it is smoothed (docs/benchmark.md).
    smoothing: float = 1.0
    # Horizontally the hand goes straight to where the expert wants it, equally fast in all directions. By default x and
    # y are limited one by one, as in the papers: far from its aim the hand goes diagonally, the last part along one
    # axis. With --policy.scene_turn a straight motion still fits when it is turned (docs/recipe.md). Meta-World alone.
    straight_paths: bool = False
    # Probability, in each step, that something begins to push the hand, for 5 to 10 steps in a random direction, and in
    # one of three pushes the gripper as well. The dataset holds what the expert would have done, so it shows how to
    # recover, which helps some tasks and harms others (docs/recipe.md). 0 leaves the expert undisturbed, as in the
    # papers.
    pushes: float = 0.0
    # A demonstration ends after so many successful steps. By default it goes on to the end of the episode, as the
    # baselines' do, so half of a dataset may show what happens after the success, where nothing is left to learn: with
    # 10, Meta-World's tasks are solved more often in the mean (docs/recipe.md).
    successful_steps: int | None = within(None, least=1, most=1_000_000)
    # Successful demonstrations of each task.
    n_episodes: int = within(10, least=1, most=1_000_000)
    # Seed of the first attempt; each further attempt adds 1. Keep it away from the seeds of evaluation (LeRobot's start
    # at 1000), or the policy is tested on what it has seen. A Minari dataset's episodes bring their own starts.
    seed: int = within(FIRST_SEED, least=0, most=2**31)
    # Replace the dataset if it exists.
    overwrite: bool = False
    # Upload the dataset to the Hugging Face Hub under repo_id.
    push_to_hub: bool = False
    # Upload as a private dataset; by default as the account's settings say.
    private: bool | None = None


def collect(config: CollectConfig) -> LeRobotDataset:
    """Collect, write and, if asked for, upload a dataset.

    The dataset is written whole or not at all, see `whole_folder`.

    Raises:
        UserError: if the folder exists, is being written, cannot be written, or the expert fails too often.
    """
    env_config = config.env
    if not isinstance(env_config, PointCloudEnvConfig):
        raise UserError(f"Only point-cloud environments have a demonstrator, got env.type={env_config.type}.")
    check_bounds(config)
    root = new_dataset_root(config.repo_id, config.root, overwrite=config.overwrite)
    env_config.validate()
    _check_successful_steps(config, env_config)
    attempts = _attempts(config, env_config)  # before anything is written: the expert may not exist
    with whole_folder(root, overwrite=config.overwrite) as unfinished:
        _write(config, env_config, attempts, unfinished)
    dataset = LeRobotDataset(config.repo_id, root=root)
    if config.push_to_hub:
        push_dataset(dataset, private=config.private, tags=["point-cloud", env_config.type])
    return dataset


def _attempts(config: CollectConfig, env_config: PointCloudEnvConfig) -> dict[str, Iterator[Attempt]]:
    # Groups may overlap; a task's episodes are wanted once.
    tasks = dict.fromkeys(task for tasks in env_config.tasks().values() for task in tasks)
    straight = config.straight_paths
    attempts = {task: env_config.attempts(task, config.expert, config.seed, straight_paths=straight) for task in tasks}
    names = env_config.action_names()
    return {
        task: pushed(smoothed(of_task, config.smoothing), config.pushes, names) for task, of_task in attempts.items()
    }


def _check_successful_steps(config: CollectConfig, env_config: PointCloudEnvConfig) -> None:
    if config.successful_steps is None:
        return
    task = next(task for tasks in env_config.tasks().values() for task in tasks)
    env = env_config.env_factory(task)()
    least = env.min_successful_steps
    if env.succeeds_at_the_end:
        raise UserError(
            "--successful_steps ends an episode before its time, and so before env.success=final is decided: add "
            "--env.success=any."
        )
    if config.successful_steps < least:
        raise UserError(
            f"--successful_steps must be at least {least}, as many as make an episode of {env_config.type} a "
            f"demonstration, got {config.successful_steps}."
        )


def _write(
    config: CollectConfig, env_config: PointCloudEnvConfig, attempts: dict[str, Iterator[Attempt]], root: Path
) -> None:
    dataset = LeRobotDataset.create(
        config.repo_id, fps=env_config.fps, features=_features(env_config), root=root, use_videos=False
    )
    try:
        for task, of_task in attempts.items():
            _collect_task(dataset, config, env_config, task, of_task)
    finally:
        dataset.finalize()  # closes its files, which would otherwise come back when they are garbage-collected


def _collect_task(
    dataset: LeRobotDataset,
    config: CollectConfig,
    env_config: PointCloudEnvConfig,
    task: str,
    attempts: Iterator[Attempt],
) -> None:
    description, n_episodes = env_config.task_description(task), config.n_episodes
    attempts = islice(attempts, MAX_ATTEMPTS * n_episodes)
    episodes = demonstrations(
        env_config.env_factory(task), attempts, n_wanted=n_episodes, successful_steps=config.successful_steps
    )
    n_tried = n_kept = 0
    bar = tqdm(total=n_episodes, desc=f"Demonstrations of {task}", unit="episode")
    with closing(episodes), bar as progress:
        for n_tried, episode in enumerate(episodes, start=1):
            if episode.is_successful:
                for seen, state, action in zip(*episode[:3], strict=True):
                    frame = {OBS_STATE: state, ACTION: action, "task": description}
                    dataset.add_frame({**frame, **_seen(env_config, seen)})
                with SuppressProgressBars():
                    dataset.save_episode()
                n_kept += 1
                progress.update()
            progress.set_postfix(tried=n_tried)
        if n_kept < n_episodes:  # not progress.n, which stands still where bars are switched off
            raise UserError(
                f"The expert of '{task}' succeeded in {n_kept} of {n_tried} episodes, {n_episodes} are wanted."
            )


def _seen(env_config: PointCloudEnvConfig, seen: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """A cloud (N, 3) or a depth image (1, H, W) under its feature's name; LeRobot writes images as (H, W, 1)."""
    (key,) = set(env_config.features_map.values()) - {OBS_STATE, ACTION}
    return {key: seen if key == OBS_POINT_CLOUD else np.moveaxis(seen, 0, -1)}


def _features(env_config: PointCloudEnvConfig) -> dict[str, dict[str, Any]]:
    state_names, action_names = env_config.state_names(), env_config.action_names()
    features: dict[str, dict[str, Any]] = {
        OBS_STATE: {"dtype": "float32", "shape": (len(state_names),), "names": state_names},
        ACTION: {"dtype": "float32", "shape": (len(action_names),), "names": action_names},
    }
    recipe = env_config.recipe()
    made = {} if recipe is None else {RECIPE_INFO: recipe.as_dict()}
    info = {**made, **observation_info(env_config.observation)}
    for name, feature in env_config.features.items():
        if feature.type is FeatureType.VISUAL:
            features[env_config.features_map[name]] = {
                "dtype": "image",
                "shape": feature.shape,
                "names": ["height", "width", "channels"],
                "info": {"is_depth_map": True, **info},
            }
        elif name == "point_cloud":
            features[OBS_POINT_CLOUD] = {
                "dtype": "float32",
                "shape": feature.shape,
                "names": ["point", "xyz"],
                "info": info,
            }
    return features


@parser.wrap()
def run(config: CollectConfig) -> None:
    """Collect and say what was collected."""
    dataset = collect(config)
    print(
        f"{dataset.num_episodes} episodes, {dataset.num_frames} frames: {dataset.root}\n"
        f"Evaluate on other seeds than these (lerobot-eval uses 1000 and up)."
    )
