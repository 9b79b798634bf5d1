"""Clouds from depth images."""

import dataclasses

import numpy as np
import pytest
from tests.depth_builders import CROP
from tests.depth_builders import LOOKING_DOWN_AND_AHEAD as ROTATION
from tests.depth_builders import make_camera as camera
from tests.depth_builders import random_depth as scene

from lerobot_uca.point_clouds.depth import (
    DepthError,
    DepthToCloud,
    DepthView,
    describe,
    is_valid,
    to_millimetres,
    unit_of,
)
from lerobot_uca.point_clouds.geometry import Crop, sample_farthest


def brute_force(view, depth):
    """All points inside the crop, one formula after the other."""
    points = view.camera.unproject(depth)
    valid = (depth > view.near) & (depth < view.far)
    return points[valid.ravel() & CROP.contains(points)]


def rows(points):
    return sorted(map(tuple, np.round(points, 5)))


def test_points_equal_the_unprojected_and_cropped_ones():
    view = DepthView(camera())
    depth = scene(view.camera).astype(np.float32)
    points = DepthToCloud([view], CROP, 32).points([depth])
    expected = brute_force(view, depth.astype(np.float64))
    assert 100 < len(expected) < depth.size / 2
    assert points.dtype == np.float32
    np.testing.assert_allclose(points, expected, atol=1e-6)


def test_a_cloud_is_a_farthest_point_sample_of_the_points():
    view = DepthView(camera())
    make = DepthToCloud([view], CROP, 64)
    depth = scene(view.camera).astype(np.float32)
    cloud, points = make([depth]), make.points([depth])
    assert cloud.shape == (64, 3)
    assert len(np.unique(cloud, axis=0)) == 64
    assert set(rows(cloud)) <= set(rows(points))
    np.testing.assert_array_equal(cloud, make([depth]))


def test_integers_are_millimetres_and_floating_point_numbers_metres():
    assert (unit_of(np.dtype(np.uint16)), unit_of(np.dtype(np.float32))) == (1e-3, 1.0)
    view = DepthView(camera())
    make = DepthToCloud([view], CROP, 64)
    millimetres = to_millimetres(scene(view.camera))
    np.testing.assert_allclose(make.points([millimetres]), make.points([millimetres / 1e3]), atol=1e-6)


@pytest.mark.parametrize("unit", [1e-3, 2.5e-4, 1e-4])
def test_a_live_frame_and_its_recording_give_the_same_cloud_bit_for_bit(unit):
    """LeRobot records uint16 and reads float32, in the same units."""
    view = DepthView(camera(), unit=unit)
    make = DepthToCloud([view], CROP, 64)
    live = np.rint(scene(view.camera) / unit).astype(np.uint16)
    live[::3, ::3] = 0
    recorded = live.astype(np.float32)[None]
    np.testing.assert_array_equal(make([live[..., None]]), make([recorded]))
    np.testing.assert_allclose(make.points([live]), brute_force(view, live * unit), atol=1e-6)


@pytest.mark.parametrize("far", [10.0, 2.0, 1.2])
def test_invalid_depth_never_makes_a_point(far):
    view = DepthView(camera(), unit=1e-3, far=far)
    everywhere = Crop((-20, -20, -20), (20, 20, 20))
    make = DepthToCloud([view], everywhere, 1)
    depth = np.zeros((48, 64), np.float32)
    depth[0, :5] = [0, np.nan, 10, far * 1e3, 65535]  # 10 and far are what LeRobot's encoder makes of invalid pixels
    depth[1, 0] = 11
    depth[1, 1] = far * 1e3 - 1
    assert len(make.points([depth])) == 2
    np.testing.assert_array_equal(np.argwhere(is_valid(view, depth)), [[1, 0], [1, 1]])


def test_several_cameras_are_fused():
    turned = np.diag([-1.0, -1.0, 1.0]) @ ROTATION
    views = [
        DepthView(camera("front")),
        DepthView(camera("back", position=(1.4, 0.0, 0.6), rotation=turned, size=(80, 48))),
    ]
    make = DepthToCloud(views, CROP, 128)
    depths = [scene(view.camera, seed).astype(np.float32) for seed, view in enumerate(views)]
    each = [DepthToCloud([view], CROP, 128).points([depth]) for view, depth in zip(views, depths, strict=True)]
    assert min(map(len, each)) > 50
    np.testing.assert_array_equal(make.points(depths), np.concatenate(each))
    cloud = set(rows(make(depths)))
    assert all(cloud & set(rows(points)) for points in each)


