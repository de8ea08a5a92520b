# SPDX-License-Identifier: Apache-2.0
"""Maps from outside: what is taken of their clouds, poses and status, and what the detector is not given."""

from __future__ import annotations

import io
from array import array
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import Path
from numpy.typing import NDArray
from PIL import Image
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2, PointField

from pipeprog_camera.camera import Camera
from pipeprog_camera.limits import MAX_CLOUD_FIELDS, MAX_CLOUD_POINTS, MAX_COORDINATE, MAX_POSES
from pipeprog_msgs.msg import KeyframeVelocities, SfmStatus
from pipeprog_node import messages
from pipeprog_node.intake import InvalidMessageError
from pipeprog_node.received import images as received_images
from pipeprog_node.received import maps as received_maps

CAMERA = Camera(1280, 720, 900.0, 901.0, 639.5, 359.5)
STAMP = 17
POINTS = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
NORMALS = (POINTS / np.linalg.norm(POINTS, axis=1)[:, None]).astype(np.float32)


def cloud(points: NDArray[np.floating] = POINTS, normals: NDArray[np.floating] | None = NORMALS) -> PointCloud2:
    return messages.point_cloud(messages.header(STAMP, "map"), points, normals=normals)


def poses(count: int = 3) -> Path:
    return messages.path(
        messages.header(STAMP, "map"), np.arange(count, dtype=np.int64), np.tile(np.eye(4), (count, 1, 1))
    )


def info() -> CameraInfo:
    return messages.info_from_camera(CAMERA, 17, "camera")


def changed(message: Any, name: str, value: object) -> Any:
    """The message with another value; `name` leads to it, as in poses.0.pose.position.x."""
    *way, last = name.split(".")
    at = message
    for step in way:
        at = at[int(step)] if step.isdigit() else getattr(at, step)
    setattr(at, last, value)
    return message


def picture(encoded: bytes) -> CompressedImage:
    return messages.compressed_image(17, "camera", encoded)


def png_of(width: int, height: int) -> bytes:
    """A small PNG whose header declares another size."""
    file = io.BytesIO()
    Image.new("L", (64, 64)).save(file, "PNG")
    return file.getvalue()[:16] + width.to_bytes(4, "big") + height.to_bytes(4, "big") + file.getvalue()[24:]


def velocities(speed: float = 1.0, readout: float = 0.015, acceleration: float = 0.0) -> KeyframeVelocities:
    """Of two keyframes."""
    linear = np.array([[0.1, 0.2, 0.3], [0.1, speed, 0.3]])
    rates = linear, 0.1 * linear, np.zeros((2, 3)), np.full((2, 3), acceleration)
    return messages.keyframe_velocities(messages.header(STAMP, "map"), readout, *rates)


def one_acceleration() -> KeyframeVelocities:
    """Velocities of two keyframes, and the acceleration of one."""
    message = velocities()
    message.accelerations = list(message.accelerations)[:1]
    return message


