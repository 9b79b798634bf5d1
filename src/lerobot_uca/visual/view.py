"""`lerobot-uca-view`: point clouds of a dataset, an environment or a camera, in a browser, as a picture or for Rerun.

Example:
    lerobot-uca-view --source=data/clouds --output=cloud.png
"""

import logging
import time
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path

import numpy as np
from lerobot.cameras import CameraConfig
from lerobot.configs import parser
from lerobot.envs.configs import EnvConfig
from numpy.typing import NDArray

from lerobot_uca.bounds import check_bounds, within
from lerobot_uca.data.sources.find import find_source
from lerobot_uca.data.sources.lerobot_source import LeRobotSource
from lerobot_uca.envs.configs import PointCloudEnvConfig
from lerobot_uca.errors import UserError
from lerobot_uca.features import POINT_CLOUD
from lerobot_uca.point_clouds.calibration import CalibrationError
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.point_clouds.recipe import optional_crop
from lerobot_uca.visual.crop_page import CropPage, colours_of
from lerobot_uca.visual.live_camera import live_clouds
from lerobot_uca.visual.rerun_file import rerun_file
from lerobot_uca.whole_file import whole_file

logger = logging.getLogger(__name__)

WIDE = Crop((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0))
"""[m] Where a crop is still to be chosen, everything within reach is shown."""
MAX_POINTS = 20_000
LIVE_PERIOD = 0.2
"""[s] From one cloud of a camera to the next."""


@dataclass
class ViewConfig:
    """Look at point clouds, and choose a crop with sliders.

    lerobot-uca-view --source=data/recorded --config=my_policy.yaml

    Opens a page in the browser; its button writes the crop to --config. With --output or --rrd nothing is served.
    """

    # A LeRobot dataset with depth or clouds, a zarr of DP3's layout, or a folder of PLY or NPZ files.
    source: Path | None = None
    # Or an environment: --env.type=metaworld_pointcloud --env.task=...
    env: EnvConfig | None = None
    # Or a connected depth camera: --camera.type=intelrealsense --camera.use_depth=true ...
    camera: CameraConfig | None = None
    # The name by which the camera is calibrated.
    camera_name: str = "front"
    # Episode of a source, by default its first, or seed of an environment, by default 0.
    episode: int | None = within(None, least=0)
    # Lowest corner of the crop [m]; points outside are grey.
    crop_low: tuple[float, float, float] | None = None
    # Highest corner of the crop [m].
    crop_high: tuple[float, float, float] | None = None
    # Show the points' own colours, if the source has some.
    colour: bool = False
    # Folder of the cameras' calibrations; by default $LEROBOT_UCA_CALIBRATION.
    calibration: str | None = None
    # Of a dataset with both depth and clouds, show the clouds.
    use_clouds: bool = False
    # Training configuration whose policy.depth.crop_low and crop_high the page's button writes; made if need be.
    config: Path = field(default_factory=lambda: Path("crop.yaml"))
    # Write a picture of the first frame instead.
    output: Path | None = None
    # Write a recording for Rerun instead.
    rrd: Path | None = None
    # The page's port, on this machine only.
    port: int = within(8080, least=1, most=65535)


