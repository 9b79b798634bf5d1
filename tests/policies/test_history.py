"""The frames that plans see, by the definition: steps -(O-1)s, ..., -s, 0 of every planning step."""

import pytest
import torch
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tests.builders import N_ACTIONS, make_config, make_observation

from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.history import Frame, ObservationHistory
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy

sizes = pytest.mark.parametrize(
    ("n_obs_steps", "stride", "n_action_steps"), [(1, 3, 2), (2, 1, 3), (2, 2, 3), (2, 5, 3), (3, 2, 1), (3, 2, 4)]
)


def make_frame(step: int) -> Frame:
    return Frame(torch.full((2, 4, 3), step), torch.full((2, 5), step))


@sizes
def test_a_plan_sees_every_stride_th_frame_and_the_first_one_stands_for_those_before_it(
    n_obs_steps, stride, n_action_steps
):
    history = ObservationHistory(n_obs_steps, stride)
    assert history.observed == []
    assert history.batch_size is None
    for now in range(12):
        history.append(make_frame(now))
        steps = [int(frame.state[0, 0]) for frame in history.observed]
        assert steps == [max(0, now - (n_obs_steps - 1 - i) * stride) for i in range(n_obs_steps)]
    assert history.batch_size == 2


@sizes
def test_frames_that_later_plans_see(n_obs_steps, stride, n_action_steps):
    history = ObservationHistory(n_obs_steps, stride)
    seen_by_plans = {
        now - i * stride for now in range(0, 60, n_action_steps) for i in range(n_obs_steps) if now - i * stride < now
    }
    for step in range(20):
        steps_to_next_plan = n_action_steps - step % n_action_steps
        assert history.is_seen_again(steps_to_next_plan, n_action_steps) == (step in seen_by_plans)


@sizes
@pytest.mark.parametrize("inference", ["eager", "openvino"])
def test_a_policy_acts_on_the_observed_steps(n_obs_steps, stride, n_action_steps, inference):
    horizon = (n_obs_steps - 1) * stride + n_action_steps
    policy = UCAFlowPolicy(
        make_config(
            n_obs_steps=n_obs_steps,
            obs_stride=stride,
            n_action_steps=n_action_steps,
            horizon=horizon,
            inference=inference,
        )
    ).eval()
    noise = torch.randn(1, horizon, N_ACTIONS)
    observations = [make_observation() for _ in range(10)]
    for now, observation in enumerate(observations):
        action = policy.select_action(observation, noise=noise)
        planned = now - now % n_action_steps
        steps = [max(0, planned + delta) for delta in policy.config.observation_delta_indices]
        o = policy.ema_model.encoder(
            *(torch.stack([observations[step][key] for step in steps], dim=1) for key in observation)
        )
        # Entries [(O-1)s : (O-1)s + n_action_steps] of the prediction, which begins at the first observed step.
        expected = policy.generate(policy.ema_model.generator, noise, o)[:, (n_obs_steps - 1) * stride + now - planned]
        torch.testing.assert_close(action, expected, atol=1e-5, rtol=0)


@sizes
def test_a_frame_is_encoded_once_and_only_if_a_plan_sees_it(n_obs_steps, stride, n_action_steps):
    horizon = (n_obs_steps - 1) * stride + n_action_steps
    config = make_config(n_obs_steps=n_obs_steps, obs_stride=stride, n_action_steps=n_action_steps, horizon=horizon)
    config.inference = "eager"
    policy = UCAFlowPolicy(config).eval()
    encoded: list[float] = []
    policy.ema_model.encoder.register_forward_hook(lambda _, inputs, __: encoded.append(inputs[1][0, 0, 0].item()))
    n_steps, n_later = 6 * n_action_steps, (n_obs_steps - 1) * stride
    for step in range(n_steps):
        observation = make_observation()
        observation["observation.state"][:] = step
        policy.select_action(observation)
    seen = {max(0, now - i * stride) for now in range(0, n_steps + n_later, n_action_steps) for i in range(n_obs_steps)}
    # The first frame also stands for those before it: it is encoded alone, and with the first plan.
    expected = sorted([0] * (n_obs_steps > 1) + [step for step in seen if step < n_steps])
    assert sorted(encoded) == expected


def test_training_windows_hold_the_observed_and_the_predicted_steps(dataset_root):
    config = make_config(obs_stride=2, horizon=5)
    dataset = LeRobotDataset("test/random", root=dataset_root)
    windows = LeRobotDataset(
        "test/random", root=dataset_root, delta_timestamps=resolve_delta_timestamps(config, dataset.meta)
    )
    window = windows[6]
    for step, delta in enumerate((-2, 0)):
        assert torch.equal(window[OBS_POINT_CLOUD][step], dataset[6 + delta][OBS_POINT_CLOUD])
    for step, delta in enumerate((-2, -1, 0, 1, 2)):
        assert torch.equal(window["action"][step], dataset[6 + delta]["action"])
    first = windows[0]  # before the episode the first frame stands for all, as in the policy's history
    assert torch.equal(first[OBS_POINT_CLOUD][0], dataset[0][OBS_POINT_CLOUD])
