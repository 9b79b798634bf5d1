"""An exported file gives the policy's actions, from raw observations, with onnxruntime and numpy alone."""

import itertools
import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_policy_config, make_pre_post_processors
from tests.builders import N_ACTIONS, N_POINTS, N_STATES, make_config, make_settings
from tests.depth_builders import make_calibration, make_camera, make_recipe

from lerobot_uca.deploy import onnx_runner
from lerobot_uca.deploy.export import export
from lerobot_uca.deploy.onnx_runner import OnnxPolicy
from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.point_clouds.recipe import CALIBRATION_VARIABLE
from lerobot_uca.policies.augmentation_config import AugmentationConfig
from lerobot_uca.policies.depth_config import DepthConfig
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy


def save(folder: Path, **changes: object) -> UCAFlowPolicy:
    """Save a policy with processors of random statistics, as training does."""
    policy = UCAFlowPolicy(make_config(**changes)).eval()
    with torch.no_grad():
        for parameter in policy.ema_model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    n_channels = policy.config.n_channels
    stats = {
        key: {"min": -torch.rand(size), "max": 1 + torch.rand(size), "mean": torch.rand(size), "std": torch.rand(size)}
        for key, size in ((OBS_POINT_CLOUD, n_channels), ("observation.state", N_STATES), ("action", N_ACTIONS))
    }
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(policy.config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return policy


def coloured_features() -> dict:
    cloud = PolicyFeature(FeatureType.STATE, (N_POINTS, 6))
    return {**make_settings()["input_features"], OBS_POINT_CLOUD: cloud}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("checkpoint")
    save(folder)
    return folder


@pytest.fixture(scope="module")
def exported(checkpoint) -> Path:
    export(str(checkpoint), checkpoint / "policy.onnx")
    return checkpoint / "policy.onnx"


def actions_of_lerobots_loop(policy: UCAFlowPolicy, folder: Path, observations: list, noise: np.ndarray) -> np.ndarray:
    pre, post = make_pre_post_processors(policy.config, pretrained_path=str(folder))
    actions = []
    for point_cloud, state in observations:
        batch = pre(
            {OBS_POINT_CLOUD: torch.from_numpy(point_cloud)[None], "observation.state": torch.from_numpy(state)}
        )
        actions.append(post(policy.select_action(batch, noise=torch.from_numpy(noise)[None]))[0].numpy())
    return np.array(actions)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"n_points": 10, "n_obs_steps": 3, "horizon": 6, "n_action_steps": 2},
        {"obs_stride": 2, "horizon": 16},
        {"n_obs_steps": 3, "obs_stride": 3, "horizon": 8, "n_action_steps": 2},
        {"normalization_mapping": {"STATE": "MEAN_STD", "ACTION": "IDENTITY"}},
        {"augmentation": AugmentationConfig(jitter=0.1)},
        {"hand_position": (1, 0, 2)},
        {"colour": True, "input_features": coloured_features()},
        {"colour": True, "input_features": coloured_features(), "n_points": 10},
    ],
)
def test_the_runner_acts_as_the_policy_in_lerobots_loop(tmp_path, changes, monkeypatch):
    policy = save(tmp_path, **changes)
    export(str(tmp_path), tmp_path / "policy.onnx")
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(policy.config.horizon, N_ACTIONS)).astype(np.float32)
    observations = [
        (
            rng.uniform(-1, 2, (N_POINTS, policy.config.n_channels)).astype(np.float32),
            rng.uniform(-1, 2, N_STATES).astype(np.float32),
        )
        for _ in range(7)
    ]
    runner = OnnxPolicy(tmp_path / "policy.onnx")
    plan = runner.plan
    monkeypatch.setattr(runner, "plan", lambda clouds, states: plan(clouds, states, noise))
    for episode in (observations[:4], observations[3:]):  # the second remembers nothing of the first
        actions = np.array([runner.select_action(*observation) for observation in episode])
        np.testing.assert_allclose(actions, actions_of_lerobots_loop(policy, tmp_path, episode, noise), atol=1e-5)
        assert actions.shape == (4, N_ACTIONS)
        runner.reset()
        policy.reset()


def test_the_file_holds_the_averaged_weights_alone(checkpoint, exported):
    weights = (checkpoint / "model.safetensors").stat().st_size
    assert 0.4 * weights < exported.stat().st_size < 0.7 * weights


