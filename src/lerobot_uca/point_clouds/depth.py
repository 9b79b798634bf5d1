"""Point clouds from depth images: the same function for recorded data, live cameras and simulated ones.

Geometry only. All lengths are metres; the world frame of a view's camera is the robot's base frame, so that
`camera.X_world_camera` is X_base_camera.
Letters: H, W height and width of an image, N points.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_uca.point_clouds.geometry import Camera, Crop, sample_farthest

MILLIMETRE = 1e-3
NEAR, FAR = 0.01, 10.0
"""[m] The range of LeRobot's depth encoder. It writes what lies outside, invalid pixels too, as one of these two."""
CANDIDATES_PER_POINT = 8
"""Farthest point sampling chooses among this many pixels for each point. The cloud's largest gap is 15 to 45 %
wider than if it chose among all, and making the cloud takes 1 to 4 ms instead of 20 to 130 (benchmarks/depth.py)."""
UNITS = {"1 mm": 1e-3, "1 m": 1.0, "0.25 mm": 2.5e-4, "0.1 mm": 1e-4}
"""Units [m] that cameras and drivers give depth in: RealSense D4xx and ROS, floating point numbers, L515, D405."""
MIN_SHARE = 1 / 8
"""A cloud with fewer different points than this share of N is an error."""

Points = NDArray[np.float32]


class DepthError(ValueError):
    """Depth images that give no cloud. The message says the rule, what was got and what to look at."""


def unit_of(dtype: np.dtype[Any]) -> float:
    """Metres a unit of depth where nothing else says it: integers are millimetres, floating point numbers metres.

    The convention of ROS (REP 118) and of LeRobot's writer. LeRobot's reader gives float32 millimetres: there, and for
    a camera whose unit is not 1 mm, `DepthView.unit` has to say it.
    """
    return MILLIMETRE if np.issubdtype(dtype, np.integer) else 1.0


@dataclass(frozen=True)
class DepthView:
    """Turns one camera's depth image into points.

    Args:
        camera: intrinsics, image size and pose in the robot's base frame.
        unit: metres a unit of depth (a camera's `depth_scale`); None decides by the image's dtype, see `unit_of`.
        near, far: depth at or below near, or at or above far, is invalid [m].
    """

    camera: Camera
    unit: float | None = None
    near: float = NEAR
    far: float = FAR


class DepthToCloud:
    """Depth images of one or several cameras to one cloud.

    For each pixel the interval of depths whose points lie inside the crop is computed once. Comparing an image with
    two images then selects the pixels, and only of those that are chosen points are computed. If there are more than
    eight pixels a point, evenly many in the order of the rows are dropped before farthest point sampling. All of it is
    deterministic.

    Args:
        views: the cameras.
        crop: what belongs to the cloud, in the base frame.
        n_points: N.
    """

    def __init__(self, views: Sequence[DepthView], crop: Crop, n_points: int) -> None:
        if not views or n_points < 1:
            raise ValueError(f"At least one view and one point are needed, got {len(views)} and {n_points}.")
        self.views, self.crop, self.n_points = tuple(views), crop, n_points
        self.min_points = max(1, int(MIN_SHARE * n_points))
        self._selectors = [_Selector(view, crop) for view in views]

    def __call__(self, images: Sequence[NDArray[Any]]) -> Points:
        """The cloud of one depth image (H, W), (H, W, 1) or (1, H, W) a view: (N, 3) float32, base frame [m].

        In farthest-point order: every prefix is spread evenly, too.

        Raises:
            DepthError: for an image of another size or type, and for too few points.
        """
        points = self.candidates(images)
        if len(points) < self.min_points:
            raise DepthError(self._too_few(len(points), images))
        return sample_farthest(points, self.n_points)

    def candidates(self, images: Sequence[NDArray[Any]]) -> Points:
        """The points that the cloud is sampled from: those inside the crop, or evenly chosen ones, (M, 3) float32."""
        return self.points(images, max_points=CANDIDATES_PER_POINT * self.n_points)

    def points(self, images: Sequence[NDArray[Any]], max_points: int | None = None) -> Points:
        """The points inside the crop, all of them or evenly chosen ones: (M, 3) float32, base frame [m]."""
        if len(images) != len(self.views):
            raise DepthError(f"One depth image a camera is needed, {len(self.views)}, got {len(images)}.")
        share = None if max_points is None else max_points // len(self.views)
        return np.concatenate(
            [selector.points(image, share) for selector, image in zip(self._selectors, images, strict=True)]
        )

    def n_inside(self, images: Sequence[NDArray[Any]]) -> int:
        """The number of points inside the crop."""
        return sum(len(selector.chosen(image)[0]) for selector, image in zip(self._selectors, images, strict=True))

    def seen(self, images: Sequence[NDArray[Any]]) -> str:
        """The part of the scene that the crop covers, camera by camera, and a unit of depth in which it has points."""
        lines = [describe(view, image, self.crop) for view, image in zip(self.views, images, strict=True)]
        return ". ".join([*lines, *self._other_unit(images)])

    def _too_few(self, n_points: int, images: Sequence[NDArray[Any]]) -> str:
        return (
            f"The cloud has {n_points} points inside the crop {self.crop.low} to {self.crop.high} m, "
            f"at least {self.min_points} are needed. {self.seen(images)}."
        )

    def _other_unit(self, images: Sequence[NDArray[Any]]) -> list[str]:
        """A line for a camera that would see the crop if its depth were in another unit; nothing if none would."""
        lines = []
        for view, image in zip(self.views, images, strict=True):
            unit = view.unit or unit_of(image.dtype)
            for name, other in UNITS.items():
                n_points = len(_Selector(replace(view, unit=other), self.crop).points(image, None))
                if other != unit and n_points >= self.min_points:
                    lines.append(
                        f"In units of {name} camera '{view.camera.name}' would have {n_points} points inside the crop: "
                        f"check its depth_unit, which is {unit:g} m"
                    )
                    break
        return lines


