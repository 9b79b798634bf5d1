"""Policies that see depth images: the same clouds in training, resumed, trained further, and on the robot."""

import dataclasses
import logging
import sys

import numpy as np
import pytest
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.scripts import lerobot_train
from tests.builders import N_STATES, SMALL_POLICIES, make_config, make_statistics
from tests.depth_builders import (
    CROP,
    DEPTH_KEY,
    N_CLOUD_POINTS,
    live_frame,
    make_calibration,
    make_camera,
    make_recipe,
    write_depth_dataset,
)

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.point_clouds.depth import DepthToCloud
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.point_clouds.recipe import CALIBRATION_VARIABLE, RECIPE_INFO, CloudRecipe, camera_of
from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig
from lerobot_uca.policies.depth_config import DepthConfig
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
from lerobot_uca.policies.processor_base import make_processors
from lerobot_uca.policies.processor_depth import DepthToCloudProcessorStep

LOG_STEP = (np.log(13.5) - np.log(3.51)) / 4095
"""The step of LeRobot's depth codes: log(depth + 3.5 m) of 0.01 to 10 m in 12 bits."""


@pytest.fixture(scope="module", params=[False, True], ids=["tiff", "video"])
def recorded(request, tmp_path_factory):
    return write_depth_dataset(tmp_path_factory.mktemp("depth") / "data", video=request.param)


@pytest.fixture
def calibrated(tmp_path, monkeypatch):
    folder = tmp_path / "calibration"
    make_calibration().write(folder)
    monkeypatch.setenv(CALIBRATION_VARIABLE, str(folder))
    return folder


def policy_config(**changes):
    depth = DepthConfig(crop_low=CROP.low, crop_high=CROP.high, n_points=N_CLOUD_POINTS)
    settings = {"device": "cpu", "push_to_hub": False, "depth": depth, **SMALL_POLICIES["uca_flow"], **changes}
    return UCAFlowConfig(**settings)


@pytest.fixture
def seen(monkeypatch):
    """The policy's input in training: normalised clouds (B, O, N, 3), and the index of their newest frame."""
    batches = []
    forward = UCAFlowPolicy.forward

    def remember(self, batch, *arguments, **options):
        batches.append((batch[OBS_POINT_CLOUD].clone(), batch["index"].clone()))
        return forward(self, batch, *arguments, **options)

    monkeypatch.setattr(UCAFlowPolicy, "forward", remember)
    return batches


def train(dataset, output, policy, steps=1, **changes):
    config = TrainPipelineConfig(
        dataset=DatasetConfig(repo_id="test/depth", root=str(dataset.root)),
        policy=policy,
        output_dir=output,
        batch_size=4,
        steps=steps,
        num_workers=0,
        save_freq=1,
        **changes,
    )
    lerobot_train.train(config)
    return output / "checkpoints" / f"{steps:06d}" / "pretrained_model"


def normalised(cloud):
    low, high = np.float32(CROP.low), np.float32(CROP.high)
    return 2 * (cloud - low) / (high - low) - 1


def live_cloud(index):
    """The cloud of a live frame, by the pure function."""
    return normalised(make_recipe().make()([live_frame(index)]))


def as_rollout_gives(index):
    """A robot's observation as lerobot-rollout hands it to the preprocessor: torch uint16 (1, 1, H, W)."""
    observation = {DEPTH_KEY: live_frame(index), "observation.state": np.zeros(N_STATES, np.float32)}
    return prepare_observation_for_inference(observation, torch.device("cpu"))


def check_clouds(dataset, batches):
    """Clouds of a training are those of the live frames: bit for bit from TIFF, within the codes' step from video."""
    is_video = DEPTH_KEY in dataset.meta.video_keys
    assert batches
    for clouds, indices in batches:
        for cloud, index in zip(clouds[:, -1].numpy(), indices.tolist(), strict=True):
            if is_video:
                assert gap(cloud, every_live_point(index)) <= VIDEO_BOUND
            else:
                np.testing.assert_array_equal(cloud, live_cloud(index))


