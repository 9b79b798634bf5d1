import subprocess
import sys

import mujoco
import numpy as np
import pytest
from lerobot.envs import make_env_config

from lerobot_uca.envs import adroit
from lerobot_uca.envs.adroit import ARM, HAND, TASKS, AdroitPointCloudEnv, Outcome, make_simulator
from lerobot_uca.envs.experts.dapg import DAPGExpert, DAPGWeights
from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.geometry import Crop

# gymnasium-robotics's names of the state it starts from, besides qpos and qvel.
OWN_STATE = {"hammer": "board_pos", "door": "door_body_pos", "pen": "desired_orien"}


@pytest.fixture(scope="module", params=TASKS)
def env(request):
    env = AdroitPointCloudEnv(request.param)
    env.reset(seed=0)
    return env


def test_observations_fit_the_spaces(env):
    observation, info = env.reset(seed=0)
    assert observation["point_cloud"].shape == (1024, 3)
    assert observation["agent_pos"].shape == (24,)
    assert env.observation_space.contains(observation)
    assert info == {"is_success": False}
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert isinstance(reward, float)
    assert (terminated, truncated, info["is_success"]) == (False, False, False)


def test_no_point_is_padding_and_all_lie_in_the_crop(env):
    for seed in range(3):
        cloud = env.reset(seed=seed)[0]["point_cloud"].astype(np.float64)
        assert len(np.unique(cloud, axis=0)) == 1024
        slack = 1e-6  # float32
        crop = Crop(tuple(np.array(env.crop.low) - slack), tuple(np.array(env.crop.high) + slack))
        assert crop.contains(cloud).all()


def test_the_cloud_holds_hand_and_objects_and_not_the_table(env):
    env.reset(seed=0)
    simulator = env._simulator
    model, data = simulator.model, simulator.data
    points = env.observer.camera.capture(model, data)
    seen = set()
    for point in points:
        direction = point - np.array(env.observer.camera.camera.position)
        geom = np.zeros(1, dtype=np.int32)
        groups = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)
        mujoco.mj_ray(model, data, env.observer.camera.camera.position, direction, groups, 1, -1, geom)
        seen.add(model.body(model.geom_bodyid[geom[0]]).name)
    objects = {"hammer": {"Object", "nail"}, "door": {"door", "latch"}, "pen": {"Object", "target"}}
    assert {"palm", "ffproximal", "thproximal"} | objects.get(env.task, {"Object"}) <= seen
    assert not seen & {"world", "table"}


def test_the_target_of_relocate_is_in_the_cloud():
    env = AdroitPointCloudEnv("relocate")
    cloud = env.reset(seed=0)[0]["point_cloud"]
    distance = np.linalg.norm(cloud - env._simulator.data.site("target").xpos, axis=1)
    assert (np.abs(distance - 0.02) < 1e-4).sum() >= 5


def test_agent_pos_is_the_hands_joints(env):
    env.reset(seed=1)
    env.step(env.action_space.sample())
    data = env._simulator.data
    np.testing.assert_allclose(env._agent_pos(), [data.joint(name).qpos[0] for name in HAND])
    papers = {"hammer": slice(2, -7), "door": slice(4, -2), "pen": slice(0, -6), "relocate": slice(6, -6)}
    np.testing.assert_array_equal(env._agent_pos(), data.qpos[papers[env.task]])


def test_actions_move_the_joints_that_they_are_named_after(env):
    model = env._simulator.model
    assert tuple(model.actuator(index).name.removeprefix("A_") for index in range(model.nu)) == TASKS[env.task].joints


def test_an_action_is_two_of_the_simulators_steps(env):
    env.reset(seed=4)
    simulator = make_simulator(env.task)
    simulator.reset(seed=4)
    rng = np.random.default_rng(0)
    for _ in range(3):
        action = rng.uniform(-1, 1, env.n_actions).astype(np.float32)
        rewards = 0.0
        for _ in range(2):
            expected, reward, *_ = simulator.step(action)
            rewards += reward
        _, got, *_ = env.step(action)
        np.testing.assert_array_equal(env.expert_observation, expected)
        assert got == pytest.approx(rewards)
    assert 2 * simulator.dt == pytest.approx(1 / adroit.FPS)