class _Selector:
    """The pixels of a view that may show something inside a crop."""

    def __init__(self, view: DepthView, crop: Crop) -> None:
        camera = view.camera
        self.view = view
        rays = camera.depth_rays()
        enter, leave = crop.span(camera.position, rays)
        enter, leave = np.maximum(enter, view.near), np.minimum(leave, view.far)
        meets = (enter < leave).reshape(camera.height, camera.width)
        self._rows, self._columns = _span(np.any(meets, axis=1)), _span(np.any(meets, axis=0))
        self._origin = camera.position.astype(np.float32)
        self._rays = self._inside(rays).astype(np.float32)
        self._enter, self._leave = self._inside(enter), self._inside(leave)
        self._limits: dict[float, tuple[Points, Points]] = {}

    def points(self, image: NDArray[Any], max_points: int | None) -> Points:
        chosen, depth, unit = self.chosen(image)
        if max_points is not None and len(chosen) > max_points:
            chosen = chosen[np.arange(max_points) * len(chosen) // max_points]
        return self._origin + self._rays[chosen] * (depth[chosen, None] * np.float32(unit))

    def chosen(self, image: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.float32], float]:
        """Which depths show something inside the crop, as indices; the depths; and their unit [m]."""
        depth = as_image(self.view.camera, image)[self._rows, self._columns].astype(np.float32).ravel()
        unit = self.view.unit or unit_of(image.dtype)
        if unit not in self._limits:
            self._limits[unit] = self._limits_in(unit)
        lowest, highest = self._limits[unit]
        return np.flatnonzero((depth >= lowest) & (depth <= highest)), depth, unit  # NaN compares as False

    def _inside(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """The rays' values inside the rectangle of pixels that meet the crop."""
        camera = self.view.camera
        image = values.reshape(camera.height, camera.width, *values.shape[1:])[self._rows, self._columns]
        return image.reshape(-1, *values.shape[1:])

    def _limits_in(self, unit: float) -> tuple[Points, Points]:
        """The lowest and highest depth of each pixel that counts, in units: strictly between near and far.

        They are in the image's own units, because 10 mm must be 0.01 m exactly. A pixel outside the crop gets none.
        """
        near, far = np.float32(self.view.near / unit), np.float32(self.view.far / unit)
        lowest = np.maximum((self._enter / unit).astype(np.float32), np.nextafter(near, far))
        highest = np.minimum((self._leave / unit).astype(np.float32), np.nextafter(far, near))
        return lowest, highest


def as_image(camera: Camera, image: NDArray[Any]) -> NDArray[Any]:
    """A depth image as (H, W), checked against the camera it is said to come from.

    Raises:
        DepthError: for another size, or for values that are not numbers.
    """
    squeezed = np.squeeze(image)
    if squeezed.shape != (camera.height, camera.width) or squeezed.dtype.kind not in "uif":
        raise DepthError(
            f"A depth image of camera '{camera.name}' must be {camera.height} x {camera.width} numbers (height x "
            f"width, as calibrated), got shape {np.shape(image)} of {image.dtype}."
        )
    return squeezed


def is_valid(view: DepthView, image: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether each pixel of a depth image has a depth, (H, W)."""
    depth = as_image(view.camera, image).astype(np.float64) * (view.unit or unit_of(image.dtype))
    return (depth > view.near) & (depth < view.far)


def describe(view: DepthView, image: NDArray[Any], crop: Crop) -> str:
    """A depth image in a line: its valid share, the box of its points, and the share within a crop along each axis."""
    camera, unit = view.camera, view.unit or unit_of(image.dtype)
    depth = as_image(camera, image).astype(np.float64)
    valid = is_valid(view, image)
    if not valid.any():
        measured = depth[np.isfinite(depth) & (depth > 0)]
        if len(measured) == 0:
            return f"Camera '{camera.name}' measures nothing: every pixel is 0 or NaN"
        median = float(np.median(measured))
        return (
            f"Camera '{camera.name}' measures nothing between {view.near} and {view.far} m: its median is {median:g} "
            f"units of {unit:g} m"
        )
    points = camera.unproject(np.where(valid, depth * unit, 0))[valid.ravel()]
    low, high = (np.round(np.percentile(points, share, axis=0), 3).tolist() for share in (1, 99))
    covered = np.mean((points >= crop.low) & (points <= crop.high), axis=0)
    shares = ", ".join(f"{axis} of {share:.0%}" for axis, share in zip("xyz", covered, strict=True))
    return (
        f"Camera '{camera.name}' has {valid.mean():.0%} valid depth and sees {low} to {high} m; of its points the crop "
        f"holds the {shares}"
    )


def to_millimetres(depth: NDArray[np.floating[Any]]) -> NDArray[np.uint16]:
    """Depth [m] as a RealSense camera gives it: whole millimetres, 0 where nothing was measured."""
    limit = np.iinfo(np.uint16).max
    millimetres = np.rint(depth / MILLIMETRE)
    return np.where(np.isfinite(depth) & (millimetres <= limit), millimetres, 0).astype(np.uint16)


def _span(flags: NDArray[np.bool_]) -> slice:
    """The slice from the first to the last set flag; empty if none is set."""
    (indices,) = np.nonzero(flags)
    return slice(int(indices[0]), int(indices[-1]) + 1) if len(indices) else slice(0, 0)