VIDEO_BOUND = (0.5 * LOG_STEP * (1.8 + 3.5) + 0.001) * 1.5
"""[m] Half a code's step at the farthest depth here and twice a rounding to millimetres, along a ray of 1.5 m a metre.
A cloud's points are real ones this far off; which of them are sampled may differ."""


def every_live_point(index):
    make = make_recipe().make()
    views = make.views
    wide = type(CROP)(tuple(v - 0.01 for v in CROP.low), tuple(v + 0.01 for v in CROP.high))
    return DepthToCloud(views, wide, N_CLOUD_POINTS).points([live_frame(index)])


def gap(cloud, points):
    """The distance of a normalised cloud's points from all points [m]."""
    low, high = np.float32(CROP.low), np.float32(CROP.high)
    metres = (cloud + 1) / 2 * (high - low) + low
    return np.linalg.norm(metres[:, None] - points[None], axis=-1).min(axis=1).max()


def test_training_resuming_training_further_and_the_robot_see_the_same_clouds(
    recorded, calibrated, seen, tmp_path, monkeypatch
):
    fresh = train(recorded, tmp_path / "fresh", policy_config(), steps=1)
    check_clouds(recorded, seen)
    config = policy_config().from_pretrained(fresh)
    assert config.input_features[OBS_POINT_CLOUD].shape == (N_CLOUD_POINTS, 3)
    assert config.depth.calibration is None

    seen.clear()
    resume(fresh, monkeypatch)
    check_clouds(recorded, seen)

    seen.clear()
    further = UCAFlowConfig.from_pretrained(fresh)
    further.pretrained_path = fresh
    trained_further = train(recorded, tmp_path / "further", further)
    check_clouds(recorded, seen)

    for checkpoint in (fresh, trained_further):
        preprocess, _ = make_pre_post_processors(config, pretrained_path=str(checkpoint))
        for index in (0, 7):
            batch = preprocess(as_rollout_gives(index))
            assert DEPTH_KEY not in batch
            np.testing.assert_array_equal(batch[OBS_POINT_CLOUD][0].numpy(), live_cloud(index))
            action = UCAFlowPolicy.from_pretrained(checkpoint).select_action(batch)
            assert action.isfinite().all()


def resume(checkpoint, monkeypatch):
    """Resume as a user does, for one more step."""
    arguments = ["--resume=true", f"--config_path={checkpoint}/train_config.json", "--steps=2"]
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *arguments])
    lerobot_train.train()


# The step alone -----------------------------------------------------------------------------------------------------


def step(**changes):
    """A step as it is when its checkpoint has been loaded."""
    made = DepthToCloudProcessorStep(make_recipe(**changes).as_dict())
    made.install()
    return made


def pure_cloud(index, recipe=None):
    return (recipe or make_recipe()).make()([live_frame(index)])


@pytest.mark.parametrize("leading", [(), (1,), (3,), (2, 2)])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_any_number_of_dimensions_before_the_image(leading, dtype):
    n_frames = int(np.prod(leading))
    frames = np.stack([live_frame(index)[..., 0] for index in range(n_frames)]).astype(dtype)
    images = torch.from_numpy(frames.reshape(*leading, 1, 48, 64))
    cloud = step().observation({DEPTH_KEY: images, "observation.state": torch.zeros(2)})[OBS_POINT_CLOUD]
    assert cloud.dtype == torch.float32
    assert cloud.shape == (*leading, N_CLOUD_POINTS, 3)
    expected = np.stack([pure_cloud(index) for index in range(n_frames)])
    np.testing.assert_array_equal(cloud.numpy().reshape(expected.shape), expected)


def test_a_plain_picture_is_taken_too():
    cloud = step().observation({DEPTH_KEY: live_frame(0)[..., 0]})[OBS_POINT_CLOUD]
    np.testing.assert_array_equal(cloud.numpy(), pure_cloud(0))


def test_a_cloud_stays_as_it_is():
    observation = {OBS_POINT_CLOUD: torch.zeros(1, 5, 3), DEPTH_KEY: torch.zeros(1)}
    assert step().observation(observation) is observation
    assert DepthToCloudProcessorStep().observation(observation) is observation


