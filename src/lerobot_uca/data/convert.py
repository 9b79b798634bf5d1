"""`lerobot-uca-convert`: recorded depth or clouds to a LeRobot dataset of point clouds, which trains fast.

Example:
    lerobot-uca-convert --source=data/depth --repo_id=me/clouds --crop_low='[0.2,-0.3,0.01]' --crop_high='[0.8,0.3,0.4]'
"""

import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from lerobot.configs import parser
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.utils import SuppressProgressBars
from numpy.typing import NDArray
from tqdm import tqdm

from lerobot_uca.bounds import check_bounds, within
from lerobot_uca.data.cloud_report import EpisodeReport, prepare_report, require_pictures, write_report
from lerobot_uca.data.new_dataset import new_dataset_root
from lerobot_uca.data.sources.find import find_source
from lerobot_uca.data.sources.lerobot_source import LeRobotSource
from lerobot_uca.data.sources.source import Source
from lerobot_uca.data.whole_folder import whole_folder
from lerobot_uca.errors import UserError
from lerobot_uca.features import OBS_POINT_CLOUD, observation_info
from lerobot_uca.hub import push_dataset
from lerobot_uca.point_clouds.calibration import CalibrationError
from lerobot_uca.point_clouds.depth import MIN_SHARE
from lerobot_uca.point_clouds.geometry import Crop, sample_farthest
from lerobot_uca.point_clouds.recipe import RECIPE_INFO, optional_crop
from lerobot_uca.processes import worker_pool

logger = logging.getLogger(__name__)


@dataclass
class ConvertConfig:
    """Make a LeRobot dataset of point clouds from recorded depth or clouds. States, actions, tasks and fps are kept.

    lerobot-uca-convert --source=data/depth --repo_id=me/clouds --crop_low='[0.2,-0.3,0]' --crop_high='[0.8,0.3,0.4]'

    The source is a LeRobot dataset with depth (video or TIFF; calibrated by $LEROBOT_UCA_CALIBRATION or --calibration)
    or with clouds, a zarr of DP3's layout, or a folder of PLY or NPZ clouds with a frames.csv (docs/own_data.md).
    """

    # The folder to convert.
    source: Path
    # Name of the new dataset, 'user/name'.
    repo_id: str
    # Folder to write; by default where LeRobot looks for it, $HF_LEROBOT_HOME/repo_id.
    root: Path | None = None
    # Lowest corner of the crop [m], in the robot's base frame. Depth needs a crop; lerobot-uca-view shows one.
    crop_low: tuple[float, float, float] | None = None
    # Highest corner of the crop [m].
    crop_high: tuple[float, float, float] | None = None
    # Points of each cloud.
    n_points: int = within(512, least=1, most=100_000)
    # Keep the points' colours: clouds (N, 6), RGB after xyz, as they are. policy.colour=true looks at them.
    colour: bool = False
    # Folder of the cameras' calibrations; by default $LEROBOT_UCA_CALIBRATION.
    calibration: str | None = None
    # Of a dataset with both depth and clouds, take the clouds.
    use_clouds: bool = False
    # The episodes to convert, such as [0,1,5], by their numbers in the source; by default all.
    episodes: list[int] | None = None
    # Steps a second of a source that does not know it (zarr, PLY, NPZ).
    fps: int | None = within(None, least=1, most=10_000)
    # The task, for a source that does not know it.
    task: str = ""
    # Processes that read and sample; 0 does it in this one.
    num_workers: int = within(0, least=0, most=1024)
    # Write a report on the clouds' quality into this folder: report.txt and report.png.
    report: Path | None = None
    # Replace the dataset if it exists.
    overwrite: bool = False
    # Upload the dataset to the Hugging Face Hub under repo_id.
    push_to_hub: bool = False
    # Upload as a private dataset; by default as the account's settings say.
    private: bool | None = None


class Episode(NamedTuple):
    """One converted episode of L steps."""

    clouds: NDArray[np.float32]  # (L, N, 3), or 6 with colours
    state: NDArray[np.float32]  # (L, S)
    action: NDArray[np.float32]  # (L, A)
    tasks: list[str]
    report: EpisodeReport