def test_a_seed_reproduces_actions_and_reset_forgets(exported):
    cloud, state = np.zeros((N_POINTS, 3), np.float32), np.zeros(N_STATES, np.float32)
    a, b = (OnnxPolicy(exported, seed=3) for _ in range(2))
    first = a.select_action(cloud, state)
    np.testing.assert_array_equal(first, b.select_action(cloud, state))
    a.reset()
    assert not np.array_equal(a.select_action(cloud, state), first)  # fresh noise, so it was planned anew


def test_the_runner_draws_gaussian_noise_of_its_seed(exported):
    policies = [OnnxPolicy(exported, seed=seed) for seed in (3, 3, 4)]
    drawn = []
    for policy in policies:
        policy._shapes["noise"] = (200, 100)
        run = lambda names, values: drawn.append(values["noise"]) or (np.zeros(1), 0.0)  # noqa: E731
        policy._session = SimpleNamespace(run=run)
        policy.plan(np.zeros((2, N_POINTS, 3)), np.zeros((2, N_STATES)))
    assert abs(drawn[0].mean()) < 0.03
    assert abs(drawn[0].std() - 1) < 0.03
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])


def test_the_runner_needs_onnxruntime_and_numpy_alone(exported):
    code = f"""
import sys
sys.path.insert(0, {str(Path(onnx_runner.__file__).parent)!r})
import numpy, onnxruntime
before = set(sys.modules)
import onnx_runner
policy = onnx_runner.OnnxPolicy({str(exported)!r})
print(policy.select_action(numpy.zeros(({N_POINTS}, 3)), numpy.zeros({N_STATES})).shape)
assert not {{"torch", "lerobot", "lerobot_uca"}} & set(sys.modules)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (0, f"({N_ACTIONS},)\n"), result.stderr


def test_a_depth_policys_file_takes_clouds_whatever_cameras_are_here(tmp_path, monkeypatch):
    """It asks for no calibration, and other robots' do not count."""
    make_calibration(make_camera("wrist")).write(tmp_path / "elsewhere")
    monkeypatch.setenv(CALIBRATION_VARIABLE, str(tmp_path / "elsewhere"))
    recipe = make_recipe().as_dict()
    save(tmp_path, depth=DepthConfig(recipe=recipe))
    shapes = export(str(tmp_path), tmp_path / "policy.onnx")
    assert shapes["point_cloud"] == (2, N_POINTS, 3)


def test_an_existing_file_is_replaced_only_when_asked_for(checkpoint, tmp_path):
    output = tmp_path / "new" / "policy.onnx"
    export(str(checkpoint), output)
    with pytest.raises(UserError, match=r"exists\. Choose another --output, or replace it with --overwrite"):
        export(str(checkpoint), output)
    export(str(checkpoint), output, overwrite=True)
    assert [path.name for path in output.parent.iterdir()] == ["policy.onnx"]


# Bad input ----------------------------------------------------------------------------------------------------------


def test_a_policy_of_another_package(tmp_path):
    make_policy_config("act", device="cpu", input_features={}, output_features={}).save_pretrained(tmp_path)
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        (tmp_path / name).write_text("{}")
    with pytest.raises(UserError, match=r"Only this package's point-cloud policies can be exported; .* of type 'act'"):
        export(str(tmp_path), tmp_path / "policy.onnx")


@pytest.mark.parametrize("missing", ["config.json", "policy_preprocessor.json", "policy_postprocessor.json"])
def test_a_checkpoint_without_config_or_processors(tmp_path, missing):
    save(tmp_path)
    (tmp_path / missing).unlink()
    with pytest.raises(UserError, match=re.escape(f"has no {missing}. A checkpoint is a folder like")):
        export(str(tmp_path), tmp_path / "policy.onnx")


def test_a_processor_step_that_a_trace_would_not_hold_for(tmp_path):
    save(tmp_path)
    path = tmp_path / "policy_preprocessor.json"
    pipeline = json.loads(path.read_text())
    pipeline["steps"].insert(0, {"registry_name": "relative_actions_processor", "config": {}})
    path.write_text(json.dumps(pipeline))
    with pytest.raises(
        UserError, match="cannot be exported with its processor step 'relative_actions_processor'; these can"
    ):
        export(str(tmp_path), tmp_path / "policy.onnx")


