"""The contract with LeRobot and its users."""

import copy
import dataclasses
import json
import os
import re
import shutil

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_policy_config, make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from tests.builders import (
    N_ACTIONS,
    N_POINTS,
    N_STATES,
    make_batch,
    make_config,
    make_observation,
    make_statistics,
    overfit,
)
from torch import nn

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.meanflow import sample_intervals
from lerobot_uca.networks import forward_mode
from lerobot_uca.networks.conditioning import CONDITIONING
from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig
from lerobot_uca.policies.inputs import is_finite
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy

T = 4


def history(*observations: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {key: torch.stack([observation[key] for observation in observations], dim=1) for key in observations[0]}


def test_lerobot_finds_config_policy_and_processors():
    assert isinstance(make_policy_config("uca_flow", device="cpu"), UCAFlowConfig)
    assert get_policy_class("uca_flow") is UCAFlowPolicy
    pre, post = make_pre_post_processors(make_config(), dataset_stats=make_statistics())
    names = [step._registry_name for step in (*pre.steps, *post.steps)]
    assert set(names) >= {  # training and evaluation override these by name
        "rename_observations_processor",
        "device_processor",
        "normalizer_processor",
        "unnormalizer_processor",
    }


@pytest.mark.parametrize(
    ("stride", "horizon", "observed", "predicted", "entries"),
    [(1, 4, [-1, 0], [-1, 0, 1, 2], (1, 4)), (2, 5, [-2, 0], [-2, -1, 0, 1, 2], (2, 5))],
)
def test_horizon_table(stride, horizon, observed, predicted, entries):
    """The tables in PointCloudPolicyConfig's docstring."""
    config = make_config(obs_stride=stride, horizon=horizon)
    assert config.observation_delta_indices == observed
    assert config.action_delta_indices == predicted
    assert config.action_delta_indices[config.executed] == [0, 1, 2]
    assert (config.executed.start, config.executed.stop) == entries


def test_checkpoints_from_before_the_observation_stride_have_stride_1(policy, tmp_path):
    policy.save_pretrained(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    del config["obs_stride"]
    (tmp_path / "config.json").write_text(json.dumps(config))
    assert UCAFlowPolicy.from_pretrained(tmp_path).config.obs_stride == 1


@pytest.mark.parametrize(("n_obs_steps", "horizon", "n_action_steps"), [(1, 3, 3), (3, 16, 8), (2, 16, 15)])
def test_execution_starts_at_the_current_step(n_obs_steps, horizon, n_action_steps):
    config = make_config(n_obs_steps=n_obs_steps, horizon=horizon, n_action_steps=n_action_steps)
    assert config.action_delta_indices[config.executed] == list(range(n_action_steps))
    policy = UCAFlowPolicy(config).eval()
    assert policy.predict_action_chunk(make_observation()).shape == (1, n_action_steps, N_ACTIONS)


@pytest.mark.parametrize("batch_size", [1, 3])
def test_three_actions_are_executed_from_each_prediction(policy, batch_size):
    noise = torch.randn(batch_size, T, N_ACTIONS)
    observations = [make_observation(batch_size) for _ in range(5)]
    actions = [policy.select_action(observation, noise=noise) for observation in observations]
    first = policy.predict_action_chunk(history(observations[0], observations[0]), noise=noise)
    second = policy.predict_action_chunk(history(observations[2], observations[3]), noise=noise)
    for step in range(3):
        torch.testing.assert_close(actions[step], first[:, step])
    for step in range(2):
        torch.testing.assert_close(actions[3 + step], second[:, step])


def test_predict_action_chunk_remembers_single_observations(policy):
    """Asynchronous inference calls it so: one frame at a time, and still with a history."""
    noise = torch.randn(1, T, N_ACTIONS)
    a, b = make_observation(), make_observation()
    policy.predict_action_chunk(a, noise=noise)
    torch.testing.assert_close(
        policy.predict_action_chunk(b, noise=noise), policy.predict_action_chunk(history(a, b), noise=noise)
    )


def test_reset_forgets(policy):
    noise, observation = torch.randn(1, T, N_ACTIONS), make_observation()
    before = policy.select_action(observation, noise=noise)
    policy.select_action(make_observation(), noise=noise)
    policy.reset()
    torch.testing.assert_close(policy.select_action(observation, noise=noise), before)


def test_a_seed_reproduces_actions_and_losses(policy):
    observation, batch = make_observation(), make_batch(policy.config)
    runs = []
    for _ in range(2):
        torch.manual_seed(3)
        policy.reset()
        runs.append((policy.select_action(observation), policy.forward(batch)[0]))
    assert torch.equal(runs[0][0], runs[1][0])
    assert torch.equal(runs[0][1], runs[1][1])


@pytest.mark.parametrize(
    "changes", [{}, {"n_points": 10}, {"n_obs_steps": 1, "horizon": 3}, {"dim": 64, "n_layers": 4}]
)
@pytest.mark.parametrize("batch_size", [1, 3])
def test_the_default_runtime_gives_pytorchs_actions(changes, batch_size, caplog):
    assert_acts_like_pytorch(UCAFlowPolicy(make_config(**changes)).eval(), batch_size)
    assert not caplog.records  # PyTorch did not step in


@pytest.mark.skipif(shutil.which(os.environ.get("CXX", "g++")) is None, reason="torch.compile needs a C++ compiler")
def test_torch_compile_gives_pytorchs_actions():
    """The same path records CUDA graphs on a GPU."""
    assert_acts_like_pytorch(UCAFlowPolicy(make_config(inference="compile", n_layers=1)).eval(), batch_size=2)


@torch._inductor.config.patch({"cpp.cxx": (None, "/no/compiler"), "force_disable_caches": True})
def test_without_a_compiler():
    policy = UCAFlowPolicy(make_config(inference="compile", n_layers=1)).eval()
    with pytest.raises(UserError, match=r"needs a C\+\+ compiler.* need none: .*No working C"):
        policy.predict_action_chunk(make_observation())


@torch.no_grad()
def average(policy):
    policy.model.generator.head[-1].bias.fill_(1.0)
    policy.update()


def replace_one_weight(policy):
    weight = policy.ema_model.generator.blocks[0].feed_forward[0].weight
    weight.data = torch.full_like(weight, 0.1)


def replace_all_weights(policy):
    policy.ema_model.load_state_dict(
        {key: value + 0.01 for key, value in policy.ema_model.state_dict().items()}, assign=True
    )


CHANGES = {3: replace_one_weight, 5: replace_all_weights, 7: average}


def assert_acts_like_pytorch(fast, batch_size):
    reference = UCAFlowPolicy(dataclasses.replace(fast.config, inference="eager")).eval()
    reference.load_state_dict(fast.state_dict())
    for step in range(10):
        if step in CHANGES:  # traces and compiled code must follow
            for policy in (fast, reference):
                CHANGES[step](policy)
        observation = make_observation(batch_size)
        noise = torch.randn(batch_size, fast.config.horizon, N_ACTIONS)
        actions = [policy.select_action(observation, noise=noise) for policy in (fast, reference)]
        torch.testing.assert_close(*actions, atol=1e-5, rtol=0)


def test_trained_on_weights_are_used_by_the_next_plan(policy):
    noise, observation = torch.randn(1, T, N_ACTIONS), make_observation()
    before = policy.predict_action_chunk(observation, noise=noise)
    for _ in range(5):
        policy.update()
    policy.reset()
    after = policy.predict_action_chunk(observation, noise=noise)
    assert not torch.allclose(after, before, atol=1e-3)
    torch.testing.assert_close(
        after, policy.predict_action_chunk(history(observation, observation), noise=noise), atol=1e-5, rtol=0
    )


def test_a_frame_is_encoded_once_when_it_arrives_if_a_plan_will_see_it():
    policy = UCAFlowPolicy(make_config(inference="eager")).eval()
    calls: list[int] = []
    policy.ema_model.encoder.register_forward_hook(lambda *_: calls.append(1))
    n_encoded = []
    for _ in range(7):
        before = len(calls)
        policy.select_action(make_observation())
        n_encoded.append(len(calls) - before)
    # Plans are made in steps 0, 3 and 6, from two frames. The first one also stands for the one before it.
    assert n_encoded == [2, 0, 1, 1, 0, 1, 1]


def test_a_policy_that_has_acted_can_be_copied(policy):
    noise, observation = torch.randn(1, T, N_ACTIONS), make_observation()
    expected = policy.predict_action_chunk(observation, noise=noise)
    duplicate = copy.deepcopy(policy)
    duplicate.reset()
    assert torch.equal(duplicate.predict_action_chunk(observation, noise=noise), expected)
    assert duplicate._plan.eager.__self__ is duplicate


def test_one_network_call_makes_a_chunk():
    policy = UCAFlowPolicy(make_config(inference="eager")).eval()
    calls = []
    policy.ema_model.generator.register_forward_hook(lambda *_: calls.append(1))
    policy.predict_action_chunk(make_observation())
    assert len(calls) == 1


def test_only_the_first_n_points_are_looked_at():
    policy = UCAFlowPolicy(make_config(n_points=10)).eval()
    noise, observation = torch.randn(1, T, N_ACTIONS), make_observation()
    changed = {**observation, OBS_POINT_CLOUD: observation[OBS_POINT_CLOUD].clone()}
    changed[OBS_POINT_CLOUD][:, 10:] += 5
    expected = policy.predict_action_chunk(history(observation, observation), noise=noise)
    assert torch.equal(policy.predict_action_chunk(history(changed, changed), noise=noise), expected)


def test_loss_of_a_batch_is_the_mean_of_its_samples(policy):
    batch = make_batch(policy.config)
    untouched = {key: value.clone() for key, value in batch.items()}
    torch.manual_seed(1)
    mean, parts = policy.forward(batch)
    torch.manual_seed(1)
    each, _ = policy.forward(batch, reduction="none")
    assert each.shape == (8,)
    torch.testing.assert_close(each.mean(), mean)
    assert set(parts) == {"loss_u", "loss_v"}
    assert all(isinstance(value, float) for value in parts.values())
    assert parts["loss_u"] + parts["loss_v"] == pytest.approx(mean.item())
    for key, value in batch.items():
        assert torch.equal(value, untouched[key]), f"forward changed {key}"


def test_training_equals_the_plain_method(monkeypatch):
    """The plain method (no winners, shared calls or left-out tokens; PyTorch's tangents) has the same gradients."""
    torch.manual_seed(0)
    policy = UCAFlowPolicy(make_config(gamma=0.7, c=0.1, interval_mean=0.3, interval_std=1.7)).train()  # no defaults
    batch = make_batch(policy.config, batch_size=8)
    torch.manual_seed(1)
    loss, _ = policy.forward(batch)
    loss.backward()

    monkeypatch.setattr(forward_mode.Linear, "forward", nn.Linear.forward)
    monkeypatch.setattr(forward_mode.LayerNorm, "forward", nn.LayerNorm.forward)
    config, encoder, network, x = policy.config, policy.model.encoder, policy.model.generator, batch["action"]
    pooled = torch.relu(encoder.points.per_point(batch[OBS_POINT_CLOUD])).amax(dim=-2)
    o = torch.cat([encoder.points.project(pooled), encoder.state(batch["observation.state"])], dim=-1)

    def u_fn(z, t, h):
        P = [
            network.embed_observation(o) + network.observation_positions,
            network.embed_timestep(t)[:, None] + network.timestep_biases,
            network.embed_interval(h)[:, None] + network.interval_biases,
        ]
        tokens = torch.cat([*P, network.embed_action(z) + network.action_positions], dim=1)
        for block in network.blocks:
            tokens = block(tokens)
        return network.head(tokens[:, -T:])

    torch.manual_seed(1)
    t, h, _ = sample_intervals(len(x), "cpu", mean=config.interval_mean, std=config.interval_std)
    e = torch.randn_like(x)
    z, target = (1 - t[:, None, None]) * x + t[:, None, None] * e, e - x
    v = u_fn(z, t, torch.zeros_like(t))
    u, D_t_u = torch.func.jvp(u_fn, (z, t, h), (v.detach(), torch.ones_like(t), torch.ones_like(h)))
    V = u + h[:, None, None] * D_t_u.detach()
    errors = [(velocity - target).square().sum(dim=(1, 2)) for velocity in (V, v)]
    plain = sum((error / (error.detach() + config.c) ** (1 - config.gamma)).mean() for error in errors)

    torch.testing.assert_close(loss, plain)
    parameters = dict(policy.model.named_parameters())
    expected = torch.autograd.grad(plain, list(parameters.values()))
    for (name, parameter), gradient in zip(parameters.items(), expected, strict=True):
        torch.testing.assert_close(
            parameter.grad, gradient, rtol=1e-4, atol=1e-6, msg=lambda m, name=name: f"{name}: {m}"
        )


def test_padded_actions_are_masked(policy):
    batch = make_batch(policy.config)
    batch["action_is_pad"][:, -1] = True
    losses = []
    for is_pad in (batch["action_is_pad"], torch.zeros_like(batch["action_is_pad"])):
        torch.manual_seed(1)
        losses.append(policy.forward({**batch, "action_is_pad": is_pad})[0])
    assert losses[0] < losses[1]


def test_without_dual_pass_only_u_is_supervised():
    policy = UCAFlowPolicy(make_config(dual_pass=False))
    assert set(policy.forward(make_batch(policy.config))[1]) == {"loss_u"}


@pytest.mark.parametrize("dual_pass", [True, False])
def test_overfitting_one_batch_drives_the_one_step_error_down(dual_pass):
    assert overfit(UCAFlowPolicy(make_config(dual_pass=dual_pass, ema_power=0.6)), n_steps=400) < 0.2


@pytest.mark.parametrize("conditioning", ["cross_attention", "adaln"])
def test_a_checkpoint_remembers_which_ablation_it_is(conditioning, tmp_path):
    policy = UCAFlowPolicy(make_config(conditioning=conditioning, dual_pass=False)).eval()
    policy.save_pretrained(tmp_path)
    loaded = UCAFlowPolicy.from_pretrained(tmp_path)
    assert (loaded.config.conditioning, loaded.config.dual_pass) == (conditioning, False)
    assert type(loaded.model.generator) is CONDITIONING[conditioning]
    noise, observation = torch.randn(2, T, N_ACTIONS), make_observation(2)
    assert torch.equal(loaded.select_action(observation, noise=noise), policy.select_action(observation, noise=noise))


@pytest.mark.parametrize("max_decay", [0.9999, 0.5])
def test_averaged_weights_follow_the_stated_schedule(max_decay):
    policy = UCAFlowPolicy(make_config(ema_max_decay=max_decay))
    weight = policy.model.generator.embed_action.weight
    average = policy.ema_model.generator.embed_action.weight
    expected = average.clone()
    for decay in (
        0,
        0,
        1 - 2**-0.75,
        1 - 3**-0.75,
    ):  # the baselines': of two updates that only copy, then step 1, 2, ...
        with torch.no_grad():
            weight.add_(1.0)
        policy.update()
        expected = torch.lerp(weight, expected, min(decay, max_decay))
        torch.testing.assert_close(average, expected)


def test_training_uses_the_trained_weights_and_evaluation_their_average(policy):
    noise, observation = torch.randn(1, T, N_ACTIONS), make_observation()
    averaged = policy.eval().predict_action_chunk(history(observation, observation), noise=noise)
    trained = policy.train().predict_action_chunk(history(observation, observation), noise=noise)
    assert not torch.allclose(averaged, trained)
    policy.ema_model = copy.deepcopy(policy.model)
    same = policy.eval().predict_action_chunk(history(observation, observation), noise=noise)
    torch.testing.assert_close(same, trained)


def test_gradients_reach_all_trained_weights_and_no_averaged_one(policy):
    policy.train().forward(make_batch(policy.config))[0].backward()
    assert all(parameter.grad is not None for parameter in policy.model.parameters())
    assert all(parameter.grad is None for parameter in policy.ema_model.parameters())
    assert len(list(policy.get_optim_params())) == len(list(policy.model.parameters()))


def test_a_loaded_checkpoint_gives_bit_equal_actions_and_can_be_trained_on(policy, tmp_path):
    policy.save_pretrained(tmp_path)
    loaded = UCAFlowPolicy.from_pretrained(tmp_path)
    noise, observation = torch.randn(2, T, N_ACTIONS), make_observation(2)
    assert not loaded.training
    assert torch.equal(loaded.select_action(observation, noise=noise), policy.select_action(observation, noise=noise))
    for key, value in policy.state_dict().items():
        assert torch.equal(loaded.state_dict()[key], value), key


def test_preprocessing_of_a_loaded_checkpoint_equals_trainings(policy, tmp_path):
    stats = {
        key: {"min": -torch.rand(size), "max": 1 + torch.rand(size), "mean": torch.zeros(size), "std": torch.ones(size)}
        for key, size in ((OBS_POINT_CLOUD, 3), ("observation.state", N_STATES), ("action", N_ACTIONS))
    }
    pre, post = make_pre_post_processors(policy.config, dataset_stats=stats)
    pre.save_pretrained(tmp_path)
    post.save_pretrained(tmp_path)
    loaded_pre, loaded_post = make_pre_post_processors(policy.config, pretrained_path=str(tmp_path))
    observation = make_observation(2)
    trained, loaded = pre(dict(observation)), loaded_pre(dict(observation))
    for key in observation:
        assert torch.equal(trained[key], loaded[key])
    low, high = stats[OBS_POINT_CLOUD]["min"], stats[OBS_POINT_CLOUD]["max"]
    expected = 2 * (observation[OBS_POINT_CLOUD] - low) / (high - low) - 1
    torch.testing.assert_close(loaded[OBS_POINT_CLOUD], expected)
    action = torch.rand(2, N_ACTIONS)
    assert torch.equal(post(action), loaded_post(action))


# Bad input: the message says the rule, what was got and what is valid. --------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"horizon": 3}, "policy.horizon must be at least (n_obs_steps - 1) * obs_stride + n_action_steps = 4, got 3"),
        ({"n_action_steps": 0}, "policy.n_action_steps must be at least 1, got 0"),
        ({"obs_stride": 0}, "policy.obs_stride must be at least 1, got 0"),
        ({"obs_stride": 2}, "policy.horizon must be at least (n_obs_steps - 1) * obs_stride + n_action_steps = 5"),
        ({"n_points": 0}, "policy.n_points must be at least 1 or null, got 0"),
        ({"dtype": "float16"}, "policy.dtype must be float32 or bfloat16, got 'float16'"),
        ({"dim": 33}, "policy.dim must be even and a multiple of n_heads = 2, got 33"),
        (
            {"inference": "tensorrt"},
            "must be one of eager, openvino, openvino_bfloat16, onnxruntime, compile, got 'tensorrt'",
        ),
        ({"n_layers": 0}, "policy.n_layers must be at least 1, got 0"),
        (
            {"conditioning": "film"},
            "policy.conditioning must be one of unified, cross_attention, adaln, got 'film'",
        ),
    ],
)
def test_wrong_settings(changes, message):
    with pytest.raises(UserError, match=re.escape(message)):
        UCAFlowPolicy(make_config(**changes))