ROWS: list[tuple[str, Callable[[Any], object], Any]] = [
    ("calibration: K of zeros", received_images.camera_info, changed(info(), "k", np.zeros(9))),
    ("calibration: K of NaN", received_images.camera_info, changed(info(), "k", np.full(9, np.nan))),
    ("calibration: K of inf", received_images.camera_info, changed(info(), "k", np.full(9, np.inf))),
    ("calibration: binning", received_images.camera_info, changed(info(), "binning_x", 2)),
    ("calibration: no size", received_images.camera_info, changed(info(), "width", 0)),
    ("calibration: D of NaN", received_images.camera_info, changed(info(), "d", [np.nan] * 5)),
    ("calibration: three coefficients", received_images.camera_info, changed(info(), "d", [0.1, 0.2, 0.3])),
    ("calibration: unknown model", received_images.camera_info, changed(info(), "distortion_model", "magic")),
    ("empty cloud: all NaN", received_maps.map_points, cloud(POINTS * np.nan)),
    ("empty cloud: all infinite", received_maps.map_points, cloud(POINTS * np.inf)),
    ("empty cloud: no points", received_maps.map_points, cloud(POINTS[:0], NORMALS[:0])),
    ("empty cloud: all out of range", received_maps.map_points, cloud(POINTS + np.float32(1e30))),
    ("point cloud: a point of no bytes", received_maps.map_points, changed(cloud(), "point_step", 0)),
    ("point cloud: no fields", received_maps.map_points, changed(cloud(), "fields", [])),
    ("point cloud: unknown datatype", received_maps.map_points, changed(cloud(), "fields.0.datatype", 99)),
    ("point cloud: normal_x alone", received_maps.map_points, changed(cloud(), "fields.4.name", "other")),
    ("point cloud: short data", received_maps.map_points, changed(cloud(), "data", cloud().data[:-1])),
    ("point cloud: field outside of a point", received_maps.map_points, changed(cloud(), "fields.2.offset", 2**32 - 1)),
    ("point cloud: field of 2^32 values", received_maps.map_points, changed(cloud(), "fields.2.count", 2**32 - 1)),
    ("point cloud: field of two values", received_maps.map_points, changed(cloud(), "fields.1.count", 2)),
    ("point cloud: two fields of one name", received_maps.map_points, changed(cloud(), "fields.1.name", "x")),
    ("normals: of zero length", received_maps.map_points, cloud(normals=0.0 * NORMALS)),
    ("poses: quaternion of zeros", received_maps.keyframe_poses, changed(poses(), "poses.1.pose.orientation.w", 0.0)),
    ("poses: quaternion of NaN", received_maps.keyframe_poses, changed(poses(), "poses.1.pose.orientation.w", np.nan)),
    ("poses: position of NaN", received_maps.keyframe_poses, changed(poses(), "poses.1.pose.position.y", np.nan)),
    ("velocities: of NaN", received_maps.keyframe_velocities, velocities(speed=np.nan)),
    ("velocities: faster than any camera", received_maps.keyframe_velocities, velocities(speed=1e9)),
    ("accelerations: of NaN", received_maps.keyframe_velocities, velocities(acceleration=np.nan)),
    ("accelerations: larger than any", received_maps.keyframe_velocities, velocities(acceleration=1e9)),
    ("accelerations: of another keyframe", received_maps.keyframe_velocities, one_acceleration()),
    ("read-out: of a second", received_maps.keyframe_velocities, velocities(readout=1.0)),
    ("read-out: below zero", received_maps.keyframe_velocities, velocities(readout=-0.01)),
    ("read-out: of no rolling shutter", received_maps.keyframe_velocities, velocities(readout=0.0)),
    ("read-out: of NaN", received_maps.sfm_status, SfmStatus(readout=np.nan)),
    ("circles: one without radius", received_maps.sfm_status, SfmStatus(board_circles=[Point()])),
    (
        "circles: of NaN",
        received_maps.sfm_status,
        SfmStatus(board_circles=[Point(z=np.nan)], board_circle_radii=[0.04]),
    ),
    ("circles: of radius zero", received_maps.sfm_status, SfmStatus(board_circles=[Point()], board_circle_radii=[0.0])),
    ("image: empty", received_images.compressed_image, picture(b"")),
    ("image: not to be decoded", received_images.compressed_image, picture(b"no image")),
    ("image: over 2^30 pixels", received_images.compressed_image, picture(png_of(40_000, 40_000))),
]


@pytest.mark.parametrize(("what", "door", "message"), ROWS, ids=[what for what, _, _ in ROWS])
def test_what_ended_the_detector_is_refused_at_its_door(
    what: str, door: Callable[[Any], object], message: object
) -> None:
    with pytest.raises(InvalidMessageError) as refusal:
        door(message)
    assert refusal.value.kind == what.partition(":")[0]
    assert len(str(refusal.value)) < 500


def test_a_good_map_is_taken_as_it_is() -> None:
    taken = received_maps.map_points(cloud())
    assert taken.stamp == 17
    np.testing.assert_array_equal(taken.points, POINTS)
    np.testing.assert_array_equal(taken.normals, NORMALS)
    assert received_maps.map_points(cloud(normals=None)).normals is None
    path = received_maps.keyframe_poses(poses(4))
    assert (path.stamp, path.stamps.tolist(), path.map_from_camera.shape) == (17, [0, 1, 2, 3], (4, 4, 4))
    assert len(received_maps.keyframe_poses(poses(0)).stamps) == 0
    status = SfmStatus(map_revision=3, map_stamp=messages.time_msg(STAMP), scale_source="board", scale_sigma=0.001)
    assert received_maps.sfm_status(status) == received_maps.ReceivedStatus(17, 3, "board", 0.001)
    status.board_circles, status.board_circle_radii = [Point(x=1.0, y=2.0, z=3.0)], [0.04]
    assert received_maps.sfm_status(status).circles == ((1.0, 2.0, 3.0, 0.04),)


def test_velocities_come_as_they_were_sent() -> None:
    header = messages.header(17, "map")
    linear = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]])
    angular = np.negative(linear)
    message = messages.keyframe_velocities(header, 0.015, linear, angular, 2.0 * linear, 3.0 * angular)
    taken = received_maps.keyframe_velocities(message)
    assert (taken.stamp, taken.readout) == (17, 0.015)
    np.testing.assert_array_equal(taken.linear_acceleration, 2.0 * linear)
    np.testing.assert_array_equal(taken.angular_acceleration, 3.0 * angular)
    message.accelerations = []
    np.testing.assert_array_equal(received_maps.keyframe_velocities(message).angular_acceleration, np.zeros((2, 3)))
    np.testing.assert_array_equal(taken.linear, linear)
    np.testing.assert_array_equal(taken.angular, angular)


