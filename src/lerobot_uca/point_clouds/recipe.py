"""The recipe for a cloud from depth images: cameras, crop and sampling, as plain data.

A converted dataset, a policy's configuration and its preprocessor hold the same recipe. Crop and sampling belong to the
policy; calibrations belong to an installation, and a recipe remembers which ones it was made with.
"""

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from lerobot_uca.point_clouds.calibration import Calibration, CalibrationError, pose_difference, read_calibrations
from lerobot_uca.point_clouds.depth import FAR, MILLIMETRE, NEAR, DepthToCloud
from lerobot_uca.point_clouds.geometry import Crop

CALIBRATION_VARIABLE = "LEROBOT_UCA_CALIBRATION"
"""The environment variable that names an installation's folder of calibrations."""

SIMULATED = "simulated"
"""The method of a calibration that is known."""

RECIPE_INFO = "cloud_recipe"
"""The key of a feature's recipe, by which its clouds were made or are to be made: a LeRobot dataset's
features[key]['info'][RECIPE_INFO] is a `CloudRecipe` as a dictionary."""

Features = Mapping[str, Mapping[str, Any]]
"""The features of a LeRobot dataset."""

SAME = (0.01, 0.001)
"""(mm, deg) Poses this close are the same: files round."""


def camera_of(key: str) -> str:
    """The camera's name in a depth feature's: 'front' of 'observation.images.front_depth'."""
    return key.rpartition(".")[2].removesuffix("_depth")


@dataclass(frozen=True)
class DepthSource:
    """One camera of a recipe.

    Args:
        key: of its depth images among the observations.
        calibration: intrinsics, pose and unit.
        near, far: depth at or below near, or at or above far, is invalid [m].
    """

    key: str
    calibration: Calibration
    near: float = NEAR
    far: float = FAR


@dataclass(frozen=True)
class CloudRecipe:
    """The recipe that turns depth images into a policy's cloud.

    Args:
        sources: the cameras, in the order in which their images are given.
        crop: what belongs to the cloud, in the robot's base frame.
        n_points: of the cloud.
    """

    sources: tuple[DepthSource, ...]
    crop: Crop
    n_points: int

    def make(self) -> DepthToCloud:
        """The function from depth images to the cloud.

        Raises:
            CalibrationError: if a camera sits on the arm.
        """
        views = [source.calibration.view(source.near, source.far) for source in self.sources]
        return DepthToCloud(views, self.crop, self.n_points)

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys of the depth images among the observations."""
        return tuple(source.key for source in self.sources)

    def with_calibrations(self, calibrations: Mapping[str, Calibration]) -> Self:
        """The same recipe in another installation. A simulated camera stays where it is.

        Raises:
            CalibrationError: if one of the cameras is not calibrated.
        """
        sources = [
            source
            if source.calibration.method == SIMULATED
            else replace(source, calibration=calibration_of(camera_of(source.key), calibrations))
            for source in self.sources
        ]
        return replace(self, sources=tuple(sources))

    def differences(self, other: "CloudRecipe") -> list[str]:
        """The differences between another recipe and this one, for the same images, a line each."""
        lines = []
        if self.crop != other.crop:
            lines.append(f"the crop is {_corners(other.crop)} and was {_corners(self.crop)} m")
        if self.n_points != other.n_points:
            lines.append(f"a cloud has {other.n_points} points and had {self.n_points}")
        for mine, others in zip(self.sources, other.sources, strict=True):
            a, b = mine.calibration, others.calibration
            mm, deg = pose_difference(a.camera.X_world_camera, b.camera.X_world_camera)
            name = a.camera.name
            if mm > SAME[0] or deg > SAME[1]:
                lines.append(f"camera '{name}' is {mm:.1f} mm and {deg:.2f} deg from where it was")
            for what in ("fx", "fy", "cx", "cy", "width", "height"):
                before, now = getattr(a.camera, what), getattr(b.camera, what)
                if abs(before - now) > 1e-3:
                    lines.append(f"{what} of camera '{name}' is {now:g} and was {before:g} pixels")
            if a.depth_unit != b.depth_unit:
                lines.append(f"a unit of camera '{name}' is {b.depth_unit:g} m and was {a.depth_unit:g} m")
            if a.serial != b.serial:
                lines.append(f"camera '{name}' is the device {b.serial or 'without a serial'} and was {a.serial}")
            if (mine.near, mine.far) != (others.near, others.far):
                was, is_now = (f"{each.near:g} to {each.far:g} m" for each in (mine, others))
                lines.append(f"depth of camera '{name}' counts from {is_now} and did from {was}")
        return lines

    def as_dict(self) -> dict[str, Any]:
        """Numbers, text and lists only."""
        return {
            "sources": [
                {
                    "key": source.key,
                    "near": source.near,
                    "far": source.far,
                    "calibration": source.calibration.as_dict(),
                }
                for source in self.sources
            ],
            "crop": [list(self.crop.low), list(self.crop.high)],
            "n_points": self.n_points,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of `as_dict`.

        Raises:
            CalibrationError: for values that cannot be right.
        """
        try:
            sources = tuple(
                DepthSource(
                    str(source["key"]),
                    Calibration.from_dict(source["calibration"], f"The calibration of '{source['key']}'"),
                    float(source["near"]),
                    float(source["far"]),
                )
                for source in values["sources"]
            )
            return cls(sources, make_crop(*values["crop"]), int(values["n_points"]))
        except (KeyError, TypeError) as error:
            raise CalibrationError(f"A recipe needs sources, crop and n_points: {error!r}.") from error


