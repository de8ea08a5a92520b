# SPDX-License-Identifier: Apache-2.0
"""Colour without brightness: red against blue."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeprog_camera.camera import Camera
from pipeprog_detect.keyframe_cache import Keyframes
from pipeprog_detect.silhouette.chromaticity import DARK, red_against_blue
from pipeprog_detect.silhouette.light_sampling import LINEAR_LIGHT

LEVEL = st.integers(0, 255)


def share(blue: int, green: int, red: int) -> float:
    """What the image of one colour says, -1/2 to 1/2; it holds another colour, too."""
    found = red_against_blue(np.array([[[blue, green, red], [0, 0, 255]]], np.uint8))
    assert found is not None
    return float(LINEAR_LIGHT[found[0, 0]]) / 255.0 - 0.5


@given(LEVEL, LEVEL, LEVEL)
def test_its_light_is_the_share_of_red_over_blue(blue: int, green: int, red: int) -> None:
    expected = (red - blue) / (red + green + blue + DARK)
    # Half of the coarsest step of the sRGB curve is 0.0045 of full light.
    assert share(blue, green, red) == pytest.approx(np.clip(expected, -0.5, 0.5), abs=0.006)


def test_shade_and_grey_texture_hardly_change_it() -> None:
    """Copper in half of the light, and concrete of any brightness; between them lies 0.2."""
    copper, shaded = share(81, 114, 170), share(57, 82, 125)
    assert abs(copper - shaded) < 0.03
    concrete = [share(level, level + 1, level + 3) for level in (50, 100, 200)]
    assert np.ptp(concrete) < 0.02
    assert copper - max(concrete) > 0.18


def test_grey_images_have_none() -> None:
    grey = np.random.default_rng(1).integers(2, 250, (48, 64), np.uint8)
    image = np.repeat(grey[..., None], 3, axis=2)
    assert red_against_blue(image) is None
    image[..., 2] += 2  # as rounding does
    assert red_against_blue(image) is None
    image[5, 5, 2] += 1
    assert red_against_blue(image) is not None


def test_keyframes_are_shown_in_colour_where_they_have_one() -> None:
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    image = np.random.default_rng(1).integers(0, 255, (48, 64, 3), np.uint8)
    keyframes = Keyframes()
    for stamp, picture in enumerate((image, image[..., 0])):
        keyframes.add(stamp, cv2.imencode(".png", picture)[1].tobytes(), camera)
    view = keyframes.view(0, np.eye(4))
    coloured = view.in_colour()
    assert coloured is not None
    np.testing.assert_array_equal(coloured.image, red_against_blue(image))
    assert coloured.stamp == view.stamp
    assert coloured.blur is None
    assert keyframes.view(1, np.eye(4)).in_colour() is None
