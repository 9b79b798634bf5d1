"""`lerobot-uca-view`: point clouds of a dataset or an environment in a browser, as a picture or for Rerun.

Example:
    lerobot-uca-view --source=data/clouds --output=cloud.png
"""

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from lerobot.configs import parser
from lerobot.envs.configs import EnvConfig
from numpy.typing import NDArray

from lerobot_uca.bounds import check_bounds, within
from lerobot_uca.data.cloud_sources import LeRobotSource, find_source
from lerobot_uca.envs.configs import PointCloudEnvConfig
from lerobot_uca.errors import UserError
from lerobot_uca.point_clouds.calibration import CalibrationError
from lerobot_uca.point_clouds.geometry import Crop
from lerobot_uca.point_clouds.recipe import depth_keys, make_crop, recipe_for

logger = logging.getLogger(__name__)

WIDE = Crop((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0))
"""[m] Where a crop is still to be chosen, everything within reach is shown."""
MAX_POINTS = 20_000
INSIDE, OUTSIDE = (33, 102, 172), (200, 200, 200)


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
    # Episode of a source, or seed of an environment.
    episode: int = within(0, least=0)
    # Lowest corner of the crop [m]; points outside are grey.
    crop_low: tuple[float, float, float] | None = None
    # Highest corner of the crop [m].
    crop_high: tuple[float, float, float] | None = None
    # Show the points' own colours, if the source has some.
    colour: bool = False
    # Folder of the cameras' calibrations; by default $LEROBOT_UCA_CALIBRATION.
    calibration: str | None = None
    # Training configuration whose policy.depth.crop_low and crop_high the page's button writes; made if need be.
    config: Path = field(default_factory=lambda: Path("crop.yaml"))
    # Write a picture of the first frame instead.
    output: Path | None = None
    # Write a recording for Rerun instead.
    rrd: Path | None = None
    # The page's port, on this machine only.
    port: int = within(8080, least=1, most=65535)


def clouds_of(config: ViewConfig) -> Iterator[NDArray[np.float32]]:
    """The points of each frame of an episode, (M, 3) [m], with colours (M, 6), also those outside the crop.

    Raises:
        UserError: if there is neither a source nor an environment, or if it cannot be read.
    """
    if (config.source is None) == (config.env is None):
        raise UserError("Give either --source or --env.type.")
    if config.env is not None:
        if not isinstance(config.env, PointCloudEnvConfig):
            raise UserError(f"Only point-cloud environments can be viewed, got env.type={config.env.type}.")
        config.env.observation = "point_cloud"
        config.env.validate()
        (task, *_) = next(iter(config.env.tasks().values()))
        env = config.env.env_factory(task)()
        yield env.reset(seed=config.episode)[0]["point_cloud"]
        return
    assert config.source is not None
    try:
        source = find_source(config.source, None, "", colour=config.colour)
        if isinstance(source, LeRobotSource) and depth_keys(source.features):
            source.depth_recipe = recipe_for(
                source.features, (WIDE.low, WIDE.high), MAX_POINTS // 8, config.calibration
            )
    except CalibrationError as error:
        raise UserError(str(error)) from error
    if config.episode >= source.n_episodes:
        raise UserError(f"episode must be from 0 to {source.n_episodes - 1}, got {config.episode}.")
    for frame in source.frames(config.episode):
        yield frame.points


