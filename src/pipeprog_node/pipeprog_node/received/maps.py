# SPDX-License-Identifier: Apache-2.0
"""Maps from outside, checked: cloud, poses, velocities and status, or InvalidMessageError."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from nav_msgs.msg import Path
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import (
    MAX_ACCELERATION,
    MAX_CIRCLES,
    MAX_COORDINATE,
    MAX_NAME,
    MAX_NORMAL_ERROR,
    MAX_POSES,
    MAX_VELOCITY,
)
from pipeprog_msgs.msg import KeyframeVelocities, SfmStatus
from pipeprog_node import messages
from pipeprog_node.intake import InvalidMessageError
from pipeprog_node.received.header import checked_stamp, stamp_and_frame
from pipeprog_node.received.readout import checked_readout


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
    """How keyframes move: stamp [ns] of the publication, read-out [s], (N, 3) [m/s], [rad/s], [m/s^2], [rad/s^2]."""

    stamp: int
    readout: float
    linear: NDArray[np.float64]
    angular: NDArray[np.float64]
    linear_acceleration: NDArray[np.float64]
    angular_acceleration: NDArray[np.float64]


@dataclass(frozen=True)
class ReceivedStatus:
    """Health of the reconstruction: stamp [ns] and number of its last map (0: none yet), the rest as in SfmStatus.

    `circles`: centre and radius (x, y, z, r) [m] of each white circle of the boards.
    """

    stamp: int
    revision: int
    scale_source: str
    scale_sigma: float
    readout: float = 0.0
    camera_refined: bool = False
    circles: tuple[tuple[float, float, float, float], ...] = ()
    final: bool = False


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
    """Finite rates within MAX_VELOCITY and MAX_ACCELERATION, and a read-out that a rolling shutter can have."""
    stamp, _ = stamp_and_frame(message.header)
    checked_readout(message.readout)
    if message.readout == 0.0:
        raise InvalidMessageError("read-out", "velocities with a read-out of 0 s: a global shutter needs none")
    if len(message.velocities) > MAX_POSES:
        raise InvalidMessageError("velocities", f"{len(message.velocities)} velocities: {MAX_POSES} at most are taken")
    if len(message.accelerations) not in (0, len(message.velocities)):
        count = f"{len(message.accelerations)} accelerations for {len(message.velocities)} velocities"
        raise InvalidMessageError("accelerations", f"{count}: each keyframe has both")
    rates = messages.row_rates(message)
    kinds = [(name, kind) for kind in ("velocity", "acceleration") for name in ("linear", "angular")]
    for (name, kind), values in zip(kinds, rates, strict=True):
        most = MAX_VELOCITY if kind == "velocity" else MAX_ACCELERATION
        wrong = np.flatnonzero(~(np.abs(values) <= most).all(axis=1))  # NaN, too
        if len(wrong):
            raise InvalidMessageError(
                "velocities" if kind == "velocity" else "accelerations",
                f"the {name} {kind} of keyframe {wrong[0]} is {values[wrong[0]]}: no camera moves so",
            )
    return ReceivedVelocities(stamp, message.readout, *rates)


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
    checked_readout(message.readout)
    return ReceivedStatus(
        stamp,
        message.map_revision,
        message.scale_source,
        message.scale_sigma,
        message.readout,
        message.camera_refined,
        _circles(message),
        message.map_final,
    )


def _circles(message: SfmStatus) -> tuple[tuple[float, float, float, float], ...]:
    centres, radii = message.board_circles, message.board_circle_radii
    if len(centres) != len(radii) or len(radii) > MAX_CIRCLES:
        raise InvalidMessageError(
            "circles", f"{len(centres)} board_circles and {len(radii)} radii: each has one, and {MAX_CIRCLES} at most"
        )
    rows = [(c.x, c.y, c.z, float(r)) for c, r in zip(centres, radii, strict=True)]
    if not all(row[3] > 0.0 and all(abs(value) <= MAX_COORDINATE for value in row) for row in rows):
        raise InvalidMessageError("circles", "a circle of board_circles is nowhere or has no radius")
    return tuple(rows)