def test_the_cloud_is_of_the_same_moment_as_the_joints(env):
    env.reset(seed=0)
    env.step(env.action_space.sample())
    simulator = env._simulator
    exact = mujoco.MjData(simulator.model)
    exact.qpos[:] = simulator.data.qpos
    mujoco.mj_forward(simulator.model, exact)
    np.testing.assert_allclose(simulator.data.geom_xpos, exact.geom_xpos, atol=1e-12)


def test_no_notice_and_no_opengl():
    code = "from lerobot_uca.envs.adroit import *; e = AdroitPointCloudEnv('door', 16); e.reset(seed=0); e.render()"
    code += "; import sys; assert 'OpenGL' not in sys.modules"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout + result.stderr == ""


# Several tasks ------------------------------------------------------------------------------------------------------


def test_suites_are_the_entries_of_the_task_option():
    config = make_env_config("adroit_pointcloud", task="paper, relocate")
    assert config.tasks() == {"paper": ("hammer", "door", "pen"), "relocate": ("relocate",)}
    assert make_env_config("adroit_pointcloud", task="all").tasks() == {"all": tuple(TASKS)}


def test_several_tasks_share_one_action_and_each_moves_its_own_joints():
    config = make_env_config("adroit_pointcloud", task="paper", n_points=16)
    assert config.action_names() == [*ARM[2:], *HAND]  # door has all joints of hammer and pen
    for task in ("hammer", "door", "pen"):
        wide, own = config.env_factory(task)(), AdroitPointCloudEnv(task, n_points=16)
        action = np.random.default_rng(0).uniform(-1, 1, own.n_actions).astype(np.float32)
        by_name = dict(zip(TASKS[task].joints, action, strict=True))
        expected = np.array([by_name.get(name, 0) for name in config.action_names()], dtype=np.float32)
        np.testing.assert_array_equal(wide.from_own(action), expected)
        for env, executed in ((wide, expected), (own, action)):
            env.reset(seed=0)
            env.step(executed)
        np.testing.assert_array_equal(wide.expert_observation, own.expert_observation)


# Success ------------------------------------------------------------------------------------------------------------


def observation_of(task: str, **values: object) -> np.ndarray:
    """The simulator's own observation, zero but for what a goal looks at."""
    observation = np.zeros(make_simulator(task).observation_space.shape)
    for name, value in values.items():
        observation[{"hinge": 28, "height": 26, "axis": slice(33, 36), "desired": slice(36, 39)}[name]] = value
    return observation


@pytest.mark.parametrize(("hinge", "reached"), [(1.39, False), (1.41, True)])
def test_a_door_is_open_beyond_its_threshold(hinge, reached):
    observation = observation_of("door", hinge=hinge)
    assert adroit.judge_final(TASKS["door"], Outcome(observation, not reached, True)).is_success == reached
    assert not adroit.judge_final(TASKS["door"], Outcome(observation, True, False)).is_success  # the time is not over


@pytest.mark.parametrize(("angle", "reached"), [(17, True), (19, False)])  # cos 18.2 deg = 0.95
def test_a_pen_points_the_right_way_within_18_degrees(angle, reached):
    axis = [np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0]
    observation = observation_of("pen", axis=axis, desired=[1, 0, 0], height=0.2)
    assert adroit.judge_final(TASKS["pen"], Outcome(observation, False, True)) == (False, reached)


def test_a_dropped_pen_ends_the_episode_without_success():
    observation = observation_of("pen", axis=[1, 0, 0], desired=[1, 0, 0], height=0.07)
    for is_last in (False, True):
        assert adroit.judge_final(TASKS["pen"], Outcome(observation, True, is_last)) == (True, False)


