"""Milliseconds from a depth image to a point cloud on one core, by stage, and how even the cloud is.

A 640 x 480 camera looks at a table that fills the crop: the most points that a crop can hold. Beside it the plain
way, which computes all points before it crops them and samples them all.

    OMP_NUM_THREADS=1 taskset -c 0 python benchmarks/depth.py
"""

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np
from common import print_provenance, times
from scipy.spatial import cKDTree

from lerobot_uca.point_clouds.depth import CANDIDATES_PER_POINT, DepthToCloud, DepthView, to_millimetres
from lerobot_uca.point_clouds.geometry import Camera, Crop, as_pose, sample_farthest

X_BASE_CAMERA = ((0.0, -0.6, 0.8, -0.3), (-1.0, 0.0, 0.0, 0.05), (0.0, -0.8, -0.6, 0.7), (0.0, 0.0, 0.0, 1.0))
CAMERA = Camera("front", 600.0, 600.0, 319.5, 239.5, 640, 480, as_pose(np.array(X_BASE_CAMERA)))
CROPS = {
    "small crop": Crop((0.4, -0.15, 0.01), (0.7, 0.15, 0.4)),
    "large crop": Crop((0.1, -0.6, 0.01), (1.2, 0.6, 0.4)),
}


def main() -> None:
    """Print one row a crop and number of points."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=50)
    repeats = parser.parse_args().repeats
    print_provenance()
    image = table()
    stages = ("crop, points", "sample", "all", "plain way", "x", "gap / plain gap")
    print(f"{'ms, median':28}" + "".join(f"{stage:>16}" for stage in stages) + f"{'pixels':>10}")
    for name, crop in CROPS.items():
        for n_points in (512, 1024):
            cells, n_pixels = measure(image, crop, n_points, repeats)
            row = "".join(f"{cell:16.2f}" for cell in cells)
            print(f"{f'{name}, {n_points} points':28}{row}{n_pixels:10}")


def table() -> np.ndarray:
    """A table 5 cm above the robot's base with a box on it, as uint16 millimetres, (H, W)."""
    rays, height = CAMERA.depth_rays(), CAMERA.position[2]
    depth = np.where(rays[:, 2] < 0, (0.05 - height) / np.minimum(rays[:, 2], -1e-9), np.inf)
    box = (0.2 - height) / np.minimum(rays[:, 2], -1e-9)
    x, y, _ = (CAMERA.position[:, None] + box * rays.T).tolist()
    on_box = (np.abs(np.array(x) - 0.55) < 0.06) & (np.abs(np.array(y)) < 0.06)
    return to_millimetres(np.where(on_box, box, depth)).reshape(CAMERA.height, CAMERA.width)


def measure(image: np.ndarray, crop: Crop, n_points: int, repeats: int) -> tuple[list[float], int]:
    """The cells of one row, and the number of pixels inside the crop."""
    make = DepthToCloud([DepthView(CAMERA)], crop, n_points)
    n_candidates = CANDIDATES_PER_POINT * n_points
    points = make.points([image], n_candidates)
    every = make.points([image])
    select = typical(lambda: make.points([image], n_candidates), repeats)
    sample = typical(lambda: sample_farthest(points, n_points), repeats)
    whole = typical(lambda: make([image]), repeats)
    plain = typical(lambda: plain_way(image, crop, n_points), max(3, repeats // 10))
    ratio = gap(every, make([image])) / gap(every, plain_way(image, crop, n_points))
    return [select, sample, whole, plain, plain / whole, ratio], len(every)


def plain_way(image: np.ndarray, crop: Crop, n_points: int) -> np.ndarray:
    """All points, then the crop, then farthest point sampling of all that are left."""
    points = CAMERA.unproject(image / 1e3)
    return sample_farthest(points[(image.ravel() > 0) & crop.contains(points)], n_points)


def gap(scene: np.ndarray, cloud: np.ndarray) -> float:
    """The largest distance of a point of the scene from the cloud [m]."""
    return float(cKDTree(cloud).query(scene)[0].max())


def typical(function: Callable[[], Any], repeats: int) -> float:
    """Median milliseconds of a call."""
    return float(np.median(times(function, repeats, n_warm_up=1)))


if __name__ == "__main__":
    main()
