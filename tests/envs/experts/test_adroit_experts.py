"""Adroit's demonstrators: weights, or a Minari dataset made here from the weights."""

from itertools import islice

import numpy as np
import pytest

from lerobot_uca.data.demonstrations import demonstrate
from lerobot_uca.envs.adroit import AdroitPointCloudEnv, make_simulator
from lerobot_uca.envs.experts.adroit_experts import Replay, attempts
from lerobot_uca.envs.experts.dapg import DAPGExpert, DAPGWeights
from lerobot_uca.errors import UserError

minari = pytest.importorskip("minari")
from minari.data_collector import EpisodeBuffer  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")  # about authors and links

SEEDS = (4, 7)  # in which the expert of pen succeeds within 100 steps
N_STEPS = {"door": 200, "pen": 100}


def recorded(task: str, expert: DAPGExpert, seed: int, keeping: str) -> EpisodeBuffer:
    """An episode of the simulator alone, an action every 10 ms, keeping its seed, its state or nothing of its start."""
    simulator = make_simulator(task)
    observation, _ = simulator.reset(seed=seed)
    state = {name: simulator.get_env_state()[name] for name in simulator._state_space}
    starts = {"seeds": {"seed": seed}, "states": {"options": {"initial_state_dict": state}}, "nothing": {}}
    observations, actions = [observation], []
    for _ in range(N_STEPS[task]):
        actions.append(np.clip(expert.mean_action(observation), -1, 1).astype(np.float32))
        observation, *_ = simulator.step(actions[-1])
        observations.append(observation)
    n_steps = len(actions)
    return EpisodeBuffer(
        **starts[keeping],
        observations=observations,
        actions=actions,
        rewards=[0.0] * n_steps,
        terminations=[False] * n_steps,
        truncations=[False] * (n_steps - 1) + [True],
    )


@pytest.fixture(scope="module")
def datasets(adroit_experts, tmp_path_factory):
    """Minari's folder with the datasets local/{door,pen}/{seeds,states,nothing}-v0 of two episodes each."""
    patch = pytest.MonkeyPatch()
    patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
    for task in N_STEPS:
        expert = DAPGExpert(DAPGWeights.read(adroit_experts / f"{task}.npz"))
        simulator = make_simulator(task)
        for keeping in ("seeds", "states", "nothing"):
            minari.create_dataset_from_buffers(
                f"local/{task}/{keeping}-v0",
                [recorded(task, expert, seed, keeping) for seed in SEEDS],
                observation_space=simulator.observation_space,
                action_space=simulator.action_space,
            )
    yield
    patch.undo()


@pytest.mark.parametrize("task", N_STEPS)
@pytest.mark.parametrize("dataset", ["seeds", "states"])
@pytest.mark.usefixtures("datasets")
def test_a_replay_starts_as_recorded_and_succeeds(task, dataset):
    tries = attempts(task, f"minari:local/{{task}}/{dataset}-v0", first_seed=0)
    attempt = next(tries)
    env = AdroitPointCloudEnv(task, n_points=16)
    env.reset(**attempt.reset)
    direct = make_simulator(task)
    expected, _ = direct.reset(seed=SEEDS[0])
    np.testing.assert_allclose(env.expert_observation, expected, atol=1e-9)
    episode = demonstrate(lambda: AdroitPointCloudEnv(task, n_points=16), attempt)
    assert episode.is_successful
    assert len(episode.action) == N_STEPS[task] // 2
    assert len(list(tries)) == 1  # it ends with the dataset


def test_a_replayed_action_is_the_mean_of_the_two_that_it_stands_for():
    env = AdroitPointCloudEnv("pen", n_points=16)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 24)).astype(np.float32)
    replay = Replay("episode 0", env.expert_observation, actions)
    for expected in (actions[0:2], actions[2:4], actions[2:4], actions[2:4]):  # the last whole one is held
        np.testing.assert_allclose(replay(env), expected.mean(axis=0), rtol=1e-6)


def test_weights_start_at_the_seeds(adroit_experts):
    tries = attempts("door", str(adroit_experts / "{task}.npz"), first_seed=7)
    assert [attempt.reset for attempt in islice(tries, 3)] == [{"seed": 7}, {"seed": 8}, {"seed": 9}]


# Bad input ----------------------------------------------------------------------------------------------------------


def test_without_an_expert_the_error_says_where_to_get_one():
    with pytest.raises(UserError, match=r"Give one with --expert=.*\.npz .*aravindr93/hand_dapg.*minari:D4RL/door"):
        attempts("door", None, first_seed=0)


def test_weights_of_another_task(adroit_experts):
    path = adroit_experts / "hammer.npz"
    line = f"'{path}' does not fit door: it maps 46 observations to 26 actions, door has 39 and 28."
    with pytest.raises(UserError) as caught:
        attempts("door", str(path), first_seed=0)
    assert str(caught.value) == line


@pytest.mark.usefixtures("datasets")
def test_a_dataset_of_another_task():
    line = r"Minari dataset 'local/pen/seeds-v0' does not fit door: its observation_space has shape \(45,\), door needs"
    with pytest.raises(UserError, match=line):
        attempts("door", "minari:local/pen/seeds-v0", first_seed=0)


def test_a_dataset_without_a_version():
    with pytest.raises(UserError, match=r"'D4RL/door/expert-v2', with its version, got 'D4RL/door/expert'"):
        attempts("door", "minari:D4RL/door/expert", first_seed=0)


@pytest.mark.parametrize("dataset_id", ["D4RL/nothing/expert-v2", "not an id-v0"])
def test_a_missing_dataset(dataset_id, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    with pytest.raises(UserError, match=rf"^Minari dataset '{dataset_id}' is not on this computer and could not be "):
        attempts("door", f"minari:{dataset_id}", first_seed=0)


@pytest.mark.usefixtures("datasets")
def test_an_episode_without_its_start():
    tries = attempts("door", "minari:local/door/nothing-v0", first_seed=0)
    with pytest.raises(
        UserError, match="Cannot replay episode 0 of Minari dataset 'local/door/nothing-v0': it records"
    ):
        next(tries)


@pytest.mark.usefixtures("datasets")
def test_an_episode_that_starts_elsewhere():
    attempt = next(attempts("door", "minari:local/door/seeds-v0", first_seed=0))
    moved = attempt._replace(reset={"seed": 99})
    with pytest.raises(UserError, match=r"Cannot replay episode 0 of .*: door starts in a state that differs"):
        demonstrate(lambda: AdroitPointCloudEnv("door", n_points=16), moved)


@pytest.mark.usefixtures("datasets")
def test_states_of_another_task():
    pen = next(attempts("pen", "minari:local/pen/states-v0", first_seed=0))
    with pytest.raises(UserError, match=r"Adroit door: an initial state has door_body_pos .*, got desired_orien"):
        demonstrate(lambda: AdroitPointCloudEnv("door", n_points=16), pen)