@pytest.mark.parametrize("missing", [OBS_POINT_CLOUD, "observation.state"])
def test_a_dataset_without_cloud_or_state(missing):
    config = make_config()
    del config.input_features[missing]
    with pytest.raises(UserError, match=f"needs the feature '{missing}'"):
        UCAFlowPolicy(config)


def test_a_cloud_with_too_few_points_for_the_policy():
    with pytest.raises(UserError, match=r"must have shape \(N, 3\) with N at least 100 .* got \(32, 3\)"):
        UCAFlowPolicy(make_config(n_points=100))


def test_features_the_policy_does_not_use_are_left_out():
    config = make_config()
    config.input_features["observation.extra"] = config.input_features["observation.state"]
    assert set(UCAFlowPolicy(config).config.input_features) == {OBS_POINT_CLOUD, "observation.state"}


@pytest.mark.parametrize(
    ("key", "shape"),
    [
        (OBS_POINT_CLOUD, (8, 2, N_POINTS, 4)),
        (OBS_POINT_CLOUD, (8, 3, N_POINTS, 3)),
        ("observation.state", (8, 2, N_STATES + 1)),
        ("action", (8, 5, N_ACTIONS)),
    ],
)
def test_wrong_shapes(policy, key, shape):
    batch = {**make_batch(policy.config), key: torch.zeros(shape)}
    with pytest.raises(UserError, match=re.escape(f"'{key}' must have shape") + ".*" + re.escape(f"got {shape}")):
        policy.forward(batch)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("key", [OBS_POINT_CLOUD, "observation.state"])
