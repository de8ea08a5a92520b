# SPDX-License-Identifier: Apache-2.0
"""Pixels of a rolling shutter, thousands at a time: the same as by the definition, and the steps beside them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RolledImage
from pipeprog_camera.rolling_shutter import RowMotion

RANDOM = np.random.default_rng(4)
# A walk past things at 1.4 m/s with a turning hand: up to 30 px at half a metre.
MOTION = RowMotion(0.03, 720, np.array([1.4, -0.2, 0.3]), np.array([0.3, -0.4, 1.0]))
PIXELS, DEPTHS = RANDOM.uniform(0.0, [1279.0, 719.0], (500, 2)), RANDOM.uniform(0.5, 4.0, 500)


def rolled_image(distortion: tuple[float, ...] = (), model: str = "plumb_bob") -> RolledImage:
    return RolledImage(MOTION, Camera(1280, 720, 913.9, 913.9, 639.5, 359.5, model, distortion))


def moved_pixels(camera: Camera) -> np.ndarray:
    """The pixels, each at the time of the row that draws it: exact rotations, the lens itself."""
    centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    points = DEPTHS[:, None] * np.c_[(PIXELS - centre) / focal, np.ones(len(PIXELS))]
    shown = PIXELS
    for _ in range(6):  # each step multiplies the error by at most 0.1
        times = MOTION.row_times(camera.distort_points(shown)[:, 1])[:, None]
        moved = Rotation.from_rotvec(MOTION.angular * times).apply(points) + MOTION.linear * times
        shown = moved[:, :2] / moved[:, 2:] * focal + centre
    return shown


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("plumb_bob", ()),
        ("plumb_bob", (-0.3, 0.1, 1e-3, -5e-4, -0.02)),
        ("equidistant", (-0.02, 0.01, 0.0, 0.0)),
    ],
)
def test_pixels_are_those_of_the_motion(model: str, distortion: tuple[float, ...]) -> None:
    image = rolled_image(distortion, model)
    expected = moved_pixels(image.camera)
    np.testing.assert_allclose(image.shown(PIXELS, DEPTHS), expected, atol=2e-3)
    assert np.linalg.norm(expected - PIXELS, axis=1).max() > 20.0


def test_a_smaller_image_shows_the_same() -> None:
    image = rolled_image()
    small = image.scaled(0.5)
    expected = (image.shown(PIXELS, DEPTHS) + 0.5) * 0.5 - 0.5
    np.testing.assert_allclose(small.shown((PIXELS + 0.5) * 0.5 - 0.5, DEPTHS), expected, atol=1e-6)


def test_steps_lead_to_the_pixels_beside() -> None:
    image = rolled_image()
    angle = RANDOM.uniform(0.0, 2.0 * np.pi, len(PIXELS))
    across = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    place, step = image.shown_beside(PIXELS, (across,), DEPTHS)
    np.testing.assert_allclose(place + 5.0 * step, image.shown(PIXELS + 5.0 * across, DEPTHS), atol=2e-3)
    assert np.abs(step - across).max() > 5e-3