def test_many_pixels_are_thinned_out_evenly_first():
    view = DepthView(camera(size=(320, 240)))
    make = DepthToCloud([view], CROP, 128)
    floor = view.camera.depth_rays()[:, 2]
    depth = np.where(floor < 0, (0.05 - view.camera.position[2]) / np.minimum(floor, -1e-9), 0).reshape(240, 320)
    all_points, cloud = make.points([depth]), make([depth])
    assert len(all_points) > 10 * 8 * 128
    assert len(make.points([depth], max_points=1024)) == 1024

    def radius(sample):
        """The largest distance of a point of the scene from the sample [m]."""
        return np.sqrt(((all_points[:, None] - sample[None]) ** 2).sum(-1)).min(axis=1).max()

    assert radius(cloud) < 1.3 * radius(sample_farthest(all_points, 128))


def test_too_few_points_are_an_error_with_the_numbers():
    view = DepthView(camera(), unit=1e-3)
    far_away = Crop((5, 5, 5), (6, 6, 6))
    depth = to_millimetres(scene(view.camera))
    depth[:24] = 0
    with pytest.raises(
        DepthError, match=r"The cloud has 0 points inside the crop \(5, 5, 5\) to \(6, 6, 6\) m, at lea"
    ) as e:
        DepthToCloud([view], far_away, 512)([depth])
    assert "at least 64 are needed. Camera 'front' has 50% valid depth and sees [" in str(e.value)


def test_depth_in_other_units_is_named():
    view = DepthView(camera(), unit=1e-3)
    make = DepthToCloud([view], CROP, 64)
    metres = scene(view.camera).astype(np.float32)
    with pytest.raises(DepthError, match=r"its median is 1.0.* units of 0.001 m. In units of 1 m camera 'front' would"):
        make([metres])
    in_metres = dataclasses.replace(view, unit=1.0)
    with pytest.raises(DepthError, match=r"its median is 10.* units of 1 m. In units of 1 mm camera 'front' would"):
        DepthToCloud([in_metres], CROP, 64)([to_millimetres(metres)])


@pytest.mark.parametrize(("unit", "name"), [(2.5e-4, "0.25 mm"), (1e-4, "0.1 mm")])
def test_depth_in_a_cameras_own_unit_is_named(unit, name):
    """Four and ten times too far, but still a depth that a room may have: the crop tells."""
    view = DepthView(camera(), unit=1e-3)
    depth = np.full((48, 64), round(0.9 / unit), np.uint16)
    n_points = len(DepthToCloud([dataclasses.replace(view, unit=unit)], CROP, 64).points([depth]))
    message = f"In units of {name} camera 'front' would have {n_points} points inside the crop: check its depth_unit"
    with pytest.raises(DepthError, match=message):
        DepthToCloud([view], CROP, 64)([depth])


def test_a_covered_camera_is_named():
    view = DepthView(camera())
    with pytest.raises(DepthError, match="Camera 'front' measures nothing: every pixel is 0 or NaN"):
        DepthToCloud([view], CROP, 64)([np.zeros((48, 64), np.uint16)])


@pytest.mark.parametrize(
    ("image", "got"),
    [
        (np.zeros((3, 48, 64), np.uint8), r"shape \(3, 48, 64\) of uint8"),
        (np.zeros((64, 48), np.uint16), r"shape \(64, 48\) of uint16"),
        (np.zeros((48, 64), bool), r"shape \(48, 64\) of bool"),
    ],
)
def test_other_images_are_refused(image, got):
    with pytest.raises(DepthError, match="camera 'front' must be 48 x 64 numbers.*" + got):
        DepthToCloud([DepthView(camera())], CROP, 64)([image])


def test_one_image_a_camera():
    with pytest.raises(DepthError, match="One depth image a camera is needed, 1, got 2"):
        DepthToCloud([DepthView(camera())], CROP, 64)([np.zeros((48, 64))] * 2)
    with pytest.raises(ValueError, match="At least one view and one point are needed, got 0 and 5"):
        DepthToCloud([], CROP, 5)


def test_a_camera_that_does_not_see_the_crop_gives_nothing():
    away = DepthView(camera(rotation=ROTATION @ np.diag([-1.0, 1.0, -1.0])))
    assert DepthToCloud([away], CROP, 64).points([scene(away.camera)]).shape == (0, 3)


def test_whole_millimetres():
    depth = np.array([[0.0, 0.0004, 0.0016, 65.535, 65.6, np.inf, np.nan]])
    np.testing.assert_array_equal(to_millimetres(depth), [[0, 0, 2, 65535, 0, 0, 0]])


def test_what_a_camera_sees_is_described_in_the_base_frame():
    view = DepthView(camera(), unit=1e-3)
    text = describe(view, np.full((48, 64), 800, np.uint16), CROP)
    points = view.camera.unproject(np.full((48, 64), 0.8))
    assert str(np.round(np.percentile(points, 1, axis=0), 3).tolist()) in text
    shares = [round(100 * share) for share in ((points >= CROP.low) & (points <= CROP.high)).mean(axis=0)]
    assert text.endswith("of its points the crop holds the x of {}%, y of {}%, z of {}%".format(*shares))
