from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.scripts.lerobot_eval import eval_policy
from tests.builders import N_ACTIONS, N_POINTS, make_config

from lerobot_uca.envs import metaworld
from lerobot_uca.envs.metaworld import MetaworldPointCloudEnv
from lerobot_uca.envs.observers import OBSERVERS
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
from lerobot_uca.protocol.cells import Cell
from lerobot_uca.protocol.evaluation import PolicyPlan, Running, not_watched, run_episodes
from lerobot_uca.protocol.run_cell import make_env as make_env_of_cell

SEEDS = [11, 12, 13]
N_STEPS = 10


@pytest.fixture(autouse=True)
def _short_episodes(monkeypatch):
    monkeypatch.setattr(metaworld, "EPISODE_LENGTH", N_STEPS)
    monkeypatch.setattr(MetaworldPointCloudEnv, "_max_episode_steps", N_STEPS)


def make_env() -> MetaworldPointCloudEnv:
    return MetaworldPointCloudEnv("drawer-close", n_points=N_POINTS)


def same(values):
    return values


def evaluated(policy, *, n_envs):
    plan = PolicyPlan(policy, same, same)
    return sorted(run_episodes(make_env, policy.config, plan, SEEDS, n_envs=n_envs))


def evaluated_by_lerobot(policy):
    """The result of LeRobot's own loop, with the noise that each of our episodes draws."""
    generators = [torch.Generator().manual_seed(seed) for seed in SEEDS]
    config, select_action, n_calls = policy.config, policy.select_action, 0

    def with_noise(batch):
        nonlocal n_calls
        if n_calls % config.n_action_steps == 0:
            shape = (config.horizon, N_ACTIONS)
            noise = torch.stack([torch.randn(shape, generator=generator) for generator in generators])
        else:
            noise = None
        n_calls += 1
        return select_action(batch, noise=noise)

    policy.select_action = with_noise
    env = gym.vector.SyncVectorEnv([freeze_after_episode_end(make_env)] * len(SEEDS))
    info = eval_policy(env, policy, same, same, same, same, n_episodes=len(SEEDS), start_seed=SEEDS[0])
    env.close()
    del policy.select_action
    return info["per_episode"]


@pytest.mark.parametrize("steps", [(2, 3, 4), (1, 1, 4), (2, 4, 5), (3, 1, 4)], ids=str)
def test_episodes_are_lerobots(steps):
    """Whichever steps the policy looks at, though most are never observed; rounding apart, since frames are encoded
    together. Frames of another step change a return by more than the tolerance."""
    n_obs_steps, n_action_steps, horizon = steps
    config = make_config(n_obs_steps=n_obs_steps, n_action_steps=n_action_steps, horizon=horizon, inference="eager")
    policy = UCAFlowPolicy(config).eval()
    theirs = evaluated_by_lerobot(policy)
    ours = evaluated(policy, n_envs=len(SEEDS))
    assert [episode.seed for episode in ours] == [episode["seed"] for episode in theirs]
    assert [episode.success for episode in ours] == [episode["success"] for episode in theirs]
    assert [episode.episode_return for episode in ours] == pytest.approx(
        [episode["sum_reward"] for episode in theirs], rel=1e-5
    )
    assert len({episode.episode_return for episode in ours}) == len(SEEDS)
    assert {episode.length for episode in ours} == {N_STEPS}


def test_an_episode_does_not_depend_on_those_beside_it(policy):
    """Rounding apart."""
    together, alone = evaluated(policy, n_envs=2), evaluated(policy, n_envs=1)
    assert [episode.seed for episode in together] == SEEDS
    for first, second in zip(together, alone, strict=True):
        assert first.episode_return == pytest.approx(second.episode_return, rel=1e-4)
        assert first[:2] == second[:2]


def test_only_what_the_policy_looks_at_is_observed(policy, monkeypatch):
    observed = []
    observe = MetaworldPointCloudEnv.observe

    def counted(env):
        observed.append(env._n_steps)
        return observe(env)

    monkeypatch.setattr(MetaworldPointCloudEnv, "observe", counted)
    plan = PolicyPlan(policy, same, same)
    list(run_episodes(make_env, policy.config, plan, SEEDS[:1], n_envs=1))
    assert observed == [0, 2, 3, 5, 6, 8, 9]


def test_an_episode_is_successful_once_it_was_and_ends_when_it_is_told():
    told = iter([(1.0, False, False, True), (1.0, False, False, False), (1.0, True, False, False)])
    env = SimpleNamespace(
        reset=lambda seed: ({}, {}),
        act=lambda action: (*(step := next(told))[:3], {"is_success": step[3]}),
        observe=dict,
    )
    running = Running(env, 7, SimpleNamespace(observation_delta_indices=[-1, 0], n_action_steps=4), not_watched)
    running.execute(np.zeros((4, N_ACTIONS), np.float32))
    assert running.is_over
    assert running.result()[:4] == (7, True, 3.0, 3)


@pytest.mark.parametrize("observation", ["point_cloud", "object_cloud"])
def test_a_cell_is_evaluated_in_its_trainings_clouds(observation):
    plan = SimpleNamespace(config=SimpleNamespace(n_points=16, observation=observation))
    env = make_env_of_cell(Cell("metaworld/reach", "uca_flow", 0), plan)()
    assert type(env.observer) is OBSERVERS[observation]
    assert env.n_points == 16