@pytest.mark.parametrize("name", ["nowhere/at/all", "no-such-user/no-such-policy"])
def test_a_missing_checkpoint(tmp_path, name):
    with pytest.raises(UserError, match=f"'{name}' is not a folder and could not be downloaded from the Hub"):
        export(name, tmp_path / "policy.onnx")


def test_an_unwritable_file(checkpoint, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="Cannot write"):
        export(str(checkpoint), tmp_path / "file" / "policy.onnx")


def test_nothing_is_written_if_onnxruntime_computes_something_else(checkpoint, tmp_path, monkeypatch):
    class Other:
        def __init__(self, *args):
            self.session = onnx_runner.open_session(*args)

        def run(self, *inputs):
            action, largest = self.session.run(*inputs)
            return action + 0.01, largest

    monkeypatch.setattr("lerobot_uca.deploy.export.open_session", Other)
    with pytest.raises(UserError, match=r"computes other actions than the policy: .* Nothing was written"):
        export(str(checkpoint), tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


def test_an_old_onnxruntime(exported, monkeypatch):
    monkeypatch.setattr(onnxruntime, "__version__", "1.9.0")
    with pytest.raises(RuntimeError, match=r"onnxruntime must be at least 1\.12, got 1\.9\.0"):
        OnnxPolicy(exported)


@pytest.mark.parametrize(
    ("point_cloud", "state", "message"),
    [
        (np.zeros((5, 3)), np.zeros(N_STATES), r"'point_cloud' must have shape \(32, 3\), got \(5, 3\)"),
        (np.zeros((N_POINTS, 3)), np.zeros(2), r"'state' must have shape \(9,\), got \(2,\)"),
        (np.full((N_POINTS, 3), np.nan), np.zeros(N_STATES), "'point_cloud' must be finite"),
        (np.zeros((N_POINTS, 3)), np.full(N_STATES, np.inf), "'state' must be finite"),
        (np.zeros((N_POINTS, 3)), np.full(N_STATES, 1e30), r"'state' must lie within \+-1e\+12, got 1\.0e\+30"),
        (
            np.zeros((N_POINTS, 3)),
            np.full(N_STATES, 1e8),
            r"unlike training's: normalised it must lie within \+-1e\+06",
        ),
        (np.full((N_POINTS, 3), -1e8), np.zeros(N_STATES), "unlike training's: normalised .* Check the sensor"),
    ],
)
def test_observations_of_wrong_shapes(exported, point_cloud, state, message):
    with pytest.raises(ValueError, match=message):
        OnnxPolicy(exported).select_action(point_cloud, state)


def test_a_model_with_other_inputs(tmp_path):
    network = torch.nn.Linear(3, 3)
    torch.onnx.export(network, torch.zeros(3), str(tmp_path / "other.onnx"), dynamo=False, input_names=["x"])
    with pytest.raises(ValueError, match=r"must have the inputs point_cloud, state, noise, got x"):
        OnnxPolicy(tmp_path / "other.onnx")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("point_cloud", np.zeros((1, N_POINTS, 3)), r"'point_cloud' must have shape \(2, 32, 3\), got \(1, 32, 3\)"),
        ("point_cloud", np.full((2, N_POINTS, 3), np.nan), "'point_cloud' must be finite"),
        ("state", np.zeros(N_STATES), r"'state' must have shape \(2, 9\), got \(9,\)"),
        ("state", np.full((2, N_STATES), -1e30), "'state' must lie within"),
        ("noise", np.zeros((4, 1)), r"'noise' must have shape \(4, 4\), got \(4, 1\)"),
        ("noise", np.full((4, N_ACTIONS), np.inf), "'noise' must be finite"),
    ],
)
def test_plans_from_inputs_of_wrong_shapes(exported, name, value, message):
    steps = {"point_cloud": np.zeros((2, N_POINTS, 3)), "state": np.zeros((2, N_STATES)), "noise": None}
    with pytest.raises(ValueError, match=message):
        OnnxPolicy(exported).plan(*{**steps, name: value}.values())


def test_inputs_of_other_dtypes_are_computed_in_float32(exported):
    random = np.random.default_rng(0)
    inputs = [random.normal(size=size).astype(np.float32) for size in ((2, N_POINTS, 3), (2, N_STATES), (4, N_ACTIONS))]
    policy = OnnxPolicy(exported)
    expected = policy.plan(*inputs)
    np.testing.assert_array_equal(policy.plan(*(values.astype(np.float64) for values in inputs)), expected)