def convert(config: ConvertConfig) -> LeRobotDataset:
    """Convert, write whole or not at all, and open the new dataset.

    Raises:
        UserError: for a source that cannot be read or does not fit, for frames with too few points, and for an upload
            that fails.
    """
    check_bounds(config)
    root = new_dataset_root(config.repo_id, config.root, overwrite=config.overwrite)
    if config.report is not None:
        require_pictures()
    source, episodes = make_source(config)
    if isinstance(source, LeRobotSource) and (config.fps is not None or config.task):
        logger.warning("--fps and --task are for sources without them; a LeRobot dataset keeps its own.")
    fps = source.fps or config.fps
    if fps is None:
        raise UserError(f"'{config.source}' does not say how many steps a second it has: give --fps.")
    if config.source.resolve().is_relative_to(root.resolve()):
        raise UserError(f"--root '{root}' would replace the source, '{config.source}': name another folder.")
    if config.report is not None:
        prepare_report(config.report, root)
    if (size := source.cloud_size) is not None and size < config.n_points:
        raise UserError(f"--n_points must be at most {size}, the points of the source's clouds, got {config.n_points}.")
    with whole_folder(root, overwrite=config.overwrite) as unfinished:
        _write(config, source, fps, episodes, unfinished)
    if left_out := source.left_out():
        logger.warning("Not kept: %s.", ", ".join(left_out))
    dataset = LeRobotDataset(config.repo_id, root=root)
    if "" in dataset.meta.tasks.index and not isinstance(source, LeRobotSource):
        logger.warning("No task is given: --task says in a sentence what the robot does.")
    if config.push_to_hub:
        push_dataset(dataset, private=config.private, tags=["point-cloud"])
    return dataset


def make_source(config: ConvertConfig) -> tuple[Source, Sequence[int]]:
    """The source as configured, with its crop and, for depth, its recipe; and its chosen episodes."""
    try:
        crop = optional_crop(config.crop_low, config.crop_high)
        source = find_source(config.source, crop, config.task, colour=config.colour)
        episodes = source.choose(config.episodes)
        if config.use_clouds and not (isinstance(source, LeRobotSource) and source.has_clouds):
            raise UserError(f"--use_clouds=true needs a LeRobot dataset with clouds, got '{config.source}'.")
        if isinstance(source, LeRobotSource) and source.has_depth and not config.use_clouds:
            _make_clouds(config, source, crop, episodes)
        elif config.calibration is not None:
            logger.warning("--calibration is for depth; these clouds are taken as they are.")
    except CalibrationError as error:
        raise UserError(str(error)) from error
    return source, episodes


def _make_clouds(config: ConvertConfig, source: LeRobotSource, crop: Crop | None, episodes: Sequence[int]) -> None:
    corners = (crop.low, crop.high) if crop else None
    try:
        source.make_clouds(corners, config.n_points, config.calibration, episodes)
    except (CalibrationError, UserError) as error:
        if not source.has_clouds:
            raise
        raise UserError(f"The depth makes no clouds: {error} --use_clouds=true takes the dataset's own.") from error


def convert_episode(source: Source, n_points: int, episode: int) -> Episode:
    """Read and sample one episode."""
    frames = [frame._replace(points=_sample(frame.points, n_points)) for frame in source.frames(episode)]
    if len(frames) < 2:  # of one frame LeRobot's statistics of a cloud have another shape
        raise UserError(
            f"Episode {episode} must have at least 2 frames, got {len(frames)}: leave it out by --episodes."
        )
    few = [index for index, frame in enumerate(frames) if frame.n_points < least_points(n_points)]
    clouds = [frame.points for frame in frames]
    nowhere = np.full((1, 3), np.nan, np.float32)
    seen = np.concatenate([frame.points[:, :3] for frame in frames if frame.n_points] or [nowhere])
    state, action = (np.stack([getattr(frame, name) for frame in frames]) for name in ("state", "action"))
    report = EpisodeReport(
        episode,
        n_points=np.array([frame.n_points for frame in frames]),
        invalid=np.array([frame.invalid for frame in frames]),
        n_missing=sum(frame.n_missing for frame in frames),
        low=seen.min(axis=0),
        high=seen.max(axis=0),
        state=state,
        action=action,
        seen=source.seen(episode, few[0]) if few else "",
    )
    return Episode(np.stack(clouds), state, action, [frame.task for frame in frames], report)


def least_points(n_points: int) -> int:
    """A frame with fewer points inside the crop is too empty for a cloud of so many."""
    return max(1, int(MIN_SHARE * n_points))


def _sample(points: NDArray[np.float32], n_points: int) -> NDArray[np.float32]:
    """Sample as `DepthToCloud` does. An empty cloud stays visible as NaN until the report is written."""
    if len(points) == 0:
        return np.full((n_points, points.shape[1]), np.nan, np.float32)
    return sample_farthest(points, n_points)


