# SPDX-License-Identifier: Apache-2.0
"""Messages from outside, each type checked in one place: its values in pipeprog's types, or InvalidMessageError."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Quaternion, Vector3
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from pipeprog_camera.camera import Camera
from pipeprog_camera.encoded_image import check_bytes, check_size, encoded_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import (
    MAX_ACCELERATION,
    MAX_COORDINATE,
    MAX_NAME,
    MAX_NORMAL_ERROR,
    MAX_OVERLAP,
    MAX_POSES,
    MAX_QUATERNION_ERROR,
    MAX_SECONDS,
    MAX_TRANSFORMS,
    MAX_VELOCITY,
)
from pipeprog_camera.rolling_shutter import check_readout
from pipeprog_msgs.msg import ImageOverlap, ImageOverlapArray, KeyframesRetired, KeyframeVelocities, SfmStatus
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


@dataclass(frozen=True)
class ReceivedTransform:
    """parent_from_child (4, 4), rigid, between two frames at a time [ns]."""

    stamp: int
    parent: str
    child: str
    parent_from_child: NDArray[np.float64]


@dataclass(frozen=True)
class ReceivedTransforms:
    """The transforms of one TFMessage that can be used, and why others cannot."""

    transforms: tuple[ReceivedTransform, ...]
    refused: tuple[InvalidMessageError, ...]


@dataclass(frozen=True)
class ReceivedAcceleration:
    """Specific force (3,) [m/s^2] in the frame of an IMU at a time [ns]; None where the IMU measures none."""

    stamp: int
    frame: str
    force: NDArray[np.float64] | None


@dataclass(frozen=True)
class ReceivedRetirement:
    """Stamps [ns] of keyframes that leave the map once `keyframes_published` keyframes have come."""

    stamp: int
    frame_id: str
    keyframes_published: int
    stamps: tuple[int, ...]


@dataclass(frozen=True)
class ReceivedCloud:
    """A map's points: stamp [ns], points (N, 3) [m] and their unit normals (N, 3), None where it has none."""

    stamp: int
    points: NDArray[np.float32]
    normals: NDArray[np.float32] | None


@dataclass(frozen=True)
class ReceivedPoses:
    """Poses of keyframes: stamp [ns] of the publication, stamps (N,) [ns] of the keyframes, poses (N, 4, 4) [m]."""

    stamp: int
    stamps: NDArray[np.int64]
    map_from_camera: NDArray[np.float64]


@dataclass(frozen=True)
class ReceivedVelocities:
    """Velocities of keyframes: stamp [ns] of the publication, read-out [s], (N, 3) [m/s], (N, 3) [rad/s]."""

    stamp: int
    readout: float
    linear: NDArray[np.float64]
    angular: NDArray[np.float64]


@dataclass(frozen=True)
class ReceivedStatus:
    """Health of the reconstruction: stamp [ns] and number of its last map (0: none yet), the rest as in SfmStatus."""

    stamp: int
    revision: int
    scale_source: str
    scale_sigma: float
    readout: float = 0.0
    camera_refined: bool = False


@dataclass(frozen=True)
class ReceivedOverlap:
    """Overlap of one keyframe; fields as in pipeprog_msgs/ImageOverlap, the stamp in ns."""

    stamp: int
    registered: bool
    overlap: float
    cell_overlap: float
    matches_previous: int
    matches_next: int


@dataclass(frozen=True)
class ReceivedOverlaps:
    """One answer of the SfM: stamp [ns] of the newest keyframe it has considered, counts, overlaps that changed."""

    stamp: int
    keyframes: int
    retirements: int
    images: tuple[ReceivedOverlap, ...]


def stamp_and_frame(header: Header) -> tuple[int, str]:
    """Stamp [ns], zero or later, and name of the frame."""
    if len(header.frame_id) > MAX_NAME:
        raise InvalidMessageError("name", f"a frame_id of {len(header.frame_id)} characters is no name of a frame")
    return checked_stamp(header.stamp), header.frame_id


def checked_stamp(stamp: Time) -> int:
    """Nanoseconds of a stamp, zero or later; before the last second, so that a nanosecond can still be added."""
    if not 0 <= stamp.sec < MAX_SECONDS or stamp.nanosec >= messages.SECOND:
        raise InvalidMessageError(
            "stamp", f"the stamp {stamp.sec} s + {stamp.nanosec} ns is no time: stamp the message"
        )
    return messages.stamp_ns(stamp)


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


def odometry(message: Odometry) -> ReceivedTransform:
    """The pose of the robot's base; the twist and both covariances are not used."""
    pose = message.pose.pose
    return _transform(message.header, message.child_frame_id, pose.position, pose.orientation)


def transforms(message: TFMessage) -> ReceivedTransforms:
    """Each transform by itself: one that cannot be used does not drop the others."""
    if len(message.transforms) > MAX_TRANSFORMS:
        raise InvalidMessageError(
            "count", f"a TFMessage of {len(message.transforms)} transforms: {MAX_TRANSFORMS} at most are taken"
        )
    usable, refused = [], []
    for each in message.transforms:
        edge = each.transform
        try:
            usable.append(_transform(each.header, each.child_frame_id, edge.translation, edge.rotation))
        except InvalidMessageError as error:
            refused.append(error)
    return ReceivedTransforms(tuple(usable), tuple(refused))


