# SPDX-License-Identifier: Apache-2.0
"""Images and calibrations from outside, checked: values in pipeprog's types, or InvalidMessageError."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from pipeprog_camera.camera import Camera
from pipeprog_camera.encoded_image import check_bytes, check_size, encoded_size
from pipeprog_camera.errors import InputError
from pipeprog_node import messages
from pipeprog_node.intake import InvalidMessageError
from pipeprog_node.received.header import stamp_and_frame


@dataclass(frozen=True)
class ReceivedImage:
    """A JPEG or PNG image: stamp [ns], frame of the camera, its bytes and the size [px] that its header declares."""

    stamp: int
    frame_id: str
    encoded: bytes
    width: int
    height: int


@dataclass(frozen=True)
class ReceivedRawImage:
    """An image as its sensor gives it: stamp [ns], frame of the camera, (H, W) grey or (H, W, 3) BGR pixels."""

    stamp: int
    frame_id: str
    pixels: NDArray[np.uint8]


@dataclass(frozen=True)
class ReceivedCamera:
    """A calibration: stamp [ns] and frame of the image that it belongs to, and the camera."""

    stamp: int
    frame_id: str
    camera: Camera


def compressed_image(message: CompressedImage) -> ReceivedImage:
    """A JPEG or PNG image whose header can be read and declares a usable size."""
    stamp, frame_id = stamp_and_frame(message.header)
    encoded = bytes(message.data)
    try:
        width, height = encoded_size(encoded)
    except InputError as error:
        raise InvalidMessageError("image", str(error)) from None
    return ReceivedImage(stamp, frame_id, encoded, width, height)


def raw_image(message: Image) -> ReceivedRawImage:
    """An image whose size, encoding and bytes fit; its pixels are the message's own where none must be converted."""
    stamp, frame_id = stamp_and_frame(message.header)
    try:
        check_size(message.width, message.height)
        check_bytes(len(message.data))
        return ReceivedRawImage(stamp, frame_id, messages.image_from_msg(message))
    except InputError as error:
        raise InvalidMessageError("image", str(error)) from None


def camera_info(message: CameraInfo) -> ReceivedCamera:
    """The calibration of a whole image, with values that a real camera can have."""
    stamp, frame_id = stamp_and_frame(message.header)
    try:
        return ReceivedCamera(stamp, frame_id, messages.camera_from_info(message))
    except InputError as error:
        raise InvalidMessageError("calibration", str(error)) from None