def _write(config: ConvertConfig, source: Source, fps: int, episodes: Sequence[int], root: Path) -> None:
    dataset: LeRobotDataset | None = None
    reports: list[EpisodeReport] = []
    least, first_bad = least_points(config.n_points), None
    try:
        for episode in _converted(config, source, episodes):
            reports.append(episode.report)
            if dataset is None:
                features = _features(config, source, episode)
                dataset = LeRobotDataset.create(config.repo_id, fps, features=features, root=root, use_videos=False)
            if first_bad is None and episode.report.n_points.min() < least:
                first_bad = episode.report
            if first_bad is None:
                _add(dataset, episode)
            elif config.report is None:
                break  # nothing will be written; a report would look at the rest, too
    finally:
        if dataset is not None:
            dataset.finalize()  # closes its files, which would otherwise come back when they are garbage-collected
    if config.report is not None:
        write_report(config.report, reports, least)
    _warn_of_nan(reports)
    if n_missing := sum(report.n_missing for report in reports):
        logger.warning("%d points at (0, 0, 0), which stand for missing ones, were left out.", n_missing)
    if first_bad is not None:
        few = np.flatnonzero(first_bad.n_points < least)
        raise UserError(
            f"Episode {first_bad.episode} has {len(few)} of {len(first_bad.n_points)} frames with fewer than {least} "
            f"points inside the crop, the first is frame {few[0]} with {first_bad.n_points[few[0]]}. {first_bad.seen}. "
            "Move the crop, or leave the episode out with --episodes; --report=FOLDER shows all."
        )


def _warn_of_nan(reports: list[EpisodeReport]) -> None:
    for name in ("state", "action"):
        bad = [report.episode for report in reports if not np.isfinite(getattr(report, name)).all()]
        if bad:
            logger.warning("The %s of the episodes %s holds NaN or infinite values; training refuses them.", name, bad)


def _converted(config: ConvertConfig, source: Source, episodes: Sequence[int]) -> Iterator[Episode]:
    bar = partial(tqdm, total=len(episodes), desc="Converted", unit="episode")
    if config.num_workers == 0:
        yield from bar(map(partial(convert_episode, source, config.n_points), episodes))
        return
    with worker_pool(config.num_workers, partial(_Worker.begin, source)) as pool:
        convert_one = partial(_Worker.convert, config.n_points)
        yield from bar(_in_order(pool, convert_one, episodes, n_ahead=2 * config.num_workers))


class _Worker:
    """A worker process, which opens the source once: sent along with each episode it would be opened for each."""

    source: ClassVar[Source]

    @classmethod
    def begin(cls, source: Source) -> None:
        cls.source = source

    @classmethod
    def convert(cls, n_points: int, episode: int) -> Episode:
        return convert_episode(cls.source, n_points, episode)


def _in_order(
    pool: Executor, convert_one: Callable[[int], Episode], episodes: Iterable[int], n_ahead: int
) -> Iterator[Episode]:
    """The converted episodes; no more of them at once than this, as writing may take longer than converting."""
    left = iter(episodes)
    pending = deque(pool.submit(convert_one, episode) for episode in islice(left, n_ahead))
    while pending:
        yield pending.popleft().result()
        pending.extend(pool.submit(convert_one, episode) for episode in islice(left, 1))


def _add(dataset: LeRobotDataset, episode: Episode) -> None:
    for cloud, state, action, task in zip(episode.clouds, episode.state, episode.action, episode.tasks, strict=True):
        dataset.add_frame({OBS_POINT_CLOUD: cloud, OBS_STATE: state, ACTION: action, "task": task})
    with SuppressProgressBars():
        dataset.save_episode()


def _features(config: ConvertConfig, source: Source, episode: Episode) -> dict[str, dict[str, Any]]:
    recipe, crop = source.recipe, source.crop
    # LeRobot merges datasets whose features are equal, recipes apart: those of one crop, whatever their sources.
    info: dict[str, Any] = {
        "crop": [list(crop.low), list(crop.high)] if crop else None,
        **observation_info(source.observation),
    }
    if recipe is not None:
        info[RECIPE_INFO] = replace(recipe, n_points=config.n_points).as_dict()
    return {
        OBS_POINT_CLOUD: {
            "dtype": "float32",
            "shape": episode.clouds.shape[1:],
            "names": ["point", "xyzrgb" if config.colour else "xyz"],
            "info": info,
        },
        **{
            key: {"dtype": "float32", "shape": values.shape[1:], "names": source.names(key)}
            for key, values in ((OBS_STATE, episode.state), (ACTION, episode.action))
        },
    }


@parser.wrap()
def run(config: ConvertConfig) -> None:
    """Convert and say what was written."""
    dataset = convert(config)
    print(f"{dataset.num_episodes} episodes, {dataset.num_frames} frames of {config.n_points} points: {dataset.root}")
    if config.report is not None:
        print(f"Report: {config.report / 'report.txt'} and {config.report / 'report.png'}")
