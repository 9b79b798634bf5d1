"""Training, fine-tuning and loading: the right statistics reach LeRobot's normalisers, or a line says why not."""

import contextlib
import json
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.scripts import lerobot_train
from safetensors.torch import load_file, save_file

from lerobot_uca.data import batched_dataset, chosen_episodes
from lerobot_uca.data.batched_dataset import BatchedDataset
from lerobot_uca.deploy.export import RawPolicy, export
from lerobot_uca.deploy.onnx_runner import OnnxPolicy
from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig
from lerobot_uca.policies.processor_base import PointCloudProcessorStep
from tests.builders import N_ACTIONS, N_POINTS, N_STATES, SMALL_POLICIES, make_observation, write_dataset

STATE, ACTION = "observation.state", "action"
STATISTICS = "policy_preprocessor_step_5_normalizer_processor.safetensors"


def features(cloud: str = OBS_POINT_CLOUD, n_points: int = N_POINTS, channels: int = 3, dtype: str = "float32") -> dict:
    return {
        cloud: {"dtype": "float32", "shape": (n_points, channels), "names": None},
        STATE: {"dtype": dtype, "shape": (N_STATES,), "names": None},
        ACTION: {"dtype": dtype, "shape": (N_ACTIONS,), "names": None},
    }


def train(
    root: Path,
    output: Path,
    checkpoint: Path | None = None,
    dataset: dict | None = None,
    policy: dict | None = None,
    **options: object,
) -> Path:
    """One step of training, as lerobot-train does it. Returns its checkpoint."""
    if checkpoint is None:
        settings = SMALL_POLICIES["uca_flow"] | (policy or {})
        of_policy = UCAFlowConfig(device="cpu", push_to_hub=False, **settings)
    else:
        of_policy = PreTrainedConfig.from_pretrained(checkpoint)
        of_policy.pretrained_path = checkpoint
    config = TrainPipelineConfig(
        dataset=DatasetConfig(repo_id="test/random", root=str(root), **(dataset or {})),
        policy=of_policy,
        output_dir=output,
        steps=1,
        batch_size=4,
        num_workers=0,
        env_eval_freq=0,
        **options,
    )
    lerobot_train.train(config)
    return output / "checkpoints" / "last" / "pretrained_model"


def load(checkpoint: Path):
    config = PreTrainedConfig.from_pretrained(checkpoint)
    policy = get_policy_class(config.type).from_pretrained(checkpoint, config=config).eval()
    return policy, *make_pre_post_processors(config, pretrained_path=str(checkpoint))


def saved(checkpoint: Path) -> dict[str, torch.Tensor]:
    return load_file(checkpoint / STATISTICS)


def columns(root: Path, key: str, episodes: list[int] | None = None) -> np.ndarray:
    dataset = LeRobotDataset("test/random", root=root)
    rows = [row for row in dataset.hf_dataset if episodes is None or int(row["episode_index"]) in episodes]
    return np.stack([np.asarray(row[key]) for row in rows])


@pytest.fixture(scope="module")
def checkpoint(dataset_root, tmp_path_factory) -> Path:
    return train(dataset_root, tmp_path_factory.mktemp("train") / "new")


@pytest.fixture
def damaged(checkpoint, tmp_path) -> Path:
    return shutil.copytree(checkpoint, tmp_path / "damaged")


# Statistics ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["int64", "int32", "uint8", "bool"])
def test_every_dtype_has_right_statistics_in_its_checkpoint(tmp_path, dtype):
    write_dataset(tmp_path / "data", features=features(dtype=dtype))
    stats = saved(train(tmp_path / "data", tmp_path / "new"))
    for key in (STATE, ACTION):
        values = columns(tmp_path / "data", key).astype(np.float64)
        np.testing.assert_allclose(stats[f"{key}.min"], values.min(axis=0), atol=1e-6)
        np.testing.assert_allclose(stats[f"{key}.max"], values.max(axis=0), atol=1e-6)
        np.testing.assert_allclose(stats[f"{key}.mean"], values.mean(axis=0), atol=1e-5)


