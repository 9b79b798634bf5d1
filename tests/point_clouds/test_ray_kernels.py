"""Compiled rays against MuJoCo's own, ray by ray, on random scenes."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lerobot_uca
from lerobot_uca import point_clouds
from lerobot_uca.point_clouds import compiling, ray_casting, single_rays
from lerobot_uca.point_clouds.geometry import Camera, ray_sphere_distances
from lerobot_uca.point_clouds.intersections import at_triangle, triangle
from lerobot_uca.point_clouds.ray_casting import RayCaster
from lerobot_uca.point_clouds.ray_kernels import cast_at
from lerobot_uca.point_clouds.rays import Hits, Rays

CAMERA = Camera.from_fovy("top", (0.0, 0.0, 1.5), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), 70.0, (48, 36))
ALL = np.ones(48 * 36, bool)
RAYS = Rays.of(CAMERA, ALL)
SIZES = {
    "sphere": "0.2",
    "capsule": "0.1 0.2",
    "ellipsoid": "0.1 0.2 0.3",
    "cylinder": "0.15 0.2",
    "box": "0.1 0.2 0.15",
    "plane": "0.4 0.3 0.1",
    "mesh": None,
}


def scene(kinds: list[str], seed: int, *, moving: bool = True) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Geoms at random poses around the origin, the mesh being the hull of random points."""
    rng = np.random.default_rng(seed)
    points = " ".join(f"{value:.4f}" for value in rng.uniform(-0.2, 0.2, 90))
    bodies = ""
    for kind in kinds:
        position = " ".join(map(str, rng.uniform(-0.5, 0.5, 3)))
        euler = " ".join(map(str, Rotation.random(random_state=rng).as_euler("xyz", degrees=True)))
        size = 'mesh="rock"' if kind == "mesh" else f'size="{SIZES[kind]}"'
        joint = '<freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>' * (moving and kind != "plane")
        bodies += f'<body pos="{position}" euler="{euler}">{joint}<geom type="{kind}" {size}/></body>'
    xml = f'<mujoco><asset><mesh name="rock" vertex="{points}"/></asset><worldbody>{bodies}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def both(model: mujoco.MjModel, data: mujoco.MjData, rays: Rays) -> tuple[Hits, Hits]:
    hits = [Hits.none(len(rays.directions), with_normals=True) for _ in range(2)]
    for cast, each in zip((cast_at, single_rays.cast_at), hits, strict=True):
        cast(np.arange(model.ngeom), model, data, rays, each)
    return hits[0], hits[1]


def assert_equal(hits: Hits, expected: Hits) -> None:
    np.testing.assert_array_equal(hits.geom, expected.geom)
    np.testing.assert_allclose(hits.distance, expected.distance, rtol=1e-12)
    hit = hits.geom >= 0
    units = [each.normal[hit] / np.linalg.norm(each.normal[hit], axis=1, keepdims=True) for each in (hits, expected)]
    np.testing.assert_allclose(np.abs(np.sum(units[0] * units[1], axis=1)), 1, atol=1e-9)


@pytest.mark.parametrize("kind", SIZES)
def test_hits_of_one_geom(kind):
    n_hits = 0
    for seed in range(6):
        hits, expected = both(*scene([kind], seed), RAYS)
        assert_equal(hits, expected)
        n_hits += np.sum(hits.geom >= 0)
        if kind == "mesh":
            np.testing.assert_array_equal(hits.distance, expected.distance)  # bit by bit
    assert n_hits > 50


def test_rays_that_meet_corners_are_cast_at_every_triangle_around():
    """A rough sheet below the camera whose corners, seen from there, are centres of pixels.

    Against each triangle and each ray: MuJoCo's tree misses rays along the boxes around triangles.
    """
    camera = Camera.from_fovy("top", (0.0, 0.0, 1.0), np.eye(3).tolist(), 90.0, (17, 17))
    rays = Rays.of(camera, np.ones(17 * 17, bool))
    depth = np.random.default_rng(0).uniform(0.9, 1, 9 * 9)
    x, y = (each.ravel() / 8.5 * depth for each in np.meshgrid(np.arange(-4, 5), np.arange(-4, 5)))
    corners = [9 * row + column for row in range(8) for column in range(8)]
    faces = [f"{i} {i + 1} {i + 9} {i + 1} {i + 10} {i + 9}" for i in corners]
    vertices = " ".join(map(str, np.stack([x, y, 1 - depth], axis=1).ravel()))
    xml = f"""<mujoco><asset><mesh name="sheet" vertex="{vertices}" face="{" ".join(faces)}"/></asset>
      <worldbody><geom type="mesh" mesh="sheet"/></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hits = Hits.none(len(rays.directions), with_normals=False)
    cast_at(np.arange(1), model, data, rays, hits)
    rotation = data.geom_xmat[0].reshape(3, 3)
    origin, directions = (rays.origin - data.geom_xpos[0]) @ rotation, rays.directions @ rotation
    triangles = [triangle(tuple(origin), *model.mesh_vert[face]) for face in model.mesh_face]
    expected = [min(at_triangle(tuple(direction), each)[0] for each in triangles) for direction in directions]
    np.testing.assert_allclose(hits.distance, expected, rtol=1e-12)
    assert np.isfinite(hits.distance).sum() > 50


def test_rays_around_a_sphere():
    """None that meets it is left out, and most others are."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        centre, radius = rng.uniform((-0.8, -0.8, -0.5), (0.8, 0.8, 1.4)), rng.uniform(0.01, 0.3)
        meeting = np.flatnonzero(np.isfinite(ray_sphere_distances(RAYS.origin, RAYS.directions, centre, radius)))
        assert set(meeting) <= set(RAYS.around(centre, radius))
    assert 0 < len(RAYS.around(np.zeros(3), 0.1)) < len(ALL) / 10
    assert len(RAYS.around(np.array([0, 0, 1.5]), 0.1)) == len(ALL)  # the camera inside it


