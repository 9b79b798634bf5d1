"""Recorded depth and clouds to a dataset of clouds."""

import csv
import json
import re
import sys
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tests.builders import write_dataset
from tests.depth_builders import (
    CROP,
    DEPTH_KEY,
    N_CLOUD_POINTS,
    live_frame,
    make_calibration,
    make_camera,
    make_recipe,
    write_depth_dataset,
)
from tests.forked import run_command

from lerobot_uca.data import convert as command
from lerobot_uca.data import edit_dataset
from lerobot_uca.data.batched_dataset import BatchedDataset
from lerobot_uca.data.convert import ConvertConfig, convert, convert_episode
from lerobot_uca.data.recorded_calibrations import recorded_calibrations
from lerobot_uca.data.sources.find import find_source
from lerobot_uca.data.sources.lerobot_source import LOST_RECIPE
from lerobot_uca.data.sources.source import Frame
from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD
from lerobot_uca.point_clouds.geometry import Crop, as_pose
from lerobot_uca.point_clouds.recipe import CALIBRATION_VARIABLE, RECIPE_INFO, CloudRecipe


@pytest.fixture
def calibrated(tmp_path, monkeypatch):
    folder = tmp_path / "calibration"
    make_calibration().write(folder)
    monkeypatch.setenv(CALIBRATION_VARIABLE, str(folder))
    return folder


@pytest.fixture(scope="module")
def depth_dataset(tmp_path_factory):
    return write_depth_dataset(tmp_path_factory.mktemp("depth") / "data", video=False)


def config(source, root, **changes):
    crop = {"crop_low": CROP.low, "crop_high": CROP.high}
    return ConvertConfig(
        **{"source": source, "repo_id": "test/clouds", "root": root, "n_points": N_CLOUD_POINTS, **crop, **changes}
    )


def test_workers_leave_the_decoders_page_to_the_parent_which_has_one_line(tmp_path):
    """LeRobot prints a page of tracebacks in every process that opens a dataset without FFmpeg."""
    write_dataset(tmp_path / "source")
    (tmp_path / "torchcodec.py").write_text("raise RuntimeError('Traceback')")  # this machine may have FFmpeg
    options = ("--repo_id=test/clouds", f"--root={tmp_path / 'clouds'}", "--n_points=4", "--num_workers=2")
    result = run_command("lerobot-uca-convert", f"--source={tmp_path / 'source'}", *options, PYTHONPATH=str(tmp_path))
    assert result.returncode == 0
    assert "Traceback" not in result.stderr
    assert result.stderr.count("torchcodec") <= 1


@pytest.mark.parametrize("num_workers", [0, 1])
@pytest.mark.usefixtures("calibrated")
def test_depth_becomes_the_clouds_that_the_preprocessor_makes(depth_dataset, tmp_path, num_workers):
    dataset = convert(config(depth_dataset.root, tmp_path / "clouds", num_workers=num_workers))
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (2, 12, 20)
    make = make_recipe().make()
    for index in range(12):
        new, old = dataset[index], depth_dataset[index]
        np.testing.assert_array_equal(new[OBS_POINT_CLOUD].numpy(), make([live_frame(index)]))
        np.testing.assert_array_equal(new["observation.state"], old["observation.state"])
        np.testing.assert_array_equal(new["action"], old["action"])
        assert (new["task"], new["episode_index"], new["frame_index"]) == (
            "push",
            old["episode_index"],
            old["frame_index"],
        )
    assert [path.name for path in tmp_path.iterdir() if path.name != "calibration"] == ["clouds"]


@pytest.mark.usefixtures("calibrated")
def test_the_new_dataset_knows_how_it_was_made_and_reads_fast(depth_dataset, tmp_path):
    dataset = convert(config(depth_dataset.root, tmp_path / "clouds", episodes=[1]))
    assert (dataset.num_episodes, dataset.num_frames) == (1, 6)
    info = dataset.features[OBS_POINT_CLOUD]["info"]
    assert CloudRecipe.from_dict(info[RECIPE_INFO]) == make_recipe()
    assert info["crop"] == [list(CROP.low), list(CROP.high)]
    assert BatchedDataset("test/clouds", root=dataset.root).is_batched


@pytest.mark.usefixtures("calibrated")
def test_video_is_converted_too(tmp_path):
    source = write_depth_dataset(tmp_path / "video", video=True, n_episodes=1)
    dataset = convert(config(source.root, tmp_path / "clouds"))
    points = make_recipe().make().points([live_frame(0)])
    cloud = dataset[0][OBS_POINT_CLOUD].numpy()
    off = np.linalg.norm(cloud[:, None] - points[None], axis=-1).min(axis=1)
    assert np.median(off) < 0.002


# Data made elsewhere ------------------------------------------------------------------------------------------------


def write_zarr(path, *, channels=6, lengths=(5, 7), without=(), fill=0):
    """Write demonstrations in DP3's layout."""
    zarr = pytest.importorskip("zarr")
    rng = np.random.default_rng(0)
    n_steps = sum(lengths)
    arrays = {
        "data/point_cloud": rng.uniform(-0.1, 1.0, (n_steps, 600, channels)),
        "data/state": rng.normal(size=(n_steps, 9)),
        "data/action": rng.normal(size=(n_steps, 4)),
        "data/img": np.zeros((n_steps, 4, 4, 3)),
        "meta/episode_ends": np.cumsum(lengths),
    }
    arrays["data/point_cloud"][:, 600 - fill :] = 0
    group = zarr.open_group(str(path), mode="w", zarr_format=2)
    for key, values in arrays.items():
        if key not in without:
            group.create_array(key, data=values.astype(np.int64 if key.startswith("meta") else np.float32))
    return arrays