def test_a_constant_dimension_in_training_and_fine_tuning(dataset_root, checkpoint, tmp_path):
    def hold(frame, *_):
        frame[ACTION][3] = 0.5

    write_dataset(tmp_path / "data", change=hold)
    for trained in (
        train(tmp_path / "data", tmp_path / "new"),
        train(tmp_path / "data", tmp_path / "fine", checkpoint=checkpoint),
    ):
        _, pre, post = load(trained)
        normalised = pre({**next(batches(tmp_path / "data"))})[ACTION]
        assert torch.equal(normalised[:, 3], torch.zeros(len(normalised)))
        torch.testing.assert_close(post(torch.zeros(1, N_ACTIONS))[0, 3].item(), 0.5)


def test_a_joint_that_only_trembles_is_not_stretched(tmp_path, capfd):
    """Else a reading two thousandths of a radian off would be five times what the policy has ever seen."""
    rng = np.random.default_rng(0)

    def tremble(frame, *_):
        frame[STATE][1] = -1.57 + rng.uniform(-4e-4, 4e-4)

    write_dataset(tmp_path / "data", change=tremble)
    _, pre, _ = load(train(tmp_path / "data", tmp_path / "stretched"))
    batch = next(batches(tmp_path / "data"))
    batch[STATE][:, 1] = -1.57 + 2e-3
    assert pre(dict(batch))[STATE][:, 1].min() > 4
    said = capfd.readouterr().err
    assert "observation.state[1] moves by 0.0008 or less, another dimension by" in said
    assert "--policy.min_state_range" in said
    _, pre, _ = load(train(tmp_path / "data", tmp_path / "kept", policy={"min_state_range": 0.02}))
    torch.testing.assert_close(pre(dict(batch))[STATE][:, 1], torch.full((3,), 2e-3), atol=5e-4, rtol=0)


def batches(root: Path):
    dataset = LeRobotDataset("test/random", root=root)
    rows = [dataset[index] for index in range(3)]
    yield {key: torch.stack([row[key] for row in rows]) for key in (OBS_POINT_CLOUD, STATE, ACTION)}


def test_statistics_of_the_chosen_episodes(dataset_root, tmp_path):
    stats = saved(train(dataset_root, tmp_path / "new", dataset={"episodes": [0, 2]}))
    np.testing.assert_allclose(stats[f"{STATE}.min"], columns(dataset_root, STATE, [0, 2]).min(axis=0), rtol=1e-6)


def test_held_out_episodes_do_not_count(dataset_root, tmp_path):
    stats = saved(train(dataset_root, tmp_path / "new", dataset={"eval_split": 0.3}))
    # The last episode of each task is held out; of two tasks with episodes 0, 2 and 1 is left episode 0.
    np.testing.assert_allclose(stats[f"{STATE}.max"], columns(dataset_root, STATE, [0]).max(axis=0), rtol=1e-6)


@pytest.mark.parametrize(
    ("spoiled", "hint"), [([4], r"--dataset\.episodes=\[0,1,2,3\] "), (range(5), "No episode is left")]
)
def test_the_hint_is_about_all_episodes_held_out_or_not(tmp_path, spoiled, hint):
    def spoil(frame, episode, index):
        frame[ACTION][0] = np.nan if episode in spoiled else frame[ACTION][0]

    write_dataset(tmp_path / "data", n_episodes=5, features=features(OBS_POINT_CLOUD), change=spoil)
    with pytest.raises(UserError, match=hint):
        train(tmp_path / "data", tmp_path / "new", dataset={"eval_split": 0.0 if len(spoiled) > 1 else 0.4})


