"""Generated input: nothing ends in a library's traceback, a NaN action or a silently wrong shape."""

import json
import math
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lerobot.common.train_utils import load_training_state
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import factory
from lerobot.policies import get_policy_class, make_pre_post_processors
from tests.builders import N_ACTIONS, N_POINTS, N_STATES, make_batch, make_config
from tests.trust.conftest import N_STEPS, generated

from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.modeling_base import PointCloudPolicy
from lerobot_uca.policies.modeling_uca_flow import UCAFlowPolicy


@pytest.fixture(scope="module")
def policy() -> UCAFlowPolicy:
    return UCAFlowPolicy(make_config(inference="eager", n_points=16)).eval()


# Batches and observations -------------------------------------------------------------------------------------------

DTYPES = (torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.uint8, torch.bool)
EXTREME = (0.0, 1.0, -1.0, 1e-30, 1e5, 1e30, math.nan, math.inf, -math.inf)


@st.composite
def tensors(draw, shape: tuple[int, ...]) -> object:
    """Mostly of this shape; sometimes of another shape or kind, with extreme values in one place or all."""
    shape = list(shape)
    if draw(st.integers(0, 4)) == 0 and shape:
        axis = draw(st.integers(0, len(shape) - 1))
        change = draw(st.sampled_from(["drop", "add", 0, 1, 2, 5]))
        if change == "drop":
            del shape[axis]
        elif change == "add":
            shape.insert(axis, 1)
        else:
            shape[axis] = change
    tensor = torch.rand(shape, generator=torch.Generator().manual_seed(draw(st.integers(0, 9)))) * 2 - 1
    value = draw(st.sampled_from(EXTREME))
    where = draw(st.sampled_from(["none", "none", "one", "all"]))
    if where == "all":
        tensor = torch.full_like(tensor, value)
    elif where == "one" and tensor.numel():
        tensor.view(-1)[draw(st.integers(0, tensor.numel() - 1))] = value
    if draw(st.integers(0, 3)) == 0:
        tensor = tensor.to(draw(st.sampled_from(DTYPES)))
    kind = draw(st.sampled_from(["tensor"] * 6 + ["numpy", "list", "none", "text"]))
    if kind == "numpy" and tensor.dtype is not torch.bfloat16:
        return tensor.numpy()
    return {"list": tensor.tolist(), "none": None, "text": "cloud"}.get(kind, tensor)


@st.composite
def observations(draw) -> dict[str, object]:
    n_samples, steps = draw(st.sampled_from([0, 1, 3])), draw(st.sampled_from([(), (2,)]))
    batch = {
        OBS_POINT_CLOUD: draw(tensors((n_samples, *steps, N_POINTS, 3))),
        "observation.state": draw(tensors((n_samples, *steps, N_STATES))),
    }
    for key in draw(st.sets(st.sampled_from(sorted(batch)), max_size=1)) if draw(st.integers(0, 5)) == 0 else ():
        del batch[key]
    return batch


def n_samples_of(batch: dict[str, object]) -> int:
    return len(batch["observation.state"])


@generated(200)
@given(batch=observations(), noise=st.one_of(st.none(), tensors((1, 4, N_ACTIONS))))
def test_actions_are_finite_or_refused(policy, batch, noise):
    policy.reset()
    is_history = isinstance(batch.get(OBS_POINT_CLOUD), torch.Tensor) and batch[OBS_POINT_CLOUD].ndim == 4
    act = policy.predict_action_chunk if is_history else policy.select_action
    try:
        actions = act(batch, noise=noise)
    except UserError:
        return
    shape = (policy.config.n_action_steps, N_ACTIONS) if is_history else (N_ACTIONS,)
    assert actions.shape == (n_samples_of(batch), *shape)
    assert torch.isfinite(actions).all()


@st.composite
def training_batches(draw) -> dict[str, object]:
    batch = dict(make_batch(make_config(), batch_size=2))
    for key in draw(st.sets(st.sampled_from(sorted(batch)), min_size=1, max_size=2)):
        batch[key] = draw(tensors(tuple(batch[key].shape)))
    return batch