def clouds_of(config: ViewConfig) -> Generator[NDArray[np.float32]]:
    """The points of each frame of an episode, (M, 3) [m], with colours (M, 6), also those outside the crop.

    Raises:
        UserError: if there is not one source, environment or camera, or if it cannot be read.
    """
    if sum(each is not None for each in (config.source, config.env, config.camera)) != 1:
        raise UserError("Give one of --source, --env.type and --camera.type.")
    if config.colour and config.source is None:
        raise UserError("--colour=true shows the colours of a --source: environments and depth images have none.")
    if config.camera is not None:
        yield from live_clouds(config.camera, config.camera_name, config.calibration, WIDE, MAX_POINTS)
    if config.env is not None:
        yield _first_cloud(config.env, config.episode or 0)
        return
    assert config.source is not None
    try:
        source = find_source(config.source, None, "", colour=config.colour)
        episode = source.choose(None)[0] if config.episode is None else config.episode
        if episode not in source.episodes:
            raise UserError(f"episode must be {source.valid}, got {episode}.")
        if isinstance(source, LeRobotSource) and source.has_depth and not config.use_clouds:
            source.make_clouds((WIDE.low, WIDE.high), MAX_POINTS // 8, config.calibration, [episode])
    except CalibrationError as error:
        raise UserError(str(error)) from error
    for frame in source.frames(episode):
        yield frame.points


def _first_cloud(env_config: EnvConfig, seed: int) -> NDArray[np.float32]:
    if not isinstance(env_config, PointCloudEnvConfig):
        raise UserError(f"Only point-cloud environments can be viewed, got env.type={env_config.type}.")
    if env_config.observation == "depth":
        env_config.observation = POINT_CLOUD
    env_config.validate()
    task, *others = [task for tasks in env_config.tasks().values() for task in tasks]
    if others:
        raise UserError(f"One task can be viewed, got {env_config.task}: {', '.join((task, *others))}.")
    env = env_config.env_factory(task)()
    return env.reset(seed=seed)[0]["point_cloud"]


def crop_of(config: ViewConfig, points: NDArray[np.float32]) -> Crop:
    """The configured crop or, without one, the box of all points.

    Raises:
        UserError: for a crop that cannot be, and without one for a cloud without points.
    """
    try:
        crop = optional_crop(config.crop_low, config.crop_high)
    except CalibrationError as error:
        raise UserError(str(error)) from error
    if crop is not None:
        return crop
    if not len(points):
        raise UserError("The first frame has no point: give crop_low and crop_high, or look at another episode.")
    low, high = (np.round(np.percentile(points[:, :3], share, axis=0), 2).tolist() for share in (1, 99))
    return Crop((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def draw(file: Path, points: NDArray[np.float32], crop: Crop) -> None:
    """A picture of a cloud from three sides."""
    if not file.suffix:
        raise UserError(f"--output needs a picture's ending, such as '{file}.png', got '{file}'.")
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UserError("Pictures need matplotlib: pip install 'lerobot_policy_uca_flow[pictures]'.") from error
    colours = colours_of(points, crop) / 255
    figure = Figure(figsize=(12, 4), layout="constrained")
    for axes, (a, b) in zip(figure.subplots(1, 3), ((0, 1), (0, 2), (1, 2)), strict=True):
        axes.scatter(points[:, a], points[:, b], c=colours, s=2)
        axes.set(xlabel=f"{'xyz'[a]} [m]", ylabel=f"{'xyz'[b]} [m]", aspect="equal")
    try:
        with whole_file(file) as unfinished:
            figure.savefig(unfinished, dpi=100)
    except (OSError, ValueError) as error:
        raise UserError(f"Cannot write '{file}': {error}") from error


def record(file: Path, clouds: Iterator[NDArray[np.float32]], crop: Crop) -> None:
    """A recording of all frames for Rerun."""
    with rerun_file(file, "lerobot_uca") as (rerun, recording):
        for index, points in enumerate(clouds):
            recording.set_time("frame", sequence=index)
            recording.log("cloud", rerun.Points3D(points[:, :3], colors=colours_of(points, crop), radii=0.003))


def pages_of(config: ViewConfig, clouds: Iterator[NDArray[np.float32]]) -> Iterator[CropPage]:
    """The page, each time it may have changed: with a slider for an episode's frames, or with what a camera sees."""
    if config.camera is not None:
        first = next(clouds)
        page = CropPage(config.port, config.config, crop_of(config, first), first)
        for points in chain([first], clouds):
            page.show(points)
            yield page
    episode = list(clouds)
    page = CropPage(config.port, config.config, crop_of(config, episode[0]), np.concatenate(episode))
    page.show(episode[0])
    if len(episode) > 1:
        frame = page.server.gui.add_slider("frame", min=0, max=len(episode) - 1, step=1, initial_value=0)
        frame.on_update(lambda _: page.show(episode[int(frame.value)]))
    while True:
        yield page


def view(config: ViewConfig) -> Generator[CropPage]:
    """Serve the page and yield it, again and again until it is closed; or write what is asked for and yield nothing.

    Raises:
        UserError: as `clouds_of`, and for what cannot be written.
    """
    check_bounds(config)
    if config.camera is not None and config.rrd is not None:
        raise UserError("--rrd records an episode: record a camera's with lerobot-record first.")
    with closing(clouds_of(config)) as seen:
        if config.output is None and config.rrd is None:
            yield from pages_of(config, seen)
        clouds = list(islice(seen, 1) if config.rrd is None else seen)  # a picture is of the first frame
    crop = crop_of(config, clouds[0])
    if config.output is not None:
        draw(config.output, clouds[0], crop)
    if config.rrd is not None:
        record(config.rrd, iter(clouds), crop)


@parser.wrap()
def run(config: ViewConfig) -> None:
    """View until Ctrl-C."""
    with closing(view(config)) as pages:
        page = next(pages, None)
        if page is None:
            print(f"Written: {', '.join(str(file) for file in (config.output, config.rrd) if file)}")
            return
        print(f"http://127.0.0.1:{page.server.get_port()} (Ctrl-C ends it)", flush=True)
        for _ in pages:
            time.sleep(LIVE_PERIOD)
