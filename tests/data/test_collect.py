import dataclasses
import gc
import os
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from itertools import islice

import numpy as np
import pytest
import torch
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import make_env_config
from lerobot.policies import make_pre_post_processors
from tests.builders import make_config, make_statistics
from tests.depth_builders import make_recipe

from lerobot_uca.data import collect as collecting
from lerobot_uca.data import demonstrations
from lerobot_uca.data.collect import CollectConfig, collect
from lerobot_uca.data.convert import ConvertConfig, convert
from lerobot_uca.data.demonstrations import Demonstration, demonstrate
from lerobot_uca.envs.adroit import HAND
from lerobot_uca.envs.configs import AdroitPointCloudConfig, MetaworldPointCloudConfig
from lerobot_uca.envs.experts.expert import pushed
from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD, cloud_observation
from lerobot_uca.point_clouds.recipe import RECIPE_INFO, CloudRecipe
from lerobot_uca.policies.depth_config import DepthConfig
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
from lerobot_uca.policies.processor_base import make_processors
from lerobot_uca.policies.processor_depth import DepthToCloudProcessorStep


def config(root, **changes):
    env = MetaworldPointCloudConfig(task="drawer-close", n_points=16)
    return CollectConfig(**{"env": env, "repo_id": "test/drawer", "root": root, "n_episodes": 1, **changes})


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    root = tmp_path_factory.mktemp("collected") / "drawer"
    return collect(config(root))


def test_a_dataset_holds_whole_episodes_as_executed(collected):
    assert (collected.num_episodes, collected.num_frames, collected.fps) == (1, 200, 80)
    assert set(collected.features) >= {OBS_POINT_CLOUD, "observation.state", "action"}
    env = collected_env()
    attempt = next(env.attempts("drawer-close", None, collecting.FIRST_SEED))
    episode = demonstrate(env.env_factory("drawer-close"), attempt)
    frames = [collected[index] for index in range(200)]
    np.testing.assert_array_equal(np.stack([frame[OBS_POINT_CLOUD] for frame in frames]), episode.seen)
    np.testing.assert_array_equal(np.stack([frame["observation.state"] for frame in frames]), episode.state)
    np.testing.assert_array_equal(np.stack([frame["action"] for frame in frames]), episode.action)
    assert np.abs(episode.action).max() == 1  # the expert asks for more; what is written is what was done
    assert episode.is_successful
    assert frames[0]["task"] == env.task_description("drawer-close")


def test_a_demonstration_can_end_soon_after_its_success(collected, tmp_path):
    collect(config(tmp_path / "drawer", successful_steps=10))
    dataset = LeRobotDataset("test/drawer", root=tmp_path / "drawer")
    env_config = collected_env()
    attempt = next(env_config.attempts("drawer-close", None, collecting.FIRST_SEED))
    env, expert = env_config.env_factory("drawer-close")(), attempt.expert()
    env.reset(**attempt.reset)
    n_steps = n_successful = 0
    while n_successful < 10:
        *_, info = env.step(expert(env))
        n_steps, n_successful = n_steps + 1, n_successful + info["is_success"]
    assert len(dataset) == n_steps < 100
    for short, whole in zip(dataset, collected, strict=False):
        for key in (OBS_POINT_CLOUD, "observation.state", "action"):
            np.testing.assert_array_equal(short[key], whole[key])


def test_a_demonstration_cannot_end_before_it_is_one(tmp_path):
    with pytest.raises(UserError, match=r"--successful_steps must be at least 5, .* metaworld_pointcloud .*, got 4"):
        collect(config(tmp_path / "new", successful_steps=4))
    assert not (tmp_path / "new").exists()


def test_a_demonstration_cannot_end_before_its_success_is_decided(tmp_path):
    with pytest.raises(UserError, match=r"before env\.success=final is decided: add --env\.success=any\."):
        collect(config(tmp_path / "new", env=AdroitPointCloudConfig(task="door"), successful_steps=10))