def imu(message: Imu) -> ReceivedAcceleration:
    """The linear acceleration, which is finite and one that a robot can feel."""
    stamp, frame_id = stamp_and_frame(message.header)
    # REP 145: a covariance of -1 says that there are no accelerations.
    if not message.linear_acceleration_covariance[0] >= 0:
        return ReceivedAcceleration(stamp, _frame(frame_id), None)
    force = message.linear_acceleration
    if not all(abs(value) <= MAX_ACCELERATION for value in (force.x, force.y, force.z)):  # false for NaN
        raise InvalidMessageError(
            "acceleration", f"an acceleration of ({force.x:g}, {force.y:g}, {force.z:g}) m/s^2: check the IMU's driver"
        )
    return ReceivedAcceleration(stamp, _frame(frame_id), np.array([force.x, force.y, force.z]))


def retirement(message: KeyframesRetired) -> ReceivedRetirement:
    """Keyframes to be retired: numbers that a survey can reach, and stamps that are times."""
    stamp, frame_id = stamp_and_frame(message.header)
    if max(message.keyframes_published, len(message.stamps)) > MAX_POSES:
        raise InvalidMessageError(
            "count",
            f"{len(message.stamps)} keyframes are to be retired after {message.keyframes_published}: "
            f"{MAX_POSES} at most are taken",
        )
    stamps = tuple(checked_stamp(each) for each in message.stamps)
    return ReceivedRetirement(stamp, frame_id, message.keyframes_published, stamps)


def image_overlaps(message: ImageOverlapArray) -> ReceivedOverlaps:
    """Overlaps from 0 to 1, of no more keyframes than a survey can reach."""
    stamp, _ = stamp_and_frame(message.header)
    counts = message.keyframes_considered, message.retirements_considered, len(message.images)
    if max(counts) > MAX_POSES:
        raise InvalidMessageError(
            "count",
            "an answer to {} keyframes and {} retirements with the overlaps of {}".format(*counts)
            + f": {MAX_POSES} at most are taken",
        )
    return ReceivedOverlaps(stamp, *counts[:2], tuple(_overlap(image) for image in message.images))


def _overlap(image: ImageOverlap) -> ReceivedOverlap:
    for value in (image.overlap, image.cell_overlap):
        if not 0.0 <= value <= MAX_OVERLAP:  # false for NaN
            raise InvalidMessageError("overlap", f"an overlap of {value:g}: it is a share of the image, from 0 to 1")
    return ReceivedOverlap(
        checked_stamp(image.stamp),
        image.registered,
        image.overlap,
        image.cell_overlap,
        image.matches_previous,
        image.matches_next,
    )


def rigid_transform(position: Point | Vector3, orientation: Quaternion) -> NDArray[np.float64]:
    """(4, 4) of a position [m] below MAX_COORDINATE and a quaternion whose norm is 1 to MAX_QUATERNION_ERROR."""
    x, y, z = position.x, position.y, position.z
    if not (abs(x) < MAX_COORDINATE and abs(y) < MAX_COORDINATE and abs(z) < MAX_COORDINATE):  # false for NaN
        raise InvalidMessageError("position", f"the position ({x:g}, {y:g}, {z:g}) m is none on Earth")
    quaternion = orientation.x, orientation.y, orientation.z, orientation.w
    if not abs(math.hypot(*quaternion) - 1.0) <= MAX_QUATERNION_ERROR:
        listed = ", ".join(f"{value:g}" for value in quaternion)
        raise InvalidMessageError("rotation", f"the quaternion ({listed}) is no rotation: its norm must be 1")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), (x, y, z)
    return pose


def _transform(
    header: Header, child_frame_id: str, position: Point | Vector3, orientation: Quaternion
) -> ReceivedTransform:
    stamp, frame_id = stamp_and_frame(header)
    parent, child = _frame(frame_id), _frame(child_frame_id)
    if not parent or not child or parent == child or len(child) > MAX_NAME:
        raise InvalidMessageError(
            "name", f"a transform from {parent!r} to {child[:MAX_NAME]!r}: two names of frames are needed"
        )
    return ReceivedTransform(stamp, parent, child, rigid_transform(position, orientation))


def _frame(name: str) -> str:
    """tf2 takes names with and without the leading slash of ROS 1 for the same."""
    return name.lstrip("/")


