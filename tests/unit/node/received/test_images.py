# SPDX-License-Identifier: Apache-2.0
"""Each message type from outside: what is taken of it, and under which kind a message is dropped."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from sensor_msgs.msg import CameraInfo, Image, RegionOfInterest

from pipeprog_camera.camera import Camera
from pipeprog_node import messages
from pipeprog_node.intake import InvalidMessageError
from pipeprog_node.received import images as received_images

CAMERA = Camera(1280, 720, 900.0, 901.0, 639.5, 359.5, "plumb_bob", (-0.2, 0.05, 0.001, -0.0005, 0.0))
K = CAMERA.matrix.ravel()


def info(**changes: Any) -> CameraInfo:
    message = messages.info_from_camera(CAMERA, 17, "camera")
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def test_a_calibration_is_taken_with_its_stamp_and_frame() -> None:
    assert received_images.camera_info(info()) == received_images.ReceivedCamera(17, "camera", CAMERA)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"k": np.zeros(9)}, "not calibrated"),
        ({"k": np.full(9, np.nan)}, "no camera matrix"),
        ({"k": np.full(9, np.inf)}, "no camera matrix"),
        ({"k": CAMERA.matrix.T.ravel()}, "by rows"),
        ({"k": K * [-1, 1, 1, 1, 1, 1, 1, 1, 1]}, "not calibrated"),
        ({"k": K * [1e-3, 1, 1, 1, 1e-3, 1, 1, 1, 1]}, "focal lengths of 0.9 and"),
        ({"k": K * [1e6, 1, 1, 1, 1e6, 1, 1, 1, 1]}, "focal lengths"),
        ({"k": K * [5, 1, 1, 1, 1, 1, 1, 1, 1]}, "focal lengths"),
        ({"k": K * [1, 1, 1e9, 1, 1, 1, 1, 1, 1]}, "principal point"),
        ({"k": K * [1, 1, -1e9, 1, 1, 1, 1, 1, 1]}, "principal point"),
        ({"width": 0}, "no image size"),
        ({"width": 16}, "too small"),
        ({"width": 100_000, "height": 100_000}, "too large"),
        ({"binning_x": 2}, "binning 2"),
        ({"roi": RegionOfInterest(x_offset=8)}, "region of interest"),
        ({"roi": RegionOfInterest(width=640, height=360)}, "640 x 360 at"),
        ({"d": [0.1, 0.2, 0.3]}, "coefficients"),
        ({"d": [np.nan] * 5}, "not finite"),
        ({"d": [np.inf] * 5}, "not finite"),
        ({"d": [0.0] * 100_000}, "100000 distortion coefficients"),
        ({"d": [1e300] * 5}, "move a corner"),
        ({"d": [0.0, 50.0, 0.0, 0.0, 0.0]}, "move a corner"),
        ({"distortion_model": "equidistant", "d": [0.0, 1e3, 0.0, 0.0]}, "move a corner"),
        ({"distortion_model": "\x1b[31m" + "m" * 1000}, r"model '\\x1b\[31mmmm"),
    ],
)
def test_a_calibration_of_no_camera_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidMessageError, match=words) as raised:
        received_images.camera_info(info(**changes))
    assert raised.value.kind == "calibration"
    assert len(str(raised.value)) < 400


ACTION_CAMERA = (-0.27, 0.11, 0.0, 0.0, -0.02)
CIRCLE_OF_200_DEGREES = (0.05, -0.01, 0.01, -0.003)
RATIONAL = (0.5, -2.7, 4e-4, -1e-4, 1.6, 0.4, -2.5, 1.5)


@pytest.mark.parametrize(
    "camera",
    [
        Camera(3840, 2160, 1500.0, 1500.0, 1919.5, 1079.5, "plumb_bob", ACTION_CAMERA),
        Camera(1280, 720, 206.0, 206.0, 639.5, 359.5, "equidistant", CIRCLE_OF_200_DEGREES),
        Camera(2048, 1536, 970.0, 970.0, 1023.5, 777.0, "rational_polynomial", RATIONAL),
        Camera(1920, 1080, 54_000.0, 54_000.0, 959.5, 539.5),  # zoomed to 2 degrees
        Camera(720, 288, 800.0, 400.0, 359.5, 143.5),  # a field of interlaced video
        Camera(640, 480, 900.0, 900.0, 1200.0, 800.0),  # the left corner of a larger image
    ],
)
def test_unusual_cameras_are_taken(camera: Camera) -> None:
    assert received_images.camera_info(messages.info_from_camera(camera, 17, "camera")).camera == camera


@pytest.mark.parametrize("stamp", [Time(sec=-1), Time(sec=1, nanosec=1_000_000_000)])
def test_a_stamp_that_is_no_time_is_refused(stamp: Time) -> None:
    message = info()
    message.header.stamp = stamp
    with pytest.raises(InvalidMessageError, match="stamp the message") as raised:
        received_images.camera_info(message)
    assert raised.value.kind == "stamp"


GREY = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)


def raw(**changes: Any) -> Image:
    message = Image(header=messages.header(17, "camera"), width=64, height=48, step=64, encoding="mono8")
    message.data = GREY.tobytes()
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def test_a_raw_image_is_taken_without_a_copy() -> None:
    message = raw()
    image = received_images.raw_image(message)
    assert (image.stamp, image.frame_id) == (17, "camera")
    np.testing.assert_array_equal(image.pixels, GREY)
    assert np.shares_memory(image.pixels, np.frombuffer(message.data, np.uint8))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"width": 0}, "too small"),
        ({"width": 1, "height": 1}, "too small"),
        ({"width": 100_000, "height": 100_000}, "too large"),
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "too large"),
        ({"step": 63}, "rows of 63 bytes"),
        ({"step": 2**32 - 1}, "damaged image"),
        ({"data": []}, "are not 0 bytes"),
        ({"encoding": "rgb8"}, "damaged image"),
        ({"encoding": "yuv422" * 1000}, "publish one of"),
    ],
)
def test_a_raw_image_whose_fields_do_not_fit_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidMessageError, match=words) as raised:
        received_images.raw_image(raw(**changes))
    assert raised.value.kind == "image"
    assert len(str(raised.value)) < 300
