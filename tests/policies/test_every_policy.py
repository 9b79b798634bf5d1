"""Contracts of every policy that this package registers."""

import pytest
import torch
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.policies import make_policy_config, make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from tests.builders import (
    N_ACTIONS,
    SMALL_POLICIES,
    make_batch,
    make_observation,
    make_settings,
    make_statistics,
    overfit,
)

from lerobot_uca.errors import UserError
from lerobot_uca.policies.modeling_base import PointCloudPolicy

NETWORK_CALLS = {"uca_flow": 1, "dp3": 10, "simple_dp3": 10, "flowpolicy": 1, "mp1": 1}

VARIANTS = {
    **{name: (name, {}) for name in NETWORK_CALLS},
    "cross_attention": ("uca_flow", {"conditioning": "cross_attention"}),
    "adaln": ("uca_flow", {"conditioning": "adaln"}),
    "without dual pass": ("uca_flow", {"dual_pass": False}),
}


def mapping(state: str, action: str) -> dict[str, NormalizationMode]:
    return {"STATE": NormalizationMode(state), "ACTION": NormalizationMode(action)}


every_policy = pytest.mark.parametrize("variant", VARIANTS)


def make(variant: str, **changes: object) -> PointCloudPolicy:
    name, settings = VARIANTS[variant]
    torch.manual_seed(0)
    config = make_policy_config(name, **{**make_settings(), **SMALL_POLICIES[name], **settings, **changes})
    return get_policy_class(name)(config)


def test_every_registered_policy_is_here():
    ours = {
        name
        for name in PreTrainedConfig.get_known_choices()
        if PreTrainedConfig.get_choice_class(name).__module__.startswith("lerobot_uca.")
    }
    assert ours == {*NETWORK_CALLS, "flow"}


def test_a_checkpoint_of_flowpolicys_former_type_loads(tmp_path):
    policy = make("flowpolicy").eval()
    policy.save_pretrained(tmp_path)
    config = tmp_path / "config.json"
    config.write_text(config.read_text().replace('"type": "flowpolicy"', '"type": "flow"'))
    loaded = PreTrainedConfig.from_pretrained(tmp_path)
    assert loaded.type == "flowpolicy"
    noise, observation = torch.randn(2, 4, N_ACTIONS), make_observation(2)
    actions = [
        each.select_action(observation, noise=noise)
        for each in (policy, get_policy_class(loaded.type).from_pretrained(tmp_path).eval())
    ]
    assert torch.equal(*actions)


@pytest.mark.parametrize("name", NETWORK_CALLS)
def test_lerobot_finds_policy_and_processors_by_the_types_name(name):
    policy = make(name)
    assert policy.name == policy.config.type == name
    pre, post = make_pre_post_processors(policy.config, dataset_stats=make_statistics())
    names = [step._registry_name for step in (*pre.steps, *post.steps)]
    assert {"normalizer_processor", "unnormalizer_processor"} <= set(names)


@every_policy
def test_training_steps_lower_the_loss_of_a_batch(variant):
    """The noise and the times stay the same."""
    policy = make(variant).train()
    batch = make_batch(policy.config)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=3e-4)

    def loss() -> torch.Tensor:
        torch.manual_seed(1)
        return policy.forward(batch)[0]

    losses = []
    for _ in range(4):
        losses.append(loss())
        optimizer.zero_grad()
        losses[-1].backward()
        assert all(parameter.grad is not None for parameter in policy.get_optim_params())
        optimizer.step()
    losses.append(loss())
    assert losses == sorted(losses, reverse=True)


@every_policy
def test_each_sample_has_its_loss_and_padded_actions_do_not_count(variant):
    policy = make(variant).train()
    batch = make_batch(policy.config)
    batch["action_is_pad"][3, -2:] = True
    batch["action_is_pad"][5] = True
    losses = []
    for each in (batch, {**batch, "action_is_pad": torch.zeros_like(batch["action_is_pad"])}):
        torch.manual_seed(1)
        losses.append(policy.forward(each, reduction="none")[0])
    assert losses[0].shape == (8,)
    assert losses[0][3] != losses[1][3]
    if VARIANTS[variant][0] == "mp1":  # a part of its loss looks at the observations alone
        assert 0 < losses[0][5].abs() < losses[1][5].abs()
    else:
        assert losses[0][5] == 0
    others = torch.tensor([0, 1, 2, 4, 6, 7])
    torch.testing.assert_close(losses[0][others], losses[1][others])


