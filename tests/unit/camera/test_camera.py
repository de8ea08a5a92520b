# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError

K = [[900.0, 0.0, 639.5], [0.0, 905.0, 359.5], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("plumb_bob", (-0.2, 0.05, 0.001, -0.0005, 0.0)),
        ("rational_polynomial", (0.3, 0.02, 1e-4, -1e-4, 0.001, 0.5, 0.05, 0.002)),
        ("equidistant", (0.02, -0.003, 0.001, 0.0)),
    ],
)
@settings(max_examples=30, deadline=None)
@given(x=st.floats(0, 1279), y=st.floats(0, 719))
def test_distort_inverts_undistort(model: str, coefficients: tuple[float, ...], x: float, y: float) -> None:
    camera = Camera.from_calibration(1280, 720, K, model, coefficients)
    ideal = camera.undistort_points([[x, y]])
    np.testing.assert_allclose(camera.distort_points(ideal), [[x, y]], atol=1e-4)


def test_scaling_keeps_the_corner_of_the_image() -> None:
    """A ray through the outer corner of the first pixel stays in that corner: (-0.5, -0.5) in every size."""
    camera = Camera.from_calibration(1280, 720, K)
    half = camera.scaled(0.5)
    ray = np.array([(-0.5 - camera.cx) / camera.fx, (-0.5 - camera.cy) / camera.fy])
    np.testing.assert_allclose([ray[0] * half.fx + half.cx, ray[1] * half.fy + half.cy], [-0.5, -0.5], atol=1e-9)
    assert (half.width, half.height) == (640, 360)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fx": 0.0}, "not calibrated"),
        ({"fy": float("nan")}, "not calibrated"),
        ({"width": 0}, "image size"),
        ({"distortion_model": "kannala"}, "kannala"),
        ({"distortion": (0.1, 0.2, 0.3)}, "coefficients"),
        ({"distortion": (0.1, float("inf"), 0, 0, 0)}, "not finite"),
    ],
)
def test_bad_calibration_names_the_value(changes: dict[str, object], words: str) -> None:
    values = {"width": 1280, "height": 720, "fx": 900.0, "fy": 900.0, "cx": 639.5, "cy": 359.5, **changes}
    with pytest.raises(InputError, match=words):
        Camera(**values)  # type: ignore[arg-type]


def test_undistorted_camera_is_left_alone() -> None:
    camera = Camera.from_calibration(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]], "", ())
    image = np.zeros((480, 640), np.uint8)
    assert camera.undistort_image(image) is image
    assert not camera.is_distorted
