import numpy as np
import pytest

from lerobot_uca.point_clouds.geometry import (
    Camera,
    Crop,
    as_pose,
    opencv_from_opengl,
    ray_sphere_distances,
    sample_farthest,
    subsample_farthest,
)

IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def camera(width: int = 4, height: int = 2, fovy: float = 90.0) -> Camera:
    return Camera.from_fovy("test", (0.0, 0.0, 0.0), IDENTITY, fovy, (width, height))


def test_rays_of_a_small_camera_are_those_computed_by_hand():
    # fovy 90 and two rows: the focal length is one pixel, so pixel centres lie 0.5 up or down, 0.5 or 1.5 sideways.
    directions = camera().ray_directions()
    expected = np.array([[x, y, -1] for y in (0.5, -0.5) for x in (-1.5, -0.5, 0.5, 1.5)])
    np.testing.assert_allclose(directions, expected / np.linalg.norm(expected, axis=1, keepdims=True))


def test_rotation_turns_the_camera_frame_into_the_world_frame():
    looks_along_x = ((0.0, 0.0, -1.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0))  # camera x, y, z in the world: -y, z, -x
    mean = Camera.from_fovy("test", (0.0, 0.0, 0.0), looks_along_x, 60.0, (8, 8)).ray_directions().mean(axis=0)
    np.testing.assert_allclose(mean / np.linalg.norm(mean), [1, 0, 0], atol=1e-12)


def random_camera(rng: np.random.Generator) -> Camera:
    X = np.eye(4)
    X[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    X[:3, :3] *= np.sign(np.linalg.det(X[:3, :3]))
    X[:3, 3] = rng.normal(size=3)
    return Camera("random", 31.0, 29.0, 10.3, 7.8, 24, 16, as_pose(X))


def test_conventions_differ_in_y_and_z():
    """A point right, above and in front of the camera has these coordinates in either convention."""
    in_opengl, in_opencv = np.array([0.1, 0.2, -1.0, 1]), np.array([0.1, -0.2, 1.0, 1])
    X = np.asarray(random_camera(np.random.default_rng(0)).X_world_camera)
    np.testing.assert_allclose(opencv_from_opengl(X) @ in_opengl, X @ in_opencv)
    np.testing.assert_array_equal(opencv_from_opengl(opencv_from_opengl(X)), X)


def test_unproject_is_the_inverse_of_ray_directions():
    rng = np.random.default_rng(0)
    camera = random_camera(rng)
    distances = rng.uniform(0.3, 4, camera.width * camera.height)
    points = camera.position + camera.ray_directions() * distances[:, None]
    np.testing.assert_allclose(camera.unproject(camera.depth(distances)), points, atol=1e-12)


def test_a_point_comes_back_from_the_pixel_and_depth_that_it_projects_to():
    camera = random_camera(np.random.default_rng(1))
    u, v, z = 5, 11, 1.7
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    point = np.asarray(camera.X_world_camera) @ [*(np.linalg.inv(K) @ [u, v, 1] * z), 1]
    depth = np.full((camera.height, camera.width), z)
    np.testing.assert_allclose(camera.unproject(depth)[v * camera.width + u], point[:3])


def test_a_depth_of_another_camera_is_refused():
    with pytest.raises(ValueError, match=r"of camera 'random' has shape \(16, 24\), got \(24, 16\)"):
        random_camera(np.random.default_rng(0)).unproject(np.ones((24, 16)))


def test_a_ray_is_inside_a_crop_exactly_between_entering_and_leaving():
    rng = np.random.default_rng(0)
    crop = Crop((-0.3, 0.2, 1.0), (0.4, 0.9, 1.5))
    origin = np.array([1.0, -1.0, 0.5])
    directions = rng.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    along = np.linspace(0, 4, 4001)
    inside = np.array([crop.contains(origin + along[:, None] * direction) for direction in directions])
    enter, leave = crop.span(origin, directions)
    between = (enter[:, None] <= along) & (along <= leave[:, None])
    assert 0 < inside.any(axis=1).sum() < len(inside)
    np.testing.assert_array_equal(between, inside)


def test_a_ray_parallel_to_a_face_is_judged_by_the_other_axes():
    crop = Crop((0, 0, 0), (1, 1, 1))
    direction = np.array([[1.0, 0.0, 0.0]])
    for origin, expected in (([-1.0, 0.5, 0.5], (1, 2)), ([0.2, 0.5, 0.5], (0, 0.8))):
        np.testing.assert_allclose(np.ravel(crop.span(np.array(origin), direction)), expected)
    for beside_or_behind in ([-1.0, 1.5, 0.5], [2.0, 0.5, 0.5]):
        enter, leave = crop.span(np.array(beside_or_behind), direction)
        assert enter > leave


def test_distance_to_a_sphere():
    directions = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0]])
    distances = ray_sphere_distances(np.zeros(3), directions, np.array([3.0, 0.5, 0]), 1.0)
    np.testing.assert_allclose(distances, [3 - np.sqrt(0.75), np.inf, np.inf])


def test_sampling_takes_the_farthest_point_each_time():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)).astype(np.float32)
    sample = sample_farthest(points, 40)
    assert sample.dtype == np.float32
    np.testing.assert_array_equal(sample, sample_farthest(points, 40))
    for n in range(1, 40):
        distance = np.linalg.norm(points[:, None] - sample[None, :n], axis=2).min(axis=1)
        nearest = np.linalg.norm(sample[n] - sample[:n], axis=1).min()
        assert nearest == pytest.approx(distance.max(), rel=1e-5)


def test_a_shorter_sample_is_the_beginning_of_a_longer_one():
    points = np.random.default_rng(0).normal(size=(800, 3))
    np.testing.assert_array_equal(sample_farthest(points, 128), sample_farthest(points, 512)[:128])


def test_too_few_points_are_repeated_in_turn():
    points = np.random.default_rng(0).normal(size=(5, 3)) + 10
    sample = sample_farthest(points, 12)
    np.testing.assert_array_equal(sample[:5], sample[5:10])
    assert len(np.unique(sample, axis=0)) == 5
    assert (sample > 1).all()  # no zeros


@pytest.mark.parametrize("sample", [sample_farthest, subsample_farthest])
def test_colours_come_along_and_do_not_count_as_distances(sample):
    rng = np.random.default_rng(0)
    points, colours = rng.normal(size=(500, 3)), rng.uniform(0, 255, (500, 3))
    coloured = sample(np.concatenate([points, colours], axis=1).astype(np.float32), 40)
    np.testing.assert_array_equal(coloured[:, :3], sample(points.astype(np.float32), 40))
    row = {tuple(point): colour for point, colour in zip(points.astype(np.float32).tolist(), colours, strict=True)}
    for each in coloured.tolist():
        np.testing.assert_allclose(each[3:], row[tuple(each[:3])], rtol=1e-6)


def test_an_empty_cloud_is_an_error():
    with pytest.raises(ValueError, match="empty"):
        sample_farthest(np.empty((0, 3)), 10)
