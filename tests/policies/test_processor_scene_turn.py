"""Scenes turned about the hand, with the motion to learn."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.policies import make_pre_post_processors
from lerobot.processor import NormalizerProcessorStep, TransitionKey
from tests.builders import N_STATES, make_batch, make_config, make_observation, make_statistics

from lerobot_uca.envs.metaworld import MetaworldPointCloudEnv, ScriptedExpert
from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.augmentation_config import SceneTurnConfig
from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
from lerobot_uca.policies.processor_base import make_processors
from lerobot_uca.policies.processor_hand_frame import HandFrameProcessorStep
from lerobot_uca.policies.processor_scene_turn import SceneTurnProcessorStep

STATES, ACTIONS = (0, 1, 3, 4, 6, 7), (0, 1)
KEYS = (OBS_POINT_CLOUD, "observation.state", "action")


def make_step(degrees=20.0):
    return SceneTurnProcessorStep(degrees, [0, 1], list(STATES), list(ACTIONS))


def turning(degrees=20.0, **changes):
    turn = SceneTurnConfig(**{"degrees": degrees, "states": STATES, "actions": ACTIONS, **changes})
    return make_config(hand_position=(0, 1, 2), scene_turn=turn)


def make_window(n_samples=6):
    """Clouds with a colour, states and actions, all different."""
    return torch.rand(n_samples, 2, 30, 4), torch.rand(n_samples, 2, N_STATES), torch.rand(n_samples, 4, 4)


def test_a_quarter_turn_to_the_left():
    """x becomes y, and y becomes -x; the hand stays, and so do heights, the gripper and the colour."""
    cloud, state, action = make_window()
    quarter = torch.full((6,), torch.pi / 2)
    turned_cloud, turned_state, turned_action = make_step().turned(cloud, state, action, quarter)
    hand = state[:, -1:, :3]
    for first in (0, 3, 6):
        x, y, z = (state[..., first : first + 3] - hand).unbind(-1)
        after = turned_state[..., first : first + 3] - hand
        torch.testing.assert_close(after, torch.stack([-y, x, z], dim=-1))
    x, y, z = (cloud[..., :3] - hand[:, :, None]).unbind(-1)
    torch.testing.assert_close(turned_cloud[..., :3] - hand[:, :, None], torch.stack([-y, x, z], dim=-1))
    torch.testing.assert_close(turned_state[:, -1, :3], state[:, -1, :3])
    torch.testing.assert_close(turned_cloud[..., 3:], cloud[..., 3:], rtol=0, atol=0)
    x, y, *rest = action.unbind(-1)
    torch.testing.assert_close(turned_action, torch.stack([-y, x, *rest], dim=-1))


@pytest.mark.parametrize("task", ["reach", "soccer"])
@pytest.mark.parametrize("n_steps", [0, 40])  # the motion limited, and not
def test_a_straight_experts_action_in_a_turned_scene_is_its_action_turned(task, n_steps):
    """Both steer by where hand, thing and goal are: in a turned scene they do what training's turned sample does."""
    env = MetaworldPointCloudEnv(task, n_points=16)
    env.reset(seed=4)
    expert = ScriptedExpert(task, straight_paths=True)
    for _ in range(n_steps):
        env.act(expert(env))
    observation, action = env.expert_observation, expert(env).astype(np.float64)
    assert (np.hypot(*action[:2]) > 0.999) == (n_steps == 0)
    state = torch.zeros(1, 1, N_STATES, dtype=torch.float64)
    state[0, 0] = torch.tensor(np.concatenate([observation[:3], observation[4:7], observation[-3:]]))
    angle = torch.tensor([0.4], dtype=torch.float64)
    cloud = torch.zeros(1, 1, 1, 3, dtype=torch.float64)
    _, turned, turned_action = make_step().turned(cloud, state, torch.tensor(action)[None, None], angle)
    hand, thing, goal = turned[0, 0].reshape(3, 3)
    observation = np.concatenate([hand, observation[3:4], thing, observation[7:-3], goal])
    in_turned_scene = expert(SimpleNamespace(expert_observation=observation))
    np.testing.assert_allclose(in_turned_scene, turned_action[0, 0], atol=1e-6)


def test_each_sample_is_turned_by_its_own_angle_up_to_the_largest_to_either_side():
    step, n = make_step(degrees=30.0), 2000
    transition = {
        TransitionKey.OBSERVATION: {OBS_POINT_CLOUD: torch.rand(n, 2, 5, 3), "observation.state": torch.zeros(n, 2, 9)},
        TransitionKey.ACTION: torch.tensor([1.0, 0.0, 0.3, 1.0]).expand(n, 4, 4),
    }
    action = step(transition)[TransitionKey.ACTION]
    angle = torch.rad2deg(torch.atan2(action[..., 1], action[..., 0]))
    torch.testing.assert_close(angle, angle[:, :1].expand(-1, 4))  # one for all of a sample's actions
    assert -30 <= angle.min() < -29
    assert 29 < angle.max() <= 30
    assert angle[:, 0].mean().abs() < 1.5
    assert angle[:, 0].unique().numel() > 0.9 * n