def crop_of(config: ViewConfig, points: NDArray[np.float32]) -> Crop:
    """The configured crop or, without one, the box of all points."""
    if config.crop_low is not None and config.crop_high is not None:
        try:
            return make_crop(config.crop_low, config.crop_high)
        except CalibrationError as error:
            raise UserError(str(error)) from error
    low, high = (np.round(np.percentile(points[:, :3], share, axis=0), 2).tolist() for share in (1, 99))
    return Crop((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def colours_of(points: NDArray[np.float32], crop: Crop) -> NDArray[np.uint8]:
    """RGB of points (M, 3) or (M, 6), (M, 3): blue or their own inside the crop, grey outside.

    Colours above 1 are taken as 0 to 255, others as 0 to 1.
    """
    own = points[:, 3:6]
    inside = own * (1 if own.max(initial=0) > 1 else 255) if own.shape[1] else np.array(INSIDE)
    return np.where(crop.contains(points[:, :3])[:, None], inside, OUTSIDE).clip(0, 255).astype(np.uint8)


def write_crop(file: Path, crop: Crop) -> None:
    """Write a crop as policy.depth of a training configuration; what else is in the file is kept."""
    try:
        settings = yaml.safe_load(file.read_text(encoding="utf-8")) if file.exists() else {}
    except (OSError, yaml.YAMLError) as error:
        raise UserError(f"'{file}' cannot be read: {' '.join(str(error).split())}") from error
    if not isinstance(settings, dict):
        raise UserError(f"'{file}' must be a training configuration, got {type(settings).__name__}.")
    depth = settings.setdefault("policy", {}).setdefault("depth", {})
    depth["crop_low"], depth["crop_high"] = list(crop.low), list(crop.high)
    unfinished = file.with_name(f".{file.name}.unfinished")
    try:
        unfinished.write_text(yaml.safe_dump(settings, sort_keys=False), encoding="utf-8")
        unfinished.replace(file)
    except OSError as error:
        raise UserError(f"Cannot write '{file}': {error}") from error


def draw(file: Path, points: NDArray[np.float32], crop: Crop) -> None:
    """A picture of a cloud from three sides."""
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
        figure.savefig(file, dpi=100)
    except (OSError, ValueError) as error:
        raise UserError(f"Cannot write '{file}': {error}") from error


def record(file: Path, clouds: Iterator[NDArray[np.float32]], crop: Crop) -> None:
    """A recording of all frames for Rerun."""
    try:
        import rerun
    except ImportError as error:
        raise UserError("Recordings need rerun-sdk: pip install 'lerobot_policy_uca_flow[view]'.") from error
    recording = rerun.RecordingStream("lerobot_uca")
    recording.save(str(file))
    for index, points in enumerate(clouds):
        recording.set_time("frame", sequence=index)
        recording.log("cloud", rerun.Points3D(points[:, :3], colors=colours_of(points, crop), radii=0.003))
    recording.flush()


def serve(config: ViewConfig, clouds: list[NDArray[np.float32]], crop: Crop) -> Any:
    """A page on this machine with the clouds, a slider a face of the crop, and a button that writes it."""
    try:
        import viser
    except ImportError as error:
        raise UserError("The page needs viser: pip install 'lerobot_policy_uca_flow[view]'.") from error
    server = viser.ViserServer(host="127.0.0.1", port=config.port, verbose=False)
    everything = np.concatenate(clouds)[:, :3]
    low, high = everything.min(axis=0), everything.max(axis=0)
    frame = server.gui.add_slider("frame", min=0, max=max(1, len(clouds) - 1), step=1, initial_value=0)
    sliders = [
        server.gui.add_slider(
            f"{side} {'xyz'[axis]} [m]",
            min=float(low[axis]) - 0.01,
            max=float(high[axis]) + 0.01,
            step=0.005,
            initial_value=float(np.clip(corner[axis], low[axis], high[axis])),
        )
        for side, corner in (("lowest", crop.low), ("highest", crop.high))
        for axis in range(3)
    ]
    button = server.gui.add_button(f"write the crop to {config.config}")
    status = server.gui.add_markdown("")

    def chosen() -> Crop:
        x, y, z, x_high, y_high, z_high = (round(float(slider.value), 3) for slider in sliders)
        return Crop((x, y, z), (x_high, y_high, z_high))

    def show(_: Any = None) -> None:
        points = clouds[min(int(frame.value), len(clouds) - 1)]
        server.scene.add_point_cloud("/cloud", points[:, :3], colours_of(points, chosen()), point_size=0.004)
        status.content = f"{int(chosen().contains(points[:, :3]).sum())} of {len(points)} points are inside the crop"

    def write(_: Any) -> None:
        write_crop(config.config, chosen())
        status.content = f"written to {config.config}"

    frame.on_update(show)
    for slider in sliders:
        slider.on_update(show)
    button.on_click(write)
    show()
    return server


def view(config: ViewConfig) -> Any:
    """Write what is asked for, or serve the page and return its server."""
    check_bounds(config)
    clouds = list(clouds_of(config))
    crop = crop_of(config, clouds[0])
    if config.output is not None:
        draw(config.output, clouds[0], crop)
    if config.rrd is not None:
        record(config.rrd, iter(clouds), crop)
    return serve(config, clouds, crop) if config.output is None and config.rrd is None else None


@parser.wrap()
def run(config: ViewConfig) -> None:
    """View until Ctrl-C."""
    if view(config) is None:
        print(f"Written: {', '.join(str(file) for file in (config.output, config.rrd) if file)}")
        return
    print(f"http://127.0.0.1:{config.port} (Ctrl-C ends it)")
    while True:
        time.sleep(1)