def test_nan_and_infinite_observations_never_become_actions(policy, key, value):
    observation = make_observation()
    observation[key].view(-1)[7] = value
    with pytest.raises(UserError, match=f"'{key}' must be finite, got"):
        policy.select_action(observation)
    batch = make_batch(policy.config)
    batch[key].view(-1)[7] = value
    with pytest.raises(UserError, match=f"'{key}' must be finite, got 1 of"):
        policy.forward(batch)


def test_a_checkpoint_of_another_policy_type(tmp_path):
    act = make_policy_config("act", device="cpu", input_features={}, output_features={})
    act.save_pretrained(tmp_path)
    message = "needs a configuration or checkpoint of policy type 'uca_flow', got one of type 'act'"
    with pytest.raises(UserError, match=message):
        UCAFlowPolicy.from_pretrained(tmp_path)


def test_finite_values_may_have_an_infinite_sum():
    cloud = torch.full((1, 1, N_POINTS, 3), 3e38)
    assert cloud.sum() == torch.inf
    assert is_finite(cloud)


def test_another_number_of_samples_needs_a_reset(policy):
    policy.select_action(make_observation(1))
    with pytest.raises(UserError, match=r"must have 1 samples, as since the last reset\(\), got 3"):
        policy.select_action(make_observation(3))
    policy.reset()
    assert policy.select_action(make_observation(3)).shape == (3, N_ACTIONS)


