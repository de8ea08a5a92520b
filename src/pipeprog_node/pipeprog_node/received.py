# SPDX-License-Identifier: Apache-2.0
"""Messages from outside, each type checked in one place: its values in pipeprog's types, or InvalidMessageError."""

from __future__ import annotations

from dataclasses import dataclass

from sensor_msgs.msg import CameraInfo, CompressedImage
from std_msgs.msg import Header

from pipeprog_camera.camera import Camera
from pipeprog_camera.encoded_image import encoded_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_NAME
from pipeprog_node import messages
from pipeprog_node.intake import InvalidMessageError


@dataclass(frozen=True)
class ReceivedImage:
    """A JPEG or PNG image: stamp [ns], frame of the camera, its bytes and the size [px] that its header declares."""

    stamp: int
    frame_id: str
    encoded: bytes
    width: int
    height: int


@dataclass(frozen=True)
class ReceivedCamera:
    """A calibration: stamp [ns] and frame of the image that it belongs to, and the camera."""

    stamp: int
    frame_id: str
    camera: Camera


def stamp_and_frame(header: Header) -> tuple[int, str]:
    """Stamp [ns], zero or later, and name of the frame."""
    stamp = header.stamp
    if stamp.sec < 0 or stamp.nanosec >= messages.SECOND:
        raise InvalidMessageError(
            "stamp", f"the stamp {stamp.sec} s + {stamp.nanosec} ns is no time: stamp the message"
        )
    if len(header.frame_id) > MAX_NAME:
        raise InvalidMessageError("name", f"a frame_id of {len(header.frame_id)} characters is no name of a frame")
    return messages.stamp_ns(stamp), header.frame_id


def compressed_image(message: CompressedImage) -> ReceivedImage:
    """A JPEG or PNG image whose header can be read and declares a usable size."""
    stamp, frame_id = stamp_and_frame(message.header)
    encoded = bytes(message.data)
    try:
        width, height = encoded_size(encoded)
    except InputError as error:
        raise InvalidMessageError("image", str(error)) from None
    return ReceivedImage(stamp, frame_id, encoded, width, height)


def camera_info(message: CameraInfo) -> ReceivedCamera:
    """The calibration of a whole image, with values that a real camera can have."""
    stamp, frame_id = stamp_and_frame(message.header)
    try:
        return ReceivedCamera(stamp, frame_id, messages.camera_from_info(message))
    except InputError as error:
        raise InvalidMessageError("calibration", str(error)) from None