def test_a_demonstration_can_go_straight(collected, tmp_path):
    collect(config(tmp_path / "drawer", straight_paths=True))
    straight, bent = (
        np.stack([frame["action"] for frame in dataset])
        for dataset in (LeRobotDataset("test/drawer", root=tmp_path / "drawer"), collected)
    )
    speed = np.hypot(*bent.T[:2])
    assert speed.max() > 1.2
    first = int((speed > 1).argmax())
    np.testing.assert_array_equal(straight[:first], bent[:first])
    assert np.hypot(*straight[first, :2]) == pytest.approx(1)
    assert np.hypot(*straight.T[:2]).max() == pytest.approx(1)


def test_joints_do_not_go_straight(tmp_path):
    with pytest.raises(UserError, match=r"--straight_paths needs an expert that moves a hand along x and y"):
        collect(config(tmp_path / "door", env=AdroitPointCloudConfig(task="door"), straight_paths=True))
    assert not (tmp_path / "door").exists()


def test_of_a_pushed_hand_the_dataset_holds_what_the_expert_would_have_done(tmp_path):
    env_config = collected_env()
    collect(config(tmp_path / "drawer", pushes=0.05))
    dataset = LeRobotDataset("test/drawer", root=tmp_path / "drawer")
    attempts = env_config.attempts("drawer-close", None, collecting.FIRST_SEED)
    attempt = next(pushed(attempts, 0.05, env_config.action_names()))
    env, expert, executed = env_config.env_factory("drawer-close")(), attempt.expert(), attempt.disturbance()
    observation, _ = env.reset(**attempt.reset)
    n_pushed = np.zeros(4)
    for frame in dataset:
        np.testing.assert_array_equal(frame["observation.state"], observation["agent_pos"])
        action = expert(env)
        np.testing.assert_array_equal(frame["action"], action)
        done = executed(action)
        n_pushed += done != action
        observation, *_ = env.step(done)
    assert (n_pushed[:3] > 10).all()
    assert 0 < n_pushed[3] < n_pushed[0]  # some of the pushes take the gripper


def collected_env():
    return MetaworldPointCloudConfig(task="drawer-close", n_points=16)


def test_statistics_are_per_channel(collected):
    for statistic in ("min", "max"):
        assert collected.meta.stats[OBS_POINT_CLOUD][statistic].shape == (3,)


def test_the_dataset_is_the_same_without_progress_bars(collected, tmp_path, monkeypatch):
    monkeypatch.setattr(collecting, "tqdm", partial(collecting.tqdm, disable=True))  # as with TQDM_DISABLE=1
    other = collect(config(tmp_path / "drawer"))
    assert other.num_frames == collected.num_frames
    for index in (0, 100, 199):
        for key, value in collected[index].items():
            assert value == other[index][key] if isinstance(value, str) else torch.equal(value, other[index][key])


def test_depth_images_make_the_clouds_of_the_same_episode(collected, tmp_path):
    env = MetaworldPointCloudConfig(task="drawer-close", n_points=16, observation="depth")
    depth = collect(config(tmp_path / "depth", env=env))
    (key,) = depth.meta.depth_keys
    assert key == "observation.images.corner2_depth"
    for made_with in (depth.features[key]["info"], collected.features[OBS_POINT_CLOUD]["info"]):
        assert CloudRecipe.from_dict(made_with[RECIPE_INFO]) == env.recipe()
    make = env.recipe().make()
    for index in (0, 100):
        cloud, frame = collected[index][OBS_POINT_CLOUD].numpy(), depth[index]
        np.testing.assert_array_equal(frame["action"], collected[index]["action"])
        points = make.points([frame[key].numpy()])
        assert np.linalg.norm(points[None] - cloud[:, None], axis=-1).min(axis=1).max() < 0.002


