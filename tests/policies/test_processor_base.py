"""The inputs that datasets, environments and robots give, made uniform."""

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from tests.builders import N_ACTIONS, N_POINTS, N_STATES, make_config, make_statistics

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.point_clouds.geometry import sample_farthest
from lerobot_uca.policies.processor_base import PointCloudProcessorStep

STATE = "observation.state"


def preprocessor(**changes):
    return make_pre_post_processors(make_config(**changes), dataset_stats=make_statistics())[0]


def test_the_steps_and_their_names():
    names = [step._registry_name for step in preprocessor().steps]
    assert names == [
        "rename_observations_processor",
        "depth_to_cloud_processor",
        "point_cloud_processor",
        "to_batch_processor",
        "device_processor",
        "normalizer_processor",
    ]


def test_the_step_is_saved_and_loaded(tmp_path):
    config = make_config(n_points=10)
    pre, post = make_pre_post_processors(config, dataset_stats=make_statistics())
    pre.save_pretrained(tmp_path)
    post.save_pretrained(tmp_path)
    loaded, _ = make_pre_post_processors(config, pretrained_path=str(tmp_path))
    assert loaded.steps[2] == PointCloudProcessorStep(n_points=10)
    batch = {OBS_POINT_CLOUD: torch.rand(2, N_POINTS, 3), STATE: torch.rand(2, N_STATES)}
    torch.testing.assert_close(loaded(batch)[OBS_POINT_CLOUD], pre(batch)[OBS_POINT_CLOUD], rtol=0, atol=0)


@pytest.mark.parametrize("key", [OBS_POINT_CLOUD, "observation.pointcloud", "observation.pointcloud.xyz"])
@pytest.mark.parametrize("n_channels", [3, 4, 6])
def test_xyz_is_taken_from_other_names_and_wider_clouds(key, n_channels):
    cloud = torch.rand(2, 5, n_channels)
    batch = preprocessor()({key: cloud, STATE: torch.rand(2, N_STATES)})
    torch.testing.assert_close(batch[OBS_POINT_CLOUD], cloud[..., :3])
    assert [name for name in batch if "cloud" in name] == [OBS_POINT_CLOUD]


def test_what_is_taken_is_said_once(caplog):
    pre = preprocessor()
    for _ in range(2):
        pre({"observation.pointcloud": torch.rand(1, 5, 6), STATE: torch.rand(1, N_STATES)})
    said = [record.getMessage() for record in caplog.records if record.name.startswith("lerobot_uca")]
    assert said == ["'observation.pointcloud' (5, 6): its first three channels are taken as the point cloud's xyz."]


@pytest.mark.parametrize("key", ["observation.pointcloud", "observation.pointcloud.xyz"])
@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.float32])
def test_invalid_points_are_replaced_by_valid_ones(key, dtype):
    cloud = torch.arange(12.0).reshape(1, 4, 3)
    mask = torch.tensor([[0, 1, 0, 1]]).to(dtype)
    batch = preprocessor()({key: cloud, "observation.pointcloud.valid_mask": mask, STATE: torch.rand(1, N_STATES)})
    torch.testing.assert_close(batch[OBS_POINT_CLOUD], cloud[:, [1, 3, 1, 3]])


def test_a_cloud_without_valid_points():
    cloud, mask = torch.rand(2, 4, 3), torch.tensor([[True] * 4, [False] * 4])
    with pytest.raises(UserError, match="at least one valid point"):
        preprocessor()({"observation.pointcloud": cloud, "observation.pointcloud.valid_mask": mask})


def test_a_scan_is_sampled_all_over_and_not_in_its_first_corner():
    line = torch.stack([torch.linspace(0, 1, 401), torch.zeros(401), torch.zeros(401)], dim=-1)
    sampled = PointCloudProcessorStep(n_points=5).uniform(line[None, None])
    assert sampled.shape == (1, 1, 5, 3)
    torch.testing.assert_close(sampled[0, 0, :, 0].sort().values, torch.tensor([0, 0.25, 0.5, 0.75, 1]))


@pytest.mark.parametrize("n_points", [1, 16, 100])
def test_a_cloud_in_sampling_order_keeps_its_first_points(n_points):
    points = np.random.default_rng(0).normal(size=(700, 3)).astype(np.float32)
    cloud = torch.from_numpy(sample_farthest(points, 200)).repeat(2, 1, 1)
    assert torch.equal(PointCloudProcessorStep(n_points).uniform(cloud), cloud[:, :n_points])