def test_dp3s_zarr(tmp_path, caplog):
    arrays = write_zarr(tmp_path / "drawer.zarr")
    dataset = convert(config(tmp_path / "drawer.zarr", tmp_path / "clouds", fps=10, task="close the drawer"))
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (2, 12, 10)
    for index in range(12):
        frame = dataset[index]
        np.testing.assert_array_equal(frame["observation.state"], arrays["data/state"][index].astype(np.float32))
        np.testing.assert_array_equal(frame["action"], arrays["data/action"][index].astype(np.float32))
        cloud, source = frame[OBS_POINT_CLOUD].numpy(), arrays["data/point_cloud"][index, :, :3].astype(np.float32)
        assert CROP.contains(cloud).all()
        assert set(map(tuple, cloud)) <= set(map(tuple, source))
        assert len(np.unique(cloud, axis=0)) == N_CLOUD_POINTS
        assert (frame["task"], frame["episode_index"]) == ("close the drawer", index >= 5)
    assert "Not kept: data/img, colours of data/point_cloud." in caplog.messages


def test_colours_are_kept_when_asked_for(tmp_path, caplog):
    arrays = write_zarr(tmp_path / "drawer.zarr")
    dataset = convert(config(tmp_path / "drawer.zarr", tmp_path / "clouds", fps=10, colour=True))
    assert dataset.features[OBS_POINT_CLOUD]["shape"] == (N_CLOUD_POINTS, 6)
    assert dataset.features[OBS_POINT_CLOUD]["names"] == ["point", "xyzrgb"]
    for index in (0, 11):
        cloud, source = dataset[index][OBS_POINT_CLOUD].numpy(), arrays["data/point_cloud"][index].astype(np.float32)
        assert set(map(tuple, cloud)) <= set(map(tuple, source))
    assert "Not kept: data/img." in caplog.messages
    write_zarr(tmp_path / "grey.zarr", channels=3)
    with pytest.raises(UserError, match=r"--colour=true needs points with RGB after xyz, \(N, 6\), got \(600, 3\) in"):
        convert(config(tmp_path / "grey.zarr", tmp_path / "grey", fps=10, colour=True))


@pytest.mark.usefixtures("calibrated")
def test_depth_has_no_colours(depth_dataset, tmp_path):
    with pytest.raises(UserError, match="depth images have none"):
        convert(config(depth_dataset.root, tmp_path / "clouds", colour=True))


def test_colours_beside_the_points(tmp_path, caplog):
    """observation.pointcloud.xyz and .rgb, as datasets on the Hub have them."""
    features = {
        "observation.pointcloud.xyz": {"dtype": "float32", "shape": (90, 3), "names": None},
        "observation.pointcloud.rgb": {"dtype": "uint8", "shape": (90, 3), "names": None},
        "observation.state": {"dtype": "float32", "shape": (7,), "names": None},
        "action": {"dtype": "float32", "shape": (7,), "names": None},
    }
    source = write_dataset(tmp_path / "source", n_episodes=1, length=4, features=features)
    wide = {"crop_low": (-5, -5, -5), "crop_high": (5, 5, 5)}
    dataset = convert(config(source.root, tmp_path / "clouds", colour=True, **wide))
    theirs = np.concatenate([source[2][f"observation.pointcloud.{part}"].numpy() for part in ("xyz", "rgb")], axis=1)
    assert set(map(tuple, dataset[2][OBS_POINT_CLOUD].numpy())) <= set(map(tuple, theirs))
    assert not [message for message in caplog.messages if message.startswith("Not kept")]
    convert(config(source.root, tmp_path / "plain", **wide))
    assert "Not kept: observation.pointcloud.rgb." in caplog.messages


def test_without_a_crop_all_points_count(tmp_path):
    write_zarr(tmp_path / "a.zarr", channels=3)
    dataset = convert(config(tmp_path / "a.zarr", tmp_path / "clouds", fps=10, crop_low=None, crop_high=None))
    assert dataset.meta.stats[OBS_POINT_CLOUD]["min"].min() < -0.05
    assert dataset.features[OBS_POINT_CLOUD]["info"]["crop"] is None


@pytest.mark.parametrize("colours", [0, 3])
def test_the_layout_of_lerobots_open_pull_request(tmp_path, colours, caplog):
    """PR 4696: observation.pointcloud (N, 3 or 6), intrinsics (3, 3) and extrinsics (4, 4) by camera."""
    features = {
        "observation.pointcloud": {"dtype": "float32", "shape": (90, 3 + colours), "names": None},
        "observation.intrinsics.front": {"dtype": "float32", "shape": (3, 3), "names": None},
        "observation.extrinsics.front": {"dtype": "float32", "shape": (4, 4), "names": None},
        "observation.state": {"dtype": "float32", "shape": (7,), "names": None},
        "action": {"dtype": "float32", "shape": (7,), "names": None},
    }
    source = write_dataset(tmp_path / "source", n_episodes=2, length=4, features=features)
    dataset = convert(config(source.root, tmp_path / "clouds", crop_low=(-5, -5, -5), crop_high=(5, 5, 5)))
    assert dataset.num_frames == source.num_frames
    theirs = source[3]["observation.pointcloud"].numpy()[:, :3]
    assert set(map(tuple, dataset[3][OBS_POINT_CLOUD].numpy())) <= set(map(tuple, theirs))
    left_out = ["observation.intrinsics.front", "observation.extrinsics.front"]
    left_out += ["colours of observation.pointcloud"] if colours else []
    assert f"Not kept: {', '.join(left_out)}." in caplog.messages