def test_further_channels_are_left_out_and_said_once(exported, caplog):
    random = np.random.default_rng(0)
    cloud, state = random.normal(size=(N_POINTS, 6)).astype(np.float32), np.zeros(N_STATES, np.float32)
    cloud[0, 5] = np.nan
    policy, other = OnnxPolicy(exported, seed=0), OnnxPolicy(exported, seed=0)
    np.testing.assert_array_equal(policy.select_action(cloud, state), other.select_action(cloud[:, :3], state))
    policy.select_action(cloud, state)
    assert caplog.messages == ["The cloud has 6 channels: the first 3 are taken."]


def test_what_the_policy_refuses_the_runner_refuses(checkpoint, exported):
    """At the same value, in normalised units, and at every step: a sensor's glitch must not move a robot."""
    policy = UCAFlowPolicy.from_pretrained(checkpoint).eval()
    assert policy.config.n_action_steps > 2
    pre, _ = make_pre_post_processors(policy.config, pretrained_path=str(checkpoint))
    runner = OnnxPolicy(exported, seed=0)
    n_refused = 0
    for size, glitch in itertools.product(10.0 ** np.arange(2, 10), range(3)):
        policy.reset()
        runner.reset()
        for step in range(6):  # a plan lasts for three; what was refused is forgotten
            cloud, state = np.zeros((N_POINTS, 3), np.float32), np.zeros(N_STATES, np.float32)
            state[3] = size if step == glitch else 0
            batch = pre({OBS_POINT_CLOUD: torch.from_numpy(cloud), "observation.state": torch.from_numpy(state)})
            try:
                policy.select_action(batch)
            except UserError:
                n_refused += 1
                assert step == glitch
                with pytest.raises(ValueError, match="unlike training's"):
                    runner.select_action(cloud, state)
            else:
                runner.select_action(cloud, state)
    assert 0 < n_refused < 24


class Diverged(torch.nn.Module):
    def forward(self, point_cloud, state, noise):
        return (noise + point_cloud.sum() + state.sum()) * torch.inf, state.abs().amax()


def test_infinite_actions_are_never_returned(tmp_path):
    shapes = {"point_cloud": (2, N_POINTS, 3), "state": (2, N_STATES), "noise": (4, N_ACTIONS)}
    inputs = tuple(torch.zeros(shape) for shape in shapes.values())
    names = {"dynamo": False, "input_names": list(shapes), "output_names": list(onnx_runner.OUTPUTS)}
    torch.onnx.export(Diverged(), inputs, str(tmp_path / "policy.onnx"), **names)
    with pytest.raises(ValueError, match="The actions are NaN or infinite, the inputs are not"):
        OnnxPolicy(tmp_path / "policy.onnx").select_action(np.zeros((N_POINTS, 3)), np.zeros(N_STATES))


def test_a_policy_whose_training_diverged_is_not_exported(tmp_path):
    policy = save(tmp_path)
    with torch.no_grad():
        policy.ema_model.generator.head[-1].bias.fill_(torch.inf)
    policy.save_pretrained(tmp_path)
    with pytest.raises(UserError, match="its training diverged"):
        export(str(tmp_path), tmp_path / "policy.onnx")
    assert not (tmp_path / "policy.onnx").exists()


@pytest.mark.parametrize("location", ["../secret", "weights.bin"])
def test_a_file_with_weights_in_other_files(exported, tmp_path, location):
    """They may be any files of the machine, and one file is what an export writes."""
    (tmp_path / "secret").write_bytes(bytes(10**6))
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "weights.bin").write_bytes(bytes(10**6))
    model = onnx.load(exported)
    weight = model.graph.initializer[0]
    weight.data_location = onnx.TensorProto.EXTERNAL
    weight.ClearField("raw_data")
    weight.external_data.add(key="location", value=location)
    (tmp_path / "folder" / "policy.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(ValueError, match=r"policy\.onnx' keeps weights in other files \(external data\)"):
        OnnxPolicy(tmp_path / "folder" / "policy.onnx")


def test_an_invalid_model_file(tmp_path):
    (tmp_path / "policy.onnx").write_bytes(b"text")
    with pytest.raises(ValueError, match=r"policy\.onnx' cannot be opened as an ONNX model"):
        OnnxPolicy(tmp_path / "policy.onnx")
