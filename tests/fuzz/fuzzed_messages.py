# SPDX-License-Identifier: Apache-2.0
"""Messages as faulty and hostile publishers send them, of every type that the nodes subscribe to.

All randomness comes from the `random.Random` that is given: the same seed gives the same messages.
"""

from __future__ import annotations

import copy
import math
import random
import re
import struct
import zlib
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import cv2
import numpy as np
from geometry_msgs.msg import Accel, PoseStamped, TransformStamped, Twist
from nav_msgs.msg import Odometry, Path
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2
from tf2_msgs.msg import TFMessage

from pipeprog_camera.camera import Camera
from pipeprog_msgs import msg
from pipeprog_node import messages
from tests.fuzz.mutated_bytes import mutated

START = 1_600_000_000_000_000_000  # ns; the attack's messages are older than those of every recording of the tests
STEP = 100_000_000  # ns
CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)

FLOATS = (
    math.nan,
    math.inf,
    -math.inf,
    0.0,
    -0.0,
    1.0,
    -1.0,
    5e-324,
    1e-300,
    1e-200,
    1e-12,
    1e9,
    1e30,
    -1e300,
    1.7e308,
)
TEXTS = (
    *("", "/", "map", "camera", "x" * 257, "x" * 5_000, "\x00", "\n\n", "\x1b[2J\x1b[31m", "[/red]x", "[red]"),
    *("=cmd|'/C calc'!A0", r"$\frac{1}{$", "<script>alert(1)</script>", "../../etc/passwd", "{0}", "%s%n", "\u202eabc"),
)
LENGTHS = (0, 1, 2, 3, 7, 50, 1000)
MANY = (1, 1, 1, 2, 1500)  # parts of a bomb, beyond MAX_TRANSFORMS; rclpy takes 20 us to build each
_INTEGER = re.compile(r"(u?)int(8|16|32|64)")
_ARRAY = re.compile(r"sequence<([\w/]+)(?:, \d+)?>|([\w/]+)\[\d+\]")
_FLOAT_TYPES = ("double", "float")


@dataclass(frozen=True)
class Fuzzed:
    """A message, or CDR bytes, as a publisher takes them; `kind` says how it was made."""

    kind: str
    content: Any

    @property
    def cdr(self) -> bytes:
        """As it goes over the wire."""
        return self.content if isinstance(self.content, bytes) else serialize_message(self.content)


@dataclass(frozen=True)
class _Field:
    owner: Any
    name: str
    type: str

    @property
    def value(self) -> Any:
        return getattr(self.owner, self.name)

    def set(self, value: Any) -> None:
        setattr(self.owner, self.name, value)


def good_messages(number: int) -> dict[str, Any]:
    """A message for each topic that a node subscribes to, all of one moment, as the good ones of a survey are."""
    stamp = START + number * STEP
    header = messages.header(stamp, "camera")
    noise = np.random.default_rng(number).integers(0, 256, (CAMERA.height, CAMERA.width), np.uint8)
    image = messages.compressed_image(stamp, "camera", messages.encode_jpeg(noise))
    info = messages.info_from_camera(CAMERA, stamp, "camera")
    odometry = Odometry(header=messages.header(stamp, "odom"), child_frame_id="base")
    odometry.pose.pose.position.x = 0.1 * number
    imu = Imu(header=messages.header(stamp, "imu"))
    imu.linear_acceleration.z = 9.81
    edge = TransformStamped(header=messages.header(stamp, "base"), child_frame_id="camera")
    report = msg.ImageOverlap(stamp=header.stamp, registered=True, overlap=0.9, cell_overlap=0.9, matches_previous=300)
    map_header = messages.header(stamp, "map")
    points = np.random.default_rng(number).normal(size=(500, 3)).astype(np.float32)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (3, 1, 1))
    return {
        "camera_info": info,
        "image/compressed": image,
        "image": Image(
            header=header, width=320, height=240, step=320, encoding="mono8", data=array("B", noise.tobytes())
        ),
        "image_overlap": msg.ImageOverlapArray(header=header, keyframes_considered=number, images=[report]),
        "keyframes/image/compressed": image,
        "keyframes/camera_info": info,
        "keyframes/retired": msg.KeyframesRetired(header=header, keyframes_published=number, stamps=[header.stamp]),
        "odometry": odometry,
        "imu": imu,
        "/tf": TFMessage(transforms=[edge]),
        "/tf_static": TFMessage(transforms=[edge]),
        "map_points": messages.point_cloud(map_header, points, np.zeros((500, 3), np.uint8), normals),
        "keyframe_poses": messages.path(map_header, stamp + np.arange(3) * STEP, poses),
        "keyframe_velocities": messages.keyframe_velocities(map_header, 0.015, *np.ones((4, 3, 3))),
        "keyframes/refined_camera_info": info,
        "sfm_status": msg.SfmStatus(header=map_header, map_revision=number + 1, map_stamp=header.stamp, metric=True),
    }