@every_policy
def test_actions_have_the_right_shape_and_take_the_stated_number_of_network_calls(variant):
    policy = make(variant, inference="eager").eval()  # a runtime calls what was traced
    calls = []
    policy.ema_model.generator.register_forward_hook(lambda *_: calls.append(1))
    actions = [policy.select_action(make_observation(2)) for _ in range(4)]
    assert all(action.shape == (2, N_ACTIONS) for action in actions)
    assert len(calls) == 2 * NETWORK_CALLS[VARIANTS[variant][0]]  # the fourth action needs a second prediction


@every_policy
def test_a_loaded_checkpoint_gives_equal_actions(variant, tmp_path):
    policy = make(variant).eval()
    policy.save_pretrained(tmp_path)
    loaded = type(policy).from_pretrained(tmp_path)
    assert loaded.config.type == policy.config.type
    noise, observation = torch.randn(2, 4, N_ACTIONS), make_observation(2)
    assert torch.equal(loaded.select_action(observation, noise=noise), policy.select_action(observation, noise=noise))


@every_policy
def test_training_in_bfloat16(variant):
    policy = make(variant, dtype="bfloat16").train()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss, _ = policy.forward(make_batch(policy.config))
        actions = policy.predict_action_chunk(make_observation())
    loss.backward()
    assert all(parameter.grad.isfinite().all() for parameter in policy.get_optim_params())
    assert actions.dtype == torch.float32


@every_policy
def test_a_loss_in_inference_mode_is_that_without_gradients(variant):
    policy = make(variant).eval()
    batch = make_batch(policy.config)
    losses = []
    for mode in (torch.no_grad, torch.inference_mode):
        torch.manual_seed(0)
        with mode():
            losses.append(policy.forward(batch)[0])
    assert torch.equal(*losses)
    with torch.inference_mode():
        assert policy.forward(make_batch(policy.config))[0].isfinite()


@pytest.mark.parametrize(("name", "n_steps"), [("dp3", 50), ("flowpolicy", 150), ("mp1", 150)])
def test_a_baseline_learns_the_actions_of_one_batch(name, n_steps):
    assert overfit(make(name, unet_widths=(32, 64), ema_power=0.6), n_steps) < 0.4


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("dp3", {"unet_widths": (8, 12)}, r"policy.unet_widths must be multiples of unet_groups = 8, got \[8, 12\]"),
        ("dp3", {"unet_widths": ()}, "policy.unet_widths must be a list of numbers, got \\(\\)"),
        ("dp3", {"horizon": 6, "unet_widths": (8, 8, 8)}, "policy.horizon must be a multiple of 4, .* got 6"),
        ("simple_dp3", {"unet_blocks": 0}, "policy.unet_blocks must be at least 1, got 0"),
        ("simple_dp3", {"unet_groups": 0}, "policy.unet_groups must be at least 1, got 0"),
        ("simple_dp3", {"unet_kernel_size": 4}, "policy.unet_kernel_size must be odd, got 4"),
        ("flowpolicy", {"time_dim": 7}, "policy.time_dim must be even, got 7"),
        ("simple_dp3", {"n_inference_steps": 101}, "must be at least 2 and divide n_training_steps = 100, got 101"),
        ("dp3", {"n_inference_steps": 51}, "must be at least 2 and divide n_training_steps = 100, got 51"),
        ("dp3", {"n_inference_steps": 1}, "must be at least 2 and divide n_training_steps = 100, got 1"),
        ("dp3", {"normalization_mapping": mapping("MIN_MAX", "MEAN_STD")}, "ACTION: MIN_MAX .* got MEAN_STD"),
        ("simple_dp3", {"normalization_mapping": mapping("MIN_MAX", "IDENTITY")}, "for 'simple_dp3', .* got IDENTITY"),
        (
            "uca_flow",
            {"normalization_mapping": {"STATE": NormalizationMode.MIN_MAX}},
            "must name STATE .* and ACTION, got",
        ),
        ("uca_flow", {"normalization_mapping": {"STATE": "MIN_MAX", "ACTION": "FOO"}}, "MIN_MAX, .* got 'FOO'"),
        ("simple_dp3", {"inference": "compile"}, "'simple_dp3' .* must be one of eager, openvino, "),
        ("flowpolicy", {"delta": 0.0}, "policy.delta must be above 0, got 0.0"),
        ("flowpolicy", {"n_segments": 0}, "policy.n_segments must be at least 1, got 0"),
        ("mp1", {"horizon": 3}, r"policy.horizon must be at least \(n_obs_steps - 1\) \* obs_stride"),
    ],
)
def test_wrong_settings(name, changes, message):
    with pytest.raises(UserError, match=message):
        make(name, **changes)


