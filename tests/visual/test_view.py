"""Looking at clouds."""

import re
import socket
import sys
import urllib.request
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from tests.browser import browser, needs_browser
from tests.depth_builders import CROP, live_frame, make_calibration, make_recipe, write_depth_dataset
from tests.forked import run_code
from tests.robots.conftest import wait_until

from lerobot_uca.data.sources.lerobot_source import LeRobotSource
from lerobot_uca.envs.configs import MetaworldPointCloudConfig
from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.point_clouds.recipe import CALIBRATION_VARIABLE
from lerobot_uca.visual import live_camera
from lerobot_uca.visual import view as command
from lerobot_uca.visual.crop_page import INSIDE, OUTSIDE, CropPage, colours_of, write_crop
from lerobot_uca.visual.view import ViewConfig, clouds_of, record, view


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
    assert (colours == INSIDE).all(axis=1).sum() == len(inside)


def test_colours_are_the_points_own_where_they_have_some():
    points = np.array([[0.5, 0, 0.1, 1.0, 0.5, 0], [5, 5, 5, 1.0, 0.5, 0]], dtype=np.float32)
    np.testing.assert_array_equal(colours_of(points, CROP), [(255, 127, 0), OUTSIDE])
    points[0, 3:] = (200, 100, 0)
    np.testing.assert_array_equal(colours_of(points, CROP)[0], (200, 100, 0))
    np.testing.assert_array_equal(colours_of(points[:, :3], CROP), [INSIDE, OUTSIDE])


def test_an_episode_of_a_folder_by_its_number_and_by_default_the_first(tmp_path):
    for index in range(4):
        np.savez(tmp_path / f"{index}.npz", points=np.full((5, 3), (1 + index) / 10, np.float32))
    rows = ["file,episode,state_x,action_x", *(f"{index}.npz,{1 + index // 2},0,0" for index in range(4))]
    (tmp_path / "frames.csv").write_text("\n".join(rows) + "\n")
    for episode, first in ((None, 0.1), (1, 0.1), (2, 0.3)):
        assert next(clouds_of(ViewConfig(source=tmp_path, episode=episode)))[0, 0] == np.float32(first)
    with pytest.raises(UserError, match=r"^episode must be from 1 to 2, got 0\."):
        next(clouds_of(ViewConfig(source=tmp_path, episode=0)))


def test_one_task_of_a_group_has_to_be_named():
    with pytest.raises(UserError, match=r"One task can be viewed, got reach,push: reach, push\."):
        next(clouds_of(ViewConfig(env=MetaworldPointCloudConfig(task="reach,push", n_points=64))))


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
@pytest.mark.parametrize(("options", "n_frames"), [({}, 1), ({"rrd": "cloud.rrd"}, 6)], ids=["picture", "both"])
def test_a_picture_reads_one_frame(depth_dataset, tmp_path, monkeypatch, options, n_frames):
    if options:
        pytest.importorskip("rerun")
    frame, read = LeRobotSource._frame, []
    monkeypatch.setattr(LeRobotSource, "_frame", lambda self, item: read.append(item) or frame(self, item))
    files = {name: tmp_path / file for name, file in {"output": "cloud.png", **options}.items()}
    assert list(view(ViewConfig(source=depth_dataset.root, **files))) == []
    assert len(read) == n_frames
    assert all(file.exists() for file in files.values())


WINDOW = (1100, 700)
PANEL = 340
"""[pixels] The width of the page's right side, which holds its sliders and buttons."""


def free_port() -> int:
    with socket.socket() as opened:
        opened.bind(("127.0.0.1", 0))
        return opened.getsockname()[1]


def n_pixels(picture: np.ndarray, colour: tuple[int, int, int]) -> int:
    """Pixels of about a colour beside the panel; the page lights its points, so that shades differ a little."""
    scene = picture[:, : -PANEL - 20].astype(int)
    return int((np.abs(scene - colour).max(axis=-1) < 30).sum())


@needs_browser
@pytest.mark.usefixtures("calibrated")
def test_a_browser_shows_the_cloud(depth_dataset, tmp_path):
    """Blue points inside the crop and grey ones outside it, on the page as it is served; sliders turn blue to grey."""
    pytest.importorskip("viser")
    config = ViewConfig(source=depth_dataset.root, crop_low=CROP.low, crop_high=CROP.high, port=free_port())
    with closing(view(config)) as pages:
        page = next(pages)
        try:
            with browser(f"http://127.0.0.1:{page.server.get_port()}", tmp_path / "user", WINDOW) as picture:
                wait_until(lambda: min(n_pixels(picture(), colour) for colour in (INSIDE, OUTSIDE)) > 100, 120)
                for slider in page._sliders[:3]:
                    slider.value = slider.max  # the crop holds nothing
                wait_until(lambda: n_pixels(picture(), INSIDE) == 0, 120)
                assert n_pixels(picture(), OUTSIDE) > 100
        finally:
            page.server.stop()