@pytest.mark.parametrize(
    "dtype", [torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.uint8, torch.bool]
)
def test_every_dtype_becomes_float32_and_the_statistics_stay(dtype):
    pre, _ = make_pre_post_processors(make_config(), dataset_stats=make_statistics())
    values = {
        OBS_POINT_CLOUD: torch.ones(2, 2, N_POINTS, 3),
        STATE: torch.ones(2, 2, N_STATES),
        "action": torch.ones(2, 4, N_ACTIONS),
    }
    batch = pre({key: value.to(dtype) for key, value in values.items()})
    for key, value in values.items():
        assert torch.equal(batch[key], value)  # 1 is the upper end
    assert {value.dtype for value in pre.steps[-1].state_dict().values()} == {torch.float32}
    assert pre.steps[-1].state_dict()["action.std"].tolist() == [0.5] * N_ACTIONS


def test_numpy_arrays_are_taken():
    cloud, state = np.zeros((1, N_POINTS, 3)), np.zeros((1, N_STATES))
    batch = preprocessor()({OBS_POINT_CLOUD: cloud, STATE: state})
    assert (batch[OBS_POINT_CLOUD].dtype, batch[STATE].dtype) == (torch.float32, torch.float32)


def test_a_single_frame_becomes_a_batch():
    batch = preprocessor()({OBS_POINT_CLOUD: torch.rand(N_POINTS, 3), STATE: torch.rand(N_STATES)})
    assert (batch[OBS_POINT_CLOUD].shape, batch[STATE].shape) == ((1, N_POINTS, 3), (1, N_STATES))


def test_a_single_window_becomes_a_batch():
    window = {
        OBS_POINT_CLOUD: torch.rand(2, N_POINTS, 3),
        STATE: torch.rand(2, N_STATES),
        "action": torch.rand(4, N_ACTIONS),
        "action_is_pad": torch.zeros(4, dtype=torch.bool),
        "index": torch.tensor(0),
    }
    batch = preprocessor()(window)
    for key, value in window.items():
        torch.testing.assert_close(batch[key], value[None])


@pytest.mark.parametrize("leading", [(), (3,), (3, 2)])
def test_one_dimension_that_lerobot_reads_as_a_number(leading):
    step = PointCloudProcessorStep()
    observation = {OBS_POINT_CLOUD: torch.rand(*leading, N_POINTS, 3), STATE: torch.rand(leading)}
    result = step({"observation": observation, "action": torch.rand(leading), "complementary_data": None})
    expected = leading or (1,)
    assert result["observation"][STATE].shape == (*expected, 1)
    assert result["action"].shape == (*expected, 1)


@pytest.mark.parametrize("n_actions", [1, 2])
def test_a_single_window_of_actions_of_one_dimension(n_actions):
    window = {
        OBS_POINT_CLOUD: torch.rand(2, N_POINTS, 3),
        STATE: torch.rand(2, N_STATES),
    }
    action = torch.rand(4) if n_actions == 1 else torch.rand(4, n_actions)
    transition = {"observation": window, "action": action, "complementary_data": {"index": torch.tensor(0)}}
    assert PointCloudProcessorStep()(transition)["action"].shape == (1, 4, n_actions)


@pytest.mark.parametrize("n_points", [None, 12])
def test_the_features_that_it_gives(n_points):
    given = {
        "observation.pointcloud": PolicyFeature(FeatureType.STATE, (N_POINTS, 6)),
        STATE: PolicyFeature(FeatureType.STATE, (N_STATES,)),
    }
    step = PointCloudProcessorStep(n_points=n_points)
    features = step.transform_features({PipelineFeatureType.OBSERVATION: given, PipelineFeatureType.ACTION: {}})
    shapes = {name: feature.shape for name, feature in features[PipelineFeatureType.OBSERVATION].items()}
    assert shapes == {STATE: (N_STATES,), OBS_POINT_CLOUD: (n_points or N_POINTS, 3)}


def test_a_state_without_batch_beside_a_cloud_with_one():
    batch = preprocessor()({OBS_POINT_CLOUD: torch.rand(1, N_POINTS, 3), STATE: torch.rand(N_STATES)})
    assert batch[STATE].shape == (1, N_STATES)