def test_a_camera_without_depth_is_told():
    with pytest.raises(UserError, match=f"makes its cloud from {DEPTH_KEY}: {DEPTH_KEY} is missing.*use_depth: true"):
        step().observation({"observation.images.front": torch.zeros(1, 3, 48, 64)})


def test_wrong_images_are_told_in_one_line():
    with pytest.raises(UserError, match="camera 'front' must be 48 x 64 numbers"):
        step().observation({DEPTH_KEY: torch.zeros(1, 1, 20, 20)})
    with pytest.raises(UserError, match="every pixel is 0 or NaN"):
        step().observation({DEPTH_KEY: torch.zeros(1, 1, 48, 64)})
    with pytest.raises(UserError, match="In units of 1 m camera 'front' would have"):
        step().observation({DEPTH_KEY: torch.full((1, 1, 48, 64), 0.8)})


def test_a_recipe_survives_being_written():
    recipe = make_recipe(depth_unit=2.5e-4)
    assert CloudRecipe.from_dict(recipe.as_dict()) == recipe
    assert camera_of(DEPTH_KEY) == "front"


@pytest.mark.parametrize("recipe", [{}, {"sources": 3, "crop": [], "n_points": 1}, {"sources": [{}]}])
def test_a_damaged_recipe_is_refused(recipe):
    with pytest.raises(UserError, match="A recipe needs sources, crop and n_points"):
        DepthToCloudProcessorStep(recipe).install()


def moved_camera(mm):
    x, y, z = make_camera().position
    return make_camera(position=(x + mm / 1e3, y, z))


def test_another_installation_uses_its_own_calibration_and_says_how_far_it_is(calibrated, caplog):
    moved = make_calibration(moved_camera(30))
    moved.write(calibrated)
    there = step()
    assert "training, camera 'front' is 30.0 mm and 0.00 deg from where it was." in caplog.messages[0]
    cloud = there.observation({DEPTH_KEY: live_frame(0)})[OBS_POINT_CLOUD].numpy()
    np.testing.assert_array_equal(cloud, pure_cloud(0, make_recipe(camera=moved.camera)))
    assert there.get_config()["recipe"] == make_recipe().as_dict()  # the checkpoint still knows its own


def test_a_folder_of_calibrations_may_be_named_when_a_checkpoint_is_loaded(tmp_path, caplog, monkeypatch):
    """lerobot-eval and lerobot-rollout with --policy.depth.calibration."""
    monkeypatch.delenv(CALIBRATION_VARIABLE, raising=False)
    checkpoint, trained = tmp_path / "checkpoint", make_config(depth=DepthConfig(recipe=make_recipe().as_dict()))
    UCAFlowPolicy(trained).save_pretrained(checkpoint)
    for processors in make_processors(trained, make_statistics()):
        processors.save_pretrained(checkpoint)
    other = make_calibration(moved_camera(30))
    other.write(tmp_path / "other")
    config = UCAFlowConfig.from_pretrained(checkpoint, cli_overrides=[f"--depth.calibration={tmp_path / 'other'}"])
    caplog.clear()
    preprocess, _ = make_pre_post_processors(config, pretrained_path=str(checkpoint))
    assert "training, camera 'front' is 30.0 mm and 0.00 deg from where it was." in caplog.text
    cloud = preprocess(as_rollout_gives(0))[OBS_POINT_CLOUD][0].numpy()
    np.testing.assert_allclose(cloud, pure_cloud(0, make_recipe(camera=other.camera)), atol=1e-6)
    step = next(each for each in preprocess.steps if isinstance(each, DepthToCloudProcessorStep))
    assert step.get_config() == {"recipe": make_recipe().as_dict()}  # no path of this machine
    config.depth.calibration = str(tmp_path / "missing")
    with pytest.raises(UserError, match="missing' must be a folder of calibrations"):
        make_pre_post_processors(config, pretrained_path=str(checkpoint))


