"""Contracts of every environment, as LeRobot's commands make it."""

import numpy as np
import pytest
from lerobot.envs import make_env, make_env_config, preprocess_observation
from lerobot.envs.utils import env_to_policy_features

from lerobot_uca.envs.point_cloud_env import PointCloudEnv
from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds import single_rays
from lerobot_uca.point_clouds.cameras import PointCloudCamera
from lerobot_uca.point_clouds.geometry import ray_sphere_distances, sample_farthest
from lerobot_uca.point_clouds.rays import Hits, Rays


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
        for _ in range(episode_length - 1):
            *_, truncated, _ = vector.step(actions)
        assert truncated.tolist() == [True, True]
        again, _ = vector.reset(seed=[5, 6])  # it is frozen for LeRobot's loop alone
        np.testing.assert_array_equal(again["point_cloud"], observations["point_cloud"])
        assert vector.step(actions)[3].tolist() == [False, False]
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


# The robot left out ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "task"),
    [
        *(("metaworld_pointcloud", task) for task in ("reach", "push", "hand-insert", "stick-pull", "coffee-pull")),
        *(("adroit_pointcloud", task) for task in ("hammer", "pen")),
    ],
)
def test_an_object_cloud_is_what_the_camera_sees_without_the_robot(kind, task):
    whole = make_env_config(kind, task=task).env_factory(task)()
    env = make_env_config(kind, task=task, observation="object_cloud").env_factory(task)()
    whole.reset(seed=5)
    cloud = env.reset(seed=5)[0]["point_cloud"].astype(np.float64)
    assert cloud.shape == env.observation_space["point_cloud"].shape
    model, data, markers = whole._simulator.model, whole._simulator.data, whole._markers()
    camera = whole.observer.camera
    hits = camera._caster.cast(model, data)
    rays = camera._caster.rays
    is_of_robot = [hangs_on(model, body, env.robot) for body in model.geom_bodyid]
    is_robot = np.append(is_of_robot, False)[hits.geom]
    robot = rays.origin + rays.directions[is_robot] * hits.distance[is_robot, None]
    robot = robot[camera.crop.contains(robot)]
    everything = camera.capture(model, data, markers)
    rest = everything[distances(everything, robot) > 1e-6]
    assert min(len(robot), len(rest)) > 20
    assert distances(cloud, rest).max() < 1e-6  # float32
    assert distances(rest, cloud).max() < 0.03  # no part is missing


def hangs_on(model, body: int, root: str) -> bool:
    while body and model.body(body).name != root:
        body = model.body_parentid[body]
    return bool(body)


def test_where_the_robot_hides_everything_the_cloud_is_the_robots():
    env = make_env_config("metaworld_pointcloud", task="reach", observation="object_cloud").env_factory("reach")()
    env.reset(seed=0)
    camera = env.observer.camera
    whole = PointCloudCamera(camera.camera, camera.crop).capture(env._simulator.model, env._simulator.data)
    camera._is_left_out = lambda model: np.append(np.ones(model.ngeom, bool), False)
    env._markers = tuple
    assert distances(env.observe()["point_cloud"].astype(np.float64), whole).max() < 1e-6


# Depth --------------------------------------------------------------------------------------------------------------


def depth_config(kind: str, task: str):
    return make_env_config(kind, task=task, observation="depth")