def test_clouds_without_the_robot_are_told_from_others(collected, tmp_path):
    env = MetaworldPointCloudConfig(task="drawer-close", n_points=16, observation="object_cloud")
    objects = collect(config(tmp_path / "objects", env=env))
    assert cloud_observation(objects.features) == "object_cloud"
    assert cloud_observation(collected.features) == "point_cloud"
    assert env.recipe() is None  # depth images show the robot
    again = convert(ConvertConfig(source=objects.root, repo_id="test/again", root=tmp_path / "again", n_points=8))
    assert cloud_observation(again.features) == "object_cloud"
    assert (objects[0][OBS_POINT_CLOUD] != collected[0][OBS_POINT_CLOUD]).any()
    assert torch.equal(objects[0]["action"], collected[0]["action"])
    policy = make_config(depth=DepthConfig(recipe=make_recipe().as_dict()))
    policy.set_dataset_feature_metadata(objects.features)
    assert policy.depth.recipe is None  # of a checkpoint that has seen clouds with the robot
    policy.set_dataset_feature_metadata({"other.cloud": collected.features[OBS_POINT_CLOUD]})
    assert policy.observation == "object_cloud"  # not yet renamed
    UCAFlowPolicy(policy).save_pretrained(tmp_path / "policy")
    with_recipe = make_config(depth=DepthConfig(recipe=make_recipe().as_dict()))
    for processors in make_processors(with_recipe, make_statistics()):
        processors.save_pretrained(tmp_path / "policy")
    preprocess, _ = make_pre_post_processors(policy, pretrained_path=str(tmp_path / "policy"))
    assert [step.recipe for step in preprocess.steps if isinstance(step, DepthToCloudProcessorStep)] == [None]
    for dataset, other in ((objects, "point_cloud"), (collected, "object_cloud"), (objects, "point_cloud")):
        policy.set_dataset_feature_metadata(dataset.features)
        trained = policy.observation
        assert trained != other
        policy.check_environment(None)
        policy.check_environment(MetaworldPointCloudConfig(observation=trained))
        message = f"training has clouds of env.observation={trained}, .* gives {other}: add --env.observation={trained}"
        with pytest.raises(UserError, match=message):
            policy.check_environment(MetaworldPointCloudConfig(observation=other))
    with pytest.raises(UserError, match="gives point_cloud: it has no other"):  # another package's
        policy.check_environment(object())
    policy.set_dataset_feature_metadata(collected.features)
    policy.check_environment(MetaworldPointCloudConfig(observation="depth"))


def test_nothing_but_the_dataset_is_left(collected):
    assert [path.name for path in collected.root.parent.iterdir()] == ["drawer"]


def test_an_existing_folder_is_kept_unless_overwritten(collected, tmp_path):
    root = tmp_path / "drawer"
    shutil.copytree(collected.root, root)
    with pytest.raises(UserError, match=re.escape(f"'{root}' exists. Choose another folder, or replace it")):
        collect(config(root))
    assert collect(config(root, overwrite=True)).num_frames == 200


@pytest.fixture
def killed_while_writing(monkeypatch):
    """The second episode is interrupted."""
    save_episode = LeRobotDataset.save_episode

    def save_or_die(self):
        if self.num_episodes:
            raise KeyboardInterrupt
        save_episode(self)

    monkeypatch.setattr(LeRobotDataset, "save_episode", save_or_die)


@pytest.mark.usefixtures("killed_while_writing")
def test_a_run_that_dies_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        collect(config(tmp_path / "drawer", n_episodes=2))
    gc.collect()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("killed_while_writing")
def test_an_overwrite_that_dies_keeps_the_old_dataset(collected, tmp_path):
    root = tmp_path / "drawer"
    shutil.copytree(collected.root, root)
    with pytest.raises(KeyboardInterrupt):
        collect(config(root, n_episodes=2, overwrite=True))
    assert LeRobotDataset("test/drawer", root=root).num_frames == 200


def test_an_expert_that_fails_is_reported(tmp_path, monkeypatch):
    failed = Demonstration(*(np.zeros((3, 1)) for _ in range(3)), is_successful=False)
    monkeypatch.setattr(collecting, "demonstrations", lambda env, attempts, **_: (failed for _ in attempts))
    with pytest.raises(UserError, match="The expert of 'drawer-close' succeeded in 0 of 20 episodes, 1 are wanted"):
        collect(config(tmp_path / "drawer"))
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(UserError, match="Cannot write"):
        collect(config(tmp_path / "file" / "drawer"))


