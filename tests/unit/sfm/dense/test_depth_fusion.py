# SPDX-License-Identifier: Apache-2.0
"""Fusion of exact and spoilt depth maps of a wall with a pipe in front of it."""

import numpy as np
import pytest

from pipeprog_camera.camera import Camera
from pipeprog_sfm.config import FusionConfig
from pipeprog_sfm.dense.depth_fusion import Fusion
from pipeprog_sfm.dense.stereo import DepthMap

CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
WALL, AXIS, RADIUS = 2.0047, 1.7, 0.15  # the wall lies within a layer of voxels, not between two
VOXEL = 0.01
CONFIG = FusionConfig(voxel=VOXEL, min_views=3)


def pose(x, y=0.0):
    matrix = np.eye(4)
    matrix[:2, 3] = -x, -y
    return matrix


def exact(stamp, camera_from_map, unit=1.0):
    """Depth map of the wall z = WALL and an upright pipe, in units of `unit` metres."""
    x = -camera_from_map[0, 3]
    rows, columns = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    slope = (columns - CAMERA.cx) / CAMERA.fx
    a, b, c = slope**2 + 1, slope * x - AXIS, x**2 + AXIS**2 - RADIUS**2
    hit = b * b - a * c > 0
    depth = np.full(rows.shape, WALL)
    depth[hit] = ((-b - np.sqrt(np.where(hit, b * b - a * c, 0.0))) / a)[hit]
    color = np.zeros((*rows.shape, 3), np.uint8)
    color[hit] = 200, 100, 50  # BGR
    color[~hit] = 30
    return DepthMap(stamp, (depth / unit).astype(np.float32), CAMERA, color)


POSES = {stamp: pose(0.1 * stamp - 0.25, 0.02 * stamp) for stamp in range(6)}
MAPS = [exact(stamp, matrix) for stamp, matrix in POSES.items()]


def fuse(depth_maps, cameras_from_map, scale, config):
    """Cloud of all depth maps with poses, in order of time."""
    fusion = Fusion(config)
    for depth_map in sorted(depth_maps, key=lambda depth_map: depth_map.stamp):
        if depth_map.stamp in cameras_from_map:
            fusion.add(depth_map, cameras_from_map[depth_map.stamp], scale)
    return fusion.cloud()


@pytest.fixture(scope="module")
def cloud():
    return fuse(MAPS, POSES, 1.0, CONFIG)


def surface(points):
    """Distance to the surface and its outward normal (towards the cameras)."""
    p = points.astype(float)
    radial = np.c_[p[:, 0], np.zeros(len(p)), p[:, 2] - AXIS]
    distance = np.linalg.norm(radial, axis=1)
    on_pipe = np.abs(distance - RADIUS) < np.abs(p[:, 2] - WALL)
    normal = np.where(on_pipe[:, None], radial / distance[:, None], [0.0, 0.0, -1.0])
    return np.where(on_pipe, distance - RADIUS, p[:, 2] - WALL), normal, on_pipe


def test_points_lie_on_the_surface(cloud):
    distance, _, on_pipe = surface(cloud.points)
    assert on_pipe.sum() > 500
    assert (~on_pipe).sum() > 5000
    assert np.abs(distance[~on_pipe]).max() < 1e-4
    assert np.percentile(np.abs(distance[on_pipe]), 95) < 0.002  # bilinear depth cuts the curve: p^2 / (8 R) = 0.3 mm


def test_normals_face_the_cameras(cloud):
    _, normal, on_pipe = surface(cloud.points)
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0, atol=1e-5)
    angle = np.degrees(np.arccos(np.clip((cloud.normals * normal).sum(axis=1), -1, 1)))
    assert np.percentile(angle[~on_pipe], 90) < 1.0
    assert np.median(angle[on_pipe]) < 8.0
    assert (cloud.normals[:, 2] < 0).all()


def test_colors_are_rgb_and_views_are_counted(cloud):
    _, _, on_pipe = surface(cloud.points)
    np.testing.assert_array_equal(np.median(cloud.colors[on_pipe], axis=0), [50, 100, 200])
    np.testing.assert_array_equal(np.median(cloud.colors[~on_pipe], axis=0), [30, 30, 30])
    assert cloud.views.min() == CONFIG.min_views
    assert cloud.views.max() == len(MAPS)


