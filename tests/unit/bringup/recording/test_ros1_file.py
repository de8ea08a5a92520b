# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 1 and of RealSense's SDK: whole, torn, without an index, damaged and hostile."""

from __future__ import annotations

import struct
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from pipeprog_bringup.recording import cdr, inflation
from pipeprog_bringup.recording.bag import Bag, MotionMessage
from pipeprog_bringup.recording.ros1_messages import ros2_type, to_cdr
from pipeprog_camera.errors import InputError
from tests.unit.bringup.recordings import (
    START,
    STEP,
    camera_messages,
    ros1_bytes,
    ros1_camera_messages,
    ros1_header,
    ros1_text,
    write_bag,
)

COUNT = 40
IMAGES = [data for _, _, _, data in camera_messages(COUNT)[1::2]]


def content(path: Path) -> list[tuple[int, str, bytes]]:
    """Stamp, fault and JPEG of each frame."""
    read = [(frame, cdr.read_image(frame.data, cdr.COMPRESSED_IMAGE)) for frame in Bag.open(path)]
    return [(frame.stamp, frame.fault, bytes(image.data)) for frame, image in read]


@pytest.fixture
def same(tmp_path: Path) -> list[tuple[int, str, bytes]]:
    """What the same recording has as an mcap file of ROS 2."""
    return content(write_bag(tmp_path / "same.mcap", camera_messages(COUNT)))


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
@pytest.mark.parametrize("index", [True, False])
def test_gives_the_same_frames_as_mcap(tmp_path: Path, same: list, compression: str, index: bool) -> None:
    path = tmp_path / "walk.bag"
    path.write_bytes(ros1_bytes(ros1_camera_messages(COUNT), compression, index))
    assert content(path) == same
    bag = Bag.open(path)
    assert bag.camera == Bag.open(tmp_path / "same.mcap").camera
    assert bag.losses == []


def test_an_mcap_file_of_ros_1_messages(tmp_path: Path, same: list) -> None:
    path = tmp_path / "ros1.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros1")
        channels: dict[str, int] = {}
        for topic, type_name, log_time, data in ros1_camera_messages(COUNT):
            if topic not in channels:
                schema = writer.register_schema(type_name, "ros1msg", b"")
                channels[topic] = writer.register_channel(topic, "ros1", schema)
            writer.add_message(channels[topic], log_time, data, log_time)
        writer.finish()
    assert content(path) == same


def test_messages_come_in_the_order_of_their_times(tmp_path: Path, same: list) -> None:
    path = tmp_path / "late.bag"
    path.write_bytes(ros1_bytes(ros1_camera_messages(COUNT)[::-1]))
    assert content(path) == same


@pytest.mark.parametrize("compression", ["none", "bz2"])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_torn_file_gives_what_it_still_holds(tmp_path: Path, same: list, share: float, compression: str) -> None:
    path = tmp_path / "torn.bag"
    whole = ros1_bytes(ros1_camera_messages(COUNT), compression)
    path.write_bytes(whole[: int(share * len(whole))])
    found = content(path)
    assert 0.4 * share * COUNT < len(found) < COUNT
    assert found == same[: len(found)]
    (note,) = Bag.open(path).losses
    assert str(path) in note
    assert "torn" in note