def test_without_an_installation_the_calibration_of_training_is_used_and_told(caplog):
    step()
    (line,) = caplog.messages
    assert line.startswith("Camera 'front': the calibration of the policy's training is used (2026-11-25).")


def test_the_same_installation_is_silent(calibrated, caplog):
    step()
    assert not caplog.messages


def test_an_installation_without_the_camera_is_refused(calibrated):
    (calibrated / "123456.yaml").unlink()
    make_calibration(make_camera("wrist"), serial="1").write(calibrated)
    with pytest.raises(UserError, match="Camera 'front' needs a calibration, got those of wrist"):
        step()


def test_a_camera_on_the_arm_is_refused():
    with pytest.raises(UserError, match="Camera 'front' moves with the tool"):
        step(frame="tool")


# Settings -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tiff(tmp_path_factory):
    return write_depth_dataset(tmp_path_factory.mktemp("tiff") / "data", video=False)


def test_training_from_depth_needs_a_calibration(tiff, tmp_path, monkeypatch):
    monkeypatch.delenv(CALIBRATION_VARIABLE, raising=False)
    with pytest.raises(UserError, match="Camera 'front' needs a calibration, got none"):
        train(tiff, tmp_path / "out", policy_config())
    depth = DepthConfig(crop_low=CROP.low, crop_high=CROP.high, calibration=str(tmp_path / "missing"))
    with pytest.raises(UserError, match="missing' must be a folder of calibrations"):
        train(tiff, tmp_path / "out2", policy_config(depth=depth))


@pytest.mark.usefixtures("calibrated")
def test_training_from_depth_needs_a_crop(tiff, tmp_path):
    with pytest.raises(UserError, match="A cloud from depth needs a crop: give crop_low and crop_high"):
        train(tiff, tmp_path / "out", policy_config(depth=DepthConfig()))
    depth = DepthConfig(crop_low=(0, 0, 1), crop_high=(1, 1, 0))
    with pytest.raises(UserError, match=r"low below high in each, got \(0.0, 0.0, 1.0\) and \(1.0, 1.0, 0.0\)"):
        train(tiff, tmp_path / "out2", policy_config(depth=depth))


def check_clouds_of(recipe, batches):
    for clouds, indices in batches:
        for cloud, index in zip(clouds[:, -1].numpy(), indices.tolist(), strict=True):
            np.testing.assert_array_equal(cloud, normalised(recipe.make()([live_frame(index)])))


def test_the_named_folder_counts_in_training_and_whenever_it_goes_on(tiff, seen, tmp_path, monkeypatch):
    """Whatever LEROBOT_UCA_CALIBRATION names: a recording station has its own cameras."""
    make_calibration().write(tmp_path / "named")
    depth = dataclasses.replace(policy_config().depth, calibration=str(tmp_path / "named"))
    monkeypatch.delenv(CALIBRATION_VARIABLE, raising=False)
    fresh = train(tiff, tmp_path / "fresh", policy_config(depth=depth))
    resume(fresh, monkeypatch)
    further = UCAFlowConfig.from_pretrained(fresh)
    further.pretrained_path = fresh
    train(tiff, tmp_path / "further", further)

    make_calibration(moved_camera(30)).write(tmp_path / "stations")
    monkeypatch.setenv(CALIBRATION_VARIABLE, str(tmp_path / "stations"))
    depth.calibration = str(tmp_path / "named")
    there = train(tiff, tmp_path / "there", policy_config(depth=depth))
    resume(there, monkeypatch)
    assert len(seen) == 5
    check_clouds_of(make_recipe(), seen)
    assert UCAFlowConfig.from_pretrained(there).depth.recipe == make_recipe().as_dict()


