"""Clouds as the hand sees them."""

import pytest
import torch
from lerobot.policies import make_pre_post_processors
from lerobot.processor import NormalizerProcessorStep, TransitionKey
from tests.builders import N_STATES, make_batch, make_config, make_observation, make_statistics

from lerobot_uca.envs.metaworld import MetaworldPointCloudEnv
from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.augmentation_config import AugmentationConfig
from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
from lerobot_uca.policies.processor_augmentation import CloudAugmentationProcessorStep
from lerobot_uca.policies.processor_base import make_processors
from lerobot_uca.policies.processor_hand_frame import HandFrameProcessorStep, hand_frame_steps

MEAN = [0.1, 0.6, 0.2]


def statistics():
    """With which normalisation changes nothing, and the hand's mean position."""
    stats = make_statistics()
    stats["observation.state"]["mean"][:3] = MEAN
    return stats


def step_of(processors):
    return next((step for step in processors[0].steps if isinstance(step, HandFrameProcessorStep)), None)


def test_a_scene_that_moves_with_the_hand_looks_the_same_and_one_that_stays_does_not():
    step = HandFrameProcessorStep([0, 1, 2], MEAN)
    cloud, state = torch.rand(5, 2, 40, 3), torch.rand(5, 2, 9)
    moved = torch.rand(5, 2, 3)
    state_moved = torch.cat([state[..., :3] + moved, state[..., 3:]], dim=-1)
    seen = step.seen_from_hand(cloud, state)
    torch.testing.assert_close(step.seen_from_hand(cloud + moved[..., None, :], state_moved), seen)
    torch.testing.assert_close(step.seen_from_hand(cloud, state_moved), seen - moved[..., None, :])


def test_a_point_at_the_hand_comes_to_its_mean_position():
    state = torch.rand(4, 9)
    seen = HandFrameProcessorStep([6, 4, 5], MEAN).seen_from_hand(state[:, None, [6, 4, 5]], state)
    torch.testing.assert_close(seen[:, 0], torch.tensor(MEAN).expand(4, 3))


def test_colours_and_states_stay_as_they_are():
    coloured, state = torch.rand(3, 2, 20, 6), torch.rand(3, 2, 9)
    step = HandFrameProcessorStep([0, 1, 2], MEAN)
    torch.testing.assert_close(step.seen_from_hand(coloured, state)[..., 3:], coloured[..., 3:], rtol=0, atol=0)
    observation = {OBS_POINT_CLOUD: coloured, "observation.state": state}
    after = step({TransitionKey.OBSERVATION: observation})[TransitionKey.OBSERVATION]
    assert after["observation.state"] is state


def test_training_and_evaluation_see_the_same():
    """A window's last observation, and the same one in an episode."""
    config = make_config(hand_position=(0, 1, 2))
    preprocess, _ = make_processors(config, statistics())
    batch = make_batch(config, batch_size=3)
    inputs = (OBS_POINT_CLOUD, "observation.state")
    trained = preprocess(batch)[OBS_POINT_CLOUD][:, -1]
    torch.testing.assert_close(preprocess({key: batch[key][:, -1] for key in inputs})[OBS_POINT_CLOUD], trained)
    expected = batch[OBS_POINT_CLOUD][:, -1] + (torch.tensor(MEAN) - batch["observation.state"][:, -1, :3])[:, None]
    torch.testing.assert_close(trained, expected)


def test_metaworlds_first_states_are_the_hand_in_the_clouds_frame():
    env = MetaworldPointCloudEnv("reach")
    observation, _ = env.reset(seed=0)
    hand = env._simulator.data.body("hand").xpos
    assert observation["agent_pos"][:3] == pytest.approx(hand, abs=1e-6)
    cloud = observation["pc"] if "pc" in observation else observation["point_cloud"]
    assert abs(cloud - hand).sum(axis=1).min() < 0.1  # its points are among the cloud's


def test_off_by_default():
    assert step_of(make_processors(make_config(), make_statistics())) is None


def test_it_stands_between_augmentation_and_normaliser():
    config = make_config(hand_position=(0, 1, 2), augmentation=AugmentationConfig(jitter=0.01))
    kinds = [type(step) for step in make_processors(config, statistics())[0].steps]
    places = [
        kinds.index(kind) for kind in (CloudAugmentationProcessorStep, HandFrameProcessorStep, NormalizerProcessorStep)
    ]
    assert places == sorted(places)


def test_a_checkpoint_keeps_it_and_a_training_from_it_may_change_it(tmp_path):
    config = make_config(hand_position=(0, 1, 2))
    UCAFlowPolicy(config).save_pretrained(tmp_path)
    for processors in make_processors(config, statistics()):
        processors.save_pretrained(tmp_path)
    loaded = UCAFlowConfig.from_pretrained(tmp_path)

    def loaded_step(config, **options):
        return step_of(make_pre_post_processors(config, pretrained_path=str(tmp_path), **options))

    step = loaded_step(loaded)
    assert step.dimensions == [0, 1, 2]
    assert step.mean == pytest.approx(MEAN)
    other = statistics()
    other["observation.state"]["mean"][:3] += 1  # another dataset's, as LeRobot passes them
    step = loaded_step(loaded, preprocessor_overrides={"normalizer_processor": {"stats": other}})
    assert step.mean == pytest.approx([each + 1 for each in MEAN])
    loaded.hand_position = None
    assert loaded_step(loaded) is None


@pytest.mark.parametrize("wrong", [(0, 1), (0, 1, 1), (0, 1, N_STATES), (0, 1, 2, 3)])
def test_wrong_dimensions(wrong):
    rule = f"must be three different dimensions of 'observation.state', 0 to {N_STATES - 1}"
    with pytest.raises(UserError, match=rule):
        make_config(hand_position=wrong).validate_features()


@pytest.mark.parametrize("wrong", ["012", (0, -1, 2), (0, 1.5, 2)])
def test_no_dimensions_at_all(wrong):
    with pytest.raises(UserError, match=r"policy\.hand_position must be"):
        make_config(hand_position=wrong).validate_features()


def test_without_the_mean_it_cannot_be():
    stats = statistics()
    for name in ("mean", "std"):
        del stats["observation.state"][name]
    with pytest.raises(UserError, match=r"policy\.hand_position needs 'mean' of 'observation\.state'"):
        make_processors(make_config(hand_position=(0, 1, 2)), stats)


@pytest.mark.parametrize("wrong", [[0.1, 0.6], [float("nan")] * N_STATES])
def test_a_wrong_mean(wrong):
    with pytest.raises(UserError, match=f"as {N_STATES} finite numbers"):
        hand_frame_steps(make_config(hand_position=(0, 1, 2)), {"mean": wrong})


def test_without_observations_nothing_happens():
    step = HandFrameProcessorStep([0, 1, 2], MEAN)
    transition = {TransitionKey.ACTION: torch.zeros(1, 4), TransitionKey.OBSERVATION: {}}
    assert step(transition) is transition
    observation = make_observation()
    short = {OBS_POINT_CLOUD: observation[OBS_POINT_CLOUD], "observation.state": torch.zeros(1, 2)}
    after = step({TransitionKey.OBSERVATION: short})[TransitionKey.OBSERVATION]
    torch.testing.assert_close(after[OBS_POINT_CLOUD], short[OBS_POINT_CLOUD])