def write_with_calibration(
    root, pose_of=lambda index: np.array(make_camera().X_world_camera), focal_of=lambda _: 57.6, n_episodes=1
):
    """Depth beside its camera's calibration, in the layout of LeRobot's PR 4696."""
    camera = make_camera()

    def intrinsics(index):
        return np.array([[focal_of(index), 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])

    columns = {"observation.intrinsics.front": intrinsics, "observation.extrinsics.front": pose_of}
    return write_depth_dataset(root, video=False, n_episodes=n_episodes, length=3, columns=columns)


def test_a_calibration_beside_the_depth_is_used(tmp_path, monkeypatch, caplog):
    """PR 4696: intrinsics (3, 3) and extrinsics (4, 4), camera to world, in each frame."""
    monkeypatch.delenv(CALIBRATION_VARIABLE, raising=False)
    source = write_with_calibration(tmp_path / "source")
    dataset = convert(config(source.root, tmp_path / "clouds"))
    assert "Calibrations in the dataset are used: camera front." in caplog.text
    assert "Not kept" not in caplog.text
    recipe = CloudRecipe.from_dict(dataset.features[OBS_POINT_CLOUD]["info"][RECIPE_INFO])
    camera, expected = recipe.sources[0].calibration.camera, make_camera()
    assert (camera.width, camera.height) == (expected.width, expected.height)
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [57.6, expected.fy, 30.72, 24.48])
    np.testing.assert_allclose(camera.X_world_camera, expected.X_world_camera, atol=1e-7)
    for index in range(3):
        np.testing.assert_array_equal(dataset[index][OBS_POINT_CLOUD], recipe.make()([live_frame(index)]))
        np.testing.assert_allclose(
            dataset[index][OBS_POINT_CLOUD], make_recipe().make()([live_frame(index)]), atol=1e-5
        )


@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 1), (1, 48, 64)])
def test_a_calibration_is_of_the_images_size_wherever_their_channel_is(tmp_path, shape):
    dataset = write_with_calibration(tmp_path / "source")
    assert dataset.features[DEPTH_KEY]["shape"] == (48, 64, 1)
    dataset.features[DEPTH_KEY]["shape"] = shape
    camera = recorded_calibrations(dataset)["front"].camera
    assert (camera.height, camera.width) == (48, 64)


def test_episodes_in_which_the_camera_stood_elsewhere_can_be_left_out(tmp_path, monkeypatch):
    monkeypatch.delenv(CALIBRATION_VARIABLE, raising=False)

    def bumped(index):
        pose = np.array(make_camera().X_world_camera)
        pose[0, 3] += 0.02 * (index >= 3)
        return pose

    source = write_with_calibration(tmp_path / "source", pose_of=bumped, n_episodes=2)
    with pytest.raises(UserError, match=r"moves by 20\.0 mm and 0\.00 deg in the dataset, first in episode 1 "):
        convert(config(source.root, tmp_path / "clouds"))
    dataset = convert(config(source.root, tmp_path / "clouds", episodes=[1]))
    pose = CloudRecipe.from_dict(dataset.features[OBS_POINT_CLOUD]["info"][RECIPE_INFO]).sources[0].calibration
    np.testing.assert_allclose(pose.camera.X_world_camera, bumped(3), atol=1e-7)


def test_a_calibration_beside_the_depth_must_be_right(tmp_path, monkeypatch):
    monkeypatch.delenv(CALIBRATION_VARIABLE, raising=False)

    def moving(index):
        pose = np.array(make_camera().X_world_camera)
        pose[0, 3] += 0.02 * index
        return pose

    wrong = {
        "Camera 'front' moves by 40.0 mm and 0.00 deg in the dataset, first in episode 0 ": {"pose_of": moving},
        "must be the same in all frames, it changes by 2, first in episode 0: ": {"focal_of": lambda index: 57 + index},
        "pose must hold a rotation": {"pose_of": lambda _: np.diag([2.0, 1, 1, 1])},
    }
    for number, (message, each) in enumerate(wrong.items()):
        source = write_with_calibration(tmp_path / str(number), **each)
        with pytest.raises(UserError, match=message):
            convert(config(source.root, tmp_path / "clouds"))
    make_calibration(make_camera(position=(-0.2, 0.05, 0.7))).write(tmp_path / "mine")
    source = tmp_path / "0"
    dataset = convert(config(source, tmp_path / "clouds", calibration=str(tmp_path / "mine")))  # what is given counts
    recipe = CloudRecipe.from_dict(dataset.features[OBS_POINT_CLOUD]["info"][RECIPE_INFO])
    assert recipe.sources[0].calibration.camera.position[0] == -0.2


