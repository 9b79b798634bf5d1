"""One rule for what goes into a policy, whatever computes it and in training."""

import re

import numpy as np
import pytest
import torch
from tests.builders import N_ACTIONS, N_POINTS, N_STATES, make_batch, make_config, make_observation

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy

T = 4
OBS_STATE = "observation.state"
every_engine = pytest.mark.parametrize("inference", ["eager", "openvino", "onnxruntime"])


def make(inference: str) -> UCAFlowPolicy:
    return UCAFlowPolicy(make_config(inference=inference)).eval()


CONVERSIONS = {
    "float64": torch.Tensor.double,
    "float16": torch.Tensor.half,
    "bfloat16": torch.Tensor.bfloat16,
    "NumPy": torch.Tensor.numpy,
    "NumPy, float64": lambda value: value.numpy().astype(np.float64),
    "NumPy, read-only": lambda value: np.frombuffer(value.numpy().tobytes(), np.float32).reshape(value.shape),
}


@every_engine
@pytest.mark.parametrize("convert", CONVERSIONS.values(), ids=CONVERSIONS)
def test_observations_and_noise_of_any_real_dtype_are_computed_in_float32(inference, convert):
    policy = make(inference)
    given = {key: convert(value) for key, value in make_observation().items()}
    noise = convert(torch.randn(1, T, N_ACTIONS))
    rounded = {key: torch.as_tensor(np.array(_float32(value))) for key, value in given.items()}
    expected = policy.select_action(rounded, noise=torch.as_tensor(np.array(_float32(noise))))
    policy.reset()
    action = policy.select_action(given, noise=noise)
    assert action.dtype == torch.float32
    assert torch.equal(action, expected)
    history = {key: value[:, None][:, [0, 0]] for key, value in given.items()}
    torch.testing.assert_close(policy.predict_action_chunk(history, noise=noise)[:, 0], expected)


def _float32(value: torch.Tensor | np.ndarray) -> np.ndarray:
    return value.float().numpy() if isinstance(value, torch.Tensor) else value.astype(np.float32)


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int64, torch.float32])
def test_padding_of_any_dtype_gives_the_loss_of_bool(policy, dtype):
    batch = make_batch(policy.config)
    batch["action_is_pad"][:, -1] = True
    losses = []
    for is_pad in (batch["action_is_pad"], batch["action_is_pad"].to(dtype), batch["action_is_pad"].numpy()):
        torch.manual_seed(1)
        losses.append(policy.forward({**batch, "action_is_pad": is_pad})[0].item())
    assert losses[0] == losses[1] == losses[2]


@every_engine
def test_a_batch_without_samples(inference):
    policy = make(inference)
    windows = make_batch(policy.config, batch_size=0)
    message = re.escape(f"at least one sample, got '{OBS_POINT_CLOUD}' of shape (0, ")
    with pytest.raises(UserError, match=message):
        policy.select_action(make_observation(0))
    for act in (policy.predict_action_chunk, policy.forward):
        with pytest.raises(UserError, match=message):
            act(windows)


def test_a_sample_without_a_batch(policy):
    sample = {key: value[0] for key, value in make_observation().items()}
    message = (
        rf"must have shape \(B, N, 3\) with N at least 1, got \({N_POINTS}, 3\)\. A single sample needs a dimension"
    )
    for act in (policy.select_action, policy.predict_action_chunk):
        with pytest.raises(UserError, match=message):
            act(sample)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({OBS_STATE: ["a"] * N_STATES}, "'observation.state' must be a tensor or an array of real numbers, got list"),
        ({OBS_STATE: None}, "'observation.state' must be a tensor or an array of real numbers, got NoneType"),
        ({OBS_STATE: torch.zeros(1, N_STATES, dtype=torch.complex64)}, "must hold real numbers, got torch.complex64"),
        ({OBS_STATE: torch.full((1, N_STATES), 1e300, dtype=torch.float64)}, "must be finite, got 9 of 9"),
        ({OBS_STATE: np.full((1, N_STATES), 1e300)}, "must be finite, got 9 of 9"),
        ({OBS_STATE: torch.zeros(1, 2)}, r"'observation.state' must have shape \(1, 9\), got \(1, 2\)"),
    ],
)
def test_wrong_observations(policy, change, message):
    with pytest.raises(UserError, match=message):
        policy.select_action({**make_observation(), **change})


@every_engine
def test_wrong_noise(inference):
    policy = make(inference)
    with pytest.raises(UserError, match=r"'noise' must have shape \(1, 4, 4\), got \(1, 3, 4\)"):
        policy.select_action(make_observation(), noise=torch.zeros(1, 3, N_ACTIONS))
    with pytest.raises(UserError, match=r"'noise' must be finite, got 16 of 16"):
        policy.select_action(make_observation(), noise=torch.full((1, T, N_ACTIONS), torch.nan))


def test_padding_of_a_wrong_shape(policy):
    batch = {**make_batch(policy.config), "action_is_pad": torch.zeros(8, 3)}
    with pytest.raises(UserError, match=r"'action_is_pad' must have shape \(8, 4\), got \(8, 3\)"):
        policy.forward(batch)


@every_engine
@pytest.mark.parametrize("key", [OBS_POINT_CLOUD, OBS_STATE, "noise"])
def test_a_huge_input_is_named(inference, key):
    """PyTorch would compute NaN, the runtimes any number."""
    policy = make(inference)
    batch = {**make_observation(), "noise": torch.randn(1, T, N_ACTIONS)}
    batch[key].view(-1)[1] = 1e30
    with pytest.raises(UserError, match=rf"'{key}' must lie within \+-1e\+06, got 1\.0e\+30: .* Check the sensor"):
        policy.select_action(batch, noise=batch.pop("noise"))


def test_large_values_are_computed_with(policy):
    """A dataset's out-of-range readings may give such values."""
    observation = make_observation()
    observation[OBS_STATE][0, 3] = 1e5
    assert policy.select_action(observation).isfinite().all()


@pytest.mark.parametrize("key", [OBS_POINT_CLOUD, OBS_STATE, "action"])
@pytest.mark.parametrize(("value", "message"), [(3e38, r"must lie within"), (torch.inf, "must be finite, got 1 of")])
def test_training_data_that_makes_the_loss_infinite_is_named(policy, key, value, message):
    batch = make_batch(policy.config)
    batch[key].view(-1)[1] = value
    with pytest.raises(UserError, match=f"'{key}' {message}"):
        policy.train().forward(batch)


@every_engine
@pytest.mark.parametrize("value", [torch.nan, 1e38])
def test_weights_that_diverged(inference, value):
    policy = make(inference)
    with torch.no_grad():
        policy.ema_model.generator.embed_action.weight.fill_(value)
        policy.model.generator.embed_action.weight.fill_(value)
    message = "'uca_flow' computes NaN or infinite values from good inputs: its training diverged"
    with pytest.raises(UserError, match=message):
        policy.select_action(make_observation())
    with pytest.raises(UserError, match=message):
        policy.train().forward(make_batch(policy.config))
