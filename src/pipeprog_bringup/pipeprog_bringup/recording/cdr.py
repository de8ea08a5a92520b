# SPDX-License-Identifier: Apache-2.0
"""The camera's messages as CDR bytes, without rclpy: read by hand, written by mcap_ros2.

Reading needs the first fields only (a stamp, a size), must survive damaged messages, and recordings may lack the
definitions that a general decoder needs. Layout: OMG CDR (XCDR1), a four-byte encapsulation header, every number
aligned to its size counted from behind that header; the definitions are those of sensor_msgs in ROS 2 Jazzy.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap_ros2.writer import serialize_dynamic

from pipeprog_bringup.recording.definitions import message_definition
from pipeprog_camera.camera import Camera

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ODOMETRY = "nav_msgs/msg/Odometry"
IMU = "sensor_msgs/msg/Imu"
TF = "tf2_msgs/msg/TFMessage"
NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class CameraInfo:
    """A CameraInfo message: size [px], row-major (9,) K, distortion in the model's order."""

    stamp: int
    frame_id: str
    width: int
    height: int
    distortion_model: str
    distortion: tuple[float, ...]
    k: tuple[float, ...]

    def camera(self) -> Camera:
        """The camera that it describes; raises InputError where it is not calibrated or its model is unknown."""
        return Camera.from_calibration(self.width, self.height, self.k, self.distortion_model, self.distortion)


class _Reader:
    """Reads one message; struct.error or IndexError where the bytes end too early."""

    def __init__(self, data: bytes) -> None:
        if len(data) < 4:
            raise struct.error("no encapsulation header")
        self.data = data
        self.position = 4
        self.order = "<" if data[1] & 1 else ">"

    def numbers(self, kind: str, count: int) -> tuple:
        size = struct.calcsize(kind)
        start = self.position + (4 - self.position) % size
        self.position = start + size * count
        return struct.unpack_from(f"{self.order}{count}{kind}", self.data, start)

    def number(self, kind: str) -> int:
        return self.numbers(kind, 1)[0]

    def string(self) -> str:
        length = self.number("I")
        text = self.data[self.position : self.position + length]
        if len(text) < length:
            raise struct.error("string cut off")
        self.position += length
        return text.rstrip(b"\0").decode("utf-8", "replace")

    def header(self) -> tuple[int, str]:
        seconds, nanoseconds = self.number("i"), self.number("I")
        return seconds * NANOSECONDS + nanoseconds, self.string()


def read_header(data: bytes) -> tuple[int, str]:
    """Stamp [ns] and frame of any message that begins with a std_msgs/Header; ValueError where it is damaged."""
    try:
        return _Reader(data).header()
    except (struct.error, IndexError) as error:
        raise ValueError(f"damaged message header: {error}") from None


def read_camera_info(data: bytes) -> CameraInfo:
    """A CameraInfo from its CDR bytes; ValueError where they are damaged."""
    try:
        reader = _Reader(data)
        stamp, frame_id = reader.header()
        height, width = reader.numbers("I", 2)
        model = reader.string()
        distortion = reader.numbers("d", reader.number("I"))
        return CameraInfo(stamp, frame_id, width, height, model, distortion, reader.numbers("d", 9))
    except (struct.error, IndexError, MemoryError) as error:
        raise ValueError(f"damaged CameraInfo: {error}") from None


def image_size(data: bytes, type_name: str) -> tuple[int, int] | None:
    """(width, height) of an image message [px]; a compressed image is decoded for it. None where it is damaged."""
    try:
        reader = _Reader(data)
        reader.header()
        if type_name == IMAGE:
            height, width = reader.numbers("I", 2)
            return width, height
        reader.string()
        length = reader.number("I")
    except (struct.error, IndexError):
        return None
    import cv2

    encoded = np.frombuffer(data, np.uint8, offset=reader.position)[:length]
    image = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED) if len(encoded) else None
    return None if image is None else (image.shape[1], image.shape[0])


def image_encoding(data: bytes, type_name: str) -> str:
    """The encoding of a raw image, the format of a compressed one; empty where the message is damaged."""
    try:
        reader = _Reader(data)
        reader.header()
        if type_name == IMAGE:
            reader.numbers("I", 2)
        return reader.string()
    except (struct.error, IndexError):
        return ""


def is_whole(data: bytes, type_name: str) -> bool:
    """Whether an image message is as long as its length field says; the pixels are not decoded."""
    try:
        reader = _Reader(data)
        reader.header()
        if type_name == IMAGE:
            reader.numbers("I", 2)
        reader.string()
        if type_name == IMAGE:
            reader.numbers("B", 1)
            reader.number("I")
        length = reader.number("I")
    except (struct.error, IndexError):
        return False
    return len(data) >= reader.position + length


def write(type_name: str, content: Mapping[str, Any]) -> bytes:
    """CDR bytes of a message of the type `package/msg/Name`; fields that `content` lacks have their defaults."""
    return _encoder(type_name)(content)


def header(stamp: int, frame_id: str) -> dict[str, Any]:
    """The content of a std_msgs/Header with a stamp in nanoseconds."""
    return {"stamp": {"sec": stamp // NANOSECONDS, "nanosec": stamp % NANOSECONDS}, "frame_id": frame_id}


def write_compressed_image(stamp: int, frame_id: str, image_format: str, encoded: bytes) -> bytes:
    """CDR bytes of a CompressedImage."""
    return write(COMPRESSED_IMAGE, {"header": header(stamp, frame_id), "format": image_format, "data": encoded})


def write_camera_info(stamp: int, frame_id: str, camera: Camera) -> bytes:
    """CDR bytes of the CameraInfo of a monocular camera (R identity, P = [K | 0])."""
    content = {
        "header": header(stamp, frame_id),
        "height": camera.height,
        "width": camera.width,
        "distortion_model": camera.distortion_model,
        "d": list(camera.distortion),
        "k": camera.matrix.ravel().tolist(),
        "r": np.eye(3).ravel().tolist(),
        "p": np.c_[camera.matrix, np.zeros(3)].ravel().tolist(),
    }
    return write(CAMERA_INFO, content)


@functools.cache
def _encoder(type_name: str) -> Callable[[Mapping[str, Any]], bytes]:
    return serialize_dynamic(type_name, message_definition(type_name))[type_name]
