# SPDX-License-Identifier: Apache-2.0
"""Standard messages to NumPy and back."""

from __future__ import annotations

from array import array

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_node import messages

ROWS, COLUMNS = 4, 6
COLOR = np.random.default_rng(0).integers(0, 256, (ROWS, COLUMNS, 3)).astype(np.uint8)  # BGR
GREY = COLOR[:, :, 0]


def image(encoding: str, pixels: NDArray, padding: int = 0, is_bigendian: bool = False) -> Image:
    rows: NDArray[np.uint8] = np.ascontiguousarray(pixels).view(np.uint8).reshape(ROWS, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    return Image(
        height=ROWS,
        width=COLUMNS,
        encoding=encoding,
        step=rows.shape[1],
        is_bigendian=is_bigendian,
        data=array("B", rows.tobytes()),
    )


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_stamps_keep_every_nanosecond(stamp: int) -> None:
    assert messages.stamp_ns(messages.time_msg(stamp)) == stamp


@pytest.mark.parametrize("padding", [0, 3])
@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("mono8", GREY, GREY),
        ("8UC1", GREY, GREY),
        ("bgr8", COLOR, COLOR),
        ("rgb8", COLOR[:, :, ::-1], COLOR),
        ("bgra8", np.dstack([COLOR, GREY]), COLOR),
        ("rgba8", np.dstack([COLOR[:, :, ::-1], GREY]), COLOR),
    ],
)
def test_raw_images_become_grey_or_bgr(encoding: str, pixels: NDArray, expected: NDArray, padding: int) -> None:
    decoded = messages.image_from_msg(image(encoding, pixels, padding))
    assert decoded.dtype == np.uint8
    np.testing.assert_array_equal(decoded, expected)


@pytest.mark.parametrize("is_bigendian", [False, True])
def test_16_bits_are_scaled_whatever_the_sensor_uses_of_them(is_bigendian: bool) -> None:
    twelve_bits = (np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS) * 178).astype(">u2" if is_bigendian else "<u2")
    decoded = messages.image_from_msg(image("mono16", twelve_bits, is_bigendian=is_bigendian))
    assert decoded.max() == 255
    np.testing.assert_allclose(decoded, twelve_bits / twelve_bits.max() * 255, atol=0.51)


@pytest.mark.parametrize("encoding", ["32FC1", "yuv422", ""])
def test_unknown_encoding_is_reported(encoding: str) -> None:
    with pytest.raises(InputError, match=f"'{encoding}'.*bgr8"):
        messages.image_from_msg(image(encoding, GREY))


def test_image_with_too_few_bytes_is_reported() -> None:
    message = image("bgr8", COLOR)
    message.data = message.data[:-1]
    with pytest.raises(InputError, match="damaged image: 6 x 4 bgr8"):
        messages.image_from_msg(message)


def test_jpeg_goes_there_and_back() -> None:
    smooth = cv2.resize(COLOR, (64, 48), interpolation=cv2.INTER_CUBIC)
    message = messages.compressed_image(17, "camera", messages.encode_jpeg(smooth))
    assert message.format == "jpeg"
    decoded = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert np.abs(decoded.astype(int) - smooth).mean() < 4.0  # grey values of 255


@pytest.mark.parametrize(
    ("model", "distortion"),
    [("plumb_bob", (0.1, -0.2, 0.001, 0.002, 0.05)), ("equidistant", (0.1, 0.2, 0.3, 0.4)), ("plumb_bob", ())],
)
def test_camera_goes_there_and_back(model: str, distortion: tuple[float, ...]) -> None:
    camera = Camera(1280, 720, 900.0, 901.0, 639.5, 359.5, model, distortion)
    message = messages.info_from_camera(camera, 17, "camera")
    assert messages.camera_from_info(message) == camera
    assert messages.stamp_ns(message.header.stamp) == 17


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"k": [0.0] * 9}, "not calibrated"),
        ({"distortion_model": "magic"}, "unknown distortion model 'magic'"),
        ({"width": 0}, "no image size"),
        ({"binning_x": 2}, "binning 2"),
    ],
)
def test_camera_that_cannot_be_used_is_reported(change: dict[str, object], text: str) -> None:
    message = messages.info_from_camera(Camera(1280, 720, 900.0, 901.0, 639.5, 359.5), 0, "camera")
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(InputError, match=text):
        messages.camera_from_info(message)