@pytest.mark.parametrize(
    ("kind", "task"),
    [
        ("metaworld_pointcloud", "drawer-close"),
        ("metaworld_pointcloud", "pick-out-of-hole"),
        ("metaworld_pointcloud", "stick-pull"),
        ("adroit_pointcloud", "door"),
    ],
)
def test_a_depth_image_gives_the_cloud_that_the_environment_gives(kind, task):
    """Points are where the cloud's are, to half a millimetre of depth; which of them are sampled may differ."""
    config = depth_config(kind, task)
    depth_env, cloud_env = config.env_factory(task)(), make_env_config(kind, task=task).env_factory(task)()
    cloud = cloud_env.reset(seed=3)[0]["point_cloud"]
    (key,) = set(depth_env.reset(seed=3)[0]) - {"agent_pos"}
    simulator, markers = cloud_env._simulator, cloud_env._markers()
    everything = cloud_env.observer.camera.capture(simulator.model, simulator.data, markers)
    make = config.recipe().make()
    metres = depth_env.observer.camera.capture(simulator.model, simulator.data, markers)
    # From exact depth the same cloud; where two points are equally far, as on a door, rounding may take the other one.
    assert (distances(make([metres / 1e-3]), cloud) < 2e-6).mean() > 0.8
    # From whole millimetres: each point of a cloud is near one of the other's scene, and no part is left out.
    image = depth_env.observe()[key]
    assert (image.shape, image.dtype) == ((1, *metres.shape), np.uint16)
    from_depth = make([image])
    bound = 0.0005 * np.linalg.norm(config.view(task)[0].depth_rays(), axis=1).max() + 1e-6
    spacing = distances(everything, cloud).max()
    at_edge = distances(from_depth, everything) > bound  # a pixel whose point rounding moved across the crop's face
    assert at_edge.mean() < 0.01
    assert distances(from_depth[at_edge], everything).max(initial=0) < 0.01
    assert distances(everything, from_depth).max() < 1.2 * spacing + 0.001


def distances(points: np.ndarray, cloud: np.ndarray) -> np.ndarray:
    """The distance from each of the points to the nearest one of the cloud [m]."""
    return np.array([np.linalg.norm(cloud - point, axis=1).min() for point in points])


def test_depth_reaches_the_policy_under_the_names_of_lerobots_cameras():
    config = depth_config("metaworld_pointcloud", "drawer-close")
    features = env_to_policy_features(config)
    assert features["observation.images.corner2_depth"].shape == (1, 128, 128)
    vector = make_env(config, n_envs=2)["drawer-close"][0]
    try:
        batch = preprocess_observation(vector.reset(seed=[5, 6])[0])
    finally:
        vector.close()
    assert batch["observation.images.corner2_depth"].shape == (2, 1, 128, 128)


def test_depth_is_of_one_camera_and_one_crop():
    config = depth_config("metaworld_pointcloud", "drawer-close,hand-insert")
    with pytest.raises(UserError, match="depth needs tasks of one camera and one crop, got 2 in"):
        config.validate()
    with pytest.raises(UserError, match=r"env\.observation must be one of point_cloud, object_cloud, depth, got"):
        make_env_config("metaworld_pointcloud", task="reach", observation="colour").validate()
    assert make_env_config("metaworld_pointcloud", task="drawer-close,reach").recipe() is not None


@pytest.mark.parametrize(
    ("kind", "task"),
    [
        *(("metaworld_pointcloud", task) for task in ("assembly", "coffee-pull", "door-open", "hand-insert", "push")),
        *(("adroit_pointcloud", task) for task in ("hammer", "door", "pen", "relocate")),
    ],
)
def test_the_cloud_is_that_of_casting_all_rays_at_everything(kind, task):
    env = make_env_config(kind, task=task).env_factory(task)()
    env.reset(seed=0)
    env.action_space.seed(0)
    camera, crop = env.observer.camera.camera, env.crop
    rays = Rays.of(camera, np.ones(camera.width * camera.height, bool))
    for _ in range(2):
        for _ in range(15):
            env.act(env.action_space.sample())
        model, data = env._simulator.model, env._simulator.data
        hits = Hits.none(len(rays.directions), with_normals=False)
        single_rays.cast_at(single_rays.visible(model), model, data, rays, hits)
        distances = [ray_sphere_distances(rays.origin, rays.directions, *marker[:2]) for marker in env._markers()]
        distance = np.minimum.reduce([hits.distance, *distances])[:, None]
        points = (rays.origin + rays.directions * distance)[np.isfinite(distance[:, 0])]
        expected = sample_farthest(points[crop.contains(points)], env.n_points)
        np.testing.assert_array_equal(env.observe()["point_cloud"], expected)