@pytest.mark.parametrize("how", ["folder", "variable"])
def test_training_further_on_another_installations_data(how, tiff, calibrated, seen, tmp_path, monkeypatch, caplog):
    fresh = train(tiff, tmp_path / "fresh", policy_config())
    make_calibration(moved_camera(30)).write(tmp_path / "other")
    further = UCAFlowConfig.from_pretrained(fresh)
    further.pretrained_path = fresh
    if how == "folder":
        further.depth.calibration = str(tmp_path / "other")
    else:
        monkeypatch.setenv(CALIBRATION_VARIABLE, str(tmp_path / "other"))
    seen.clear()
    # LeRobot's training takes the root's handlers away.
    monkeypatch.setattr(logging.getLogger("lerobot_uca.policies.depth_config"), "handlers", [caplog.handler])
    trained = train(tiff, tmp_path / "further", further)
    moved = make_recipe(camera=moved_camera(30))
    check_clouds_of(moved, seen)
    assert UCAFlowConfig.from_pretrained(trained).depth.recipe == moved.as_dict()
    assert [record.message for record in caplog.records if record.name.endswith("depth_config")] == [
        "Compared with the checkpoint's training, camera 'front' is 30.0 mm and 0.00 deg from where it was."
    ]


def test_training_from_depth_reads_the_datasets_own_calibration(seen, tmp_path, monkeypatch):
    camera, other = make_camera(), make_calibration(moved_camera(30))
    other.write(tmp_path / "other")
    monkeypatch.setenv(CALIBRATION_VARIABLE, str(tmp_path / "other"))
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], np.float32)
    own = {
        "observation.intrinsics.front": lambda index: K,
        "observation.extrinsics.front": lambda index: np.array(camera.X_world_camera, np.float32),
    }
    dataset = write_depth_dataset(tmp_path / "data", video=False, columns=own)
    trained = train(dataset, tmp_path / "out", policy_config())
    recipe = CloudRecipe.from_dict(UCAFlowConfig.from_pretrained(trained).depth.recipe)
    assert recipe.sources[0].calibration.method == "recorded in the dataset"
    check_clouds_of(recipe, seen)
    np.testing.assert_allclose(recipe.sources[0].calibration.camera.position, camera.position, atol=1e-6)
    with pytest.raises(UserError, match="holds the calibration of camera 'front', which lerobot-train and"):
        policy_config().depth.settle(dataset.meta.features)  # from features alone
    half = {key: value for key, value in dataset.meta.features.items() if "intrinsics" not in key}
    assert policy_config().depth.settle(half).sources[0].calibration == other


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"crop_low": (0.3, 0.0, 0.0), "crop_high": (0.5, 0.1, 0.1)}, "policy.depth.crop_low and crop_high do"),
        ({"n_points": 1024}, "policy.depth.n_points do"),
        ({"crop_low": CROP.low, "crop_high": CROP.high, "n_points": N_CLOUD_POINTS}, None),
        ({}, None),
    ],
)
def test_options_that_made_clouds_do_not_heed_are_told(changes, names, caplog):
    depth = DepthConfig(**changes)
    for _ in range(2):  # as often as LeRobot asks
        assert depth.settle(features_made_with(make_recipe())) == make_recipe()
    assert depth.n_points == N_CLOUD_POINTS
    assert depth.crop_low in (None, CROP.low)
    assert len(caplog.messages) == (names is not None)
    assert (names or "") in caplog.text


def test_one_corner_alone_is_refused(tiff, calibrated):
    with pytest.raises(UserError, match="Give both crop_low and crop_high, or neither"):
        DepthConfig(crop_low=CROP.low).settle(tiff.meta.features)


def features_made_with(recipe):
    info = {} if recipe is None else {RECIPE_INFO: recipe.as_dict()}
    return {OBS_POINT_CLOUD: {"dtype": "float32", "shape": (N_CLOUD_POINTS, 3), "info": info}}


def test_training_further_on_other_clouds_makes_those_from_now_on_and_says_so(caplog):
    depth = DepthConfig(recipe=make_recipe().as_dict())
    other = dataclasses.replace(make_recipe(), crop=Crop((0.1, -0.3, 0.01), (0.9, 0.35, 0.4)), n_points=20)
    assert depth.settle(features_made_with(make_recipe())) == make_recipe()
    assert not caplog.messages
    assert depth.settle(features_made_with(other)) == other
    assert depth.recipe == other.as_dict()
    (message,) = caplog.messages
    assert "the crop is [0.1, -0.3, 0.01] to [0.9, 0.35, 0.4] and was [0.2, -0.3, 0.01] to" in message
    assert "a cloud has 20 points and had 48" in message
    caplog.clear()
    assert depth.settle(features_made_with(None)) == other
    assert "does not say how its clouds were made" in caplog.text