def test_seen_from_the_hand_a_cloud_is_turned_about_the_hands_mean_place():
    """The hand's frame comes after, so old observations are turned about their own hand."""
    cloud, state, action = make_window()
    angle = torch.rand(6)
    hand_frame = HandFrameProcessorStep([0, 1, 2], [0.1, 0.6, 0.2])
    turned, turned_state, _ = make_step().turned(cloud, state, action, angle)
    seen = hand_frame.seen_from_hand(turned, turned_state)[..., :2] - torch.tensor([0.1, 0.6])
    before = hand_frame.seen_from_hand(cloud, state)[..., :2] - torch.tensor([0.1, 0.6])
    torch.testing.assert_close(seen.norm(dim=-1), before.norm(dim=-1))
    by = torch.atan2(seen[..., 1], seen[..., 0]) - torch.atan2(before[..., 1], before[..., 0])
    torch.testing.assert_close(by.cos(), angle.cos()[:, None, None].expand_as(by))


def test_the_seed_decides():
    config = turning()
    batch = make_batch(config)

    def seen(seed):
        torch.manual_seed(seed)
        return make_processors(config, make_statistics())[0]({**batch})

    for key in KEYS:
        torch.testing.assert_close(seen(1)[key], seen(1)[key], rtol=0, atol=0)
        assert (seen(1)[key] != seen(2)[key]).any()


def test_only_training_is_turned():
    config = turning()
    turned, _ = make_processors(config, make_statistics())
    config.scene_turn = SceneTurnConfig()
    plain, _ = make_processors(config, make_statistics())
    batch, observation = make_batch(config), make_observation()
    with torch.no_grad():  # the loss of held-out episodes
        for key in KEYS:
            torch.testing.assert_close(turned({**batch})[key], plain({**batch})[key])
    torch.testing.assert_close(turned({**observation})[OBS_POINT_CLOUD], plain({**observation})[OBS_POINT_CLOUD])
    assert (turned({**batch})["action"] != plain({**batch})["action"]).any()


def test_off_by_default_and_on_it_stands_in_metres_before_the_hands_frame():
    assert SceneTurnProcessorStep not in map(type, make_processors(make_config(), make_statistics())[0].steps)
    kinds = [type(step) for step in make_processors(turning(), make_statistics())[0].steps]
    assert kinds.index(SceneTurnProcessorStep) + 1 == kinds.index(HandFrameProcessorStep)
    assert kinds.index(SceneTurnProcessorStep) < kinds.index(NormalizerProcessorStep)


def test_a_checkpoint_keeps_it_and_a_training_from_it_may_change_it(tmp_path):
    config = turning()
    UCAFlowPolicy(config).save_pretrained(tmp_path)
    for processors in make_processors(config, make_statistics()):
        processors.save_pretrained(tmp_path)
    loaded = UCAFlowConfig.from_pretrained(tmp_path)
    assert loaded.scene_turn == config.scene_turn

    def step_of(config):
        preprocess, _ = make_pre_post_processors(config, pretrained_path=str(tmp_path))
        return next((step for step in preprocess.steps if isinstance(step, SceneTurnProcessorStep)), None)

    assert step_of(loaded) == make_step()
    loaded.scene_turn.degrees = 5.0
    assert step_of(loaded) == make_step(5.0)
    loaded.scene_turn = SceneTurnConfig()
    assert step_of(loaded) is None


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"degrees": 181.0}, "policy.scene_turn.degrees must be at most 180"),
        ({"degrees": -1.0}, "policy.scene_turn.degrees must be at least 0"),
        ({"states": None}, "policy.scene_turn.states must be pairs of different dimensions, 0 to 8, .*got None"),
        ({"states": (0, 1, 3)}, r"policy.scene_turn.states must be pairs .*got \[0, 1, 3\]"),
        ({"states": (0, 9)}, r"policy.scene_turn.states must be pairs .*got \[0, 9\]"),
        ({"actions": (1, 1)}, r"policy.scene_turn.actions must be pairs .*0 to 3, .*got \[1, 1\]"),
        ({"states": (3, 4)}, r"states must hold the hand's x and y, \[0, 1\] of policy.hand_position, .* got \[3, 4\]"),
        ({"states": (1, 0)}, r"states must hold the hand's x and y, \[0, 1\] of policy.hand_position, .* got \[1, 0\]"),
        ({"actions": ()}, r"policy.scene_turn.actions must be pairs .*got \(\)"),
    ],
)
def test_wrong_values(wrong, message):
    with pytest.raises(UserError, match=message):
        turning(**wrong).validate_features()


def test_a_single_frame_is_no_training_and_stays():
    transition = {
        TransitionKey.OBSERVATION: {OBS_POINT_CLOUD: torch.rand(1, 5, 3), "observation.state": torch.zeros(1, 9)},
        TransitionKey.ACTION: torch.zeros(1, 4),
    }
    assert make_step()(transition) is transition


def test_it_needs_to_know_the_hand():
    config = turning()
    config.hand_position = None
    with pytest.raises(UserError, match=r"scene_turn.degrees=20 turns scenes about the hand: policy.hand_position"):
        config.validate_features()
    config.scene_turn = SceneTurnConfig()
    config.validate_features()
