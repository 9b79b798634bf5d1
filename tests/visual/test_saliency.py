import numpy as np
import pytest
import torch
from lerobot.policies import make_pre_post_processors
from tests.builders import N_ACTIONS, N_POINTS, N_STATES, make_config, make_statistics, write_dataset

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy
from lerobot_uca.visual.saliency import main, moments_of, saliency


def inputs(policy, batch_size=2):
    config = policy.config
    cloud = torch.rand(batch_size, config.n_obs_steps, N_POINTS, 3)
    return cloud, torch.rand(batch_size, config.n_obs_steps, N_STATES), torch.randn(batch_size, 4, N_ACTIONS)


def test_saliency_is_the_gradients_length(policy):
    """Checked by finite differences in double precision."""
    policy = policy.double()
    cloud, state, noise = (each.double() for each in inputs(policy))
    got = saliency(policy, cloud, state, noise)
    model = policy.active_model

    def size(points):
        return policy.generate(model.generator, noise, model.encoder(points, state))[1].square().sum()

    point = int(got[1].argmax())
    gradient = []
    for axis in range(3):
        ahead, behind = cloud.clone(), cloud.clone()
        ahead[1, -1, point, axis] += 1e-6
        behind[1, -1, point, axis] -= 1e-6
        gradient.append((size(ahead) - size(behind)) / 2e-6)
    assert got[1, point].item() == pytest.approx(torch.stack(gradient).norm().item(), rel=1e-5)
    assert got.shape == (2, N_POINTS)


