# SPDX-License-Identifier: Apache-2.0
"""Standard messages from and to NumPy arrays and pipeprog's types."""

from __future__ import annotations

from array import array

import cv2
import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Accel, Point, Pose, PoseStamped, Quaternion, Transform, TransformStamped, Twist, Vector3
from nav_msgs.msg import Path
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2, PointField
from std_msgs.msg import Header

from pipeprog_camera.camera import Camera, check_whole_sensor
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import (
    MAX_CLOUD_FIELDS,
    MAX_CLOUD_POINTS,
    MAX_NAME,
    MAX_POINT_STEP,
    MAX_QUATERNION_ERROR,
    MAX_SECONDS,
)
from pipeprog_camera.raw_image import SAMPLES, check_layout
from pipeprog_msgs.msg import KeyframeVelocities

SECOND = 1_000_000_000  # ns

# Conversion to BGR of the encodings that are neither grey nor BGR.
_TO_BGR = {
    "rgb8": cv2.COLOR_RGB2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    "8UC4": cv2.COLOR_BGRA2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
}
_FIELD_TYPES = {
    PointField.INT8: "i1",
    PointField.UINT8: "u1",
    PointField.INT16: "i2",
    PointField.UINT16: "u2",
    PointField.INT32: "i4",
    PointField.UINT32: "u4",
    PointField.FLOAT32: "f4",
    PointField.FLOAT64: "f8",
}
_NORMALS = ("normal_x", "normal_y", "normal_z")
_FIELD_CODES = {name: code for code, name in _FIELD_TYPES.items()}


def stamp_ns(stamp: Time) -> int:
    """Nanoseconds of a stamp."""
    return stamp.sec * SECOND + stamp.nanosec