@pytest.mark.parametrize("pipeline", [EvalPipelineConfig, TrainPipelineConfig])
def test_seeds_of_demonstrations_and_evaluation_are_apart(pipeline):
    """LeRobot evaluates episode i with its default seed + i, also during training."""
    first_evaluation = next(field.default for field in dataclasses.fields(pipeline) if field.name == "seed")
    assert first_evaluation + 100_000 <= collecting.FIRST_SEED


def test_groups_that_overlap_give_each_task_once(tmp_path):
    env = MetaworldPointCloudConfig(task="hard,assembly,push,dial-turn", n_points=16)
    attempts = collecting._attempts(config(tmp_path / "x", env=env), env)
    assert list(attempts) == [*env.tasks()["hard"], "dial-turn"]


def test_a_name_that_is_too_long(tmp_path):
    with pytest.raises(UserError, match="Cannot write"):
        collect(config(tmp_path / ("x" * 300)))


def test_an_adroit_dataset_holds_the_successful_episodes_alone(adroit_experts, tmp_path):
    env = AdroitPointCloudConfig(task="pen", n_points=16)
    expert = str(adroit_experts / "{task}.npz")
    dataset = collect(config(tmp_path / "pen", env=env, expert=expert, seed=1))  # of seeds 1 and 2, 1 fails
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (1, 50, 50)
    assert dataset.features["action"]["names"] == dataset.features["observation.state"]["names"] == list(HAND)
    failed, kept = (
        demonstrate(env.env_factory("pen"), attempt) for attempt in islice(env.attempts("pen", expert, first_seed=1), 2)
    )
    assert (failed.is_successful, kept.is_successful) == (False, True)
    np.testing.assert_array_equal(np.stack([dataset[index]["action"] for index in range(50)]), kept.action)


def test_meta_world_takes_no_expert(tmp_path):
    with pytest.raises(UserError, match=r"Meta-World's experts are built in\. Leave --expert out, got 'door\.npz'"):
        collect(config(tmp_path / "new", expert="door.npz"))


def test_wrong_settings(tmp_path):
    with pytest.raises(UserError, match=r"repo_id must be 'user/name', got 'a/b/c'"):
        collect(config(tmp_path / "new", repo_id="a/b/c"))
    with pytest.raises(UserError, match=r"env\.fps of metaworld_pointcloud is 80, the simulation's own; got 30"):
        collect(config(tmp_path / "new", env=MetaworldPointCloudConfig(task="reach", fps=30)))
    with pytest.raises(UserError, match="n_episodes must be at least 1, got 0"):
        collect(config(tmp_path / "new", n_episodes=0))
    with pytest.raises(UserError, match=r"Only point-cloud environments have a demonstrator, got env\.type=pusht"):
        collect(config(tmp_path / "new", env=make_env_config("pusht")))


@pytest.mark.parametrize(("cores", "wanted", "workers"), [({0}, 5, 1), ({0, 1, 2, 3}, 2, 2), ({0, 1}, 5, 2)])
def test_no_more_processes_than_cores_or_episodes(cores, wanted, workers, monkeypatch):
    """On a machine of many cores a job may have few."""

    @contextmanager
    def pool(n_workers):
        assert n_workers == workers
        with ThreadPoolExecutor(n_workers) as threads:
            yield threads

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: cores)
    monkeypatch.setattr(demonstrations, "worker_pool", pool)
    one = Demonstration(np.zeros((1, 4, 3)), np.zeros((1, 9)), np.zeros((1, 4)), is_successful=True)
    monkeypatch.setattr(demonstrations, "demonstrate", lambda *_: one)
    assert len(list(demonstrations.demonstrations(None, iter(range(9)), n_wanted=wanted))) == wanted