def test_the_robot_makes_the_clouds_of_the_further_training(tmp_path, monkeypatch):
    monkeypatch.delenv(CALIBRATION_VARIABLE, raising=False)
    trained = make_config(depth=DepthConfig(recipe=make_recipe().as_dict()))
    for processors in make_processors(trained, make_statistics()):
        processors.save_pretrained(tmp_path)
    other = dataclasses.replace(make_recipe(), n_points=20)
    trained.depth.settle(features_made_with(other))
    preprocess, _ = make_pre_post_processors(trained, pretrained_path=str(tmp_path))
    (there,) = [each for each in preprocess.steps if isinstance(each, DepthToCloudProcessorStep)]
    cloud = there.observation({DEPTH_KEY: live_frame(0)})[OBS_POINT_CLOUD].numpy()
    np.testing.assert_array_equal(cloud, pure_cloud(0, other))


def test_another_device_is_said(calibrated, caplog):
    make_calibration(serial="654321").write(calibrated)
    (calibrated / "123456.yaml").unlink()
    step()
    assert "camera 'front' is the device 654321 and was 123456" in caplog.text


def test_depth_of_a_type_that_numpy_lacks():
    picture = torch.full((1, 1, 48, 64), 700, dtype=torch.bfloat16)
    expected = step().observation({DEPTH_KEY: picture.float()})[OBS_POINT_CLOUD]
    assert torch.equal(step().observation({DEPTH_KEY: picture})[OBS_POINT_CLOUD], expected)


def test_a_policy_trained_on_unknown_clouds_does_not_take_depth(tiff, calibrated, dataset_root, tmp_path):
    clouds = LeRobotDataset("test/random", root=dataset_root)
    config = policy_config(depth=DepthConfig())
    checkpoint = train(clouds, tmp_path / "clouds", config)
    further = UCAFlowConfig.from_pretrained(checkpoint)
    further.pretrained_path = checkpoint
    further.depth.crop_low, further.depth.crop_high = CROP.low, CROP.high
    with pytest.raises(UserError, match="was trained on clouds of unknown origin"):
        train(tiff, tmp_path / "further", further)


@pytest.mark.parametrize(
    ("info", "near", "far", "unit"),
    [
        ({}, 0.01, 10.0, 1e-3),
        ({"depth_unit": "mm", "video.depth_min": 0.01, "video.depth_max": 2.0}, 0.01, 2.0, 1e-3),
        ({"depth_unit": "m"}, 0.01, 10.0, 1e-3),
    ],
)
def test_the_encoders_range_is_taken_from_the_dataset(info, near, far, unit, tiff, calibrated):
    if info.get("depth_unit") == "m":  # LeRobot reads millimetres, whatever the camera's unit
        make_calibration(depth_unit=2.5e-4).write(calibrated)
    features = {
        **tiff.meta.features,
        DEPTH_KEY: {**tiff.meta.features[DEPTH_KEY], "info": {"is_depth_map": True, **info}},
    }
    recipe = policy_config().depth.settle(features)
    (source,) = recipe.sources
    assert (source.near, source.far, source.calibration.depth_unit) == (near, far, unit)


def test_a_cameras_own_unit_scales_the_encoders_range(tiff, calibrated):
    make_calibration(depth_unit=2.5e-4).write(calibrated)
    info = {"is_depth_map": True, "depth_unit": "mm", "video.depth_min": 0.08, "video.depth_max": 8.0}
    recipe = policy_config().depth.settle({DEPTH_KEY: {"dtype": "video", "info": info}})
    (source,) = recipe.sources
    assert (source.near, source.far, source.calibration.depth_unit) == (0.02, 2.0, 2.5e-4)