@pytest.mark.parametrize("pictures", [False, True])  # with some, LeRobot reads row by row
def test_leaving_out_the_episode_with_a_nan_trains(tmp_path, pictures):
    def spoil(frame, episode, index):
        if pictures:
            frame["observation.images.top"] = np.zeros((8, 8, 3), np.uint8)
        if (episode, index) == (1, 4):
            frame[OBS_POINT_CLOUD][3, 1] = np.nan

    picture = {"dtype": "image", "shape": (8, 8, 3), "names": ["height", "width", "channels"]}
    given = features(OBS_POINT_CLOUD) | ({"observation.images.top": picture} if pictures else {})
    write_dataset(tmp_path / "data", features=given, change=spoil)
    with pytest.raises(UserError, match=r"in episode 1, frame 4\. --dataset\.episodes=\[0,2\]"):
        train(tmp_path / "data", tmp_path / "all")
    stats = saved(train(tmp_path / "data", tmp_path / "new", dataset={"episodes": [0, 2]}))
    assert all(torch.isfinite(value).all() for value in stats.values())


# Clouds -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("cloud", "channels"), [("observation.pointcloud", 6), ("observation.pointcloud.xyz", 3)])
def test_clouds_of_other_plugins_train_and_act(tmp_path, cloud, channels):
    write_dataset(tmp_path / "data", features=features(cloud, channels=channels))
    trained = train(tmp_path / "data", tmp_path / "new")
    xyz = columns(tmp_path / "data", cloud)[..., :3]
    np.testing.assert_allclose(saved(trained)[f"{OBS_POINT_CLOUD}.max"], xyz.max(axis=(0, 1)), rtol=1e-6)
    policy, pre, post = load(trained)
    frame = LeRobotDataset("test/random", root=tmp_path / "data")[0]
    assert post(policy.select_action(pre(frame))).shape == (1, N_ACTIONS)
    assert RawPolicy(str(trained)).input_shapes["point_cloud"] == (2, N_POINTS, 3)
    check_exported(trained, frame, cloud)


def check_exported(trained: Path, frame: dict, cloud: str) -> None:
    """The exported file gives a raw frame's actions as the policy does."""
    policy, pre, post = load(trained)
    export(str(trained), trained / "policy.onnx")
    runner = OnnxPolicy(trained / "policy.onnx")
    noise = torch.randn(1, policy.config.horizon, N_ACTIONS)
    expected = post(policy.predict_action_chunk(pre(frame), noise=noise))[0]
    xyz = frame[cloud].numpy()[..., :3]
    actions = runner.plan(np.stack([xyz] * 2), np.stack([frame[STATE].numpy()] * 2), noise[0].numpy())
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    assert runner.select_action(frame[cloud].numpy(), frame[STATE].numpy()).shape == (N_ACTIONS,)


@pytest.mark.parametrize("n_points", [None, 16])
def test_colours_train_act_and_are_normalised_by_channel(tmp_path, n_points):
    def bright(frame, *_):
        frame["observation.pointcloud"][:, 3:] = np.random.default_rng(1).uniform(0, 255, (N_POINTS, 3))

    write_dataset(tmp_path / "data", features=features("observation.pointcloud", channels=6), change=bright)
    trained = train(tmp_path / "data", tmp_path / "new", policy={"colour": True, "n_points": n_points})
    everything = columns(tmp_path / "data", "observation.pointcloud")
    if n_points is None:
        np.testing.assert_allclose(saved(trained)[f"{OBS_POINT_CLOUD}.max"], everything.max(axis=(0, 1)), rtol=1e-6)
    policy, pre, post = load(trained)
    frame = LeRobotDataset("test/random", root=tmp_path / "data")[0]
    batch = pre(frame)
    assert batch[OBS_POINT_CLOUD].shape == (1, n_points or N_POINTS, 6)
    assert batch[OBS_POINT_CLOUD].abs().max() <= 1 + 1e-5
    assert post(policy.select_action(batch)).shape == (1, N_ACTIONS)
    assert RawPolicy(str(trained)).input_shapes["point_cloud"] == (2, n_points or N_POINTS, 6)
    further = train(tmp_path / "data", tmp_path / "further", checkpoint=trained)
    assert load(further)[0].config.input_features[OBS_POINT_CLOUD].shape == (N_POINTS, 6)


