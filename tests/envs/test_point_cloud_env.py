"""What holds for every environment, as LeRobot's commands make it."""

import numpy as np
import pytest
from lerobot.envs import make_env, make_env_config, preprocess_observation
from lerobot.envs.utils import env_to_policy_features

from lerobot_uca.envs.point_cloud_env import PointCloudEnv
from lerobot_uca.errors import UserError


@pytest.mark.parametrize(
    ("kind", "task", "n_actions", "episode_length"),
    [("metaworld_pointcloud", "dial-turn", 4, 200), ("adroit_pointcloud", "pen", 24, 50)],
)
@pytest.mark.parametrize("use_async_envs", [False, True])
def test_vector_environments_give_the_episodes_of_single_ones(kind, task, n_actions, episode_length, use_async_envs):
    config = make_env_config(kind, task=task, n_points=64)
    vector = make_env(config, n_envs=2, use_async_envs=use_async_envs)[task][0]
    try:
        observations, _ = vector.reset(seed=[5, 6])
        assert vector.call("_max_episode_steps")[0] == episode_length
        assert vector.call("task")[0] == task
        assert vector.call("task_description")[0] == config.task_description(task)
        actions = np.full((2, n_actions), 0.5, dtype=np.float32)
        stepped, *_, info = vector.step(actions)
        assert info["is_success"].tolist() == [False, False]
        assert vector.call("render")[0].shape == (320, 320, 3)
    finally:
        vector.close()
    for index, seed in enumerate((5, 6)):
        single = config.env_factory(task)()
        observation, _ = single.reset(seed=seed)
        np.testing.assert_array_equal(observations["point_cloud"][index], observation["point_cloud"])
        np.testing.assert_array_equal(stepped["point_cloud"][index], single.step(actions[index])[0]["point_cloud"])


@pytest.mark.parametrize(("kind", "task"), [("metaworld_pointcloud", "dial-turn"), ("adroit_pointcloud", "pen")])
def test_observations_reach_the_policy_under_the_features_names(kind, task):
    config = make_env_config(kind, task=task)
    env = config.env_factory(task)()
    batch = preprocess_observation(env.reset(seed=0)[0])
    features = env_to_policy_features(config)
    assert features["action"].shape == env.action_space.shape
    for key, feature in features.items():
        if key != "action":
            assert tuple(batch[key].shape[-len(feature.shape) :]) == feature.shape


SEEDED_TASKS = {
    "metaworld_pointcloud": ("drawer-close", "assembly", "pick-place", "door-lock"),
    "adroit_pointcloud": ("hammer", "door", "pen", "relocate"),
}


@pytest.mark.parametrize(("kind", "task"), [(kind, task) for kind, tasks in SEEDED_TASKS.items() for task in tasks])
def test_a_seed_gives_the_same_episode_in_any_order_and_another_seed_does_not(kind, task):
    make = make_env_config(kind, task=task, n_points=64).env_factory(task)
    env = make()
    first, other = rollout(env, 7), rollout(env, 8)
    for a, b, c in zip(first, rollout(make(), 7), rollout(env, 7), strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)
    assert not np.array_equal(first[0], other[0])


def rollout(env: PointCloudEnv, seed: int, n_steps: int = 3) -> list[np.ndarray]:
    observation, _ = env.reset(seed=seed)
    arrays = [observation["point_cloud"], observation["agent_pos"]]
    rng = np.random.default_rng(0)
    for _ in range(n_steps):
        observation, reward, *_ = env.step(rng.uniform(-1, 1, env.n_actions).astype(np.float32))
        arrays += [observation["point_cloud"], observation["agent_pos"], np.array(reward)]
    return arrays


@pytest.mark.parametrize("kind", ["metaworld_pointcloud", "adroit_pointcloud"])
def test_tasks_in_threads_would_share_the_policys_memory(kind):
    config = make_env_config(kind, max_parallel_tasks=2)
    for start in (config.get_env_processors, lambda: make_env(config)):  # of training and of evaluation
        with pytest.raises(UserError, match=r"env\.max_parallel_tasks must be 1, got 2: .* share one policy"):
            start()