def fuzzed_message(samples: Sequence[Any], rng: random.Random) -> Fuzzed:
    """One message made of good ones of the same type."""
    kind = rng.choice(sorted(_KINDS))
    return Fuzzed(kind, _KINDS[kind](samples, rng))


def fuzzed_stream(topic: str, seed: int, samples: Sequence[Any] = ()) -> Iterator[Fuzzed]:
    """Messages without end for a topic of `good_messages`, from these and from further `samples`."""
    rng = random.Random(f"{topic} {seed}")
    known = [good_messages(number)[topic] for number in range(4)] + list(samples)
    while True:
        yield fuzzed_message(known, rng)


def fuzzed_messages(topic: str, count: int, seed: int) -> list[Fuzzed]:
    """The first `count` messages of that stream."""
    return list(islice(fuzzed_stream(topic, seed), count))


def _one_field(samples: Sequence[Any], rng: random.Random) -> Any:
    return _altered(samples, rng, 1)


def _some_fields(samples: Sequence[Any], rng: random.Random) -> Any:
    return _altered(samples, rng, rng.randrange(2, 7))


def _all_fields(samples: Sequence[Any], rng: random.Random) -> Any:
    return _altered(samples, rng, 1000)


def _not_finite(samples: Sequence[Any], rng: random.Random) -> Any:
    """Numbers that are none: in one field or in all."""
    message = copy.deepcopy(rng.choice(samples))
    numbers = [field for field in _fields(message) if any(name in field.type for name in _FLOAT_TYPES)]
    for field in numbers if rng.random() < 0.3 else rng.sample(numbers, min(len(numbers), 1)):
        field.set(_value(field.type, field.value, rng))
    if isinstance(message, PointCloud2):
        message.data = array("B", np.full(len(message.data) // 4, rng.choice(FLOATS[:3]), "<f4").tobytes())
    return message


def _counts(samples: Sequence[Any], rng: random.Random) -> Any:
    """Sizes, counts and stamps that cannot be."""
    message = copy.deepcopy(rng.choice(samples))
    counted = [field for field in _fields(message) if _INTEGER.fullmatch(field.type) or _ARRAY.fullmatch(field.type)]
    for field in rng.sample(counted, min(len(counted), rng.randrange(1, 4))):
        field.set(_value(field.type, field.value, rng))
    return message


def _mixed(samples: Sequence[Any], rng: random.Random) -> Any:
    """Fields of two good messages in one."""
    message, other = copy.deepcopy(rng.choice(samples)), copy.deepcopy(rng.choice(samples))
    for name in message.get_fields_and_field_types():
        if rng.random() < 0.5:
            setattr(message, name, getattr(other, name))
    return message


def _bytes(samples: Sequence[Any], rng: random.Random) -> bytes:
    """CDR bytes that were damaged."""
    return mutated(serialize_message(rng.choice(samples)), rng)


def _bomb(samples: Sequence[Any], rng: random.Random) -> Any:
    """Small on the wire, large or hopeless where it is opened."""
    message = copy.deepcopy(rng.choice(samples))
    bombs = _BOMBS.get(type(message))
    if bombs is None:
        return _altered(samples, rng, 1000)
    rng.choice(bombs)(message, rng)
    return message


_KINDS: dict[str, Callable[[Sequence[Any], random.Random], Any]] = {
    "one field": _one_field,
    "some fields": _some_fields,
    "all fields": _all_fields,
    "not finite": _not_finite,
    "counts": _counts,
    "mixed": _mixed,
    "damaged bytes": _bytes,
    "bomb": _bomb,
}


def _altered(samples: Sequence[Any], rng: random.Random, count: int) -> Any:
    """A copy with `count` of its fields replaced, all where it has fewer."""
    message = copy.deepcopy(rng.choice(samples))
    fields = _fields(message)
    for field in rng.sample(fields, min(len(fields), count)):
        field.set(_value(field.type, field.value, rng))
    return message


def _fields(message: Any) -> list[_Field]:
    """The fields with values of a message and of those within it (of sequences: of their first three)."""
    found = []
    for name, type_name in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if hasattr(value, "get_fields_and_field_types"):
            found += _fields(value)
            continue
        found.append(_Field(message, name, type_name))
        if "/" in type_name:
            found += [field for part in value[:3] for field in _fields(part)]
    return found


def _value(type_name: str, value: Any, rng: random.Random) -> Any:
    """Another value of a field's type."""
    if type_name in _FLOAT_TYPES:
        return rng.choice((*FLOATS, value * (1.0 + rng.random()), rng.uniform(-1e3, 1e3)))
    if type_name == "boolean":
        return not value
    if type_name.startswith("string"):
        return rng.choice(TEXTS)
    if match := _INTEGER.fullmatch(type_name):
        bits = int(match[2])
        low, high = (0, (1 << bits) - 1) if match[1] else (-(1 << bits - 1), (1 << bits - 1) - 1)
        near = min(max(value + rng.choice((-1, 1)), low), high)
        return rng.choice(
            (low, high, 0, 1, high // 2, near, rng.randrange(low, high + 1), 1 << rng.randrange(bits - 1))
        )
    match = _ARRAY.fullmatch(type_name)
    assert match is not None, type_name
    return _sequence(match[1] or match[2], value, rng, is_fixed=match[1] is None)


def _sequence(element: str, value: Any, rng: random.Random, is_fixed: bool) -> Any:
    """Another sequence: elements replaced or, where its length is free, fewer or more of them."""
    if element == "uint8" and not is_fixed:
        return array(
            "B", rng.choice((bytes(value), b"\xff" * 100, bytes(rng.choice(LENGTHS)), mutated(bytes(value), rng)))
        )
    values = list(value)
    if not is_fixed and rng.random() < 0.5:
        length = rng.choice(LENGTHS)
        values = (values * (length // max(len(values), 1) + 1))[:length]
    if "/" in element:
        return values
    for index in range(len(values)) if rng.random() < 0.3 else range(min(len(values), 1)):
        values[index] = _value(element, values[index], rng)
    return values


def png_header(width: int, height: int) -> bytes:
    """A PNG that declares this size [px] and has next to no pixels."""

    def part(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    shape = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", shape) + part(b"IDAT", zlib.compress(bytes(64))) + part(b"IEND", b"")


def jpeg_of_size(width: int, height: int) -> bytes:
    """A JPEG of noise whose header declares this size [px]."""
    encoded = messages.encode_jpeg(np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8))
    start = encoded.index(b"\xff\xc0") + 5
    return encoded[:start] + struct.pack(">HH", height, width) + encoded[start + 4 :]


def jpeg_of_scans(scans: int) -> bytes:
    """A progressive JPEG whose last scan comes again and again."""
    noise = np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8)
    encoded = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    last = encoded.rindex(b"\xff\xda")
    return encoded[:last] + encoded[last:-2] * scans + encoded[-2:]


IMAGES = (
    *(
        png_header(*size)
        for size in ((100_000, 100_000), (2**31 - 1, 1), (1, 1), (0, 0), (31, 31), (32, 32), (8192, 8192))
    ),
    *(jpeg_of_size(*size) for size in ((65_500, 65_500), (30_000, 30_000), (1, 65_535), (0, 0), (8192, 8192))),
    *(
        jpeg_of_scans(3000),
        b"",
        b"\xff",
        b"\xff\xd8\xff",
        b"\x89PNG\r\n\x1a\n",
        b"GIF89a" + bytes(100),
        b"BM" + bytes(100),
    ),
)


def _image_bomb(message: CompressedImage, rng: random.Random) -> None:
    message.data = array("B", rng.choice(IMAGES))


def _raw_image_bomb(message: Image, rng: random.Random) -> None:
    message.width, message.height = rng.choice(((2**32 - 1, 2**32 - 1), (0, 0), (1, 1), (65_536, 65_536), (320, 2**31)))
    message.step = rng.choice((0, 1, 2**32 - 1, message.width & 0xFFFFFFFF))


def _calibration_bomb(message: CameraInfo, rng: random.Random) -> None:
    message.k = [rng.choice((0.0, math.nan, math.inf, 1e-300, 1e300))] * 9
    message.distortion_model, message.d = rng.choice(
        (("plumb_bob", [math.nan] * 5), ("", [0.0] * 3), ("equidistant", [1e9] * 4))
    )


def _cloud_without_points(message: PointCloud2, rng: random.Random) -> None:
    message.width, message.height = rng.choice(((2**32 - 1, 2**32 - 1), (0, 0), (2**31, 1)))
    message.point_step = rng.choice((0, 1, 2**32 - 1, message.point_step))


def _cloud_of_other_fields(message: PointCloud2, rng: random.Random) -> None:
    field = rng.choice(message.fields)
    field.name = rng.choice(("x", "normal_x", "", "rgb", "\x00"))
    field.datatype, field.offset, field.count = (
        rng.choice((0, 99, 8)),
        rng.choice((0, 2**32 - 1)),
        rng.choice((0, 2**32 - 1)),
    )


def _cloud_of_one_place(message: PointCloud2, rng: random.Random) -> None:
    message.data = array("B", bytes(len(message.data)))


def _path_bomb(message: Path, rng: random.Random) -> None:
    message.poses = [copy.deepcopy(message.poses[0]) if message.poses else PoseStamped()] * rng.choice(MANY)
    _spoil_quaternion(message.poses[0].pose.orientation, rng)


def _odometry_bomb(message: Odometry, rng: random.Random) -> None:
    _spoil_quaternion(message.pose.pose.orientation, rng)


def _transform_bomb(message: TFMessage, rng: random.Random) -> None:
    message.transforms = (message.transforms or [TransformStamped()])[:1] * rng.choice(MANY)
    _spoil_quaternion(message.transforms[0].transform.rotation, rng)
    if rng.random() < 0.3:
        message.transforms[0].child_frame_id = message.transforms[0].header.frame_id


def _spoil_quaternion(rotation: Any, rng: random.Random) -> None:
    rotation.x = rotation.y = rotation.z = 0.0
    rotation.w = rng.choice((0.0, 1e-300, 1e-200, 5e-324, math.nan, math.inf, 1e200))


def _many_reports(message: msg.ImageOverlapArray, rng: random.Random) -> None:
    message.images = (message.images or [msg.ImageOverlap()])[:1] * rng.choice(MANY)
    message.keyframes_considered = rng.choice((0, 2**31, 2**32 - 1))


def _many_retired(message: msg.KeyframesRetired, rng: random.Random) -> None:
    message.stamps = (message.stamps or [message.header.stamp])[:1] * rng.choice(MANY)
    message.keyframes_published = rng.choice((0, 2**31, 2**32 - 1))


def _many_velocities(message: msg.KeyframeVelocities, rng: random.Random) -> None:
    message.velocities = (message.velocities or [Twist()])[:1] * rng.choice(MANY)
    message.accelerations = rng.choice(([], [Accel()] * 2, [Accel()] * len(message.velocities)))
    message.readout = rng.choice((0.0, -1.0, 1e9, math.nan, math.inf))


_BOMBS: dict[type, tuple[Callable[[Any, random.Random], None], ...]] = {
    CompressedImage: (_image_bomb,),
    Image: (_raw_image_bomb,),
    CameraInfo: (_calibration_bomb,),
    PointCloud2: (_cloud_without_points, _cloud_of_other_fields, _cloud_of_one_place),
    Path: (_path_bomb,),
    Odometry: (_odometry_bomb,),
    TFMessage: (_transform_bomb,),
    msg.ImageOverlapArray: (_many_reports,),
    msg.KeyframesRetired: (_many_retired,),
    msg.KeyframeVelocities: (_many_velocities,),
}