def test_a_bad_frame_is_neither_remembered_nor_a_reason_to_forget(policy):
    noise, good = torch.randn(1, T, N_ACTIONS), make_observation()
    policy.predict_action_chunk(good, noise=noise)
    with pytest.raises(UserError, match="must have shape"):
        policy.select_action({**good, OBS_POINT_CLOUD: torch.zeros(1, N_POINTS, 2)})
    bad = {**good, OBS_POINT_CLOUD: torch.full((1, N_POINTS, 3), torch.nan)}
    with pytest.raises(UserError, match="must be finite"):
        policy.predict_action_chunk(bad, noise=noise)
    assert policy.select_action(good, noise=noise).isfinite().all()


@pytest.mark.parametrize(
    ("key", "shape", "message"),
    [
        (OBS_POINT_CLOUD, (N_POINTS, 2), r"must have shape \(N, 3\)"),
        ("observation.state", (3, 3), r"must be a vector, got shape \(3, 3\)"),
    ],
)
def test_a_dataset_whose_features_have_wrong_shapes(key, shape, message):
    config = make_config()
    config.input_features[key] = PolicyFeature(FeatureType.STATE, shape)
    with pytest.raises(UserError, match=message):
        UCAFlowPolicy(config)


def test_a_truncated_checkpoint(policy, tmp_path):
    policy.save_pretrained(tmp_path)
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(UserError, match=r"model\.safetensors' does not hold the weights of this 'uca_flow' policy"):
        UCAFlowPolicy.from_pretrained(tmp_path)


def test_a_checkpoint_with_missing_weights_is_refused(policy, tmp_path):
    """LeRobot would only warn and evaluate a half-random policy."""
    from safetensors.torch import load_file, save_file

    policy.save_pretrained(tmp_path)
    weights = load_file(tmp_path / "model.safetensors")
    del weights["ema_model.generator.embed_action.weight"]
    save_file(weights, tmp_path / "model.safetensors")
    with pytest.raises(UserError, match=r"ema_model\.generator\.embed_action\.weight"):
        UCAFlowPolicy.from_pretrained(tmp_path)


def test_a_checkpoint_without_weights(policy, tmp_path):
    policy.save_pretrained(tmp_path)
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises(UserError, match="has no weights"):
        UCAFlowPolicy.from_pretrained(tmp_path)