def test_colours_that_are_missing(dataset_root, checkpoint, tmp_path):
    with pytest.raises(UserError, match=r"must have shape \(N, 6\) with .* after xyz and RGB .*, got \(32, 3\)"):
        train(dataset_root, tmp_path / "new", policy={"colour": True})
    _, pre, _ = load(checkpoint)
    step = next(each for each in pre.steps if isinstance(each, PointCloudProcessorStep))
    step.colour = True
    with pytest.raises(UserError, match=r"must have shape \(..., N, 6\) or more channels, got \(1, 32, 3\)"):
        pre(make_observation())


@pytest.mark.parametrize("is_batched", [True, False])  # a dataset with a camera, or of more than 4 GiB, is not
@pytest.mark.parametrize("shape", [(N_POINTS,), (N_POINTS, 1)])
def test_invalid_points_count_nowhere(tmp_path, shape, is_batched, monkeypatch):
    if not is_batched:
        monkeypatch.setattr(batched_dataset, "MAX_BYTES", 0)

    def mask(frame, *_):
        frame["observation.pointcloud.valid_mask"][:] = True
        frame["observation.pointcloud.valid_mask"][5:9] = False
        frame["observation.pointcloud.xyz"][5:9] = np.nan

    of_mask = {"dtype": "bool", "shape": shape, "names": None}
    both = {**features("observation.pointcloud.xyz"), "observation.pointcloud.valid_mask": of_mask}
    write_dataset(tmp_path / "data", features=both, change=mask)
    trained = train(tmp_path / "data", tmp_path / "new")
    xyz = columns(tmp_path / "data", "observation.pointcloud.xyz")
    for name, of in (("min", np.nanmin), ("max", np.nanmax), ("mean", np.nanmean), ("std", np.nanstd)):
        np.testing.assert_allclose(saved(trained)[f"{OBS_POINT_CLOUD}.{name}"], of(xyz, axis=(0, 1)), rtol=1e-4)
    policy, pre, _ = load(trained)
    assert policy.select_action(pre(LeRobotDataset("test/random", root=tmp_path / "data")[0])).isfinite().all()


def test_a_streamed_dataset_says_that_its_invalid_points_count(tmp_path, caplog, monkeypatch):
    of_mask = {"dtype": "bool", "shape": (N_POINTS,), "names": None}
    write_dataset(tmp_path / "data", features={**features(), f"{OBS_POINT_CLOUD}.valid_mask": of_mask})
    monkeypatch.setattr(chosen_episodes.logger, "handlers", [caplog.handler])  # LeRobot takes the root's away
    monkeypatch.setattr(lerobot_train, "cycle", lambda loader: iter(()), raising=False)
    with contextlib.suppress(StopIteration):
        train(tmp_path / "data", tmp_path / "new", dataset={"streaming": True})
    assert f"The dataset is streamed: invalid points of '{OBS_POINT_CLOUD}' count in its normalisation." in caplog.text


def test_invalid_points_count_nowhere_in_sampled_clouds(tmp_path):
    """Of 32 points the policy looks at 8 valid ones, here of a mask that a rename_map alone pairs with its cloud."""

    def mask(frame, *_):
        frame["observation.seen"][:] = False
        frame["observation.seen"][:20] = True
        frame["observation.scan"][20:] = 1e6

    both = {**features("observation.scan"), "observation.seen": {"dtype": "bool", "shape": (N_POINTS,), "names": None}}
    write_dataset(tmp_path / "data", features=both, change=mask)
    write_dataset(tmp_path / "before")
    checkpoint = train(tmp_path / "before", tmp_path / "checkpoint", policy={"n_points": 8})
    renaming = {"observation.scan": OBS_POINT_CLOUD, "observation.seen": f"{OBS_POINT_CLOUD}.valid_mask"}
    trained = train(tmp_path / "data", tmp_path / "new", checkpoint=checkpoint, rename_map=renaming)
    scan = columns(tmp_path / "data", "observation.scan")
    np.testing.assert_allclose(saved(trained)[f"{OBS_POINT_CLOUD}.max"], scan[:, :20].max(axis=(0, 1)), rtol=1e-6)