@pytest.fixture
def checkpoint(policy, dataset_root, tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.policies.factory import make_pre_post_processors

    folder = tmp_path / "checkpoint"
    policy.save_pretrained(folder)
    stats = LeRobotDataset("test/random", root=dataset_root).meta.stats
    for processor in make_pre_post_processors(policy.config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return folder


def test_a_picture_and_a_recording(checkpoint, dataset_root, tmp_path, capsys):
    pytest.importorskip("rerun")
    main([str(checkpoint), str(dataset_root), f"--output={tmp_path}/saliency", "--rerun"])
    assert (tmp_path / "saliency" / "saliency.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "saliency" / "saliency.rrd").read_bytes().startswith(b"RRF")
    assert "saliency.png" in capsys.readouterr().out


def test_moments_are_in_the_datasets_units(checkpoint, dataset_root):
    moments = moments_of(checkpoint, dataset_root, episode=1)
    assert moments.steps == [0, 4, 8, 12]  # of 13
    assert moments.points.shape == (4, N_POINTS, 3)
    assert moments.saliency.max(axis=1) == pytest.approx(1)
    assert moments.actions.shape == (4, 3, N_ACTIONS)


@pytest.mark.parametrize("masked", [False, True])
def test_the_points_shown_are_those_that_the_policy_saw(tmp_path, masked):
    """Fewer than the cloud has, which lies under another plugin's name, in no order, and perhaps with a mask."""
    features = {
        "observation.pointcloud.xyz": {"dtype": "float32", "shape": (N_POINTS, 3), "names": None},
        "observation.state": {"dtype": "float32", "shape": (N_STATES,), "names": None},
        "action": {"dtype": "float32", "shape": (N_ACTIONS,), "names": None},
    }
    if masked:
        features["observation.pointcloud.valid_mask"] = {"dtype": "bool", "shape": (N_POINTS,), "names": None}
    dataset = write_dataset(tmp_path / "data", features=features)
    policy = UCAFlowPolicy(make_config(n_points=8)).eval()
    policy.save_pretrained(tmp_path / "policy")
    for processor in make_pre_post_processors(policy.config, dataset_stats=make_statistics()):  # changes no value
        processor.save_pretrained(tmp_path / "policy")
    moments = moments_of(tmp_path / "policy", tmp_path / "data", episode=0)
    for step, points, values in zip(moments.steps, moments.points, moments.saliency, strict=True):
        history = [dataset[max(0, step - 1)], dataset[step]]
        names = [name for name in history[0] if name.startswith("observation.")]
        pre, _ = make_pre_post_processors(policy.config, pretrained_path=str(tmp_path / "policy"))
        batch = pre({name: torch.stack([frame[name] for frame in history])[None] for name in names})
        cloud, state = batch[OBS_POINT_CLOUD], batch["observation.state"]
        np.testing.assert_allclose(points, cloud[0, -1], atol=1e-6)
        expected = saliency(policy, cloud, state, torch.zeros(1, policy.config.horizon, N_ACTIONS))[0]
        np.testing.assert_allclose(values, expected / expected.max(), atol=1e-5)


def test_what_is_not_there(checkpoint, dataset_root, tmp_path):
    with pytest.raises(UserError, match="--episode must be 0 to 2, got 3"):
        moments_of(checkpoint, dataset_root, episode=3)
    with pytest.raises(UserError, match=r"has no config\.json"):
        moments_of(tmp_path / "none", dataset_root, episode=0)
    with pytest.raises(UserError, match=r"none' must be a LeRobot dataset \(meta/info\.json\)\."):
        moments_of(checkpoint, tmp_path / "none", episode=0)
    (tmp_path / "damaged" / "meta").mkdir(parents=True)
    (tmp_path / "damaged" / "meta" / "info.json").write_text("{")
    with pytest.raises(UserError, match="damaged' cannot be read: JSONDecodeError"):
        moments_of(checkpoint, tmp_path / "damaged", episode=0)


def test_clouds_of_another_kind_than_trainings(policy, checkpoint, dataset_root):
    policy.config.observation = "object_cloud"
    policy.config.save_pretrained(checkpoint)
    with pytest.raises(UserError, match=r"trained on clouds of env\.observation=object_cloud, .* has point_cloud\."):
        moments_of(checkpoint, dataset_root, episode=0)


def pointed(tmp_path, state="observation.state", n_states=N_STATES, rename_map=None):
    """A checkpoint trained with a rename_map, and a dataset with a state of a name and size."""
    features = {
        OBS_POINT_CLOUD: {"dtype": "float32", "shape": (N_POINTS, 3), "names": None},
        state: {"dtype": "float32", "shape": (n_states,), "names": None},
        "action": {"dtype": "float32", "shape": (N_ACTIONS,), "names": None},
    }
    write_dataset(tmp_path / "data", features=features)
    torch.manual_seed(0)
    policy = UCAFlowPolicy(make_config()).eval()
    policy.save_pretrained(tmp_path / "policy")
    pre, post = make_pre_post_processors(policy.config, dataset_stats=make_statistics())
    pre.steps[0].rename_map = rename_map or {}
    pre.save_pretrained(tmp_path / "policy")
    post.save_pretrained(tmp_path / "policy")
    return tmp_path / "policy", tmp_path / "data"


def test_features_are_renamed_as_in_training(tmp_path):
    renamed = moments_of(
        *pointed(tmp_path / "a", "observation.q", rename_map={"observation.q": "observation.state"}), 0
    )
    named = moments_of(*pointed(tmp_path / "b"), 0)
    np.testing.assert_array_equal(renamed.saliency, named.saliency)
    np.testing.assert_array_equal(renamed.states, named.states)


def test_a_state_of_another_name_or_size(tmp_path):
    expected = r"must have 'observation\.state' of the checkpoint's shape \(9,\), got "
    with pytest.raises(UserError, match=expected + r"observation\.point_cloud, observation\.q, "):
        moments_of(*pointed(tmp_path / "a", "observation.q"), 0)
    with pytest.raises(UserError, match=expected + r"\(7,\)\."):
        moments_of(*pointed(tmp_path / "b", n_states=7), 0)


def test_every_ablation_has_saliency():
    for conditioning in ("cross_attention", "adaln"):
        policy = UCAFlowPolicy(make_config(conditioning=conditioning)).eval()
        with torch.no_grad():
            for parameter in policy.parameters():
                parameter.add_(0.1 * torch.randn_like(parameter))
        assert (saliency(policy, *inputs(policy)) > 0).any()
