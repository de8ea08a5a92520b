"""The camera's three messages as CDR bytes: headers, image sizes and CameraInfo without a ROS installation.

Layout: OMG CDR (XCDR1), a four-byte encapsulation header, every number aligned to its size counted from behind that
header; the message definitions are those of sensor_msgs in ROS 2 Jazzy.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

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


class _Writer:
    """Writes one little-endian message."""

    def __init__(self) -> None:
        self.data = bytearray(b"\x00\x01\x00\x00")

    def numbers(self, kind: str, *values: float) -> None:
        size = struct.calcsize(kind)
        self.data += bytes((4 - len(self.data)) % size)
        self.data += struct.pack(f"<{len(values)}{kind}", *values)

    def string(self, text: str) -> None:
        encoded = text.encode() + b"\0"
        self.numbers("I", len(encoded))
        self.data += encoded

    def header(self, stamp: int, frame_id: str) -> None:
        self.numbers("i", stamp // NANOSECONDS)
        self.numbers("I", stamp % NANOSECONDS)
        self.string(frame_id)


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
    """Whether an image message is as long as it says; what its pixels hold is another matter."""
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


def write_compressed_image(stamp: int, frame_id: str, image_format: str, encoded: bytes) -> bytes:
    """CDR bytes of a CompressedImage."""
    writer = _Writer()
    writer.header(stamp, frame_id)
    writer.string(image_format)
    writer.numbers("I", len(encoded))
    return bytes(writer.data) + encoded


def write_camera_info(stamp: int, frame_id: str, camera: Camera) -> bytes:
    """CDR bytes of the CameraInfo of a monocular camera (R identity, P = [K | 0])."""
    writer = _Writer()
    writer.header(stamp, frame_id)
    writer.numbers("I", camera.height, camera.width)
    writer.string(camera.distortion_model)
    writer.numbers("I", len(camera.distortion))
    writer.numbers("d", *camera.distortion, *camera.matrix.ravel(), *np.eye(3).ravel())
    writer.numbers("d", *np.c_[camera.matrix, np.zeros(3)].ravel())
    writer.numbers("I", 0, 0, 0, 0, 0, 0)
    writer.numbers("B", 0)
    return bytes(writer.data)
