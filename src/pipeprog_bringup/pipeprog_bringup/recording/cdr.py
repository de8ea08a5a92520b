# SPDX-License-Identifier: Apache-2.0
"""The camera's messages as CDR bytes, without rclpy: read by hand, written by mcap_ros2.

Reading must survive damaged messages, and recordings may lack the definitions that a general decoder needs. A message
is read to its end, since the middleware drops without a word what it cannot decode. Layout: OMG CDR (XCDR1), a
four-byte encapsulation header, every number aligned to its size counted from behind that header; the definitions are
those of sensor_msgs in ROS 2 Jazzy.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap_ros2.writer import serialize_dynamic
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeprog_bringup.recording.definitions import message_definition
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera, check_whole_sensor
from pipeprog_camera.limits import MAX_DISTORTION_COEFFICIENTS, MAX_NAME, MAX_POSES, MAX_SECONDS, MAX_SMALL_MESSAGE

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
COMPRESSED_VIDEO = "foxglove_msgs/msg/CompressedVideo"
FFMPEG_PACKET = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ODOMETRY = "nav_msgs/msg/Odometry"
IMU = "sensor_msgs/msg/Imu"
TF = "tf2_msgs/msg/TFMessage"
NANOSECONDS = 1_000_000_000


_LITTLE_ENDIAN, _BIG_ENDIAN = b"\0\1", b"\0\0"  # encapsulation identifiers of plain CDR


class StampError(ValueError):
    """A stamp that is no time."""


@dataclass(frozen=True)
class CameraInfo:
    """A CameraInfo message: size [px], row-major (9,) K, distortion in the model's order, part of the sensor.

    `binning`, `offset` and `region` are (x, y) in pixels, as in camera.check_whole_sensor.
    """

    frame_id: str
    width: int
    height: int
    distortion_model: str
    distortion: tuple[float, ...]
    k: tuple[float, ...]
    binning: tuple[int, int]
    offset: tuple[int, int]
    region: tuple[int, int]

    def camera(self) -> Camera:
        """The camera that it describes; raises InputError where it is not calibrated or its model is unknown."""
        check_whole_sensor((self.width, self.height), self.binning, self.offset, self.region)
        return Camera.from_calibration(self.width, self.height, self.k, self.distortion_model, self.distortion)


@dataclass(frozen=True)
class ImageFields:
    """An image message: stamp [ns], frame, the format of a compressed image or the encoding of a raw one, its bytes.

    `width`, `height` [px] and `step` [bytes of a row] are those of a raw image, 0 of a compressed one. Of video the
    format is the codec, and the bytes are those of one coded frame.
    """

    stamp: int
    frame_id: str
    encoding: str
    data: memoryview
    width: int = 0
    height: int = 0
    step: int = 0


class _Reader:
    """Reads one message; ValueError where the bytes end too early or are none of a message."""

    def __init__(self, data: bytes) -> None:
        if data[:2] not in (_LITTLE_ENDIAN, _BIG_ENDIAN) or len(data) < 4:
            raise ValueError("no encapsulation header of CDR")
        self.data = data
        self.position = 4
        self.order = "<" if data[:2] == _LITTLE_ENDIAN else ">"

    def numbers(self, kind: str, count: int) -> tuple:
        size = struct.calcsize(kind)
        start = self.position + (4 - self.position) % size
        self.position = start + size * count
        if self.position > len(self.data):
            raise ValueError(f"cut off: {len(self.data)} bytes")
        return struct.unpack_from(f"{self.order}{count}{kind}", self.data, start)

    def number(self, kind: str) -> int:
        return self.numbers(kind, 1)[0]

    def bytes(self) -> memoryview:
        """A sequence of octets, with its length before it; a view."""
        length = self.number("I")
        content = memoryview(self.data)[self.position : self.position + length]
        if len(content) < length:
            raise ValueError(f"cut off: {len(content)} of {length} bytes")
        self.position += length
        return content

    def string(self) -> str:
        text = bytes(self.bytes()).rstrip(b"\0").decode("utf-8", "replace")
        if len(text) > MAX_NAME or not text.isprintable():
            raise ValueError(f"{len(text)} characters that are no name")
        return text

    def header(self) -> tuple[int, str]:
        seconds, nanoseconds = self.number("i"), self.number("I")
        if not 0 <= seconds < MAX_SECONDS or nanoseconds >= NANOSECONDS:
            raise StampError(f"stamp is no time: {seconds} s + {nanoseconds} ns; the camera's driver must set it")
        return seconds * NANOSECONDS + nanoseconds, self.string()


def read_camera_info(data: bytes) -> CameraInfo:
    """A CameraInfo from its CDR bytes, read to its end; ValueError where they are damaged."""
    if len(data) > MAX_SMALL_MESSAGE:
        raise ValueError(f"{len(data)} bytes are no CameraInfo")
    reader = _Reader(data)
    reader.numbers("I", 2)  # the stamp; the image's own is used
    frame_id = reader.string()
    height, width = reader.numbers("I", 2)
    model = reader.string()
    coefficients = reader.number("I")
    if coefficients > MAX_DISTORTION_COEFFICIENTS:
        raise ValueError(f"{coefficients} distortion coefficients")
    distortion = reader.numbers("d", coefficients)
    k = reader.numbers("d", 9)
    reader.numbers("d", 9 + 12)  # R and P
    binning_x, binning_y, x, y, region_height, region_width = reader.numbers("I", 6)
    reader.number("B")  # do_rectify
    binning, offset, region = (binning_x, binning_y), (x, y), (region_width, region_height)
    return CameraInfo(frame_id, width, height, model, distortion, k, binning, offset, region)


def read_velocities(data: bytes) -> tuple[float, list[FloatArray]]:
    """The read-out [s] of a pipeprog_msgs/KeyframeVelocities, and velocities and accelerations, linear and angular.

    ValueError where they are damaged.
    """
    reader = _Reader(data)
    reader.header()
    readout = reader.numbers("d", 1)[0]
    found: list[FloatArray] = []
    for name in ("velocities", "accelerations"):
        count = reader.number("I")
        if count > MAX_POSES:
            raise ValueError(f"{count} {name}")
        found += list(np.array(reader.numbers("d", 6 * count)).reshape(count, 2, 3).swapaxes(0, 1))
    return readout, found


def read_image(data: bytes, type_name: str) -> ImageFields:
    """An image message of any type from its CDR bytes, read to its end; ValueError where they are damaged.

    The pixels are not decoded. Raises StampError where only the stamp cannot be used.
    """
    reader = _Reader(data)
    stamp, frame_id = reader.header()
    if type_name == COMPRESSED_IMAGE:
        return ImageFields(stamp, frame_id, reader.string(), reader.bytes())
    if type_name == COMPRESSED_VIDEO:
        data = reader.bytes()
        return ImageFields(stamp, frame_id, reader.string(), data)
    if type_name == FFMPEG_PACKET:
        reader.numbers("i", 2)  # width and height, which the stream itself has
        codec = reader.string().partition(";")[0]
        reader.number("Q")  # presentation time in units of the encoder
        reader.numbers("B", 2)  # flags, is_bigendian
        return ImageFields(stamp, frame_id, codec, reader.bytes())
    height, width = reader.numbers("I", 2)
    encoding = reader.string()
    reader.number("B")  # is_bigendian
    step = reader.number("I")
    return ImageFields(stamp, frame_id, encoding, reader.bytes(), width, height, step)


def write(type_name: str, content: Mapping[str, Any]) -> bytes:
    """CDR bytes of a message of the type `package/msg/Name`; fields that `content` lacks have their defaults."""
    return _encoder(type_name)(content)


def header(stamp: int, frame_id: str) -> dict[str, Any]:
    """The content of a std_msgs/Header with a stamp in nanoseconds."""
    return {"stamp": {"sec": stamp // NANOSECONDS, "nanosec": stamp % NANOSECONDS}, "frame_id": frame_id}


def with_stamp(data: bytes, stamp: int) -> bytes:
    """A message that begins with a header, under another stamp [ns]."""
    order = "<" if data[1] & 1 else ">"  # the first four bytes are those of the encapsulation
    return data[:4] + struct.pack(f"{order}iI", *divmod(stamp, NANOSECONDS)) + data[12:]


def write_compressed_image(stamp: int, frame_id: str, image_format: str, encoded: bytes) -> bytes:
    """CDR bytes of a CompressedImage."""
    return write(COMPRESSED_IMAGE, {"header": header(stamp, frame_id), "format": image_format, "data": encoded})


def write_image(stamp: int, frame_id: str, encoding: str, pixels: NDArray[np.uint8 | np.uint16]) -> bytes:
    """CDR bytes of an Image of (H, W) or (H, W, 3) pixels; by hand, since a general encoder takes seconds for them."""
    height, width = pixels.shape[:2]
    step = pixels.nbytes // height
    head = struct.pack("<iI", *divmod(stamp, NANOSECONDS)) + _text(frame_id)
    head += bytes(-len(head) % 4) + struct.pack("<II", height, width) + _text(encoding) + b"\0"  # is_bigendian
    head += bytes(-len(head) % 4) + struct.pack("<II", step, pixels.nbytes)
    return _LITTLE_ENDIAN + b"\0\0" + head + np.ascontiguousarray(pixels).tobytes()


def write_odometry(stamp: int, frame_id: str, child: str, pose: FloatArray) -> bytes:
    """CDR bytes of an Odometry with the (4, 4) pose of `child` in `frame_id`; velocities and covariances are zero."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    place = {
        "position": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
        "orientation": {"x": x, "y": y, "z": z, "w": w},
    }
    return write(ODOMETRY, {"header": header(stamp, frame_id), "child_frame_id": child, "pose": {"pose": place}})


def _text(value: str) -> bytes:
    encoded = value.encode() + b"\0"
    return struct.pack("<I", len(encoded)) + encoded


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
