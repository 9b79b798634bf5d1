"""Changes to training's clouds: rigid motions about the camera, noise, points left out."""

import numpy as np
import pytest
import torch
from lerobot.policies import make_pre_post_processors
from lerobot.processor import NormalizerProcessorStep, TransitionKey
from tests.builders import make_batch, make_config, make_observation, make_statistics
from tests.depth_builders import make_recipe

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.point_clouds.calibration import rotation_angle
from lerobot_uca.point_clouds.registration import fit_points
from lerobot_uca.policies.augmentation_config import AugmentationConfig
from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig
from lerobot_uca.policies.depth_config import DepthConfig
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
from lerobot_uca.policies.processor_augmentation import CloudAugmentationProcessorStep
from lerobot_uca.policies.processor_base import PointCloudProcessorStep, make_processors

CAMERAS = [[-0.3, 0.05, 0.7], [0.8, -0.4, 0.9]]
SHIFT, TURN = 0.02, 3.0


def make_clouds(n_samples=24, n_obs=2, n_points=40):
    """Clouds [m] half a metre before the base, the same in each observation step."""
    cloud = torch.rand(n_samples, 1, n_points, 3, dtype=torch.float64) * 0.4 + torch.tensor([0.3, -0.2, 0.0])
    return cloud.expand(-1, n_obs, -1, -1).clone()


def motions(before, after):
    """The motion (4, 4) of each sample's first cloud."""
    return [fit_points(a[0].numpy(), b[0].numpy()).X for a, b in zip(before, after, strict=True)]


def test_a_cloud_moves_rigidly_and_as_one_with_the_other_observation_steps():
    clouds = make_clouds()
    moved = CloudAugmentationProcessorStep(camera_shift=SHIFT, camera_turn=TURN, positions=CAMERAS).augmented(clouds)
    torch.testing.assert_close(torch.cdist(moved, moved), torch.cdist(clouds, clouds))  # lengths
    triple = [torch.linalg.det(each[:, 0, 1:4] - each[:, 0, :1]) for each in (clouds, moved)]
    torch.testing.assert_close(*triple)  # no mirror
    torch.testing.assert_close(moved[:, 0], moved[:, 1])
    assert (moved - clouds).abs().amax(dim=(1, 2, 3)).unique().numel() == len(clouds)  # each sample has its own


def test_the_motion_is_an_error_of_the_cameras_pose_in_the_base_frame():
    """Turned about the camera by at most so many degrees, shifted by at most so many metres, in all directions."""
    clouds = make_clouds(200)
    camera = np.array(CAMERAS[0])
    turned = CloudAugmentationProcessorStep(camera_turn=TURN, positions=CAMERAS[:1]).augmented(clouds)
    angles = []
    for X in motions(clouds, turned):
        np.testing.assert_allclose(X[:3, :3] @ camera + X[:3, 3], camera, atol=1e-9)
        angles.append(rotation_angle(X[:3, :3]))
    assert 0.9 * TURN < max(angles) <= TURN + 1e-6
    assert min(angles) < 0.1 * TURN
    shifted = CloudAugmentationProcessorStep(camera_shift=SHIFT).augmented(clouds) - clouds
    shifts = shifted[:, 0, 0]
    torch.testing.assert_close(shifted, shifts[:, None, None].expand_as(shifted))  # a translation
    assert 0.9 * SHIFT < shifts.norm(dim=-1).max() <= SHIFT + 1e-9
    assert (shifts.amax(dim=0) > 0.5 * SHIFT).all()
    assert (shifts.amin(dim=0) < -0.5 * SHIFT).all()


def test_of_several_cameras_one_is_wrong():
    clouds = make_clouds(50)
    turned = CloudAugmentationProcessorStep(camera_turn=TURN, positions=CAMERAS).augmented(clouds)
    stays = np.array(
        [
            [np.linalg.norm(X[:3, :3] @ camera + X[:3, 3] - camera) < 1e-9 for camera in np.array(CAMERAS)]
            for X in motions(clouds, turned)
        ]
    )
    assert stays.any(axis=1).all()
    assert stays.sum(axis=0).min() > 5


def test_jitter_moves_each_point_by_itself():
    clouds = make_clouds(100)
    noise = CloudAugmentationProcessorStep(jitter=0.005).augmented(clouds) - clouds
    assert noise.std() == pytest.approx(0.005, rel=0.02)
    assert abs(noise.mean()) < 1e-4
    assert noise.flatten(0, 2).std(dim=0).numpy() == pytest.approx(0.005, rel=0.05)


@pytest.mark.parametrize("drop", [0.5, 0.99999])
def test_points_that_are_left_out_are_replaced_by_others_of_the_cloud(drop):
    clouds = make_clouds(100, n_points=50)
    thinned = CloudAugmentationProcessorStep(drop=drop).augmented(clouds)
    shares = []
    for before, after in zip(clouds.flatten(0, 1), thinned.flatten(0, 1), strict=True):
        same = (before == after).all(dim=-1)
        assert set(map(tuple, after.tolist())) <= set(map(tuple, before.tolist()))
        assert len(set(map(tuple, after[same].tolist()))) == len(set(map(tuple, after.tolist())))
        shares.append(1 - float(same.double().mean()))
    assert np.mean(shares) == pytest.approx(drop / 2, abs=0.05)
    assert max(shares) > 0.8 * drop