@pytest.mark.usefixtures("calibrated")
def test_the_page_is_served_on_this_machine_only(depth_dataset, tmp_path):
    pytest.importorskip("viser")
    file = tmp_path / "mine.yaml"
    crop = {"crop_low": CROP.low, "crop_high": CROP.high}
    with closing(view(ViewConfig(source=depth_dataset.root, port=free_port(), config=file, **crop))) as pages:
        page = next(pages)
        try:
            assert page.server.get_host() == "127.0.0.1"
            with urllib.request.urlopen(f"http://127.0.0.1:{page.server.get_port()}") as opened:
                assert b"<html" in opened.read().lower()
            page._sliders[2].value = 0.1  # the lowest z
            page.write()
        finally:
            page.server.stop()
    depth = yaml.safe_load(file.read_text())["policy"]["depth"]
    np.testing.assert_allclose(depth["crop_low"], (*CROP.low[:2], 0.1), atol=0.005)
    np.testing.assert_allclose(depth["crop_high"], CROP.high, atol=0.005)


def write_of_page(crop: Crop, points: np.ndarray, file) -> str:
    """What the button says, of a page that shows some points."""
    page = CropPage(free_port(), file, crop, points)
    try:
        page.show(points)
        page.write()
        return page._status.content
    finally:
        page.server.stop()


@pytest.mark.parametrize(
    "points",
    [
        np.random.default_rng(0).uniform(0, 0.5, (500, 3)),
        np.random.default_rng(0).uniform(2, 3, (500, 3)) * [1, 1, 0],
        np.empty((0, 3)),
    ],
    ids=["smaller", "elsewhere, flat", "none"],
)
def test_the_crop_that_is_given_is_the_one_written(points, tmp_path):
    """Wherever an episode's points are, which may be few of those that the crop is for."""
    pytest.importorskip("viser")
    crop = Crop((-0.213, -0.2, -0.05), (0.901, 0.9, 0.6))
    assert "written to" in write_of_page(crop, points.astype(np.float32), tmp_path / "mine.yaml")
    depth = yaml.safe_load((tmp_path / "mine.yaml").read_text())["policy"]["depth"]
    assert (tuple(depth["crop_low"]), tuple(depth["crop_high"])) == (crop.low, crop.high)


def test_sliders_that_make_no_crop_write_none(tmp_path):
    pytest.importorskip("viser")
    points = np.random.default_rng(0).uniform(0, 0.5, (500, 3)).astype(np.float32)
    said = write_of_page(Crop((0.1, 0.2, 0.3), (0.2, 0.3, 0.3)), points, tmp_path / "mine.yaml")
    assert said.startswith("A crop has corners (x, y, z) [m], low below high in each, got")
    assert list(tmp_path.iterdir()) == []


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
    commented = "batch_size: 64 # as in the paper\njob_name: 'run #3'\n"
    file.write_text(commented)
    assert write_crop(file, CROP) == tmp_path / "mine.yaml.old"
    assert write_crop(file, CROP) is None
    assert (tmp_path / "mine.yaml.old").read_text() == commented
    assert yaml.safe_load(file.read_text())["batch_size"] == 64
    for text, message in {
        "- 1": "mine.yaml' must hold options of a training by name, got list",
        "policy: uca_flow": "policy in .*mine.yaml' must hold options of a training by name, got str",
        "policy: {depth: 3}": "policy.depth in .*mine.yaml' must hold options of a training by name, got int",
    }.items():
        file.write_text(text)
        with pytest.raises(UserError, match=message):
            write_crop(file, CROP)
        assert file.read_text() == text
    file.write_bytes("# café".encode("latin-1"))
    with pytest.raises(UserError, match="cannot be read: 'utf-8' codec"):
        write_crop(file, CROP)
    for text in ("", "policy:", "policy:\n  depth:"):
        file.write_text(text)
        write_crop(file, CROP)
        assert yaml.safe_load(file.read_text())["policy"]["depth"]["crop_low"] == list(CROP.low)
    (tmp_path / "train.json").write_text("{}")
    with pytest.raises(UserError, match=r"into a YAML file, such as crop\.yaml, got"):
        write_crop(tmp_path / "train.json", CROP)
    assert (tmp_path / "train.json").read_text() == "{}"
    with pytest.raises(UserError, match="Cannot write"):
        write_crop(tmp_path / "missing" / "mine.yaml", CROP)


class DyingCamera:
    """Gives one frame; then its thread has ended, as LeRobot's RealSense camera says it."""

    use_depth, serial_number, width, height = True, "", 64, 48

    def __init__(self):
        self.frames, self.is_connected = [live_frame(0)], True

    def connect(self):
        pass

    def disconnect(self):
        self.is_connected = False

    def read_latest_depth(self):
        if not self.frames:
            raise RuntimeError("RealSense read thread is not running.")
        return self.frames.pop()


