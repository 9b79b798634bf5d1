"""Ray casting against MuJoCo's own single-ray function, on a small scene with known geometry."""

import itertools

import mujoco
import numpy as np
import pytest

from lerobot_uca.point_clouds.cameras import (
    BACKGROUND,
    DepthCamera,
    Marker,
    PictureCamera,
    PointCloudCamera,
    shade,
    surface_colours,
)
from lerobot_uca.point_clouds.depth import DepthToCloud, DepthView, to_millimetres
from lerobot_uca.point_clouds.geometry import Camera, Crop

SCENE = """
<mujoco>
  <asset>
    <texture name="grey" type="2d" builtin="flat" rgb1="0.5 0.5 0.5" width="4" height="4"/>
    <material name="red" rgba="1 0 0 1"/>
    <material name="textured" texture="grey" rgba="1 1 0 1"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 0.1" material="textured"/>
    <geom name="ball" type="sphere" size="0.2" pos="0 0 0.5" material="red"/>
    <geom name="box" type="box" size="0.1 0.1 0.1" pos="0.5 0 0.1" rgba="0 0 1 1"/>
    <geom name="collision_shape" type="sphere" size="0.4" pos="0 0 0.5" group="3"/>
  </worldbody>
</mujoco>
"""
MOVING_SCENE = """
<mujoco>
  <worldbody>
    <geom type="plane" size="2 2 0.1"/>
    <body name="box" pos="0.5 0 0.1"><geom type="box" size="0.1 0.1 0.1"/></body>
    <body pos="0.1 0 0.3"><joint type="slide" axis="0 0 1"/><geom type="sphere" size="0.2"/></body>
  </worldbody>
</mujoco>
"""
ARM_SCENE = """
<mujoco>
  <worldbody>
    <geom type="plane" size="2 2 0.1"/>
    <body name="thing" pos="0.5 0 0.1"><geom type="box" size="0.1 0.1 0.1"/></body>
    <body name="arm" pos="-0.4 0 0.5">
      <geom type="sphere" size="0.1"/>
      <body pos="0.4 0 0"><geom type="sphere" size="0.2"/></body>
    </body>
    <body name="last" pos="0 0.5 0.1"><geom type="box" size="0.1 0.1 0.1"/></body>
  </worldbody>
</mujoco>
"""
LOOKING_DOWN = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
CAMERA = Camera.from_fovy("top", (0.0, 0.0, 2.0), LOOKING_DOWN, 60.0, (40, 40))
EVERYTHING = Crop((-9, -9, -9), (9, 9, 9))


@pytest.fixture(scope="module")
def scene():
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def points_of_single_rays(model: mujoco.MjModel, data: mujoco.MjData) -> list[np.ndarray]:
    origin = CAMERA.position
    points = []
    for direction in CAMERA.ray_directions():
        hit = np.zeros(1, dtype=np.int32)
        distance = mujoco.mj_ray(model, data, origin, direction, np.array([1, 1, 1, 0, 0, 0], np.uint8), 1, -1, hit)
        if distance >= 0:
            points.append(origin + distance * direction)
    return points


def test_points_equal_those_of_single_rays(scene):
    points = PointCloudCamera(CAMERA, EVERYTHING).capture(*scene)
    np.testing.assert_allclose(points, points_of_single_rays(*scene), atol=1e-9)


def test_points_follow_what_moves_what_is_moved_and_another_model():
    camera = PointCloudCamera(CAMERA, EVERYTHING)
    clouds = []
    for _ in range(2):
        model = mujoco.MjModel.from_xml_string(MOVING_SCENE)
        data = mujoco.MjData(model)
        for falling, sideways in ((0.0, 0.0), (0.3, 0.0), (1.7, 0.0), (0.3, 0.4)):  # 1.7: around the camera
            data.qpos[0] = falling
            model.body("box").pos[1] = sideways
            mujoco.mj_forward(model, data)
            clouds.append(camera.capture(model, data))
            np.testing.assert_allclose(clouds[-1], points_of_single_rays(model, data), atol=1e-9)
    assert all(len(a) != len(b) or not np.allclose(a, b) for a, b in itertools.pairwise(clouds))


def test_a_crop_keeps_exactly_the_points_inside(scene):
    model, data = scene
    crop = Crop((-0.3, -0.3, 0.05), (0.3, 0.3, 1.0))
    everything = PointCloudCamera(CAMERA, EVERYTHING).capture(model, data)
    inside = PointCloudCamera(CAMERA, crop).capture(model, data)
    np.testing.assert_allclose(inside, everything[crop.contains(everything)])
    np.testing.assert_allclose(np.linalg.norm(inside - [0, 0, 0.5], axis=1), 0.2, atol=1e-6)  # the ball, and it alone


def test_markers_are_seen_and_hidden_like_solid_spheres(scene):
    model, data = scene
    above = Marker(np.array([0, 0, 1.0]), 0.1, np.ones(3))
    below = Marker(np.array([0, 0, 0.1]), 0.1, np.ones(3))  # under the ball
    camera = PointCloudCamera(CAMERA, EVERYTHING)
    plain = camera.capture(model, data)
    np.testing.assert_array_equal(camera.capture(model, data, [below]), plain)
    changed = camera.capture(model, data, [above])
    moved = np.abs(changed - plain).max(axis=1) > 0
    assert moved.any()
    np.testing.assert_allclose(np.linalg.norm(changed[moved] - above.centre, axis=1), 0.1, atol=1e-9)