@generated(200)
@given(batch=training_batches(), reduction=st.sampled_from(["mean", "none", "sum"]))
def test_losses_are_finite_or_refused(policy, batch, reduction):
    try:
        loss, parts = policy.forward(batch, reduction=reduction)
    except UserError:
        return
    assert loss.shape == (() if reduction == "mean" else (2,))
    assert torch.isfinite(loss).all()
    assert all(math.isfinite(value) for value in parts.values())


# Checkpoints ----------------------------------------------------------------------------------------------------------

VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(-(10**12), 10**12), st.floats(), st.text(max_size=5), st.just([]), st.just({})
)


def damage(draw: Callable, path: Path) -> None:
    """Remove a file, cut it off, overwrite some bytes or, of JSON, replace or remove a value anywhere inside."""
    content = path.read_bytes()
    how = draw(st.sampled_from(["value"] * 3 + ["remove", "cut", "bytes", "folder", "deep"]))
    if how == "value" and path.suffix == ".json":
        tree = json.loads(content)
        node = tree
        while True:
            keys = list(node) if isinstance(node, dict) else list(range(len(node)))
            if not keys:
                return
            key = draw(st.sampled_from(keys))
            if isinstance(node[key], dict | list) and node[key] and draw(st.booleans()):
                node = node[key]
                continue
            break
        if draw(st.integers(0, 3)) == 0:
            del node[key]
        else:
            node[key] = draw(VALUES)
        path.write_text(json.dumps(tree))
    elif how in ("remove", "folder"):
        path.unlink()
        if how == "folder":
            path.mkdir()
    elif how == "cut":
        path.write_bytes(content[: draw(st.integers(0, len(content) - 1))])
    elif how == "deep":
        path.write_bytes(b"[" * 100_000)
    else:
        start = draw(st.integers(0, len(content) - 1))
        path.write_bytes(content[:start] + draw(st.binary(min_size=1, max_size=20)) + content[start + 1 :])


def use(folder: Path) -> None:
    """Load what `lerobot-eval` loads, act, and load what a resumed training loads."""
    path = folder / "pretrained_model"
    config = PreTrainedConfig.from_pretrained(path)
    if not hasattr(config, "validate_sizes"):
        return  # of another type, by damage
    config.pretrained_path = path
    loaded: PointCloudPolicy = get_policy_class(config.type).from_pretrained(path, config=config)
    preprocess, postprocess = make_pre_post_processors(config, pretrained_path=str(path))
    observation = {OBS_POINT_CLOUD: torch.rand(1, N_POINTS, 3), "observation.state": torch.rand(1, N_STATES)}
    action = postprocess(loaded.select_action(preprocess(observation)))
    assert action.shape == (1, N_ACTIONS)
    assert torch.isfinite(action).all()
    optimizer = config.get_optimizer_preset().build(loaded.get_optim_params())
    scheduler = config.get_scheduler_preset().build(optimizer, N_STEPS)
    load_training_state(folder, optimizer, scheduler)


@pytest.fixture(scope="module")
def whole(trained) -> Path:
    return trained / "checkpoints" / f"{N_STEPS:06d}"


@generated(100)
@given(data=st.data())
def test_a_damaged_checkpoint_works_or_is_refused(whole, tmp_path, data):
    folder = tmp_path / "copy"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(whole, folder)
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "README.md")
    damage(data.draw, data.draw(st.sampled_from(files)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            use(folder)
        except UserError:
            return


def test_a_whole_checkpoint_is_used(whole):
    use(whole)


# Datasets -------------------------------------------------------------------------------------------------------------


@generated(10)
@given(data=st.data())
def test_a_damaged_dataset_works_or_is_refused(trained, tmp_path, data):
    root = tmp_path / "data"
    shutil.rmtree(root, ignore_errors=True)
    shutil.copytree(trained.parent / "data", root)
    damage(data.draw, data.draw(st.sampled_from(sorted(path for path in root.rglob("*.*") if path.is_file()))))
    config = TrainPipelineConfig(
        dataset=DatasetConfig(repo_id="test/random", root=str(root)),
        policy=make_config(),
        output_dir=tmp_path / "run",
    )
    try:
        dataset = factory.make_train_eval_datasets(config)[0]
        samples = dataset.__getitems__([0, len(dataset) - 1])
    except UserError:
        return
    assert samples[0][OBS_POINT_CLOUD].shape == (2, N_POINTS, 3)
