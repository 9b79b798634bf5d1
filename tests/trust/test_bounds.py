"""Every number of every configuration has bounds, and what lies outside of them is refused by its name."""

import math
from dataclasses import fields, replace
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from tests.trust.conftest import generated, train, training_options

from lerobot_uca.bounds import BOUNDS, check_bounds
from lerobot_uca.data.collect import CollectConfig, collect
from lerobot_uca.envs.configs import AdroitPointCloudConfig, MetaworldPointCloudConfig
from lerobot_uca.errors import UserError
from lerobot_uca.policies.configuration_dp3 import DP3Config
from lerobot_uca.policies.configuration_flowpolicy import FlowConfig
from lerobot_uca.policies.configuration_mp1 import MP1Config
from lerobot_uca.policies.configuration_simple_dp3 import SimpleDP3Config
from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig

CONFIGS = {
    "policy": (UCAFlowConfig, DP3Config, SimpleDP3Config, FlowConfig, MP1Config),
    "env": (MetaworldPointCloudConfig, AdroitPointCloudConfig),
}
LEROBOTS = {field.name for base in (PreTrainedConfig, EnvConfig) for field in fields(base)} - {"n_obs_steps"}
NUMBERS = [
    (group, config, field)
    for group, configs in CONFIGS.items()
    for config in configs
    for field in fields(config)
    if field.name not in LEROBOTS and {field.type, *get_args(field.type)} & {int, float}
]


def make(group: str, config: type, **values: object) -> object:
    return config(**({"device": "cpu"} if group == "policy" else {}), **values)


def check(group: str, config: object) -> None:
    (config.validate_sizes if group == "policy" else config.validate)()


@pytest.mark.parametrize(("group", "config", "field"), NUMBERS, ids=lambda value: getattr(value, "name", None))
def test_every_number_has_bounds_that_its_default_keeps(group, config, field):
    assert BOUNDS in field.metadata
    check_bounds(make(group, config), group)


@st.composite
def invalid(draw, field):
    """Values that a field must not have: out of its bounds, not finite, or of another type."""
    bounds = field.metadata[BOUNDS]
    whole = int in (field.type, *get_args(field.type))
    wrong = [st.sampled_from([math.nan, math.inf, -math.inf, "1", True, [[1]]])]
    if not bounds.is_optional:
        wrong.append(st.none())
    if whole:
        wrong.append(st.floats(0.1, 0.9).map(lambda part: 2 + part))
    lower = bounds.least if bounds.least is not None else bounds.above
    upper = bounds.most if bounds.most is not None else bounds.below
    number = st.integers if whole else st.floats
    if lower is not None:
        below = (int(lower) - 1) if whole else lower - 1e-3 * max(1, abs(lower))
        wrong.append(number(max_value=below, **({} if whole else {"allow_infinity": False})))
    if upper is not None:
        above = (int(upper) + 1) if whole else upper + 1e-3 * max(1, abs(upper))
        wrong.append(number(min_value=above, **({} if whole else {"allow_infinity": False})))
    value = draw(st.one_of(wrong))
    if not isinstance(field.default, tuple):
        return value
    valid = list(field.default)
    return draw(st.sampled_from([[*valid[:-1], value], (), None, 1, [valid]]))


@pytest.mark.parametrize(("group", "config", "field"), NUMBERS, ids=lambda value: getattr(value, "name", None))
def test_what_is_out_of_bounds_is_refused(group, config, field):
    @generated(12)
    @given(value=invalid(field))
    def refused(value):
        with pytest.raises(UserError, match=rf"^{group}\.{field.name} must be "):
            check(group, make(group, config, **{field.name: value}))

    refused()


@pytest.mark.parametrize(("group", "config", "field"), NUMBERS, ids=lambda value: getattr(value, "name", None))
def test_nothing_but_the_bounds_is_a_limit_of_their_check(group, config, field):
    bounds = field.metadata[BOUNDS]
    for limit in (bounds.least, bounds.most):
        if limit is not None:
            value = (limit,) * len(field.default) if isinstance(field.default, tuple) else limit
            check_bounds(make(group, config, **{field.name: value}), group)


@pytest.mark.parametrize("config", [*CONFIGS["policy"]])
def test_flags_are_true_or_false(config):
    for field in fields(config):
        if field.type is bool and field.name not in LEROBOTS:
            with pytest.raises(UserError, match=rf"policy\.{field.name} must be true or false, got None"):
                check("policy", make("policy", config, **{field.name: None}))


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("horizon=1000000000", "policy.horizon must be at most 1024, got 1000000000"),
        ("ema_power=-1", "policy.ema_power must be at least 0, got -1"),
        ("ema_max_decay=.nan", "policy.ema_max_decay must be finite, got nan"),
        ("ema_max_decay=2", "policy.ema_max_decay must be at most 1, got 2"),
        ("optimizer_lr=-1", "policy.optimizer_lr must be above 0, got -1"),
        ("optimizer_lr=.inf", "policy.optimizer_lr must be finite, got inf"),
        ("gamma=-1", "policy.gamma must be at least 0, got -1"),
        ("c=-1", "policy.c must be above 0, got -1"),
        ("interval_std=-1", "policy.interval_std must be above 0, got -1"),
        ("scheduler_warmup_steps=-1", "policy.scheduler_warmup_steps must be at least 0, got -1"),
        ("n_point_features=0", "policy.n_point_features must be at least 1, got 0"),
        ("n_state_features=-1", "policy.n_state_features must be at least 1, got -1"),
        ("point_widths=[]", "policy.point_widths must be a list of numbers, got ()"),
        ("point_widths=[64,0]", "policy.point_widths must be a list of numbers, each at least 1, got (64, 0)"),
        ("dual_pass=null", "policy.dual_pass must be true or false, got None"),
    ],
)
def test_the_command_line_is_checked_before_anything_is_made(trained, tmp_path, option, message):
    with pytest.raises(UserError) as error:
        train(*training_options(trained.parent / "data", tmp_path / "run"), f"--policy.{option}")
    assert str(error.value).startswith(message)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("name", "value"), [("n_episodes", 0), ("n_episodes", True), ("seed", -1), ("overwrite", None)]
)
def test_collecting_is_checked_too(tmp_path, name, value):
    config = CollectConfig(env=MetaworldPointCloudConfig(), repo_id="test/data", root=tmp_path / "data")
    with pytest.raises(UserError, match=rf"^{name} must be "):
        collect(replace(config, **{name: value}))