def test_further_channels_stay_as_they_are():
    coloured = torch.cat([make_clouds(3), torch.rand(3, 2, 40, 3, dtype=torch.float64)], dim=-1)
    step = CloudAugmentationProcessorStep(jitter=0.01, camera_shift=SHIFT, camera_turn=TURN, positions=CAMERAS)
    torch.testing.assert_close(step.augmented(coloured)[..., 3:], coloured[..., 3:], rtol=0, atol=0)


def everything(**changes):
    options = {"jitter": 0.002, "drop": 0.3, "camera_shift": SHIFT, "camera_turn": TURN, **changes}
    depth = DepthConfig(recipe=make_recipe().as_dict())
    return make_config(augmentation=AugmentationConfig(**options), depth=depth)


def test_the_seed_decides():
    config = everything()
    batch = make_batch(config)

    def seen(seed):
        torch.manual_seed(seed)
        return make_processors(config, make_statistics())[0](batch)[OBS_POINT_CLOUD]

    torch.testing.assert_close(seen(1), seen(1), rtol=0, atol=0)
    assert (seen(1) != seen(2)).any()
    assert (seen(1) != batch[OBS_POINT_CLOUD]).any()


def test_only_training_is_augmented():
    config = everything()
    preprocess, _ = make_processors(config, make_statistics())
    batch, observation = make_batch(config), make_observation()
    with torch.no_grad():  # the loss of held-out episodes
        torch.testing.assert_close(preprocess(batch)[OBS_POINT_CLOUD], batch[OBS_POINT_CLOUD])
    torch.testing.assert_close(preprocess(observation)[OBS_POINT_CLOUD], observation[OBS_POINT_CLOUD])
    assert (preprocess(batch)[OBS_POINT_CLOUD] != batch[OBS_POINT_CLOUD]).any()


@pytest.mark.parametrize("options", [{"camera_shift": 0.02}, {"jitter": 0.01}, {"drop": 0.3}])
@pytest.mark.parametrize("n_frames", [1, 4])
def test_single_frames_are_no_training_and_stay(options, n_frames):
    """As of `policy.select_action(preprocess(dataset[0]))`, which holds the action too."""
    observation = {OBS_POINT_CLOUD: torch.rand(n_frames, 40, 3)}
    transition = {TransitionKey.OBSERVATION: observation, TransitionKey.ACTION: torch.zeros(n_frames, 4)}
    assert CloudAugmentationProcessorStep(**options)(transition) is transition


def test_off_by_default():
    preprocess, _ = make_processors(make_config(), make_statistics())
    assert CloudAugmentationProcessorStep not in map(type, preprocess.steps)


def test_metres_in_the_base_frame_come_before_the_normaliser():
    kinds = [type(step) for step in make_processors(everything(), make_statistics())[0].steps]
    place = kinds.index(CloudAugmentationProcessorStep)
    assert kinds[place - 1] is PointCloudProcessorStep
    assert kinds.index(NormalizerProcessorStep) > place


def test_a_checkpoint_keeps_it_and_a_training_from_it_may_change_it(tmp_path):
    config = everything()
    UCAFlowPolicy(config).save_pretrained(tmp_path)
    for processors in make_processors(config, make_statistics()):
        processors.save_pretrained(tmp_path)
    loaded = UCAFlowConfig.from_pretrained(tmp_path)
    assert loaded.augmentation == config.augmentation

    def step_of(config):
        preprocess, _ = make_pre_post_processors(config, pretrained_path=str(tmp_path))
        return next((step for step in preprocess.steps if isinstance(step, CloudAugmentationProcessorStep)), None)

    assert step_of(loaded).get_config() == {
        **vars(config.augmentation),
        "positions": [[-0.3, 0.05, 0.7]],
    }
    loaded.augmentation = AugmentationConfig(jitter=0.5e-3)
    assert (step_of(loaded).jitter, step_of(loaded).drop) == (0.5e-3, 0)
    loaded.augmentation = AugmentationConfig()
    assert step_of(loaded) is None


def test_a_turn_needs_to_know_the_camera():
    config = make_config(augmentation=AugmentationConfig(camera_turn=1.0))
    with pytest.raises(UserError, match="camera_turn=1 turns clouds about their camera, which must be known"):
        make_processors(config, make_statistics())
    config.augmentation = AugmentationConfig(camera_shift=0.01)
    preprocess, _ = make_processors(config, make_statistics())
    assert preprocess({**make_batch(config)})[OBS_POINT_CLOUD].isfinite().all()


@pytest.mark.parametrize(
    "wrong", [{"jitter": -0.1}, {"drop": 1.0}, {"camera_shift": 1.0}, {"camera_turn": float("nan")}]
)
def test_wrong_values(wrong):
    (name,) = wrong
    with pytest.raises(UserError, match=f"policy.augmentation.{name} must be"):
        make_config(augmentation=AugmentationConfig(**wrong)).validate_sizes()


def test_without_observations_nothing_happens():
    step = CloudAugmentationProcessorStep(jitter=0.1)
    transition = {TransitionKey.ACTION: torch.zeros(1, 4), TransitionKey.OBSERVATION: {}}
    assert step(transition) is transition