def test_a_further_training_begins_its_average_anew(damaged, dataset_root, tmp_path):
    """And not with the slow decay of the one before, in which what is evaluated would remain what it was."""
    file = damaged / "model.safetensors"
    weights = {name: value + 1 if name.startswith("ema_model.") else value for name, value in load_file(file).items()}
    save_file({**weights, "ema_step": torch.tensor(16_000)}, file)
    after = load_file(train(dataset_root, tmp_path / "new", checkpoint=damaged) / "model.safetensors")
    assert after["ema_step"] == 1
    names = [name.removeprefix("model.") for name in after if name.startswith("model.")]
    assert names
    assert all(torch.equal(after[f"ema_model.{name}"], after[f"model.{name}"]) for name in names)


@pytest.mark.parametrize("mapping", [{"STATE": "MEAN_STD"}, {"ACTION": "MIN_MAX"}, {}])
def test_what_is_not_normalised_is_named(dataset_root, tmp_path, mapping):
    with pytest.raises(UserError, match=r"must name STATE \(which the cloud is, too\) and ACTION, got"):
        train(dataset_root, tmp_path / "new", policy={"normalization_mapping": mapping})


def test_an_adapter_alone_is_not_a_policy(checkpoint, tmp_path):
    shutil.copytree(checkpoint, tmp_path / "adapter")
    (tmp_path / "adapter" / "model.safetensors").rename(tmp_path / "adapter" / "adapter_model.safetensors")
    file = tmp_path / "adapter" / "config.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "use_peft": True}))  # as LeRobot writes it
    with pytest.raises(UserError, match="PEFT trains an adapter alone"):
        load(tmp_path / "adapter")


@pytest.mark.parametrize("is_batched", [True, False])
def test_a_frame_without_valid_points_is_named(tmp_path, is_batched, monkeypatch):
    if not is_batched:
        monkeypatch.setattr(batched_dataset, "MAX_BYTES", 0)

    def mask(frame, episode, index):
        frame["observation.pointcloud.valid_mask"][:] = (episode, index) != (1, 2)

    of_mask = {"dtype": "bool", "shape": (N_POINTS,), "names": None}
    both = {**features("observation.pointcloud.xyz"), "observation.pointcloud.valid_mask": of_mask}
    write_dataset(tmp_path / "data", features=both, change=mask)
    with pytest.raises(UserError, match=r"got none in episode 1, frame 2\. --dataset\.episodes=\[0,2\] leaves"):
        train(tmp_path / "data", tmp_path / "new")


def test_evaluation_under_another_name(checkpoint):
    """As `lerobot-eval --rename_map` loads the processors."""
    policy, pre, _ = load(checkpoint)
    renaming = {"rename_observations_processor": {"rename_map": {"observation.scan": OBS_POINT_CLOUD}}}
    renamed, _ = make_pre_post_processors(
        policy.config, pretrained_path=str(checkpoint), preprocessor_overrides=renaming
    )
    cloud, state = torch.randn(1, N_POINTS, 3), torch.randn(1, N_STATES)
    expected = pre({OBS_POINT_CLOUD: cloud, STATE: state})
    assert not torch.equal(expected[OBS_POINT_CLOUD], cloud)  # it is normalised
    assert torch.equal(renamed({"observation.scan": cloud, STATE: state})[OBS_POINT_CLOUD], expected[OBS_POINT_CLOUD])


