# SPDX-License-Identifier: Apache-2.0
"""Images prepared ahead are the same as those prepared in their turn."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_sfm.config import MapperConfig
from pipeprog_sfm.features.images_ahead import ImagesAhead, decoded
from pipeprog_sfm.features.sift import extract

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
CONFIG = MapperConfig()


def encoded(seed: int) -> bytes:
    coarse = np.random.default_rng(seed).integers(0, 256, (30, 40), np.uint8)
    image = cv2.resize(coarse, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_CUBIC)
    return cv2.imencode(".png", image)[1].tobytes()


def prepared(images: dict[int, bytes]) -> ImagesAhead:
    """One that has prepared all of these images, by stamp."""
    ahead = ImagesAhead(CONFIG)
    for stamp, data in images.items():
        ahead.expect(stamp, data, CAMERA)
    ahead._thread.submit(lambda: None).result()  # after them
    return ahead


def test_what_was_expected_has_the_features_of_its_image() -> None:
    images = {stamp: encoded(stamp) for stamp in range(3)}
    ahead = prepared(images)
    for stamp, data in images.items():
        image = ahead.take(stamp, data, CAMERA, CAMERA)
        np.testing.assert_array_equal(image.gray, decoded(data, CAMERA))
        again = extract(image.gray, CAMERA, CONFIG)
        assert image.features is not None
        assert len(again) > 0
        np.testing.assert_array_equal(image.features.keypoints, again.keypoints)
        np.testing.assert_array_equal(image.features.descriptors, again.descriptors)


def test_features_are_those_of_the_calibration_used() -> None:
    data = encoded(0)
    ahead = prepared({1: data})
    image = ahead.take(1, data, CAMERA, replace(CAMERA, fx=151.0))
    assert image.features is None
    np.testing.assert_array_equal(image.gray, decoded(data, CAMERA))


def test_another_image_of_the_stamp_is_not_taken_for_the_one_expected() -> None:
    ahead, other = prepared({1: encoded(0)}), encoded(1)
    image = ahead.take(1, other, CAMERA, CAMERA)
    assert image.features is None
    np.testing.assert_array_equal(image.gray, decoded(other, CAMERA))


@pytest.mark.parametrize("is_expected", [False, True])
@pytest.mark.parametrize(
    ("data", "camera", "problem"),
    [(encoded(0)[:100], CAMERA, "damaged"), (encoded(0), replace(CAMERA, width=161), "has 160 x 120 pixels")],
)
def test_problems_are_told_when_the_image_is_taken(
    is_expected: bool, data: bytes, camera: Camera, problem: str
) -> None:
    ahead = ImagesAhead(CONFIG)
    if is_expected:
        ahead.expect(1, data, camera)
    with pytest.raises(InputError, match=problem):
        ahead.take(1, data, camera, camera)


def test_one_that_is_forgotten_is_not_expected_any_more() -> None:
    data = encoded(0)
    ahead = prepared({1: data})
    ahead.forget(1)
    ahead.forget(2)
    assert ahead.take(1, data, CAMERA, CAMERA).features is None