def test_a_body_that_is_left_out_hides_what_is_behind_it_but_gives_no_points():
    model = mujoco.MjModel.from_xml_string(ARM_SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    whole, without = PointCloudCamera(CAMERA, EVERYTHING), PointCloudCamera(CAMERA, EVERYTHING, left_out="arm")
    points = whole.capture(model, data)
    is_arm = np.zeros(len(points), bool)
    for centre, radius in (([-0.4, 0, 0.5], 0.1), ([0, 0, 0.5], 0.2)):
        is_arm |= np.abs(np.linalg.norm(points - centre, axis=1) - radius) < 1e-6
    assert 10 < is_arm.sum() < len(points) - 100
    np.testing.assert_array_equal(without.capture(model, data), points[~is_arm])
    over = Marker(np.array([0, 0, 1.0]), 0.1, np.ones(3))
    under = Marker(np.array([0, 0, 0.1]), 0.1, np.ones(3))
    seen = without.capture(model, data, [over, under])
    distance = {marker: np.abs(np.linalg.norm(seen - [0, 0, marker], axis=1) - 0.1) for marker in (1.0, 0.1)}
    assert (distance[1.0] < 1e-6).sum() > 3
    assert not (distance[0.1] < 1e-6).any()
    again = mujoco.MjModel.from_xml_string(ARM_SCENE.replace('name="arm"', 'name="x"').replace('"last"', '"arm"'))
    data = mujoco.MjData(again)
    mujoco.mj_forward(again, data)
    assert len(without.capture(again, data)) > (~is_arm).sum()  # of another model it is another body


def test_a_depth_picture_holds_the_points_that_the_cloud_camera_sees(scene):
    model, data = scene
    marker = Marker(np.array([-0.6, 0, 0.2]), 0.15, np.array([0, 1.0, 0]))
    crop = Crop((-0.9, -0.5, 0.02), (0.8, 0.5, 0.9))
    depth = DepthCamera(CAMERA).capture(model, data, [marker])
    assert depth.shape == (40, 40)
    assert depth.min() == pytest.approx(2 - 0.7, abs=0.005)  # the top of the ball
    expected = PointCloudCamera(CAMERA, crop).capture(model, data, [marker])
    assert len(expected) > 100
    make = DepthToCloud([DepthView(CAMERA)], crop, 16)
    np.testing.assert_allclose(make.points([depth]), expected, atol=1e-6)
    # In whole millimetres a point moves by half of one along its ray's depth, and none crosses the crop's faces here.
    in_millimetres = make.points([to_millimetres(depth)])
    bound = 0.0005 * np.linalg.norm(CAMERA.depth_rays(), axis=1).max() + 1e-6
    assert np.linalg.norm(in_millimetres - expected, axis=1).max() <= bound


def test_a_depth_picture_of_nothing(scene):
    looking_up = Camera.from_fovy("up", (0.0, 0.0, 2.0), ((1.0, 0, 0), (0, -1.0, 0), (0, 0, -1.0)), 60.0, (8, 8))
    depth = DepthCamera(looking_up).capture(*scene)
    assert np.isinf(depth).all()
    assert (to_millimetres(depth) == 0).all()


def test_a_picture_shows_surfaces_in_their_colours(scene):
    model, data = scene
    marker = Marker(np.array([-0.6, 0, 0.2]), 0.15, np.array([0, 1.0, 0]))
    camera = Camera.from_fovy("top", (0.0, 0.0, 2.0), LOOKING_DOWN, 60.0, (41, 41))
    picture = PictureCamera(camera).capture(model, data, [marker])
    assert picture.shape == (41, 41, 3)
    assert picture.dtype == np.uint8
    red, green, blue = picture[20, 20], picture[20, 9], picture[20, 29]
    assert red[0] > 200
    assert red[1:].max() == 0
    assert green[1] > 150
    assert green[[0, 2]].max() == 0
    assert blue[2] > 150
    assert blue[:2].max() == 0


def test_where_there_is_nothing_the_picture_shows_the_background(scene):
    model, data = scene
    looking_up = Camera.from_fovy("up", (0.0, 0.0, 2.0), ((1.0, 0, 0), (0, -1.0, 0), (0, 0, -1.0)), 60.0, (8, 8))
    assert (PictureCamera(looking_up).capture(model, data) == BACKGROUND).all()
    assert len(PointCloudCamera(looking_up, EVERYTHING).capture(model, data)) == 0


def test_colours_come_from_the_geom_its_material_and_texture(scene):
    colours = surface_colours(scene[0])
    np.testing.assert_allclose(colours[0], [128 / 255, 128 / 255, 0], atol=0.01)
    np.testing.assert_allclose(colours[1], [1, 0, 0])
    np.testing.assert_allclose(colours[2], [0, 0, 1])


def test_surfaces_facing_the_camera_are_brighter():
    colours = np.ones((2, 3))
    directions = np.array([[0, 0, -1.0]] * 2)
    picture = shade(colours, np.array([[0, 0, 1.0], [1.0, 0, 0]]), directions)
    assert picture.dtype == np.uint8
    assert (picture[0] == 255).all()
    assert (picture[1] < picture[0]).all()
