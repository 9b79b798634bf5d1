"""A report on the quality of recorded clouds: numbers as text, and a picture."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.errors import UserError
from lerobot_uca.whole_file import whole_file


class EpisodeReport(NamedTuple):
    """The numbers of one episode of L steps."""

    episode: int
    n_points: NDArray[np.int_]  # (L,) points inside the crop, before sampling
    invalid: NDArray[np.float64]  # (L,) share of pixels without depth, or of points that are not finite or missing
    n_missing: int  # points at (0, 0, 0)
    low: NDArray[np.float32]  # (3,) lowest corner of the sampled clouds [m]; NaN where all are empty
    high: NDArray[np.float32]  # (3,) highest corner [m]
    state: NDArray[np.float32]  # (L, S)
    action: NDArray[np.float32]  # (L, A)
    seen: str  # of the first frame with too few points, what part of the scene the crop covers


def require_pictures() -> Any:
    """The figures of matplotlib, or a `UserError`: asked for before the work, at whose end the report stands."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UserError(
            "The report's picture needs matplotlib: pip install 'lerobot_policy_uca_flow[pictures]'."
        ) from error
    return Figure


def prepare_report(folder: Path, root: Path) -> None:
    """Make the folder of a report on the dataset that is to be written in `root`.

    Raises:
        UserError: if it cannot be made, or would be replaced with the dataset.
    """
    if folder.resolve().is_relative_to(root.resolve()):
        raise UserError(f"--report must lie outside the new dataset '{root}', got '{folder}'.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"Cannot write the report: {error}") from error


def write_report(folder: Path, episodes: Sequence[EpisodeReport], least: int) -> None:
    """Write report.txt and report.png into a folder.

    Args:
        folder: to write into.
        episodes: at least one.
        least: a frame with fewer points is too empty.
    """
    picture = io.BytesIO()
    _draw(picture, episodes, least)
    text = "\n".join(summarise(episodes, least)) + "\n"
    try:
        for name, content in (("report.txt", text.encode()), ("report.png", picture.getvalue())):
            with whole_file(folder / name) as unfinished:
                unfinished.write_bytes(content)
    except OSError as error:
        raise UserError(f"Cannot write the report: {error}") from error


def summarise(episodes: Sequence[EpisodeReport], least: int) -> list[str]:
    """The report's lines."""
    n_points = np.concatenate([each.n_points for each in episodes])
    invalid = np.concatenate([each.invalid for each in episodes])
    empty = [(each.episode, int(frame)) for each in episodes for frame in np.flatnonzero(each.n_points < least)]
    lines = [
        f"{len(episodes)} episodes, {len(n_points)} frames",
        f"points inside the crop a frame: at least {n_points.min()}, median {np.median(n_points):.0f}",
        f"frames with fewer than {least} points: {len(empty)}" + _listed("episode {} frame {}", empty),
        f"share of invalid depth or points: median {np.median(invalid):.1%}, at most {invalid.max():.1%}",
        f"clouds lie in (normalisation range): {_range(episodes)}",
    ]
    for name in ("state", "action"):
        values = np.concatenate([getattr(each, name) for each in episodes])
        n_bad = int((~np.isfinite(values)).any(axis=1).sum())
        constant = np.flatnonzero(np.ptp(values, axis=0) == 0).tolist()
        lines += [
            f"{name}: {values.shape[1]} dimensions, {n_bad} frames with NaN or infinite values",
            f"{name} dimensions that are constant: {', '.join(map(str, constant)) or 'none'}",
            f"{name} range: {_numbers(np.nanmin(values, axis=0))} to {_numbers(np.nanmax(values, axis=0))}",
        ]
    return lines


def _range(episodes: Sequence[EpisodeReport]) -> str:
    seen = [each for each in episodes if np.isfinite(each.low).all()]
    if not seen:
        return "nowhere, all are empty"
    low, high = np.min([each.low for each in seen], axis=0), np.max([each.high for each in seen], axis=0)
    return f"{_numbers(low)} to {_numbers(high)} m"


def _listed(pattern: str, pairs: list[tuple[int, int]]) -> str:
    shown = ", ".join(pattern.format(*pair) for pair in pairs[:10])
    return f" ({shown}{', ...' if len(pairs) > 10 else ''})" if pairs else ""


def _numbers(values: NDArray[np.float32]) -> str:
    return "[" + ", ".join(f"{value:.3g}" for value in values) + "]"


def _draw(file: IO[bytes], episodes: Sequence[EpisodeReport], least: int) -> None:
    figure = require_pictures()(figsize=(10, 6), layout="constrained")
    points_axes, invalid_axes = figure.subplots(2, 1, sharex=True)
    points_axes.plot(np.concatenate([each.n_points for each in episodes]), linewidth=0.8)
    points_axes.axhline(least, color="tab:red", linewidth=0.8, label=f"least, {least}")
    points_axes.set(ylabel="points inside the crop", yscale="symlog")
    points_axes.legend()
    invalid_axes.plot(100 * np.concatenate([each.invalid for each in episodes]), color="tab:orange", linewidth=0.8)
    invalid_axes.set(ylabel="invalid [%]", xlabel="frame, episodes one after the other")
    for end in np.cumsum([len(each.n_points) for each in episodes])[:-1]:
        for axes in (points_axes, invalid_axes):
            axes.axvline(end - 0.5, color="0.8", linewidth=0.5)
    figure.savefig(file, dpi=100)
