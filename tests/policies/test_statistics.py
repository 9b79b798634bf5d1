"""A dataset's statistics, made fit for LeRobot's normalisers."""

import numpy as np
import pytest
import torch
from lerobot.policies.factory import make_pre_post_processors
from tests.builders import N_ACTIONS, N_POINTS, N_STATES, make_config, make_statistics

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.statistics import settled_statistics

STATE, ACTION = "observation.state", "action"
MODES = ["MIN_MAX", "MEAN_STD", "QUANTILES", "QUANTILE10"]


def statistics(key: str, values: np.ndarray) -> dict:
    """Statistics of which one feature's are those of values (R, D)."""
    quantiles = {f"q{q:02d}": np.quantile(values, q / 100, axis=0) for q in (1, 10, 90, 99)}
    of_key = {name: getattr(values, name)(axis=0) for name in ("min", "max", "mean", "std")}
    others = {each: {**of, **dict.fromkeys(quantiles, of["max"])} for each, of in make_statistics().items()}
    return {**others, key: {**of_key, **quantiles}}


def processors(stats: dict, mode: str = "MIN_MAX"):
    config = make_config(normalization_mapping={"STATE": mode, "ACTION": mode})
    return make_pre_post_processors(config, dataset_stats=stats)


def batch(**values: torch.Tensor) -> dict:
    state = values.get("state", torch.zeros(N_STATES))
    action = values.get("action", torch.zeros(N_ACTIONS))
    return {OBS_POINT_CLOUD: torch.zeros(1, N_POINTS, 3), STATE: state[None], ACTION: action[None]}


def column(constant: float, spread: float = 0.0, n: int = N_ACTIONS) -> np.ndarray:
    """Values (1000, D) of which the first dimension is (nearly) constant."""
    values = np.random.default_rng(0).uniform(-1, 1, (1000, n))
    values[:, 0] = constant + spread * np.linspace(-0.5, 0.5, 1000)
    return values


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("constant", [0.0, -1.0, 0.3, 1000.0, 1e8])
def test_a_constant_action_is_normalised_to_0_and_comes_back(mode, constant):
    pre, post = processors(statistics(ACTION, column(constant)), mode)
    action = torch.tensor([constant, 0.1, 0.2, 0.3])
    normalised = pre(batch(action=action))[ACTION]
    assert normalised[0, 0].abs() < 1e-4
    torch.testing.assert_close(post(normalised)[0], action)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("spread", [0.0, 1e-9, 5e-5])
def test_a_reading_beside_a_constant_is_not_stretched(mode, spread):
    pre, _ = processors(statistics(STATE, column(0.3, spread, N_STATES)), mode)
    state = torch.zeros(N_STATES)
    state[0] = 0.3 + 1e-3  # 1 mm off
    assert pre(batch(state=state))[STATE][0, 0].item() == pytest.approx(1e-3, rel=1e-3)
    state[0] = 0.3 + 2.5  # far off: in proportion
    assert pre(batch(state=state))[STATE][0, 0].item() == pytest.approx(2.5, rel=1e-3)


def test_what_varies_is_stretched_as_ever():
    pre, _ = processors(statistics(ACTION, column(5.0, 2e-4)))
    assert pre(batch(action=torch.full((N_ACTIONS,), 5.0001)))[ACTION][0, 0].item() == pytest.approx(1, abs=0.01)


def test_rounding_of_a_large_constant_does_not_count_as_a_range():
    values = column(1e6, n=N_STATES).astype(np.float32)
    values[::2, 0] = np.nextafter(np.float32(1e6), np.float32(2e6))
    pre, _ = processors(statistics(STATE, values.astype(np.float64)))
    assert pre(batch(state=torch.full((N_STATES,), 1e6)))[STATE][0, 0].abs() < 1e-3


def test_a_flat_cloud_keeps_its_proportions():
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3)) * [1, 1, 0] + [0, 0, 0.2]
    pre, _ = processors(statistics(OBS_POINT_CLOUD, points))
    cloud = torch.tensor([[[0.5, 0.5, 0.2], [0.5, 0.5, 0.21]]])
    z = pre({OBS_POINT_CLOUD: cloud, STATE: torch.zeros(1, N_STATES)})[OBS_POINT_CLOUD][0, :, 2]
    torch.testing.assert_close(z, torch.tensor([0, 0.01]), atol=1e-6, rtol=0)


def test_what_is_constant_is_said(caplog):
    values = column(1.0)
    values[:, 2] = 0
    settled_statistics(statistics(ACTION, values), make_config())
    assert caplog.messages == ["(Nearly) constant in the data, so not stretched by normalisation: action[0, 2]"]


@pytest.mark.parametrize("kind", [np.int64, np.uint8, torch.tensor, list])
def test_statistics_of_every_kind_become_float(kind):
    stats = make_statistics()
    convert = (lambda values: values.astype(kind)) if isinstance(kind, type) and kind is not list else kind
    stats[ACTION] = {"min": convert(np.zeros(N_ACTIONS)), "max": convert(np.full(N_ACTIONS, 5.0))}
    settled = settled_statistics(stats, make_config())[ACTION]
    assert settled["max"].dtype == np.float64
    assert settled["max"].tolist() == [5.0] * N_ACTIONS


def test_renamed_features_and_wider_clouds():
    stats = make_statistics()
    stats["observation.scan"] = {name: np.append(values, 9.0) for name, values in stats.pop(OBS_POINT_CLOUD).items()}
    settled = settled_statistics(stats, make_config(), {"observation.scan": OBS_POINT_CLOUD})
    assert settled[OBS_POINT_CLOUD]["max"].tolist() == [1, 1, 1]


@pytest.mark.parametrize("stats", [None, {}])
def test_no_statistics(stats):
    with pytest.raises(UserError, match=r"needs the dataset's statistics, got none: meta/stats\.json"):
        settled_statistics(stats, make_config())


@pytest.mark.parametrize("key", [OBS_POINT_CLOUD, STATE, ACTION])
def test_a_feature_without_statistics(key):
    stats = make_statistics()
    del stats[key]
    with pytest.raises(UserError, match=f"needs 'min' of '{key}', which is not among the dataset's"):
        settled_statistics(stats, make_config())


@pytest.mark.parametrize(
    ("values", "message"), [(np.zeros(3), "must be 4 numbers"), (np.full(4, np.nan), "must be finite")]
)
def test_invalid_statistics(values, message):
    stats = make_statistics()
    stats[ACTION]["max"] = values
    with pytest.raises(UserError, match=f"'max' of 'action' in the dataset's .* {message}"):
        settled_statistics(stats, make_config())


def test_what_is_not_normalised_needs_no_statistics():
    config = make_config(normalization_mapping={"STATE": "IDENTITY", "ACTION": "MIN_MAX"})
    stats = {ACTION: make_statistics()[ACTION]}
    assert settled_statistics(stats, config)[OBS_POINT_CLOUD] == {}