@pytest.mark.usefixtures("calibrated")
def test_a_camera_that_dies_is_said_in_a_line(monkeypatch):
    camera = DyingCamera()
    monkeypatch.setattr(live_camera, "make_cameras_from_configs", lambda _: {"front": camera})
    clouds = live_camera.live_clouds(SimpleNamespace(use_depth=True, type="stub"), "front", None, CROP, 100)
    assert next(clouds).shape[1] == 3
    with pytest.raises(UserError, match=r"Camera 'front' gives no cloud: RealSense read thread is not running\."):
        next(clouds)
    assert not camera.is_connected


@pytest.mark.usefixtures("calibrated")
def test_a_camera_that_is_not_there_is_said_in_a_line(monkeypatch):
    def connect():
        raise ConnectionError("Failed to open it.")

    config, camera = SimpleNamespace(use_depth=True, type="stub"), DyingCamera()
    camera.connect = connect
    monkeypatch.setattr(live_camera, "make_cameras_from_configs", lambda _: {"front": camera})
    with pytest.raises(UserError, match=r"^Camera 'front' cannot be opened: Failed to open it\."):
        next(live_camera.live_clouds(config, "front", None, CROP, 100))

    def make(_):
        raise ValueError("No RealSense camera found with name 'D435'")

    monkeypatch.setattr(live_camera, "make_cameras_from_configs", make)
    with pytest.raises(UserError, match=r"^Camera 'front' cannot be opened: ValueError: No RealSense camera found"):
        next(live_camera.live_clouds(config, "front", None, CROP, 100))


def test_wrong_input(depth_dataset, tmp_path, monkeypatch):
    monkeypatch.delenv(CALIBRATION_VARIABLE, raising=False)
    wrong = {
        "Give one of --source, --env.type and --camera.type": ViewConfig(),
        "Camera 'front' needs a calibration": ViewConfig(source=depth_dataset.root),
        "must be a LeRobot dataset": ViewConfig(source=tmp_path),
        "episode must be at least 0": ViewConfig(source=tmp_path, episode=-1),
    }
    for message, config in wrong.items():
        with pytest.raises(UserError, match=message):
            next(view(config))


@pytest.mark.usefixtures("calibrated")
def test_what_cannot_be_shown_is_one_line(depth_dataset, tmp_path):
    with pytest.raises(UserError, match="Give both crop_low and crop_high"):
        list(view(ViewConfig(source=depth_dataset.root, crop_low=(0, 0, 0), output=tmp_path / "a.png")))
    with pytest.raises(UserError, match=r"Cannot write '.*none/a.rrd'"):
        list(view(ViewConfig(source=depth_dataset.root, rrd=tmp_path / "none" / "a.rrd")))
    for name in (tmp_path / "folder.rrd", tmp_path / f"{'a' * 300}.rrd"):
        (tmp_path / "folder.rrd").mkdir(exist_ok=True)
        with pytest.raises(UserError, match=r"Cannot write '.*\.rrd': .*(not a regular file|name too long)"):
            list(view(ViewConfig(source=depth_dataset.root, rrd=name)))
    with pytest.raises(UserError, match=r"--output needs a picture's ending, such as '.*/cloud.png'"):
        list(view(ViewConfig(source=depth_dataset.root, output=tmp_path / "cloud")))
    with pytest.raises(UserError, match="The first frame has no point"):
        command.crop_of(ViewConfig(source=depth_dataset.root), np.empty((0, 3), np.float32))


ON_A_SMALL_DISK = """
import resource
from pathlib import Path
import numpy as np
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.visual.view import record
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, resource.RLIM_INFINITY))
record(Path({file!r}), iter(np.random.rand(20, 2000, 3).astype(np.float32)), Crop((-1, -1, -1), (2, 2, 2)))
"""


def test_a_recording_that_does_not_fit_on_the_disk_is_said(tmp_path):
    """Rerun itself says nothing, or waits for ever."""
    pytest.importorskip("rerun")
    result = run_code(ON_A_SMALL_DISK.format(file=str(tmp_path / "a.rrd")))
    assert re.search(r"UserError: Cannot write '.*a\.rrd': \[Errno 27\] File too large", result.stderr), result.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_recording_that_ends_early_is_not_left_behind(tmp_path):
    def clouds():
        yield np.zeros((4, 6), np.float32)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(tmp_path / "a.rrd", clouds(), Crop((-1, -1, -1), (1, 1, 1)))
    assert list(tmp_path.iterdir()) == []


def test_without_a_crop_the_box_of_the_points_is_shown():
    points = np.random.default_rng(0).uniform(0, 1, (1000, 3)).astype(np.float32)
    crop = command.crop_of(ViewConfig(), points)
    np.testing.assert_allclose([crop.low, crop.high], [[0.01] * 3, [0.99] * 3], atol=0.03)