def time_msg(stamp: int) -> Time:
    """Stamp of nanoseconds; also of those that stamp_ns has made of a stamp whose nanoseconds exceed a second."""
    sec = min(stamp // SECOND, MAX_SECONDS)
    return Time(sec=sec, nanosec=stamp - sec * SECOND)


def duration_msg(seconds: float) -> Duration:
    """A duration [s]."""
    nanoseconds = round(1e9 * seconds)
    return Duration(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def seconds(duration: Duration) -> float:
    """Seconds of a duration."""
    return float(duration.sec + 1e-9 * duration.nanosec)


def header(stamp: int, frame_id: str) -> Header:
    """Header with a stamp in nanoseconds."""
    return Header(stamp=time_msg(stamp), frame_id=frame_id)


def image_from_msg(message: Image) -> NDArray[np.uint8]:
    """(H, W) grey or (H, W, 3) BGR; raises InputError where the encoding or the size is none that can be used."""
    height, width, step = message.height, message.width, message.step
    data = np.frombuffer(message.data, np.uint8)
    check_layout(width, height, message.encoding, step, len(data))
    size, channels = SAMPLES[message.encoding]
    rows = data[: height * step].reshape(height, step)[:, : width * channels * size]
    if size == 2:
        return _to_8_bits(np.ascontiguousarray(rows).view(">u2" if message.is_bigendian else "<u2"))
    image = np.ascontiguousarray(rows) if channels == 1 else np.ascontiguousarray(rows).reshape(height, width, channels)
    conversion = _TO_BGR.get(message.encoding)
    return image if conversion is None else cv2.cvtColor(image, conversion).astype(np.uint8, copy=False)


def encode_jpeg(image: NDArray[np.uint8], quality: int = 95) -> bytes:
    """JPEG of a (H, W) grey or (H, W, 3) BGR image."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def compressed_image(stamp: int, frame_id: str, encoded: bytes) -> CompressedImage:
    """Message of an image's JPEG or PNG bytes."""
    kind = "png" if encoded.startswith(b"\x89PNG") else "jpeg"
    return CompressedImage(header=header(stamp, frame_id), format=kind, data=array("B", encoded))


def camera_from_info(message: CameraInfo) -> Camera:
    """The calibrated camera; raises InputError where it is not calibrated, or for a part of the sensor only."""
    roi = message.roi
    check_whole_sensor(
        (message.width, message.height),
        (message.binning_x, message.binning_y),
        (roi.x_offset, roi.y_offset),
        (roi.width, roi.height),
    )
    return Camera.from_calibration(message.width, message.height, message.k, message.distortion_model, message.d)


def info_from_camera(camera: Camera, stamp: int, frame_id: str) -> CameraInfo:
    """CameraInfo of an image that is neither rectified nor cropped."""
    return CameraInfo(
        header=header(stamp, frame_id),
        width=camera.width,
        height=camera.height,
        distortion_model=camera.distortion_model,
        d=list(camera.distortion),
        k=camera.matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.c_[camera.matrix, np.zeros(3)].ravel(),
    )


def path(path_header: Header, stamps: NDArray[np.int64], map_from_camera: NDArray[np.float64]) -> Path:
    """Path of (N,) stamps and (N, 4, 4) poses of the optical frame in the header's frame."""
    poses = []
    for stamp, pose in zip(stamps.tolist(), map_from_camera, strict=True):
        x, y, z = pose[:3, 3].tolist()
        qx, qy, qz, qw = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True).tolist()
        message = Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
        poses.append(PoseStamped(header=header(stamp, path_header.frame_id), pose=message))
    return Path(header=path_header, poses=poses)


def transform(stamp: int, parent: str, child: str, parent_from_child: NDArray[np.float64]) -> TransformStamped:
    """A rigid transform (4, 4) [m] between two frames at a time [ns]."""
    x, y, z = map(float, parent_from_child[:3, 3])
    qx, qy, qz, qw = map(float, Rotation.from_matrix(parent_from_child[:3, :3]).as_quat())
    moved = Transform(translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(x=qx, y=qy, z=qz, w=qw))
    return TransformStamped(header=header(stamp, parent), child_frame_id=child, transform=moved)


def keyframe_velocities(path_header: Header, readout: float, *rates: NDArray[np.float64]) -> KeyframeVelocities:
    """Rates for the path of equal header, all (N, 3): velocities, linear [m/s] and angular [rad/s], and accelerations.

    readout in s.
    """
    vectors = [[Vector3(x=x, y=y, z=z) for x, y, z in rate.tolist()] for rate in rates]
    velocities, accelerations = zip(*vectors[:2], strict=True), zip(*vectors[2:], strict=True)
    return KeyframeVelocities(
        header=path_header,
        readout=readout,
        velocities=[Twist(linear=linear, angular=angular) for linear, angular in velocities],
        accelerations=[Accel(linear=linear, angular=angular) for linear, angular in accelerations],
    )


def row_rates(message: KeyframeVelocities) -> tuple[NDArray[np.float64], ...]:
    """Linear and angular velocities (N, 3) and accelerations (N, 3), zero where none came, as they are sent."""
    found: list[NDArray[np.float64]] = []
    for part in (message.velocities, message.accelerations or [Accel()] * len(message.velocities)):
        vectors = [[(v.x, v.y, v.z) for v in (each.linear, each.angular)] for each in part]
        found += list(np.array(vectors, float).reshape(-1, 2, 3).swapaxes(0, 1))
    return tuple(found)


def poses_from_path(message: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(N,) stamps [ns] and (N, 4, 4) poses of a path; raises InputError where a pose is no position and rotation."""
    stamps = np.array([stamp_ns(pose.header.stamp) for pose in message.poses], np.int64)
    positions, quaternions = np.zeros((len(stamps), 3)), np.zeros((len(stamps), 4))
    for row, stamped in enumerate(message.poses):
        position, orientation = stamped.pose.position, stamped.pose.orientation
        positions[row] = position.x, position.y, position.z
        quaternions[row] = orientation.x, orientation.y, orientation.z, orientation.w
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(~np.isfinite(positions).all(axis=1) | ~(np.abs(norms - 1.0) <= MAX_QUATERNION_ERROR))
    if len(wrong):
        raise InputError(
            f"pose {wrong[0]} of the path has the position {_listed(positions[wrong[0]])} and the quaternion "
            f"{_listed(quaternions[wrong[0]])}: finite metres and a norm of 1 are needed"
        )
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    if len(stamps):
        poses[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
        poses[:, :3, 3] = positions
    return stamps, poses


def point_cloud(
    cloud_header: Header,
    points: NDArray[np.floating],
    colors: NDArray[np.uint8] | None = None,
    normals: NDArray[np.floating] | None = None,
    views: NDArray[np.integer] | None = None,
) -> PointCloud2:
    """Unordered cloud of (N, 3) points [m], with (N, 3) RGB colours, (N, 3) unit normals, (N,) numbers of views.

    Colour is one float of the bytes 0x00RRGGBB, which RViz and PCL expect.
    """
    names = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    columns: dict[str, NDArray] = dict(zip("xyz", points.T, strict=True))
    if colors is not None:
        red, green, blue = colors.astype(np.uint32).T
        names.append(("rgb", "<f4"))
        columns["rgb"] = (red << 16 | green << 8 | blue).astype("<u4").view("<f4")
    if normals is not None:
        names += [("normal_x", "<f4"), ("normal_y", "<f4"), ("normal_z", "<f4")]
        columns |= dict(zip(("normal_x", "normal_y", "normal_z"), normals.T, strict=True))
    if views is not None:
        names.append(("views", "u1"))
        columns["views"] = np.minimum(views, 255)
    table = np.empty(len(points), np.dtype(names))
    for name, column in columns.items():
        table[name] = column
    data = array("B")
    data.frombytes(table.tobytes())
    assert table.dtype.fields is not None
    return PointCloud2(
        header=cloud_header,
        height=1,
        width=len(table),
        fields=[
            PointField(name=name, offset=field[1], datatype=_FIELD_CODES[field[0].str[1:]], count=1)
            for name, field in table.dtype.fields.items()
        ],
        is_bigendian=False,
        point_step=table.dtype.itemsize,
        row_step=table.dtype.itemsize * len(table),
        data=data,
        is_dense=bool(np.isfinite(points).all()),
    )


def table_from_cloud(message: PointCloud2) -> NDArray[np.void]:
    """(N,) structured array of the cloud's fields; raises InputError where fields, sizes and data do not fit.

    It is a view of the message, unless its rows are padded.
    """
    width, height, step = message.width, message.height, message.point_step
    if width * height > MAX_CLOUD_POINTS:
        raise InputError(f"a point cloud of {width} x {height} points is too large: {MAX_CLOUD_POINTS} at most")
    if len(message.fields) > MAX_CLOUD_FIELDS:
        raise InputError(f"a point cloud of {len(message.fields)} fields is none: {MAX_CLOUD_FIELDS} at most")
    if step > MAX_POINT_STEP:
        raise InputError(f"damaged point cloud: points of {step} bytes: {MAX_POINT_STEP} at most")
    layout = _layout(message)
    row_step = message.row_step if height > 1 else width * step
    if row_step < width * step or len(message.data) < row_step * height:
        raise InputError(
            f"damaged point cloud: {width} x {height} points of {step} bytes in rows of {row_step} bytes "
            f"are not {len(message.data)} bytes"
        )
    if row_step == width * step:
        return np.frombuffer(message.data, layout, count=width * height)
    rows = np.frombuffer(message.data, np.uint8, count=row_step * height).reshape(height, row_step)
    return np.ascontiguousarray(rows[:, : width * step]).view(layout).reshape(-1)


def _layout(message: PointCloud2) -> np.dtype[np.void]:
    """The type of one point; raises InputError where a field is of an unknown type or lies outside of the point."""
    step, order = message.point_step, ">" if message.is_bigendian else "<"
    names, formats = [], []
    for field in message.fields:
        name = field.name[:MAX_NAME]
        if field.datatype not in _FIELD_TYPES:
            raise InputError(f"damaged point cloud: the field {name!r} has the unknown datatype {field.datatype}")
        kind, count = np.dtype(order + _FIELD_TYPES[field.datatype]), max(field.count, 1)
        if field.offset + count * kind.itemsize > step:
            raise InputError(
                f"damaged point cloud: the field {name!r} of {count} x {kind.itemsize} bytes at {field.offset} "
                f"lies outside of the {step} bytes of a point"
            )
        if not name or name in names:
            raise InputError(f"damaged point cloud: a second field {name!r}, or one without a name")
        names.append(name)
        formats.append(kind if count == 1 else np.dtype((kind, (count,))))
    if not names:
        raise InputError("the point cloud has no fields: x, y and z are needed")
    offsets = [field.offset for field in message.fields]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})


def points_from_cloud(message: PointCloud2) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """(N, 3) points [m] and (N, 3) normals, None where the cloud has none; raises InputError without x, y and z."""
    table = table_from_cloud(message)
    names = table.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        listed = ", ".join(names)[:MAX_NAME]
        raise InputError(f"the point cloud has the fields {listed}: x, y and z are needed")
    normals = [name for name in _NORMALS if name in names]
    if len(normals) not in (0, 3):
        raise InputError(f"the point cloud has {' and '.join(normals)} alone: normals are all three or none")
    return _columns(table, "x", "y", "z"), _columns(table, *_NORMALS) if normals else None


def colors_from_cloud(message: PointCloud2) -> NDArray[np.uint8] | None:
    """(N, 3) RGB colours, None where the cloud has none."""
    table = table_from_cloud(message)
    if "rgb" not in (table.dtype.names or ()):
        return None
    if table.dtype["rgb"].itemsize != 4:
        raise InputError(f"the point cloud's field rgb has {table.dtype['rgb'].itemsize} bytes: 4 are needed")
    packed = np.ascontiguousarray(table["rgb"]).view(np.uint32).reshape(-1)
    return np.c_[packed >> 16 & 255, packed >> 8 & 255, packed & 255].astype(np.uint8)


def _columns(table: NDArray[np.void], *names: str) -> NDArray[np.float32]:
    several = [name for name in names if table.dtype[name].shape]
    if several:
        raise InputError(f"the point cloud's field {several[0]} has several values for each point: one is needed")
    columns = np.empty((len(table), len(names)), np.float32)
    with np.errstate(over="ignore"):  # infinity is what becomes of numbers beyond single precision
        for number, name in enumerate(names):
            columns[:, number] = table[name]
    return columns


def _listed(values: NDArray[np.float64]) -> str:
    return f"({', '.join(f'{value:g}' for value in values)})"


def _to_8_bits(image: NDArray) -> NDArray[np.uint8]:
    """Scaled by its own maximum: sensors put 10 to 16 bits into 16, and the message does not say how many."""
    return (image.astype(np.float32) * (255.0 / max(int(image.max()), 1)) + 0.5).astype(np.uint8)
