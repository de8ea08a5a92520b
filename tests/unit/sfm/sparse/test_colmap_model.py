# SPDX-License-Identifier: Apache-2.0
"""COLMAP models: written, and read back by COLMAP itself."""

import cv2  # noqa: F401  # before pycolmap
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from pipeprog_camera.camera import Camera
from pipeprog_sfm.sparse.colmap import ModelView, write_model

PLAIN = Camera(640, 480, 500.0, 505.0, 319.5, 239.5)
LENSES = [
    PLAIN,
    Camera(640, 480, 500.0, 505.0, 319.5, 239.5, "plumb_bob", (-0.2, 0.05, 0.001, -0.002, 0.01)),
    Camera(640, 480, 500.0, 505.0, 319.5, 239.5, "equidistant", (0.02, -0.01, 0.003, 0.001)),
]


def model(camera):
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.8, -0.6, 2.0], [0.8, 0.6, 3.0], (40, 3))
    views = []
    for number in range(3):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix()
        pose[:3, 3] = [-0.2 * number, 0.0, 0.0]
        inside = points @ pose[:3, :3].T + pose[:3, 3]
        pixels = inside[:, :2] / inside[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        seen = np.sort(rng.choice(40, 30, replace=False)) if number else np.arange(40)
        views.append(ModelView(f"{number}.jpg", camera, pose, pixels[seen], seen))
    counts = np.bincount(np.concatenate([view.points for view in views]), minlength=40)
    assert counts.min() >= 1
    return views, points


@pytest.mark.parametrize("camera", LENSES, ids=["pinhole", "plumb_bob", "equidistant"])
def test_colmap_reads_the_model_and_finds_no_error(tmp_path, camera):
    views, points = model(camera)
    write_model(tmp_path / "colmap", views, points)
    (tmp_path / "text").mkdir()
    for file in (tmp_path / "colmap").glob("*.txt"):
        file.rename(tmp_path / "text" / file.name)
    for folder in ("colmap", "text"):
        read = pycolmap.Reconstruction(tmp_path / folder)
        assert read.num_reg_images() == 3
        assert read.num_points3D() == 40
        # Its own cameras project the points to where they were seen.
        assert max(point.error for point in read.points3D.values()) < 1e-3
        read.update_point_3d_errors()
        assert read.compute_mean_reprojection_error() < 1e-3
        places = np.stack([point.xyz for _, point in sorted(read.points3D.items())])
        assert places == pytest.approx(points, abs=1e-9)
        image = read.image(2)
        assert image.cam_from_world().matrix() == pytest.approx(views[1].camera_from_map[:3], abs=1e-9)


def test_the_half_pixel_is_in_the_model_once(tmp_path):
    views, points = model(PLAIN)
    write_model(tmp_path, views, points)
    read = pycolmap.Reconstruction(tmp_path)
    assert read.camera(1).params.tolist() == [500.0, 505.0, 320.0, 240.0]
    assert read.image(1).points2D[0].xy == pytest.approx(views[0].pixels[0] + 0.5, abs=1e-9)