def test_empty_camera_info_of_a_driver_is_reported() -> None:
    with pytest.raises(InputError, match="set width and height"):
        messages.camera_from_info(CameraInfo())


def test_path_goes_there_and_back() -> None:
    rng = np.random.default_rng(1)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.random(5, random_state=1).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(5, 3))
    stamps = np.arange(5, dtype=np.int64) * 10**9 + 7
    message = messages.path(messages.header(99, "map"), stamps, poses)
    assert {pose.header.frame_id for pose in message.poses} == {"map"}
    stamps_back, poses_back = messages.poses_from_path(message)
    np.testing.assert_array_equal(stamps_back, stamps)
    np.testing.assert_allclose(poses_back, poses, atol=1e-12)


def test_empty_path_and_cloud() -> None:
    stamps, poses = messages.poses_from_path(
        messages.path(messages.header(0, "map"), np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    )
    assert (stamps.shape, poses.shape) == ((0,), (0, 4, 4))
    points, normals = messages.points_from_cloud(messages.point_cloud(messages.header(0, "map"), np.zeros((0, 3))))
    assert points.shape == (0, 3)
    assert normals is None


def test_cloud_goes_there_and_back() -> None:
    rng = np.random.default_rng(2)
    points = rng.normal(size=(50, 3)).astype(np.float32)
    normals = rng.normal(size=(50, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (50, 3)).astype(np.uint8)
    views = np.arange(50) * 10
    message = messages.point_cloud(messages.header(5, "map"), points, colors, normals, views)
    assert (message.height, message.width, message.is_dense) == (1, 50, True)
    assert [field.name for field in message.fields[:4]] == ["x", "y", "z", "rgb"]
    points_back, normals_back = messages.points_from_cloud(message)
    np.testing.assert_array_equal(points_back, points)
    np.testing.assert_array_equal(normals_back, normals)
    np.testing.assert_array_equal(messages.colors_from_cloud(message), colors)
    np.testing.assert_array_equal(messages.table_from_cloud(message)["views"], np.minimum(views, 255))


def test_colour_is_packed_as_rviz_expects() -> None:
    cloud = messages.point_cloud(messages.header(0, "map"), np.zeros((1, 3)), np.array([[0x12, 0x34, 0x56]], np.uint8))
    assert bytes(cloud.data)[12:16] == bytes([0x56, 0x34, 0x12, 0])  # little endian 0x00RRGGBB


def test_cloud_with_gaps_is_not_called_dense() -> None:
    assert not messages.point_cloud(messages.header(0, "map"), np.array([[0.0, 1.0, np.nan]])).is_dense


def test_padded_big_endian_cloud_is_read() -> None:
    table = np.zeros(
        3, np.dtype({"names": ["x", "y", "z"], "formats": [">f8"] * 3, "offsets": [8, 16, 24], "itemsize": 40})
    )
    table["x"], table["y"], table["z"] = 1.0, 2.0, 3.0
    fields = [PointField(name=n, offset=8 * i, datatype=PointField.FLOAT64, count=1) for i, n in enumerate("xyz", 1)]
    message = PointCloud2(
        height=1,
        width=3,
        fields=fields,
        is_bigendian=True,
        point_step=40,
        row_step=120,
        data=array("B", table.tobytes()),
    )
    np.testing.assert_array_equal(messages.points_from_cloud(message)[0], np.tile([1.0, 2.0, 3.0], (3, 1)))


def test_cloud_that_cannot_be_used_is_reported() -> None:
    message = messages.point_cloud(messages.header(0, "map"), np.zeros((4, 3)))
    message.fields[2].name = "intensity"
    with pytest.raises(InputError, match="x, y, intensity: x, y and z are needed"):
        messages.points_from_cloud(message)
    message.data = message.data[:-1]
    with pytest.raises(InputError, match="damaged point cloud"):
        messages.points_from_cloud(message)


@pytest.mark.parametrize("count", [1, 2**31 - 1, 2**28])
def test_a_point_of_gigabytes_is_refused(count: int) -> None:
    """NumPy raises ValueError where the size of an element does not fit into 32 bits with a sign."""
    message = messages.point_cloud(messages.header(0, "map"), np.zeros((0, 3)))
    message.point_step, message.fields[0].count = 2**32 - 1, count
    with pytest.raises(InputError, match="points of 4294967295 bytes"):
        messages.points_from_cloud(message)