def write_folder(folder, kind, *, n_frames=4):
    plyfile = pytest.importorskip("plyfile")
    rng = np.random.default_rng(0)
    folder.mkdir()
    rows, clouds = [], []
    for index in range(n_frames):
        points = rng.uniform([0.1, -0.4, 0], [1, 0.4, 0.5], (200, 3)).astype(np.float32)
        points[:10] = np.nan
        name = f"{index}.{kind}"
        if kind == "npz":
            np.savez(folder / name, points=points)
        else:
            channels = [*((axis, "f4") for axis in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
            vertices = np.array([(*p, 10, 20, 30) for p in points.tolist()], dtype=channels)
            plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")]).write(str(folder / name))
        rows.append(
            [name, index // 2, f"task {index // 2}", *rng.normal(size=3).round(3), *rng.normal(size=2).round(3)]
        )
        clouds.append(points)
    with (folder / "frames.csv").open("w", newline="") as opened:
        writer = csv.writer(opened)
        writer.writerow(["file", "episode", "task", "state_x", "state_y", "state_z", "action_x", "action_grip"])
        writer.writerows(rows)
    return rows, clouds


@pytest.mark.parametrize("kind", ["npz", "ply"])
def test_a_folder_of_files(tmp_path, kind):
    rows, clouds = write_folder(tmp_path / "recorded", kind)
    dataset = convert(config(tmp_path / "recorded", tmp_path / "clouds", fps=5))
    assert (dataset.num_episodes, dataset.num_frames) == (2, 4)
    assert dataset.features["action"]["names"] == ["x", "grip"]
    for index, (row, cloud) in enumerate(zip(rows, clouds, strict=True)):
        frame = dataset[index]
        np.testing.assert_allclose(frame["observation.state"], row[3:6], atol=1e-6)
        np.testing.assert_allclose(frame["action"], row[6:], atol=1e-6)
        assert frame["task"] == row[2]
        assert set(map(tuple, frame[OBS_POINT_CLOUD].numpy())) <= set(map(tuple, cloud))


def test_what_a_folder_holds_besides_is_said(tmp_path, caplog):
    (tmp_path / "recorded").mkdir()
    for index in range(2):
        np.savez(tmp_path / "recorded" / f"{index}.npz", points=np.full((40, 6), 0.1 + index))
    (tmp_path / "recorded" / "frames.csv").write_text(
        "file,episode,state_x,action_x,reward\n0.npz,0,1,2,3\n1.npz,0,1,2,3\n"
    )
    convert(config(tmp_path / "recorded", tmp_path / "clouds", fps=5, crop_low=None, crop_high=None))
    assert "Not kept: column reward, the points' colours." in caplog.messages
    assert "No task is given: --task says in a sentence what the robot does." in caplog.messages


def test_an_episode_of_one_frame_is_named(tmp_path):
    write_folder(tmp_path / "recorded", "npz", n_frames=5)
    with pytest.raises(UserError, match="Episode 2 must have at least 2 frames, got 1: leave it out by --episodes"):
        convert(config(tmp_path / "recorded", tmp_path / "clouds", fps=5))
    assert not (tmp_path / "clouds").exists()
    assert convert(config(tmp_path / "recorded", tmp_path / "clouds", fps=5, episodes=[0, 1])).num_episodes == 2


@pytest.mark.parametrize("key", ["observation.state", "action"])
def test_a_dataset_without_what_is_learned(tmp_path, key):
    features = {
        OBS_POINT_CLOUD: {"dtype": "float32", "shape": (32, 3), "names": None},
        "observation.state": {"dtype": "float32", "shape": (9,), "names": None},
        "action": {"dtype": "float32", "shape": (4,), "names": None},
    }
    del features[key]
    write_dataset(tmp_path / "data", features=features)
    with pytest.raises(UserError, match=rf"must have observation\.state and action; {key} is missing"):
        convert(config(tmp_path / "data", tmp_path / "clouds"))


@pytest.mark.usefixtures("calibrated")
def test_a_damaged_video_is_one_line(tmp_path):
    source = write_depth_dataset(tmp_path / "data", video=True, n_episodes=1)
    (video,) = source.root.rglob("*.mp4")
    video.write_bytes(video.read_bytes()[:300])
    with pytest.raises(UserError, match=r"^Frame 0 of episode 0 of '.*data' cannot be read: \w+: ") as error:
        convert(config(source.root, tmp_path / "clouds"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["image", "video"])
@pytest.mark.usefixtures("calibrated")
def test_pictures_that_no_cloud_is_made_of_are_not_decoded(tmp_path, kind, caplog):
    picture = {"dtype": kind, "shape": (32, 48, 3), "names": ["height", "width", "channels"]}
    depth = {**picture, "dtype": "image", "shape": (48, 64, 1), "info": {"is_depth_map": True}}
    vector = {"dtype": "float32", "shape": (2,), "names": None}
    features = {"observation.state": vector, "action": vector, "observation.images.rgb": picture, DEPTH_KEY: depth}
    source = LeRobotDataset.create("test/both", 20, features=features, root=tmp_path / "data")
    for index in range(3):
        pictures = {
            "observation.images.rgb": np.zeros((32, 48, 3), np.uint8),
            DEPTH_KEY: live_frame(index).reshape(48, 64, 1),
        }
        vectors = {name: np.full(2, index, np.float32) for name in ("observation.state", "action")}
        source.add_frame({**pictures, **vectors, "task": "push"})
    source.save_episode()
    source.finalize()
    for video in (tmp_path / "data").rglob("*.mp4"):
        video.write_bytes(b"damaged")
    found = find_source(tmp_path / "data", CROP, "")
    found.make_clouds((CROP.low, CROP.high), N_CLOUD_POINTS, None, [0])
    assert "observation.images.rgb" not in next(found._items(0))
    dataset = convert(config(tmp_path / "data", tmp_path / "clouds"))
    np.testing.assert_array_equal(dataset[2][OBS_POINT_CLOUD].numpy(), make_recipe().make()([live_frame(2)]))
    assert "Not kept: observation.images.rgb." in caplog.messages


@pytest.mark.parametrize(
    ("names", "chosen", "states"),
    [(["1", "2", "3"], [1, 2], [0, 0, 1, 1]), (["2.0", "0.0", "1.0"], [1, 2], [2, 2, 0, 0]), ("abc", [1], [1, 1])],
)
def test_a_folders_episodes_are_chosen_by_their_numbers(tmp_path, names, chosen, states):
    write_folder(tmp_path / "recorded", "npz", n_frames=6)
    rows = [f"{index}.npz,{names[index // 2]},{index // 2},0" for index in range(6)]
    (tmp_path / "recorded" / "frames.csv").write_text("\n".join(["file,episode,state_x,action_x", *rows]) + "\n")
    dataset = convert(config(tmp_path / "recorded", tmp_path / "clouds", fps=5, episodes=chosen))
    assert [float(dataset[index]["observation.state"]) for index in range(4)[: len(states)]] == states


def test_episodes_that_there_are_not(tmp_path):
    write_folder(tmp_path / "recorded", "npz")
    for number, (names, valid) in enumerate({"34": "from 3 to 4", "25": "among 2, 5", "ab": "from 0 to 1"}.items()):
        rows = [f"{index}.npz,{names[index // 2]},0,0" for index in range(4)]
        (tmp_path / "recorded" / "frames.csv").write_text("\n".join(["file,episode,state_x,action_x", *rows]) + "\n")
        with pytest.raises(UserError, match=rf"^episodes must be different ones {valid}, got \[7\]"):
            convert(config(tmp_path / "recorded", tmp_path / f"clouds{number}", fps=5, episodes=[7]))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("file,episode,state_x,state_x,action_x\n0.npz,0,1,2,3\n", "got 'state_x' twice"),
        (
            "file,episode,state_x,action_x\n0.npz,1,2,3\n1.npz,01,2,3\n",
            "must have one name for each episode, got 1 and 01",
        ),
        ("", "it has none"),
    ],
)
def test_a_frames_csv_that_would_lose_something(tmp_path, content, message):
    write_folder(tmp_path / "recorded", "npz")
    (tmp_path / "recorded" / "frames.csv").write_text(content)
    with pytest.raises(UserError, match=message):
        convert(config(tmp_path / "recorded", tmp_path / "clouds", fps=5))


@pytest.mark.usefixtures("calibrated")
def test_two_conversions_can_be_merged(depth_dataset, tmp_path, monkeypatch):
    roots = [tmp_path / "monday", tmp_path / "tuesday"]
    for root, episodes in zip(roots, ([0], [1]), strict=True):
        convert(config(depth_dataset.root, root, episodes=episodes))
    convert(config(depth_dataset.root, tmp_path / "lower", crop_low=(CROP.low[0], CROP.low[1], CROP.low[2] - 0.01)))

    def merge(*roots):
        paths = json.dumps([str(root) for root in roots])
        options = ('--operation.repo_ids=["test/a", "test/b"]', f"--operation.roots={paths}", "--new_repo_id=test/both")
        command = ["lerobot-uca-edit-dataset", "--repo_id=test/a", "--operation.type=merge", *options]
        monkeypatch.setattr(sys, "argv", [*command, f"--new_root={tmp_path / 'both'}"])
        edit_dataset.run()

    with pytest.raises(UserError, match="Same features is expected"):
        merge(roots[0], tmp_path / "lower")
    merge(*roots)
    assert LeRobotDataset("test/both", root=tmp_path / "both").num_episodes == 2


def test_days_between_which_the_camera_was_calibrated_anew_can_be_merged(depth_dataset, tmp_path, calibrated, caplog):
    roots = [tmp_path / "monday", tmp_path / "tuesday"]
    for root, x in zip(roots, (0.0, 0.003), strict=True):
        camera = make_camera()
        pose = np.array(camera.X_world_camera)
        pose[0, 3] += x
        replace(make_calibration(), camera=replace(camera, X_world_camera=as_pose(pose))).write(calibrated)
        convert(config(depth_dataset.root, root))
    metadata = [LeRobotDataset("test/clouds", root=root).meta for root in roots]
    edit_dataset._unite_recipes(metadata)
    assert metadata[0].features == metadata[1].features
    assert RECIPE_INFO in metadata[0].features[OBS_POINT_CLOUD]["info"]
    assert f"In '{roots[1]}' camera 'front' is 3.0 mm and 0.00 deg from where it was." in caplog.text


def test_collected_clouds_of_two_crops_lose_their_recipe_when_merged(tmp_path, caplog):
    """Several tasks that are collected together have none either."""
    recipes = [make_recipe(), replace(make_recipe(), crop=Crop((0, 0, 0), (1, 1, 1)))]
    metadata = [write_dataset(tmp_path / str(index)).meta for index in range(2)]
    for meta, recipe in zip(metadata, recipes, strict=True):
        meta.features[OBS_POINT_CLOUD]["info"] = {RECIPE_INFO: recipe.as_dict()}
    edit_dataset._unite_recipes(metadata)
    assert [meta.features[OBS_POINT_CLOUD]["info"] for meta in metadata] == [{}, {}]
    assert "Not kept: the recipe of the clouds" in caplog.text


@pytest.mark.parametrize("damage", ["info", "rows", "no rows"])
def test_a_damaged_dataset_is_one_line(tmp_path, damage):
    write_dataset(tmp_path / "data")
    (rows,) = (tmp_path / "data" / "data").rglob("*.parquet")
    if damage == "info":
        (tmp_path / "data" / "meta" / "info.json").write_text("{")
    elif damage == "rows":
        rows.write_bytes(rows.read_bytes()[:500])
    else:
        rows.unlink()
    with pytest.raises(UserError, match=r"data' cannot be read: ") as error:
        convert(config(tmp_path / "data", tmp_path / "clouds"))
    assert "\n" not in str(error.value)


def test_colours_of_ply_files(tmp_path):
    write_folder(tmp_path / "recorded", "ply")
    dataset = convert(config(tmp_path / "recorded", tmp_path / "clouds", fps=5, colour=True))
    cloud = dataset[0][OBS_POINT_CLOUD].numpy()
    np.testing.assert_array_equal(cloud[:, 3:], np.broadcast_to([10, 20, 30], (N_CLOUD_POINTS, 3)))


# The report ---------------------------------------------------------------------------------------------------------


def test_a_report_tells_what_is_wrong_and_nothing_is_written(tmp_path):
    _, clouds = write_folder(tmp_path / "recorded", "npz")
    np.savez(tmp_path / "recorded" / "3.npz", points=clouds[3][:20] + 5)
    with pytest.raises(UserError, match="Episode 1 has 1 of 2 frames with fewer than 6 points inside the crop, the fi"):
        convert(config(tmp_path / "recorded", tmp_path / "clouds", fps=5, report=tmp_path / "report"))
    assert not (tmp_path / "clouds").exists()
    text = (tmp_path / "report" / "report.txt").read_text()
    assert "2 episodes, 4 frames" in text
    assert "points inside the crop a frame: at least 0, median" in text
    assert "frames with fewer than 6 points: 1 (episode 1 frame 1)" in text
    assert "share of invalid depth or points: median 5.0%, at most 50.0%" in text
    assert "state dimensions that are constant: none" in text
    assert (tmp_path / "report" / "report.png").stat().st_size > 5000


def test_a_report_says_where_the_points_are_that_an_empty_frame_lacks(tmp_path):
    """One empty frame in each episode: the others tell how to move the crop."""
    write_folder(tmp_path / "recorded", "npz")
    for index, points in ((0, np.full((40, 3), 9.0)), (2, np.full((40, 3), 9.0))):
        np.savez(tmp_path / "recorded" / f"{index}.npz", points=points.astype(np.float32))
    report = {"report": tmp_path / "report", "fps": 5}
    with pytest.raises(UserError, match="Episode 0 has 1 of 2 frames with fewer than"):
        convert(config(tmp_path / "recorded", tmp_path / "clouds", **report))
    (line,) = [line for line in (tmp_path / "report" / "report.txt").read_text().splitlines() if "clouds lie" in line]
    low, high = (json.loads(part) for part in re.findall(r"\[.*?\]", line))
    assert np.all(np.array(low) >= CROP.low)
    assert np.all(np.array(high) <= CROP.high)
    nowhere = {"crop_low": (-3, -3, -3), "crop_high": (-2, -2, -2)}
    with pytest.raises(UserError, match="Episode 0 has 2 of 2"):
        convert(config(tmp_path / "recorded", tmp_path / "clouds", **report, **nowhere))
    assert "clouds lie in (normalisation range): nowhere" in (tmp_path / "report" / "report.txt").read_text()


def test_a_report_that_would_be_lost_is_refused_before_the_work(tmp_path):
    write_folder(tmp_path / "recorded", "npz")
    (tmp_path / "file").touch()
    for report, message in (("clouds/report", "must lie outside the new dataset"), ("file", "Cannot write the report")):
        with pytest.raises(UserError, match=message):
            convert(config(tmp_path / "recorded", tmp_path / "clouds", fps=5, report=tmp_path / report))
        assert not (tmp_path / "clouds").exists()


@pytest.mark.usefixtures("calibrated")
def test_a_report_of_depth(depth_dataset, tmp_path):
    convert(config(depth_dataset.root, tmp_path / "clouds", report=tmp_path / "report"))
    text = (tmp_path / "report" / "report.txt").read_text()
    share = np.mean([((frame == 0) | (frame >= 10000)).mean() for frame in map(live_frame, range(12))])
    assert f"share of invalid depth or points: median {share:.1%}" in text
    n_points = [len(make_recipe().make().points([live_frame(index)])) for index in range(12)]
    assert f"at least {min(n_points)}, median {np.median(n_points):.0f}" in text


# Wrong input --------------------------------------------------------------------------------------------------------


def test_wrong_sources(tmp_path, depth_dataset, monkeypatch):
    monkeypatch.delenv(CALIBRATION_VARIABLE, raising=False)
    write_zarr(tmp_path / "a.zarr", without=("data/state",))
    write_zarr(tmp_path / "ends.zarr", lengths=(5, 7), without=("meta/episode_ends",))
    (tmp_path / "empty.zarr").mkdir()
    group = pytest.importorskip("zarr").open_group(str(tmp_path / "group.zarr"), mode="w")
    group.create_group("data/state")
    write_folder(tmp_path / "recorded", "npz")
    (tmp_path / "columns").mkdir()
    (tmp_path / "columns" / "frames.csv").write_text("file,episode\na,0\n")
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "frames.csv").write_text("file,episode,state_x,action_x\na.npz,0,1,2\n")
    wrong = {
        "must be a LeRobot dataset": config(tmp_path / "nothing", tmp_path / "out"),
        "data/state is missing, got data/action, data/img": config(tmp_path / "a.zarr", tmp_path / "out", fps=5),
        "meta/episode_ends is missing": config(tmp_path / "ends.zarr", tmp_path / "out", fps=5),
        "data/point_cloud, data/state, data/action": config(tmp_path / "group.zarr", tmp_path / "out", fps=5),
        "cannot be read as zarr": config(tmp_path / "empty.zarr", tmp_path / "out", fps=5),
        "must have the columns file, episode, state_": config(tmp_path / "columns", tmp_path / "out", fps=5),
        "a.npz' .frames.csv. cannot be read": config(tmp_path / "files", tmp_path / "out", fps=5),
        "does not say how many steps a second": config(tmp_path / "recorded", tmp_path / "out"),
        "Camera 'front' needs a calibration": config(depth_dataset.root, tmp_path / "out"),
        "Give both crop_low and crop_high": config(depth_dataset.root, tmp_path / "out", crop_low=None),
        "low below high": config(depth_dataset.root, tmp_path / "out", crop_low=(1, 1, 1), crop_high=(0, 0, 0)),
        "episodes must be different ones from 0 to 1, got .2.": config(
            tmp_path / "recorded", tmp_path / "out", fps=5, episodes=[2]
        ),
        "n_points must be at least 1": config(tmp_path / "recorded", tmp_path / "out", fps=5, n_points=0),
        "repo_id must be 'user/name'": config(tmp_path / "recorded", tmp_path / "out", fps=5, repo_id="a/b/c"),
    }
    for message, each in wrong.items():
        with pytest.raises(UserError, match=message):
            convert(each)
    assert not (tmp_path / "out").exists()


def damage_zarr(path, key, **changes):
    group = pytest.importorskip("zarr").open_group(str(path), mode="a")
    del group[key]
    group.create_array(key, **changes)


def damage_chunk(path):
    chunk = next(file for file in sorted((path / "data" / "state").iterdir()) if not file.name.startswith("."))
    chunk.write_bytes(b"\xff" * chunk.stat().st_size)


DAMAGE = {
    "a chunk": (damage_chunk, "data/state cannot be read"),
    "text": (lambda path: damage_zarr(path, "data/state", data=np.full((12, 2), "a")), "data/state must hold real nu"),
    "complex": (
        lambda path: damage_zarr(path, "data/point_cloud", data=np.ones((12, 600, 3), complex)),
        "data/point_cloud must hold real numbers, got complex128",
    ),
    "episode_ends of two dimensions": (
        lambda path: damage_zarr(path, "meta/episode_ends", data=np.array([[5, 12]])),
        "meta/episode_ends must be whole numbers",
    ),
    "episode_ends with fractions": (
        lambda path: damage_zarr(path, "meta/episode_ends", data=np.array([4.5, 12])),
        "meta/episode_ends must be whole numbers",
    ),
    "states of two dimensions": (
        lambda path: damage_zarr(path, "data/state", data=np.ones((12, 2, 3), np.float32)),
        r"data/state must have shape \(steps, numbers\), got \(12, 2, 3\)",
    ),
}


@pytest.mark.parametrize(("damage", "message"), DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_zarr_is_one_line(tmp_path, damage, message):
    write_zarr(tmp_path / "a.zarr")
    damage(tmp_path / "a.zarr")
    with pytest.raises(UserError, match=message):
        convert(config(tmp_path / "a.zarr", tmp_path / "clouds", fps=5))
    assert not (tmp_path / "clouds").exists()


def replace_row(folder, row):
    lines = (folder / "frames.csv").read_text().splitlines()
    (folder / "frames.csv").write_text("\n".join([*lines[:-1], row]) + "\n")


DAMAGED_FILES = {
    "truncated": (
        lambda folder: (folder / "1.npz").write_bytes((folder / "1.npz").read_bytes()[:500]),
        "cannot be",
    ),
    "empty": (lambda folder: (folder / "1.npz").write_bytes(b""), "cannot be read"),
    "text": (lambda folder: np.savez(folder / "1.npz", points=np.full((200, 3), "a")), "must be real numbers, got <U1"),
    "complex": (lambda folder: np.savez(folder / "1.npz", points=np.ones((200, 3), complex)), "must be real numbers"),
    "a short row": (
        lambda folder: replace_row(folder, "3.npz,1"),
        "for each column in each row, row 5 has not",
    ),
    "a long row": (lambda folder: replace_row(folder, "3.npz,1,a,1,2,3,4,5,6"), "row 5 has not"),
}


@pytest.mark.parametrize(("damage", "message"), DAMAGED_FILES.values(), ids=DAMAGED_FILES)
def test_a_damaged_file_is_one_line(tmp_path, damage, message):
    write_folder(tmp_path / "recorded", "npz")
    damage(tmp_path / "recorded")
    with pytest.raises(UserError, match=message):
        convert(config(tmp_path / "recorded", tmp_path / "clouds", fps=5))


def test_a_spreadsheets_frames_csv_is_read(tmp_path):
    write_folder(tmp_path / "recorded", "npz")
    file = tmp_path / "recorded" / "frames.csv"
    file.write_text(file.read_text(), encoding="utf-8-sig")
    assert convert(config(tmp_path / "recorded", tmp_path / "clouds", fps=5)).num_episodes == 2


def test_states_that_are_not_numbers_are_said(tmp_path, caplog):
    write_folder(tmp_path / "recorded", "npz")
    replace_row(tmp_path / "recorded", "3.npz,1,task,nan,0,0,0,0")
    convert(config(tmp_path / "recorded", tmp_path / "clouds", fps=5))
    assert "The state of the episodes [1] holds NaN or infinite values; training refuses them." in caplog.messages


@pytest.mark.usefixtures("calibrated")
def test_clouds_converted_again_are_as_many_points_on_the_robot(depth_dataset, tmp_path, caplog):
    convert(config(depth_dataset.root, tmp_path / "clouds"))
    again = config(tmp_path / "clouds", tmp_path / "fewer", n_points=16, crop_low=None, crop_high=None, fps=7, task="a")
    dataset = convert(again)
    recipe = CloudRecipe.from_dict(dataset.features[OBS_POINT_CLOUD]["info"][RECIPE_INFO])
    assert recipe.n_points == dataset.features[OBS_POINT_CLOUD]["shape"][0] == 16
    assert (dataset.fps, dataset[0]["task"]) == (20, "push")
    assert "--fps and --task are for sources without them; a LeRobot dataset keeps its own." in caplog.messages


@pytest.mark.usefixtures("calibrated")
def test_clouds_cropped_again_are_not_what_a_robot_makes(depth_dataset, tmp_path, caplog):
    convert(config(depth_dataset.root, tmp_path / "clouds"))
    wide = {"crop_low": tuple(x - 1 for x in CROP.low), "crop_high": tuple(x + 1 for x in CROP.high)}
    for root, crop, has_recipe in (("wide", wide, True), ("tight", {"crop_low": (0.3, *CROP.low[1:])}, False)):
        caplog.clear()
        dataset = convert(config(tmp_path / "clouds", tmp_path / root, **crop))
        assert (RECIPE_INFO in dataset.features[OBS_POINT_CLOUD]["info"]) == has_recipe
        assert (f"Not kept: {LOST_RECIPE}." in caplog.messages) != has_recipe


@pytest.mark.usefixtures("calibrated")
def test_clouds_beside_the_depth_are_not_kept(tmp_path, caplog):
    clouds = {OBS_POINT_CLOUD: lambda index: np.zeros((8, 3), np.float32)}
    source = write_depth_dataset(tmp_path / "data", video=False, columns=clouds)
    convert(config(source.root, tmp_path / "clouds"))
    assert f"Not kept: {OBS_POINT_CLOUD}." in caplog.messages


def test_clouds_beside_the_depth_are_taken_when_asked_for(tmp_path, monkeypatch, caplog):
    monkeypatch.delenv(CALIBRATION_VARIABLE, raising=False)
    columns = {OBS_POINT_CLOUD: lambda index: np.full((16, 3), 0.1 + index, np.float32)}
    source = write_depth_dataset(tmp_path / "data", video=False, columns=columns)
    with pytest.raises(UserError, match=r"The depth makes no clouds: .*needs a calibration.*--use_clouds=true takes"):
        convert(config(source.root, tmp_path / "clouds"))
    whole = {"crop_low": None, "crop_high": None, "n_points": 16, "calibration": str(tmp_path)}
    dataset = convert(config(source.root, tmp_path / "clouds", use_clouds=True, **whole))
    np.testing.assert_allclose(dataset[3][OBS_POINT_CLOUD], 3.1)
    assert "--calibration is for depth; these clouds are taken as they are." in caplog.messages


def test_missing_points_written_as_zeros_are_no_points(tmp_path, caplog):
    """As the baselines' Adroit fills up its clouds, and cameras write pixels without depth."""
    arrays = write_zarr(tmp_path / "a.zarr", fill=100)
    assert (arrays["data/point_cloud"][:, -100:, :3] == 0).all()
    whole = {"crop_low": None, "crop_high": None, "n_points": 510}
    dataset = convert(config(tmp_path / "a.zarr", tmp_path / "clouds", fps=10, **whole))
    assert np.abs(dataset[0][OBS_POINT_CLOUD].numpy()).max(axis=1).min() > 0
    assert "1200 points at (0, 0, 0), which stand for missing ones, were left out." in caplog.messages


def test_points_are_not_repeated_to_make_more(tmp_path):
    write_zarr(tmp_path / "a.zarr")
    with pytest.raises(UserError, match=r"--n_points must be at most 600, the points of .* clouds, got 601\."):
        convert(config(tmp_path / "a.zarr", tmp_path / "clouds", fps=10, n_points=601))


@pytest.mark.parametrize(
    ("root", "message"),
    [("data/raw", r"would replace the source, '.*data/raw': name another folder"), ("data", "holds other things, raw")],
)
@pytest.mark.usefixtures("calibrated")
def test_a_source_is_not_replaced(tmp_path, root, message):
    source = write_depth_dataset(tmp_path / "data" / "raw", video=False)
    with pytest.raises(UserError, match=message):
        convert(config(source.root, tmp_path / root, overwrite=True))
    assert LeRobotDataset("test/depth", root=source.root).num_episodes == 2


def test_no_more_is_held_than_needed():
    """Of an episode the sampled clouds, of a dataset as many episodes as are written and converted meanwhile."""
    alive: list[weakref.ref] = []

    class Recording:
        def frames(self, episode):
            for _ in range(5):
                assert sum(each() is not None for each in alive) <= 1  # the one before, in the caller's hands
                points = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)
                alive.append(weakref.ref(points))
                frame = Frame(points, 1000, 0.0, 0, np.zeros(2, np.float32), np.zeros(2, np.float32), "a")
                del points
                yield frame
                del frame

    assert convert_episode(Recording(), 16, 0).clouds.shape == (5, 16, 3)
    begun = []
    with ThreadPoolExecutor(1) as pool:
        for n_taken, _ in enumerate(command._in_order(pool, begun.append, range(20), n_ahead=2)):
            assert len(begun) <= n_taken + 1 + 2
    assert begun == list(range(20))


@pytest.mark.usefixtures("calibrated")
def test_a_report_without_matplotlib_is_refused_before_the_work(depth_dataset, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setattr(command, "make_source", lambda _: pytest.fail("the work has begun"))
    with pytest.raises(UserError, match="needs matplotlib"):
        convert(config(depth_dataset.root, tmp_path / "clouds", report=tmp_path / "report"))


def test_a_crop_that_leaves_nothing_says_what_it_covers(depth_dataset, tmp_path, calibrated):
    elsewhere = {"crop_low": (0.2, 5.0, 0.01), "crop_high": (0.9, 6.0, 0.4)}
    with pytest.raises(
        UserError, match=r"the first is frame 0 with 0. Camera 'front' has .* y of 0%, z of \d\d%. Move"
    ):
        convert(config(depth_dataset.root, tmp_path / "out", **elsewhere))
    write_folder(tmp_path / "recorded", "npz")
    with pytest.raises(
        UserError, match=r"frame 0 with 0. The cloud has 190 finite points from \[0.1.*; the crop is \(0.2"
    ):
        convert(config(tmp_path / "recorded", tmp_path / "out", fps=5, **elsewhere))
    assert not (tmp_path / "out").exists()


def test_depth_needs_a_crop(depth_dataset, tmp_path, calibrated):
    with pytest.raises(UserError, match="A cloud from depth needs a crop"):
        convert(config(depth_dataset.root, tmp_path / "out", crop_low=None, crop_high=None))


@pytest.mark.usefixtures("calibrated")
def test_a_full_disk_leaves_nothing(depth_dataset, tmp_path, monkeypatch):
    def full(self):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(LeRobotDataset, "save_episode", full)
    with pytest.raises(UserError, match=r"Cannot write .*No space left on device"):
        convert(config(depth_dataset.root, tmp_path / "out"))
    assert [path.name for path in tmp_path.iterdir()] == ["calibration"]


@pytest.mark.usefixtures("calibrated")
def test_the_command(depth_dataset, tmp_path, monkeypatch, capsys):
    arguments = [
        *(f"--source={depth_dataset.root}", "--repo_id=test/clouds", f"--root={tmp_path / 'clouds'}"),
        *(f"--crop_low={list(CROP.low)}", f"--crop_high={list(CROP.high)}", "--n_points=48", "--episodes=[0]"),
    ]
    monkeypatch.setattr(sys, "argv", ["lerobot-uca-convert", *arguments])
    command.run()
    assert f"1 episodes, 6 frames of 48 points: {tmp_path / 'clouds'}" in capsys.readouterr().out
    assert json.loads((tmp_path / "clouds" / "meta" / "info.json").read_text())["total_frames"] == 6
    assert DEPTH_KEY not in LeRobotDataset("test/clouds", root=tmp_path / "clouds").features


def test_an_episode_that_cannot_be_read_can_be_left_out(tmp_path):
    write_folder(tmp_path / "recorded", "npz")
    (tmp_path / "recorded" / "0.npz").write_bytes(b"damaged")
    dataset = convert(config(tmp_path / "recorded", tmp_path / "clouds", fps=5, episodes=[1]))
    assert dataset.num_episodes == 1


def test_clouds_that_there_are_not_cannot_be_taken(depth_dataset, tmp_path):
    with pytest.raises(UserError, match="--use_clouds=true needs a LeRobot dataset with clouds, got"):
        convert(config(depth_dataset.root, tmp_path / "clouds", use_clouds=True))