def test_an_index_that_lies_costs_its_messages(tmp_path: Path, same: list) -> None:
    messages = ros1_camera_messages(COUNT)
    whole = ros1_bytes(messages)
    at = whole.index(struct.pack("<II", *divmod(messages[30][2], 10**9)), whole.index(b"count=", len(whole) // 2))
    path = tmp_path / "lies.bag"
    path.write_bytes(whole[: at + 8] + struct.pack("<I", 7) + whole[at + 12 :])
    bag = Bag.open(path)
    assert COUNT - 2 <= len(list(bag)) <= COUNT
    assert "1 messages cannot be read" in bag.losses[0]


def test_motion_comes_with_the_images(tmp_path: Path) -> None:
    pose = ros1_text("base") + struct.pack("<7d36d6d36d", *range(85))
    imu = struct.pack("<4d9d3d9d3d9d", *range(37))
    moved = struct.pack("<I", 1) + ros1_header(0, "odom") + ros1_text("base") + struct.pack("<7d", *range(7))
    told = [
        ("/odom", "nav_msgs/Odometry", START + 1, ros1_header(0, "odom") + pose),
        ("/imu", "sensor_msgs/Imu", START + 2, ros1_header(0, "imu") + imu),
        ("/tf", "tf/tfMessage", START + 3, moved),
    ]
    path = tmp_path / "motion.bag"
    path.write_bytes(ros1_bytes(ros1_camera_messages(2) + told))
    found = [one for one in Bag.open(path).with_motion() if isinstance(one, MotionMessage)]
    assert [one.topic for one in found] == ["odometry", "imu", "/tf"]
    transform = {
        "translation": dict(zip("xyz", (0.0, 1.0, 2.0), strict=True)),
        "rotation": dict(zip("xyzw", (3.0, 4.0, 5.0, 6.0), strict=True)),
    }
    content = {"header": cdr.header(START, "odom"), "child_frame_id": "base", "transform": transform}
    assert found[2].data == cdr.write(cdr.TF, {"transforms": [content]})
    assert found[1].data[-37 * 8 :] == imu
    assert found[0].data[-85 * 8 :] == pose[8:]


def realsense(depth: bool) -> list[tuple[str, str, int, bytes]]:
    """What RealSense's SDK records: one CameraInfo, raw images, stamps from the start of the camera."""
    infos, images = [], []
    for sensor, stream in enumerate(("Depth_0", "Color_0") if depth else ("Color_0",)):
        base = f"/device_0/sensor_{sensor}/{stream}"
        infos.append((f"{base}/info/camera_info", *ros1_camera_messages(1, "Inverse Brown Conrady")[0][1:]))
        for number in range(3):
            kind, step = ("mono16", 128) if stream == "Depth_0" else ("rgb8", 192)
            pixels = np.full(48 * step, number, np.uint8).tobytes()
            head = struct.pack("<III", number, 12, number * STEP) + ros1_text("0")
            data = head + struct.pack("<II", 48, 64) + ros1_text(kind) + b"\0" + struct.pack("<I", step)
            data += ros1_text(pixels)
            images.append((f"{base}/image/data", "sensor_msgs/Image", START + number * STEP, data))
    return infos + sorted(images, key=lambda message: message[2])


@pytest.mark.parametrize("depth", [True, False])
def test_a_bag_of_realsense_s_sdk(tmp_path: Path, depth: bool) -> None:
    path = tmp_path / "realsense.bag"
    path.write_bytes(ros1_bytes(realsense(depth), "lz4"))
    bag = Bag.open(path)
    assert bag.image_topic.endswith("/Color_0/image/data")
    assert bag.camera_info_topic.endswith("/Color_0/info/camera_info")
    frames = list(bag)
    assert [frame.stamp for frame in frames] == [12 * 10**9 + number * STEP for number in range(3)]
    assert not any(frame.fault for frame in frames)
    assert cdr.read_image(frames[1].data, cdr.IMAGE).encoding == "rgb8"


def hostile(what: str) -> bytes:
    messages = ros1_camera_messages(4)
    if what == "a bomb":
        return ros1_bytes([("/zeros", "std_msgs/String", START, bytes(4_000_000))] * 12, "lz4", False, 1)
    if what == "a chunk of 4 GB":
        whole = ros1_bytes(messages)
        at = whole.index(b"size=") + 5
        return whole[:at] + b"\xff\xff\xff\xff" + whole[at + 4 :]
    if what == "an unknown compression":
        return ros1_bytes(messages).replace(b"compression=none", b"compression=gzip")
    if what == "version 1.2":
        return b"#ROSBAG V1.2\n" + bytes(100)
    if what == "its magic alone":
        return b"#ROSBAG V2.0\n"
    return b"#ROSBAG V2.0\n" + np.random.default_rng(1).bytes(9000)


@pytest.mark.parametrize(
    "what", ["a bomb", "a chunk of 4 GB", "an unknown compression", "version 1.2", "its magic alone", "noise"]
)
def test_a_hostile_bag_is_refused_in_one_line(tmp_path: Path, what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inflation, "FREE_CONTENT", 1 << 24)
    path = tmp_path / "hostile.bag"
    path.write_bytes(hostile(what))
    started = time.monotonic()
    with pytest.raises(InputError) as caught:
        list(Bag.open(path))
    assert time.monotonic() - started < 5.0
    assert "hostile.bag" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_messages_that_are_cut_are_no_messages() -> None:
    for _, kind, _, data in ros1_camera_messages(1):
        assert to_cdr(ros2_type(kind), data)
        assert all(not to_cdr(ros2_type(kind), data[:size]) for size in range(0, len(data), 7))
    assert not to_cdr(cdr.TF, b"\xff\xff\xff\xff")
    assert not to_cdr("std_msgs/msg/String", b"")