def make_crop(low: Iterable[float], high: Iterable[float]) -> Crop:
    """A crop from two corners of three numbers.

    Raises:
        CalibrationError: if low is not below high.
    """
    a, b = tuple(map(float, low)), tuple(map(float, high))
    if len(a) != 3 or len(b) != 3 or not all(x < y for x, y in zip(a, b, strict=True)):
        raise CalibrationError(f"A crop has corners (x, y, z) [m], low below high in each, got {a} and {b}.")
    return Crop((a[0], a[1], a[2]), (b[0], b[1], b[2]))


def optional_crop(low: Iterable[float] | None, high: Iterable[float] | None) -> Crop | None:
    """A crop from two options, or None if neither is given.

    Raises:
        CalibrationError: for one without the other, and as `make_crop`.
    """
    if low is None and high is None:
        return None
    if low is None or high is None:
        raise CalibrationError("Give both crop_low and crop_high, or neither.")
    return make_crop(low, high)


def _corners(crop: Crop) -> str:
    return f"{list(crop.low)} to {list(crop.high)}"


def depth_source(key: str, info: Mapping[str, Any], calibration: Calibration) -> DepthSource:
    """The source of a depth feature of a LeRobot dataset, with what the feature's `info` says of units and range.

    LeRobot reads depth as millimetres: in the camera's units where it was recorded as integers, in real ones where it
    was recorded in metres. Its encoder writes invalid pixels as its smallest or largest depth.
    """
    if info.get("depth_unit") == "m":
        calibration = replace(calibration, depth_unit=MILLIMETRE)
    scale = calibration.depth_unit / MILLIMETRE  # the encoder takes a camera's units for millimetres
    near = max(NEAR, scale * float(info.get("video.depth_min") or 0))
    far = min(FAR, scale * float(info.get("video.depth_max") or FAR / scale))
    return DepthSource(key, calibration, near, far)


def installed_calibrations(folder: str | None = None) -> dict[str, Calibration] | None:
    """The calibrations of a folder or, without one, of $LEROBOT_UCA_CALIBRATION; None if neither is given."""
    chosen = folder or os.environ.get(CALIBRATION_VARIABLE)
    return read_calibrations(Path(chosen)) if chosen else None


def calibration_of(camera: str, calibrations: Mapping[str, Calibration] | None) -> Calibration:
    """One camera's calibration.

    Raises:
        CalibrationError: if there is none; it says how to make one.
    """
    if calibrations and camera in calibrations:
        return calibrations[camera]
    have = f"those of {', '.join(calibrations)}" if calibrations else "none"
    raise CalibrationError(
        f"Camera '{camera}' needs a calibration, got {have}. Make one with lerobot-uca-calibrate --camera={camera} and "
        f"name its folder with {CALIBRATION_VARIABLE}."
    )


def depth_keys(features: Features) -> list[str]:
    """The features of a dataset that are depth images."""
    return [
        key
        for key, feature in features.items()
        if feature["dtype"] in ("image", "video") and (feature.get("info") or {}).get("is_depth_map")
    ]


def recipe_for(
    features: Features,
    crop: tuple[Any, Any] | None,
    n_points: int,
    calibrations: Mapping[str, Calibration],
) -> CloudRecipe:
    """The recipe for all depth images of a dataset.

    Calibrations come by camera. A simulated camera comes with a recipe, in which its calibration and a crop are.

    Raises:
        CalibrationError: if a calibration or the crop is missing.
    """
    sources = []
    for key in depth_keys(features):
        info = features[key].get("info") or {}
        if RECIPE_INFO in info:
            own = CloudRecipe.from_dict(info[RECIPE_INFO])
            crop = crop or (own.crop.low, own.crop.high)
            known = {camera_of(source.key): source.calibration for source in own.sources}
            calibration = calibration_of(camera_of(key), known)
        else:
            calibration = calibration_of(camera_of(key), calibrations)
        sources.append(depth_source(key, info, calibration))
    if crop is None:
        raise CalibrationError(
            "A cloud from depth needs a crop: give crop_low and crop_high, two corners [m] in the robot's base frame."
        )
    return CloudRecipe(tuple(sources), make_crop(*crop), n_points)