def test_hits_of_a_crowd():
    for seed in range(4):
        hits, expected = both(*scene([*SIZES, *SIZES], seed), RAYS)
        assert_equal(hits, expected)
        assert len(set(hits.geom)) > 6


@pytest.mark.parametrize("height", [0.0, 0.1, 0.3])
def test_a_camera_amid_the_geoms(height):
    """Geoms reach behind the camera, or hold it."""
    pose = Rotation.from_euler("xyz", [100, 20, 30], degrees=True).as_matrix()
    rays = Rays.of(Camera.from_fovy("amid", (0.05, 0.1, height), pose, 100.0, (48, 36)), ALL)
    for seed in range(4):
        assert_equal(*both(*scene([*SIZES], seed), rays))


def test_only_rays_that_matter_are_cast():
    model, data = scene([*SIZES], 3)
    matters = np.random.default_rng(0).random(len(ALL)) < 0.3
    hits = RayCaster(CAMERA, matters).cast(model, data)
    np.testing.assert_array_equal(hits.distance, RayCaster(CAMERA).cast(model, data).distance[matters])
    assert np.isfinite(hits.distance).sum() > 50


def test_invisible_geoms_are_not_hit():
    xml = """<mujoco><asset><material name="glass" rgba="1 1 1 0"/></asset><worldbody>
      <geom type="box" size="1 1 0.1" pos="0 0 0.9" rgba="1 1 1 0"/>
      <geom type="box" size="1 1 0.1" pos="0 0 0.6" material="glass"/>
      <geom type="box" size="1 1 0.1" pos="0 0 0.3" group="3"/>
      <geom name="seen" type="box" size="1 1 0.1"/>
    </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    geom = np.empty(1, np.int32)
    mujoco.mj_ray(model, data, CAMERA.position, np.array([0, 0, -1.0]), single_rays.VISIBLE_GROUPS, 1, -1, geom)
    assert geom[0] == model.geom("seen").id
    assert set(RayCaster(CAMERA).cast(model, data).geom) == {geom[0], -1}


def test_a_height_field():
    xml = """<mujoco><asset><hfield name="hill" nrow="2" ncol="2" size="1 1 1 1"/></asset>
      <worldbody><geom type="hfield" hfield="hill"/></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    with pytest.raises(ValueError, match="Rays are not cast at geoms of type hfield"):
        RayCaster(CAMERA).cast(model, mujoco.MjData(model))


def test_without_numba_mujoco_casts_the_same(monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "lerobot_uca.point_clouds.ray_kernels", None)
    monkeypatch.delattr(point_clouds, "ray_kernels")
    ray_casting._caster.cache_clear()
    model, data = scene([*SIZES], 0)
    slow = RayCaster(CAMERA, with_normals=True).cast(model, data)
    assert "Rays are cast one by one, ten times slower than with Numba" in caplog.text
    monkeypatch.undo()
    ray_casting._caster.cache_clear()
    assert_equal(RayCaster(CAMERA, with_normals=True).cast(model, data), slow)


def test_what_is_compiled_follows_every_module(tmp_path):
    """Numba's own cache looks at a function's own file alone."""
    package = Path(lerobot_uca.__file__).parent
    shutil.copytree(package, tmp_path / "lerobot_uca", ignore=shutil.ignore_patterns("__pycache__"))
    script = """if True:
        import mujoco, numpy as np
        from lerobot_uca.point_clouds.geometry import Camera
        from lerobot_uca.point_clouds.ray_casting import RayCaster
        xml = '<mujoco><worldbody><geom type="box" size="0.1 0.1 0.1"/></worldbody></mujoco>'
        model = mujoco.MjModel.from_xml_string(xml)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        print(RayCaster(Camera.from_fovy("c", (0, 0, 1), np.eye(3), 45, (3, 3))).cast(model, data).distance[4])
    """

    def distance():
        env = {**os.environ, "PYTHONPATH": str(tmp_path)}
        return float(subprocess.check_output([sys.executable, "-c", script], env=env))

    assert distance() == pytest.approx(0.9)
    neighbour = tmp_path / "lerobot_uca" / "point_clouds" / "intersections.py"
    neighbour.write_text(neighbour.read_text().replace("t = (side * size[axis]", "t = 0.5 + (side * size[axis]"))
    assert distance() == pytest.approx(1.4)


def test_what_was_compiled_long_ago_is_forgotten(tmp_path, monkeypatch):
    monkeypatch.setattr(compiling.NUMBA, "CACHE_DIR", str(tmp_path / "users"))
    cache = compiling._cache()
    assert cache.parent == tmp_path / "users"  # as Numba does, which makes it
    old, young, others = (cache.with_name(name) for name in ("rays_old", "rays_young", "others"))
    for folder in (cache, old, young, others):
        folder.mkdir(parents=True)
        os.utime(folder, (0, 0))
    os.utime(young)
    assert compiling._cache() == cache
    assert old.exists()  # one that is there is looked up, no more
    cache.rmdir()
    compiling._cache()
    assert [each.exists() for each in (old, young, others)] == [False, True, True]