def test_fine_tuning_under_other_names_and_with_more_points(checkpoint, tmp_path):
    write_dataset(tmp_path / "data", features=features("observation.scan", n_points=64))
    rename = {"observation.scan": OBS_POINT_CLOUD}
    trained = train(tmp_path / "data", tmp_path / "new", checkpoint=checkpoint, rename_map=rename)
    scan = columns(tmp_path / "data", "observation.scan")
    np.testing.assert_allclose(saved(trained)[f"{OBS_POINT_CLOUD}.max"], scan.max(axis=(0, 1)), rtol=1e-6)
    assert RawPolicy(str(trained)).input_shapes["point_cloud"] == (2, 64, 3)
    frame = LeRobotDataset("test/random", root=tmp_path / "data")[0]
    frame[OBS_POINT_CLOUD] = frame.pop("observation.scan")
    check_exported(trained, frame, OBS_POINT_CLOUD)


def test_fine_tuning_without_the_cloud_the_checkpoint_knows(checkpoint, tmp_path):
    write_dataset(tmp_path / "data", features=features("observation.scan"))
    with pytest.raises(
        UserError, match=f"needs '{OBS_POINT_CLOUD}', which is not among .*observation.scan.*rename_map"
    ):
        train(tmp_path / "data", tmp_path / "new", checkpoint=checkpoint)


def test_fine_tuning_with_another_robot(checkpoint, tmp_path):
    other = {**features(), STATE: {"dtype": "float32", "shape": (7,), "names": None}}
    write_dataset(tmp_path / "data", features=other)
    with pytest.raises(UserError, match=r"'observation.state' must have the checkpoint's shape \(9,\), got \(7,\)"):
        train(tmp_path / "data", tmp_path / "new", checkpoint=checkpoint)


def test_a_state_and_an_action_of_one_dimension(tmp_path):
    one = {"dtype": "float32", "shape": (1,), "names": None}
    write_dataset(tmp_path / "data", features={**features(), STATE: one, ACTION: one})
    policy, pre, post = load(train(tmp_path / "data", tmp_path / "new"))
    frame = LeRobotDataset("test/random", root=tmp_path / "data")[0]
    assert post(policy.select_action(pre(frame))).shape == (1, 1)


def test_fewer_points_are_sampled_once_and_alike_in_training_and_control(dataset_root, tmp_path, monkeypatch):
    seen = []
    read = BatchedDataset.__getitems__
    monkeypatch.setattr(BatchedDataset, "__getitems__", lambda self, rows: seen.append(read(self, rows)) or seen[-1])
    trained = train(dataset_root, tmp_path / "new", policy={"n_points": 10})
    sample = seen[0][0]
    assert sample[OBS_POINT_CLOUD].shape == (2, 10, 3)
    policy, pre, _ = load(trained)
    frame = LeRobotDataset("test/random", root=dataset_root)[int(sample["index"])]
    of_training = pre({OBS_POINT_CLOUD: sample[OBS_POINT_CLOUD][-1:], STATE: frame[STATE][None]})
    assert torch.equal(pre(frame)[OBS_POINT_CLOUD], of_training[OBS_POINT_CLOUD])
    assert policy.select_action(pre(frame)).shape == (1, N_ACTIONS)


# Loading ------------------------------------------------------------------------------------------------------------


def test_an_old_checkpoint_gets_the_point_cloud_step(damaged):
    pipeline = damaged / "policy_preprocessor.json"
    settings = json.loads(pipeline.read_text())
    settings["steps"] = [step for step in settings["steps"] if step["registry_name"] != "point_cloud_processor"]
    pipeline.write_text(json.dumps(settings))
    _, pre, _ = load(damaged)
    assert any(isinstance(step, PointCloudProcessorStep) for step in pre.steps)


