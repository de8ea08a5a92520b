# SPDX-License-Identifier: Apache-2.0
"""Features of synthetic images."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_sfm.config import MapperConfig
from pipeprog_sfm.features.matching import match
from pipeprog_sfm.features.sift import extract, root_sift

CONFIG = MapperConfig(max_features=500)


def texture(width: int, height: int, contrast: float = 1.0) -> NDArray[np.uint8]:
    noise = np.random.default_rng(5).normal(0, 1, (height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3)
    return np.clip(128 + contrast * 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def camera(width: int, height: int) -> Camera:
    return Camera(width, height, 500.0, 500.0, (width - 1) / 2, (height - 1) / 2)


@pytest.mark.parametrize(("width", "height"), [(640, 480), (1280, 720)])
def test_features_move_with_the_image(width: int, height: int) -> None:
    # A shift by a whole number of pixels must not move a feature by anything else: no half pixel is lost when the
    # image is searched at half its size.
    image = texture(width + 40, height)
    left, right = image[:, :width], image[:, 16 : width + 16]
    a, b = extract(left, camera(width, height), CONFIG), extract(right, camera(width, height), CONFIG)
    found = match(a.descriptors, b.descriptors)
    assert len(found) > 200
    difference = a.keypoints[found[:, 0]] - b.keypoints[found[:, 1]]
    assert np.median(difference, axis=0) == pytest.approx([16, 0], abs=0.02)


def test_half_size_search_keeps_the_pixel_grid() -> None:
    # A symmetric blob is found at its centre.
    y, x = np.mgrid[:720, :1280]
    image = (200 * np.exp(-((x - 643.3) ** 2 + (y - 351.6) ** 2) / (2 * 12.0**2)) + 20).astype(np.uint8)
    keypoints = extract(image, camera(1280, 720), CONFIG).keypoints
    assert np.linalg.norm(keypoints - [643.3, 351.6], axis=1).min() < 0.1


def test_thin_texture_still_gives_features_all_over() -> None:
    image = texture(1280, 720)
    image[:, 640:] = texture(1280, 720, contrast=0.05)[:, 640:]
    keypoints = extract(image, camera(1280, 720), CONFIG).keypoints
    assert len(keypoints) == CONFIG.max_features
    assert 0.4 < (keypoints[:, 0] > 640).mean() < 0.6


def test_keypoints_are_undistorted() -> None:
    image = texture(640, 480)
    plain = camera(640, 480)
    bent = replace(plain, distortion=(-0.2, 0.05, 0.001, 0.0))
    expected = bent.undistort_points(extract(image, plain, CONFIG).keypoints)
    assert extract(image, bent, CONFIG).keypoints == pytest.approx(expected, abs=1e-3)


def test_an_empty_image_has_no_features() -> None:
    features = extract(np.full((480, 640), 90, np.uint8), camera(640, 480), CONFIG)
    assert features.keypoints.shape == (0, 2)
    assert features.descriptors.shape == (0, 128)


def test_the_same_image_gives_the_same_bytes() -> None:
    image = texture(640, 480)
    a, b = extract(image, camera(640, 480), CONFIG), extract(image, camera(640, 480), CONFIG)
    assert a.keypoints.tobytes() == b.keypoints.tobytes()
    assert a.descriptors.tobytes() == b.descriptors.tobytes()


def test_root_sift_has_norm_512() -> None:
    descriptors = np.random.default_rng(0).gamma(1.0, 20.0, (50, 128)).astype(np.float32)
    assert np.linalg.norm(root_sift(descriptors).astype(float), axis=1) == pytest.approx(512, rel=0.01)
