"""Looking at clouds."""

import sys
import urllib.request

import numpy as np
import pytest
import yaml
from tests.depth_builders import CROP, live_frame, make_calibration, make_recipe, write_depth_dataset

from lerobot_uca.envs.configs import MetaworldPointCloudConfig
from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.recipe import CALIBRATION_VARIABLE
from lerobot_uca.visual import view as command
from lerobot_uca.visual.view import ViewConfig, clouds_of, colours_of, view, write_crop


@pytest.fixture(scope="module")
def depth_dataset(tmp_path_factory):
    return write_depth_dataset(tmp_path_factory.mktemp("depth") / "data", video=False, n_episodes=1)


@pytest.fixture
def calibrated(tmp_path, monkeypatch):
    make_calibration().write(tmp_path / "calibration")
    monkeypatch.setenv(CALIBRATION_VARIABLE, str(tmp_path / "calibration"))


@pytest.mark.usefixtures("calibrated")
def test_depth_is_seen_inside_and_outside_the_crop(depth_dataset):
    clouds = list(clouds_of(ViewConfig(source=depth_dataset.root)))
    assert len(clouds) == 6
    inside = clouds[2][CROP.contains(clouds[2])]
    assert len(inside) == len(make_recipe().make().points([live_frame(2)])) < len(clouds[2])
    colours = colours_of(clouds[2], CROP)
    assert (colours == command.INSIDE).all(axis=1).sum() == len(inside)


def test_colours_are_the_points_own_where_they_have_some():
    points = np.array([[0.5, 0, 0.1, 1.0, 0.5, 0], [5, 5, 5, 1.0, 0.5, 0]], dtype=np.float32)
    np.testing.assert_array_equal(colours_of(points, CROP), [(255, 127, 0), command.OUTSIDE])
    points[0, 3:] = (200, 100, 0)
    np.testing.assert_array_equal(colours_of(points, CROP)[0], (200, 100, 0))
    np.testing.assert_array_equal(colours_of(points[:, :3], CROP), [command.INSIDE, command.OUTSIDE])


def test_an_environment():
    (cloud,) = clouds_of(ViewConfig(env=MetaworldPointCloudConfig(task="reach", n_points=64), episode=3))
    assert cloud.shape == (64, 3)


@pytest.mark.usefixtures("calibrated")
def test_a_picture_and_a_recording(depth_dataset, tmp_path, monkeypatch, capsys):
    pytest.importorskip("rerun")
    picture, recording = tmp_path / "cloud.png", tmp_path / "cloud.rrd"
    arguments = [f"--source={depth_dataset.root}", f"--output={picture}", f"--rrd={recording}"]
    monkeypatch.setattr(sys, "argv", ["lerobot-uca-view", *arguments])
    command.run()
    assert f"Written: {picture}, {recording}" in capsys.readouterr().out
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert recording.read_bytes().startswith(b"RRF")


@pytest.mark.usefixtures("calibrated")
def test_the_page_is_served_on_this_machine_only(depth_dataset):
    pytest.importorskip("viser")
    server = view(ViewConfig(source=depth_dataset.root, crop_low=CROP.low, crop_high=CROP.high, port=18080))
    try:
        assert server.get_host() == "127.0.0.1"
        with urllib.request.urlopen(f"http://127.0.0.1:{server.get_port()}") as page:
            assert b"<html" in page.read().lower()
    finally:
        server.stop()


def test_the_crop_is_written_into_a_training_configuration(tmp_path):
    file = tmp_path / "mine.yaml"
    write_crop(file, CROP)
    file.write_text(file.read_text() + "batch_size: 64\n")
    write_crop(file, CROP)
    settings = yaml.safe_load(file.read_text())
    assert settings == {
        "policy": {"depth": {"crop_low": list(CROP.low), "crop_high": list(CROP.high)}},
        "batch_size": 64,
    }
    file.write_text("- 1")
    with pytest.raises(UserError, match="must be a training configuration, got list"):
        write_crop(file, CROP)
    with pytest.raises(UserError, match="Cannot write"):
        write_crop(tmp_path / "missing" / "mine.yaml", CROP)


def test_wrong_input(depth_dataset, tmp_path, monkeypatch):
    monkeypatch.delenv(CALIBRATION_VARIABLE, raising=False)
    wrong = {
        "Give either --source or --env.type": ViewConfig(),
        "Camera 'front' needs a calibration": ViewConfig(source=depth_dataset.root),
        "must be a LeRobot dataset": ViewConfig(source=tmp_path),
        "episode must be at least 0": ViewConfig(source=tmp_path, episode=-1),
    }
    for message, config in wrong.items():
        with pytest.raises(UserError, match=message):
            view(config)


def test_without_a_crop_the_box_of_the_points_is_shown():
    points = np.random.default_rng(0).uniform(0, 1, (1000, 3)).astype(np.float32)
    crop = command.crop_of(ViewConfig(), points)
    np.testing.assert_allclose([crop.low, crop.high], [[0.01] * 3, [0.99] * 3], atol=0.03)