def map_points(message: PointCloud2) -> ReceivedCloud:
    """The points that have finite coordinates (and normals) within MAX_COORDINATE; the others are left out.

    Single points without coordinates are usual, is_dense announces them; a cloud of nothing else is refused, and one
    with a normal of another length than 1.
    """
    stamp, _ = stamp_and_frame(message.header)
    try:
        points, normals = messages.points_from_cloud(message)
    except InputError as error:
        raise InvalidMessageError("point cloud", str(error)) from None
    points, normals = _usable(points, normals)
    if not len(points):
        raise InvalidMessageError(
            "empty cloud",
            f"not one of {message.width * message.height} points has finite coordinates: check its source",
        )
    if normals is not None:
        squares = np.einsum("ij,ij->i", normals, normals)
        shortest, longest = float(squares.min()) ** 0.5, float(squares.max()) ** 0.5
        if shortest < 1.0 - MAX_NORMAL_ERROR or longest > 1.0 + MAX_NORMAL_ERROR:
            raise InvalidMessageError(
                "normals", f"normals are {shortest:g} to {longest:g} long: publish them with length 1, or none"
            )
    return ReceivedCloud(stamp, points, normals)


def _usable(
    points: NDArray[np.float32], normals: NDArray[np.float32] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """The rows whose values are finite and whose coordinates are in bounds; the arrays themselves where all are."""
    if all(
        not len(each) or (each.min() >= -limit and each.max() <= limit) for each, limit in _limited(points, normals)
    ):
        return points, normals  # a comparison with NaN is false
    usable = np.logical_and.reduce([(np.abs(each) <= limit).all(axis=1) for each, limit in _limited(points, normals)])
    return points[usable], None if normals is None else normals[usable]


def _limited(
    points: NDArray[np.float32], normals: NDArray[np.float32] | None
) -> list[tuple[NDArray[np.float32], float]]:
    largest = float(np.finfo(np.float32).max)
    return [(points, MAX_COORDINATE)] + ([] if normals is None else [(normals, largest)])


def keyframe_poses(message: Path) -> ReceivedPoses:
    """Finite poses within MAX_COORDINATE, of keyframes that each have a stamp of their own."""
    stamp, _ = stamp_and_frame(message.header)
    if len(message.poses) > MAX_POSES:
        raise InvalidMessageError("poses", f"a path of {len(message.poses)} poses: {MAX_POSES} at most are taken")
    for pose in message.poses:
        checked_stamp(pose.header.stamp)
    try:
        stamps, map_from_camera = messages.poses_from_path(message)
    except InputError as error:
        raise InvalidMessageError("poses", str(error)) from None
    if len(np.unique(stamps)) < len(stamps):
        raise InvalidMessageError("repeated stamp", "two poses have one stamp: a keyframe has one pose")
    farthest = np.abs(map_from_camera[:, :3, 3]).max(initial=0.0)
    if farthest > MAX_COORDINATE:
        raise InvalidMessageError("poses", f"a pose {farthest:g} m from the origin: {MAX_COORDINATE:g} m at most")
    return ReceivedPoses(stamp, stamps, map_from_camera)


def keyframe_velocities(message: KeyframeVelocities) -> ReceivedVelocities:
    """Finite velocities within MAX_VELOCITY, and a read-out that a rolling shutter can have."""
    stamp, _ = stamp_and_frame(message.header)
    _check_readout(message.readout)
    if message.readout == 0.0:
        raise InvalidMessageError("read-out", "velocities with a read-out of 0 s: a global shutter needs none")
    if len(message.velocities) > MAX_POSES:
        raise InvalidMessageError("velocities", f"{len(message.velocities)} velocities: {MAX_POSES} at most are taken")
    parts = [[(v.x, v.y, v.z) for v in (twist.linear, twist.angular)] for twist in message.velocities]
    linear, angular = np.array(parts, float).reshape(-1, 2, 3).swapaxes(0, 1)
    for name, values in (("linear", linear), ("angular", angular)):
        wrong = np.flatnonzero(~(np.abs(values) <= MAX_VELOCITY).all(axis=1))  # NaN, too
        if len(wrong):
            raise InvalidMessageError(
                "velocities", f"the {name} velocity of keyframe {wrong[0]} is {values[wrong[0]]}: no camera moves so"
            )
    return ReceivedVelocities(stamp, message.readout, linear, angular)


def _check_readout(readout: float) -> None:
    try:
        check_readout(readout)
    except InputError as error:
        raise InvalidMessageError("read-out", str(error)) from None


def sfm_status(message: SfmStatus) -> ReceivedStatus:
    """Number and scale of the last map; a map has a scale with a standard deviation."""
    stamp_and_frame(message.header)
    stamp = checked_stamp(message.map_stamp)
    if len(message.scale_source) > MAX_NAME:
        raise InvalidMessageError("name", f"a scale_source of {len(message.scale_source)} characters is no source")
    if message.map_revision > MAX_POSES:
        raise InvalidMessageError(
            "count", f"map_revision {message.map_revision}: a survey has a map for each keyframe, {MAX_POSES} at most"
        )
    if message.map_revision and not 0.0 <= message.scale_sigma < np.inf:
        raise InvalidMessageError("scale", f"scale_sigma is {message.scale_sigma:g}: a map has one, zero or larger")
    _check_readout(message.readout)
    return ReceivedStatus(
        stamp,
        message.map_revision,
        message.scale_source,
        message.scale_sigma,
        message.readout,
        message.camera_refined,
    )