def test_single_points_that_are_nowhere_are_left_out() -> None:
    points, normals = POINTS.copy(), NORMALS.copy()
    points[1, 2], points[5, 0], points[7, 1], normals[9] = np.nan, -np.inf, 3.0 * MAX_COORDINATE, np.nan
    taken = received_maps.map_points(cloud(points, normals))
    kept = np.delete(np.arange(20), [1, 5, 7, 9])
    np.testing.assert_array_equal(taken.points, points[kept])
    np.testing.assert_array_equal(taken.normals, normals[kept])


def test_a_cloud_beyond_the_limits_is_refused_before_its_data_are_touched() -> None:
    size = 1 << (MAX_CLOUD_POINTS.bit_length() - 1) // 2
    message = changed(cloud(), "width", size)
    message.height = size + 1
    with pytest.raises(InvalidMessageError, match="too large"):
        received_maps.map_points(message)
    message.width = message.height = 2**32 - 1  # 2^64 points overflow 64 bits
    with pytest.raises(InvalidMessageError, match="too large"):
        received_maps.map_points(message)
    message = cloud()
    message.fields += [PointField(name=f"f{n}", datatype=PointField.UINT8, count=1) for n in range(MAX_CLOUD_FIELDS)]
    with pytest.raises(InvalidMessageError, match="fields"):
        received_maps.map_points(message)


def test_rows_of_an_ordered_cloud_may_be_padded() -> None:
    rows = np.frombuffer(cloud().data, np.uint8).reshape(4, -1)
    message = changed(cloud(), "height", 4)
    message.width, message.row_step = 5, rows.shape[1] + 3
    message.data = array("B", np.pad(rows, ((0, 0), (0, 3))).tobytes())
    np.testing.assert_array_equal(received_maps.map_points(message).points, POINTS)
    message.row_step = rows.shape[1] - 1
    with pytest.raises(InvalidMessageError, match="damaged"):
        received_maps.map_points(message)


@pytest.mark.parametrize(
    ("message", "kind"),
    [
        (changed(poses(), "poses.2.header.stamp", Time(sec=0, nanosec=1)), "repeated stamp"),
        (changed(poses(), "poses.2.header.stamp", Time(sec=-1)), "stamp"),
        (changed(poses(), "header.stamp", Time(nanosec=2**32 - 1)), "stamp"),
        (changed(poses(), "poses.0.pose.position.x", 1e300), "poses"),
        (changed(poses(), "poses.0.pose.orientation.w", 1e-300), "poses"),
        (changed(poses(), "poses.0.pose.orientation.w", 1e300), "poses"),
        (Path(header=messages.header(STAMP, "map"), poses=(MAX_POSES + 1) * poses(1).poses), "poses"),
    ],
)
def test_poses_that_no_survey_has_are_refused(message: Path, kind: str) -> None:
    with pytest.raises(InvalidMessageError) as refusal:
        received_maps.keyframe_poses(message)
    assert refusal.value.kind == kind


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ({"scale_sigma": np.nan}, "scale"),
        ({"scale_sigma": np.inf}, "scale"),
        ({"scale_sigma": -0.1}, "scale"),
        ({"scale_source": "s" * 1000}, "name"),
        ({"map_revision": 2**32 - 1}, "count"),
        ({"map_stamp": Time(sec=-5)}, "stamp"),
    ],
)
def test_a_status_that_no_survey_has_is_refused(change: dict[str, object], kind: str) -> None:
    with pytest.raises(InvalidMessageError) as refusal:
        received_maps.sfm_status(SfmStatus(**({"map_revision": 1, "scale_sigma": 0.1} | change)))
    assert refusal.value.kind == kind


def test_before_the_first_map_there_is_no_scale() -> None:
    assert received_maps.sfm_status(SfmStatus(scale_sigma=np.nan)).revision == 0


@given(
    width=st.integers(0, 2**32 - 1) | st.integers(0, 30),
    height=st.integers(0, 2**32 - 1) | st.integers(0, 3),
    point_step=st.integers(0, 2**32 - 1) | st.integers(0, 40),
    row_step=st.integers(0, 2**32 - 1),
    data=st.binary(max_size=600),
    is_bigendian=st.booleans(),
    fields=st.lists(
        st.builds(
            PointField,
            name=st.sampled_from(["x", "y", "z", "normal_x", "normal_y", "normal_z", "rgb", ""]),
            offset=st.integers(0, 40) | st.integers(0, 2**32 - 1),
            datatype=st.integers(0, 9) | st.integers(0, 255),
            count=st.integers(0, 3) | st.integers(0, 2**32 - 1),
        ),
        max_size=8,
    ),
)
def test_any_cloud_is_taken_with_finite_points_or_refused(data: bytes, **values: Any) -> None:
    try:
        taken = received_maps.map_points(
            PointCloud2(header=messages.header(STAMP, "map"), data=array("B", data), **values)
        )
    except InvalidMessageError:
        return
    assert np.abs(taken.points).max() <= MAX_COORDINATE
    assert taken.normals is None or np.isfinite(taken.normals).all()