def test_any_success_is_the_simulators_own_and_ends_the_episode():
    for word in (False, True):
        assert adroit.judge_any(TASKS["pen"], Outcome(observation_of("pen"), word, False)) == (word, word)


def test_the_goals_look_where_the_simulator_writes():
    door, pen = make_simulator("door"), make_simulator("pen")
    door.reset(seed=0)
    state = door.get_env_state()
    state["qpos"][28] = 1.23  # the hinge
    observation, _ = door.reset(options={"initial_state_dict": state})
    assert observation[28] == 1.23
    observation, _ = pen.reset(seed=0)
    assert observation[26] == pen.data.body("Object").xpos[2]
    axis = pen.data.site("object_top").xpos - pen.data.site("object_bottom").xpos
    np.testing.assert_allclose(observation[33:36], axis / np.linalg.norm(axis))
    desired = pen.data.site("target_top").xpos - pen.data.site("target_bottom").xpos
    np.testing.assert_allclose(observation[36:39], desired / np.linalg.norm(desired))


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("success", adroit.SUCCESS)
def test_the_expert_succeeds(task, success, adroit_experts):
    env = AdroitPointCloudEnv(task, n_points=16, success=success)
    expert = DAPGExpert(DAPGWeights.read(adroit_experts / f"{task}.npz"))
    env.reset(seed=0)
    env.observer.camera.capture = lambda *_: np.zeros((1, 3))  # nothing here looks at clouds
    steps = [env.step(expert(env))[2:] for _ in range(TASKS[task].episode_length)]
    successes = [info["is_success"] for _, _, info in steps]
    assert [truncated for _, truncated, _ in steps] == [False] * (len(steps) - 1) + [True]
    if success == "final":
        assert successes == [False] * (len(steps) - 1) + [True]
    else:
        assert sum(successes) > 5
        assert [terminated for terminated, _, _ in steps] == successes


# Bad input ----------------------------------------------------------------------------------------------------------


def test_invalid_settings():
    with pytest.raises(UserError, match=r"Unknown task 'doors'\. Adroit tasks: door, .*; groups: paper, all\."):
        make_env_config("adroit_pointcloud", task="doors").create_envs(1)
    with pytest.raises(UserError, match=r"env\.success must be one of final, any, got 'last'"):
        make_env_config("adroit_pointcloud", success="last").create_envs(1)
    with pytest.raises(UserError, match=r"env\.fps of adroit_pointcloud is 50"):
        make_env_config("adroit_pointcloud", fps=30).get_env_processors()
    with pytest.raises(UserError, match="An environment has one task, got 'paper'"):
        AdroitPointCloudEnv("paper")


def test_invalid_actions(env):
    with pytest.raises(UserError, match=rf"Adroit {env.task}: an action must be {env.n_actions} finite numbers"):
        env.step(np.zeros(3))


def test_a_state_of_another_task():
    state = {"qpos": np.zeros(30), "qvel": np.zeros(30), "desired_orien": np.zeros(4)}
    line = (
        r"Adroit door: an initial state has door_body_pos \(3\), .*, got desired_orien \(4\), qpos \(30\), qvel \(30\)"
    )
    with pytest.raises(UserError, match=line):
        AdroitPointCloudEnv("door").reset(options={"initial_state_dict": state})
    with pytest.raises(UserError, match=r"Adroit door: an initial state has door_body_pos \(3\), .*, got list"):
        AdroitPointCloudEnv("door").reset(options={"initial_state_dict": [state]})


@pytest.mark.parametrize("task", OWN_STATE)
def test_a_state_is_restored(task):
    env = AdroitPointCloudEnv(task, n_points=16)
    first, _ = env.reset(seed=3)
    state = {name: env._simulator.get_env_state()[name] for name in ("qpos", "qvel", OWN_STATE[task])}
    env.reset(seed=4)
    again, _ = env.reset(options={"initial_state_dict": state})
    np.testing.assert_array_equal(again["point_cloud"], first["point_cloud"])