def test_one_point_a_voxel(cloud):
    cells = np.floor(cloud.points.astype(float) / VOXEL + 1e-4).astype(int)
    assert len(np.unique(cells, axis=0)) > 0.97 * len(cells)  # points on a voxel's face may round to either side


def test_what_one_map_alone_claims_is_dropped():
    maps = list(MAPS)
    depth = maps[3].depth.copy()
    depth[40:80, 10:40] = 1.2  # floats before the wall
    maps[3] = DepthMap(3, depth, CAMERA, maps[3].color)
    distance, _, _ = surface(fuse(maps, POSES, 1.0, CONFIG).points)
    assert np.abs(distance).max() < 0.01


def test_noise_averages_out():
    rng = np.random.default_rng(1)
    noisy = [
        DepthMap(m.stamp, m.depth + rng.normal(0, 0.004, m.depth.shape).astype(np.float32), CAMERA, m.color)
        for m in MAPS
    ]
    distance, _, on_pipe = surface(fuse(noisy, POSES, 1.0, CONFIG).points)
    assert np.std(distance[~on_pipe]) < 0.003
    assert abs(np.mean(distance[~on_pipe])) < 0.0005


def test_cloud_grows_only_with_what_is_new():
    fusion = Fusion(FusionConfig(voxel=0.035, min_views=3))  # wider than the pixels' pitch on the wall, 14 mm
    for x in np.arange(-0.4, 0.41, 0.1):
        fusion.add(exact(0, pose(x)), pose(x), 1.0)
    before = len(fusion.cloud().points)
    for x in np.arange(-0.25, 0.26, 0.1):
        fusion.add(exact(0, pose(x)), pose(x), 1.0)
    assert len(fusion.cloud().points) < 1.05 * before


def test_streamed_and_final_fusion_agree_and_repeat(cloud):
    fusion = Fusion(CONFIG)
    for depth_map in MAPS:
        fusion.add(depth_map, POSES[depth_map.stamp], 1.0)
    again = fusion.cloud()
    for name in ("points", "normals", "colors", "views"):
        assert getattr(again, name).tobytes() == getattr(cloud, name).tobytes()


def test_scale_brings_depth_to_metres(cloud):
    halves = [exact(stamp, matrix, unit=0.5) for stamp, matrix in POSES.items()]
    np.testing.assert_array_equal(fuse(halves, POSES, 0.5, CONFIG).points, cloud.points)


def test_too_few_views_give_no_points():
    cloud = fuse(MAPS[:2], POSES, 1.0, CONFIG)
    assert cloud.points.shape == (0, 3)
    assert cloud.normals.shape == (0, 3)
    assert len(cloud.views) == 0


def test_maps_without_pose_are_left_out(cloud):
    known = {stamp: matrix for stamp, matrix in POSES.items() if stamp != 5}
    assert fuse(MAPS, known, 1.0, CONFIG).points.tobytes() == fuse(MAPS[:5], POSES, 1.0, CONFIG).points.tobytes()


def test_kept_maps_are_bounded():
    fusion = Fusion(FusionConfig(voxel=VOXEL, min_views=3, max_maps=3))
    for _ in range(3):
        for depth_map in MAPS:
            fusion.add(depth_map, POSES[depth_map.stamp], 1.0)
            assert len(fusion._views) <= 3
    assert len(fusion.cloud().points) > 5000


def test_hash_survives_growth_and_negative_coordinates():
    far = {stamp: matrix.copy() for stamp, matrix in POSES.items()}
    for matrix in far.values():
        matrix[:3, 3] += 500.0  # the cameras stand at -500 m in each axis
    fine = FusionConfig(voxel=0.002, min_views=3)
    moved, here = fuse(MAPS, far, 1.0, fine), fuse(MAPS, POSES, 1.0, fine)
    assert len(here.points) > 40000
    assert abs(len(moved.points) - len(here.points)) < 0.02 * len(here.points)
    np.testing.assert_allclose(
        moved.points.mean(axis=0, dtype=float) + 500.0, here.points.mean(axis=0, dtype=float), atol=2e-3
    )