@pytest.mark.parametrize("name", NETWORK_CALLS)
def test_modes_of_normalisation_may_be_texts(name):
    policy = make(name, normalization_mapping={"STATE": "MEAN_STD", "ACTION": "MIN_MAX"})
    assert policy.config.normalization_mapping == mapping("MEAN_STD", "MIN_MAX")


def test_peft_is_refused():
    """LeRobot's checkpoint of such a training holds the adapter alone, and not the average, which was evaluated."""
    with pytest.raises(UserError, match="PEFT trains an adapter alone, which has no averaged weights"):
        make("uca_flow").wrap_with_peft(peft_cli_overrides={"method_type": "LORA"})
    with pytest.raises(UserError, match="PEFT trains an adapter alone, which has no averaged weights"):
        make("uca_flow", use_peft=True)  # as such a checkpoint's configuration says


@pytest.mark.parametrize("weight", [0.0, 0.5, 2.0])
def test_mp1s_loss_is_the_stated_sum(weight):
    policy = make("mp1", dispersive_weight=weight).train()
    loss, parts = policy.forward(make_batch(policy.config))
    assert loss.item() == pytest.approx(parts["loss_u"] + weight * parts["loss_dispersive"], rel=1e-5)


@pytest.mark.parametrize("variant", [name for name in VARIANTS if NETWORK_CALLS[VARIANTS[name][0]] == 1])
def test_a_policy_of_one_network_call_compiles_as_one_function(variant):
    policy = make(variant).eval()
    config, observation = policy.config, make_observation()
    frame = (observation["observation.point_cloud"], observation["observation.state"])
    inputs = (
        policy.ema_model,
        *frame,
        torch.randn(1, config.horizon, N_ACTIONS),
        torch.randn(1, 1, config.n_obs_features),
    )
    torch._dynamo.reset()
    compiled = torch.compile(policy._encode_and_generate, backend="eager", fullgraph=True, dynamic=False)
    with torch.no_grad():
        for got, expected in zip(compiled(*inputs), policy._encode_and_generate(*inputs), strict=True):
            torch.testing.assert_close(got, expected)


@every_policy
@pytest.mark.parametrize("inference", ["openvino", "onnxruntime"])
def test_a_runtime_computes_pytorchs_actions(variant, inference, caplog):
    fast, reference = make(variant, inference=inference).eval(), make(variant, inference="eager").eval()
    noise = torch.randn(1, fast.config.horizon, N_ACTIONS)
    for _ in range(2):
        observation = make_observation()
        actions = [policy.predict_action_chunk(observation, noise=noise) for policy in (fast, reference)]
        torch.testing.assert_close(*actions, atol=1e-5, rtol=0)
    assert not caplog.records  # PyTorch did not step in


@pytest.mark.parametrize("inference", ["openvino", "onnxruntime"])
def test_a_whole_history_goes_through_the_runtime(inference, monkeypatch, caplog):
    fast, reference = (make("uca_flow", inference=each).eval() for each in (inference, "eager"))
    noise, observations = torch.randn(1, fast.config.horizon, N_ACTIONS), [make_observation(), make_observation()]
    history = {key: torch.stack([each[key] for each in observations], dim=1) for key in observations[0]}
    fast.predict_action_chunk(history, noise=noise)  # traces

    def pytorch(*_: object) -> None:
        raise AssertionError("PyTorch computes")

    monkeypatch.setattr(fast.ema_model.encoder, "forward", pytorch)
    monkeypatch.setattr(fast.ema_model.generator, "forward", pytorch)
    actions = [policy.predict_action_chunk(history, noise=noise) for policy in (fast, reference)]
    torch.testing.assert_close(*actions, atol=1e-5, rtol=0)
    assert not caplog.records