def test_a_checkpoint_of_a_machine_with_a_gpu_falls_back(damaged, caplog):
    for name in ("config.json", "policy_preprocessor.json"):
        file = damaged / name
        file.write_text(file.read_text().replace('"cpu"', '"cuda"'))
    policy, pre, _ = load(damaged)
    available = "cuda" if torch.cuda.is_available() else "cpu"
    assert policy.config.device == available
    assert (
        pre({OBS_POINT_CLOUD: torch.zeros(1, N_POINTS, 3), STATE: torch.zeros(1, N_STATES)})[STATE].device.type
        == available
    )
    assert torch.cuda.is_available() or "Device 'cuda' is not available" in caplog.text


def test_the_example_runs_a_checkpoint_of_a_machine_with_a_gpu(damaged, tmp_path, monkeypatch):
    for name in ("config.json", "policy_preprocessor.json"):
        file = damaged / name
        file.write_text(file.read_text().replace('"cpu"', '"cuda"'))
    example = Path(__file__).parent.parent / "examples" / "draw_prediction.py"
    options = {"checkpoint": damaged, "task": "drawer-close", "output": tmp_path / "picture.png", "every": 1}
    monkeypatch.setattr("sys.argv", [str(example), *(f"--{name}={value}" for name, value in options.items())])
    runpy.run_path(str(example), run_name="__main__")
    assert (tmp_path / "picture.png").stat().st_size > 10_000


@pytest.mark.parametrize("step", ["normalizer_processor", "device_processor"])
def test_a_step_is_missing(damaged, step):
    pipeline = damaged / "policy_preprocessor.json"
    settings = json.loads(pipeline.read_text())
    settings["steps"] = [each for each in settings["steps"] if each["registry_name"] != step]
    pipeline.write_text(json.dumps(settings))
    with pytest.raises(UserError, match=step):
        load(damaged)


def test_the_postprocessor_does_not_bring_actions_back(damaged):
    pipeline = damaged / "policy_postprocessor.json"
    settings = json.loads(pipeline.read_text())
    settings["steps"] = settings["steps"][1:]
    pipeline.write_text(json.dumps(settings))
    with pytest.raises(UserError, match=r"'policy_postprocessor' of checkpoint .* has no unnormalizer_processor"):
        load(damaged)


@pytest.mark.parametrize("key", [OBS_POINT_CLOUD, STATE, ACTION])
def test_the_normaliser_does_not_know_a_feature(damaged, key):
    stats = load_file(damaged / STATISTICS)
    save_file({name: value for name, value in stats.items() if not name.startswith(key)}, damaged / STATISTICS)
    with pytest.raises(UserError, match=f"needs 'min' of '{key}', which is not among the normalizer_processor's"):
        load(damaged)


def test_an_emptied_file_of_statistics(damaged):
    save_file({}, damaged / STATISTICS)
    with pytest.raises(UserError, match="which is not among the normalizer_processor's"):
        load(damaged)


@pytest.mark.parametrize("content", [None, b"", b"no tensors"])
def test_a_broken_file_of_statistics(damaged, content):
    (damaged / STATISTICS).unlink() if content is None else (damaged / STATISTICS).write_bytes(content)
    with pytest.raises(UserError, match=r"The processors of .* cannot be loaded"):
        load(damaged)


def test_a_normaliser_without_features(damaged):
    pipeline = damaged / "policy_preprocessor.json"
    settings = json.loads(pipeline.read_text())
    settings["steps"][-1]["config"]["features"] = {}
    pipeline.write_text(json.dumps(settings))
    with pytest.raises(UserError, match=r"normalizer_processor of checkpoint .* does not know"):
        load(damaged)


@pytest.mark.parametrize("damage", ["file", "feature"])
def test_a_dataset_without_statistics(dataset_root, tmp_path, damage):
    root = shutil.copytree(dataset_root, tmp_path / "data")
    file = root / "meta" / "stats.json"
    stats = json.loads(file.read_text())
    file.unlink()
    if damage == "feature":
        del stats[STATE]
        file.write_text(json.dumps(stats))
    with pytest.raises(
        UserError, match=r"meta/stats.json is missing" if damage == "file" else f"needs 'min' of '{STATE}'"
    ):
        train(root, tmp_path / "new")
