"""A policy's page on the Hub; tests/test_hub.py uploads one."""

from types import SimpleNamespace

import pytest
import torch
from tests.builders import N_POINTS, make_config
from tests.depth_builders import make_recipe

from lerobot_uca.point_clouds.depth import FAR, NEAR
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy


@pytest.fixture
def published() -> UCAFlowPolicy:
    return UCAFlowPolicy(make_config(inference="eager"))


def card(policy: UCAFlowPolicy, **metadata: object) -> str:
    return policy.generate_model_card("me/data", "uca_flow", None, None, **metadata).content


def test_clouds_from_depth_have_their_cameras_calibrations_and_crop(published):
    assert "depth images" not in card(published)
    published.config.depth.recipe = make_recipe().as_dict()
    text = card(published)
    assert "Crop: [0.2, -0.3, 0.01] to [0.9, 0.35, 0.4] m in the robot's base, 48 points\n" in text
    calibration = "12 touched points 2026-11-25, error 1.3 mm"
    row = f"| `observation.images.front_depth` | [-0.3, 0.05, 0.7] | {NEAR:g} to {FAR:g} | {calibration} |"
    assert row in text


def test_the_evaluations_command_names_clouds_without_the_robot(published):
    command = f"lerobot-eval --policy.path=user/name --env.type=... --env.n_points={N_POINTS}"
    assert f"{command} --eval.n_episodes=50" in card(published)
    published.config.observation = "object_cloud"
    assert f"{command} --env.observation=object_cloud --eval.n_episodes=50" in card(published)


def test_a_known_evaluation_has_its_episodes_and_seeds(published):
    assert "not evaluated" in card(published)
    published.ema_step += 2
    published.remember_success({"overall": {"pc_success": 84.0, "n_episodes": 50}}, 1000)
    published.ema_step += 1
    assert "- Success: 84.0 % of 50 episodes, environment seeds from 1000, after step 2\n" in card(published)


@pytest.mark.parametrize("training", [True, False])
def test_the_page_leaves_the_policy_as_it_was(published, training):
    published.train(training)
    state = torch.random.get_rng_state()
    card(published)
    assert {module.training for module in published.modules()} == {training}
    assert torch.equal(torch.random.get_rng_state(), state)


def test_state_and_action_are_named_as_in_the_data(published):
    names = {"action": {"names": ["x [m]", "y [m]", "z [m]", "gripper"]}}
    meta = SimpleNamespace(
        features=names,
        total_episodes=3,
        total_frames=39,
        fps=80,
        tasks=SimpleNamespace(index=["push"]),
        robot_type="ur5e",
    )
    text = card(published, dataset_meta=meta)
    assert "| `action` | (4,) | x [m], y [m], z [m], gripper; in the units of the training data |" in text
    assert "- Robot: ur5e" in text
