# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType

from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import Bag, MotionMessage
from pipeprog_bringup.recording.bag_writer import BagWriter
from pipeprog_bringup.recording.definitions import message_definition
from pipeprog_camera.errors import InputError
from tests.unit.bringup.recordings import (
    CAMERA,
    START,
    STEP,
    camera_messages,
    image,
    info,
    mcap_bytes,
    raw_image,
    write_bag,
)

IMAGES = [image(number) for number in range(8)]
LAYOUTS = {
    "zstd": mcap_bytes(camera_messages(8)),
    "lz4": mcap_bytes(camera_messages(8), CompressionType.LZ4),
    "plain": mcap_bytes(camera_messages(8), CompressionType.NONE),
    "one chunk": mcap_bytes(camera_messages(8), chunk_size=1 << 20),
    "no chunks": mcap_bytes(camera_messages(8), use_chunking=False),
}


def test_reads_the_frames_in_order_with_their_calibration(tmp_path: Path) -> None:
    for name, content in LAYOUTS.items():
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(content)
        bag = Bag.open(path)
        frames = list(bag)
        assert [frame.data for frame in frames] == IMAGES, name
        assert [frame.stamp for frame in frames] == [START + number * STEP for number in range(8)]
        assert frames[3].camera_info == info(3)
        assert (bag.image_topic, bag.image_count, bag.camera) == ("/camera/image/compressed", 8, CAMERA)
        assert bag.losses == []


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(sorted(LAYOUTS)), st.floats(0, 1), st.booleans())
@example("lz4", 0.00116, True)  # zeros from the length of the first chunk on
@example("plain", 0.96875, True)  # zeros within a channel of the summary
@example("no chunks", 0.751953125, True)  # zeros from within a message's log time on
def test_torn_at_any_byte_gives_the_frames_before_the_tear(
    tmp_path: Path, layout: str, share: float, zeros: bool
) -> None:
    content = LAYOUTS[layout]
    cut = min(int(share * len(content)), len(content) - 1)
    path = tmp_path / "torn.mcap"
    # A file system may leave zeros where the last blocks never reached the disk.
    path.write_bytes(content[:cut] + (bytes(len(content) - cut) if zeros else b""))
    try:
        bag = Bag.open(path)
    except InputError:
        # A chunk of less than one zstd block gives nothing before its end.
        assert layout == "one chunk" or cut < len(content) / 2, "enough of the file is left to read frames from it"
        return
    frames = [frame.data for frame in bag]
    assert "byte" in " ".join(bag.losses)
    if layout == "no chunks" and zeros:
        # Without chunks there is no checksum: the message that the tear runs through comes with a tail of zeros.
        assert frames[:-1] == IMAGES[: len(frames) - 1]
        return
    assert frames == IMAGES[: len(frames)]
    if layout == "no chunks":
        assert len(frames) == sum(content[:cut].count(data) for data in IMAGES)


def test_a_torn_chunk_is_read_up_to_the_tear(tmp_path: Path) -> None:
    content = mcap_bytes(camera_messages(200), chunk_size=1 << 24)
    path = tmp_path / "torn.mcap"
    path.write_bytes(content[: len(content) // 2])
    bag = Bag.open(path)
    assert 60 <= len(list(bag)) <= 110
    assert "torn" in bag.losses[0]
    assert f"byte {len(content) // 2}" in bag.losses[0]
    assert "mcap recover" in bag.losses[0]


def test_a_damaged_chunk_in_the_middle_costs_only_its_own_messages(tmp_path: Path) -> None:
    content = bytearray(LAYOUTS["zstd"])
    middle = len(content) // 2
    content[middle : middle + 200] = bytes(200)
    path = tmp_path / "damaged.mcap"
    path.write_bytes(content)
    bag = Bag.open(path)
    frames = [frame.data for frame in bag]
    assert IMAGES[0] == frames[0]
    assert IMAGES[-1] == frames[-1]
    assert 4 <= len(frames) < 8
    assert "damaged" in bag.losses[0]


def test_messages_come_in_the_order_of_their_log_times(tmp_path: Path) -> None:
    ordered = camera_messages(8)
    by_topic = sorted(ordered, key=lambda message: message[0], reverse=True)
    bag = Bag.open(write_bag(tmp_path / "by_topic.mcap", by_topic))
    frames = list(bag)
    assert [frame.data for frame in frames] == IMAGES
    assert [frame.camera_info for frame in frames[1:]] == [info(n) for n in range(7)]


def test_a_latched_camera_info_serves_all_images(tmp_path: Path) -> None:
    messages = [message for message in camera_messages(8) if message[1] != cdr.CAMERA_INFO]
    messages.insert(3, ("/camera/camera_info", cdr.CAMERA_INFO, START + 3 * STEP, info(0)))
    bag = Bag.open(write_bag(tmp_path / "latched.mcap", messages))
    assert {frame.camera_info for frame in bag} == {info(0)}


def test_stamps_that_run_backwards_are_passed_on_as_they_are(tmp_path: Path) -> None:
    messages = camera_messages(8)
    order = [0, 1, 5, 3, 3, 6]
    images = [("/camera/image/compressed", cdr.COMPRESSED_IMAGE, START + i, image(n)) for i, n in enumerate(order)]
    bag = Bag.open(write_bag(tmp_path / "back.mcap", [messages[0], *images]))
    assert [frame.stamp for frame in bag] == [START + number * STEP for number in order]


def test_damaged_images_are_passed_on_to_be_counted(tmp_path: Path) -> None:
    messages = camera_messages(8)
    messages[1] = (*messages[1][:3], image(0, encoded=b"no jpeg"))
    messages[7] = (*messages[7][:3], messages[7][3][:6])
    bag = Bag.open(write_bag(tmp_path / "damaged.mcap", messages))
    assert len(list(bag)) == 8


def folder(path: Path, parts: list[bytes], **information: object) -> Path:
    path.mkdir()
    names = [f"part_{number}.mcap" for number in range(len(parts))]
    for name, part in zip(names, parts, strict=True):
        (path / name).write_bytes(part)
    content = {"storage_identifier": "mcap", "relative_file_paths": names, **information}
    (path / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": content}))
    return path


def test_reads_a_rosbag2_folder_of_several_files(tmp_path: Path) -> None:
    messages = camera_messages(8)
    bag = Bag.open(folder(tmp_path / "bag", [mcap_bytes(messages[:6]), mcap_bytes(messages[6:])]))
    assert bag.image_count == 8
    assert [frame.data for frame in bag] == IMAGES


def test_reads_messages_that_are_compressed_one_by_one(tmp_path: Path) -> None:
    import zstandard

    messages = [(*message[:3], zstandard.compress(message[3])) for message in camera_messages(8)]
    assert [frame.data for frame in Bag.open(folder(tmp_path / "bag", [mcap_bytes(messages)]))] == IMAGES


def test_prefers_the_compressed_image_and_ignores_depth(tmp_path: Path) -> None:
    messages = camera_messages(2)
    messages.append(("/camera/image", cdr.IMAGE, START, raw_image(0)))
    messages.append(("/camera/depth/image", cdr.IMAGE, START, raw_image(0, "16UC1")))
    messages.append(("/camera/depth/camera_info", cdr.CAMERA_INFO, START, info(0)))
    bag = Bag.open(write_bag(tmp_path / "rgbd.mcap", messages))
    assert (bag.image_topic, bag.camera_info_topic) == ("/camera/image/compressed", "/camera/camera_info")
    raw = Bag.open(tmp_path / "rgbd.mcap", image_topic="/camera/image")
    assert (raw.image_type, raw.camera_info_topic, raw.image_count) == (cdr.IMAGE, "/camera/camera_info", 1)


def spot_messages(camera: str, frame_id: str) -> list[tuple[str, str, int, bytes]]:
    """One camera as Spot's driver names its topics."""
    topics = {"image": f"/spot/camera/{camera}/compressed", "info": f"/spot/camera/{camera}/camera_info"}
    return [
        (topics["info"], cdr.CAMERA_INFO, START, info(0, frame_id=frame_id)),
        (topics["image"], cdr.COMPRESSED_IMAGE, START, image(0, frame_id)),
    ]


def test_each_camera_of_spot_has_its_own_calibration(tmp_path: Path) -> None:
    messages = spot_messages("frontleft", "frontleft") + spot_messages("right", "right")
    path = write_bag(tmp_path / "spot.mcap", messages)
    for camera in ("frontleft", "right"):
        bag = Bag.open(path, image_topic=f"/spot/camera/{camera}/compressed")
        assert bag.camera_info_topic == f"/spot/camera/{camera}/camera_info"
        assert Bag.open(path, camera_info_topic=bag.camera_info_topic).image_topic == bag.image_topic
    with pytest.raises(InputError) as caught:
        Bag.open(path)
    assert "frontleft/compressed --camera-info-topic /spot/camera/frontleft/camera_info" in str(caught.value)
    assert "frontleft/compressed --camera-info-topic /spot/camera/right/camera_info" not in str(caught.value)


def test_all_cameras_of_a_rig_come_under_stamps_of_their_own(tmp_path: Path) -> None:
    cameras = ("frontleft", "frontright", "right")
    path = write_bag(tmp_path / "spot.mcap", [one for name in cameras for one in spot_messages(name, name)])
    rig = Bag.open_rig(path)
    assert [camera.frame_id for camera in rig.rig] == list(cameras)
    frames = list(rig)
    assert len(frames) == rig.image_count == 3 * Bag.open(path, image_topic="/spot/camera/right/compressed").image_count
    assert len({frame.stamp for frame in frames}) == len(frames)
    for frame in frames:
        image = cdr.read_image(frame.data, cdr.COMPRESSED_IMAGE)
        assert (image.stamp, image.frame_id) == (frame.stamp, frame.frame_id)
        assert cameras[(frame.stamp - START) % 10] == frame.frame_id
    one = Bag.open_rig(write_bag(tmp_path / "one.mcap", camera_messages(2)))
    assert not one.rig


def test_cameras_of_one_frame_are_no_rig(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "two.mcap", camera_messages(2, "/left") + camera_messages(2, "/right"))
    with pytest.raises(InputError, match="frame_id of the cameras /left/image/compressed, /right/image/compressed"):
        Bag.open_rig(path)


def test_where_the_names_do_not_tell_the_frame_does(tmp_path: Path) -> None:
    messages = [
        ("/pictures", cdr.COMPRESSED_IMAGE, START, image(0, "left")),
        ("/a/camera_info", cdr.CAMERA_INFO, START, info(0, frame_id="right")),
        ("/b/camera_info", cdr.CAMERA_INFO, START, info(0, frame_id="left")),
    ]
    assert Bag.open(write_bag(tmp_path / "odd.mcap", messages)).camera_info_topic == "/b/camera_info"


def test_a_folder_without_metadata_is_read_in_the_order_of_its_numbers(tmp_path: Path) -> None:
    path = tmp_path / "crashed"
    path.mkdir()
    messages = camera_messages(11)
    for number in range(11):
        (path / f"walk_{number}.mcap").write_bytes(mcap_bytes(messages[2 * number : 2 * number + 2]))
    assert [frame.data for frame in Bag.open(path)] == [data for _, kind, _, data in messages[1::2]]
    (path / "other_0.mcap").write_bytes(mcap_bytes(messages))
    with pytest.raises(InputError, match=r"no metadata.yaml: give one of its files \(other_0.mcap"):
        Bag.open(path)


def test_two_cameras_are_listed_as_flags(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "two.mcap", camera_messages(2, "/left") + camera_messages(2, "/right"))
    with pytest.raises(InputError) as caught:
        Bag.open(path)
    assert "--image-topic /left/image/compressed --camera-info-topic /left/camera_info" in str(caught.value)
    assert "--image-topic /right/image/compressed --camera-info-topic /right/camera_info" in str(caught.value)
    assert Bag.open(path, image_topic="/right/image/compressed").camera_info_topic == "/right/camera_info"
    assert Bag.open(path, camera_info_topic="/left/camera_info").image_topic == "/left/image/compressed"


def uncalibrated(focal: float = 60.0, distortion_model: str = "plumb_bob") -> bytes:
    """A CameraInfo that Camera would refuse."""
    content = {"header": cdr.header(START, "camera"), "height": 48, "width": 64, "distortion_model": distortion_model}
    return cdr.write(cdr.CAMERA_INFO, {**content, "k": [focal, 0.0, 31.5, 0.0, focal, 23.5, 0.0, 0.0, 1.0]})


@pytest.mark.parametrize(
    ("camera_info", "expected"),
    [
        (uncalibrated(focal=0.0), "not calibrated"),
        (uncalibrated(distortion_model="wavy"), "unknown distortion model 'wavy'"),
        (
            info(0, dataclasses.replace(CAMERA, width=128)),
            "64 x 48, but /camera/camera_info is calibrated for 128 x 48",
        ),
        (b"\0\1", "no message on /camera/camera_info can be read"),
    ],
)
def test_a_calibration_that_does_not_fit_is_an_error(tmp_path: Path, camera_info: bytes, expected: str) -> None:
    messages = [("/camera/camera_info", cdr.CAMERA_INFO, START, camera_info), *camera_messages(4)[1::2]]
    path = write_bag(tmp_path / "bag.mcap", messages)
    with pytest.raises(InputError, match=expected) as caught:
        Bag.open(path)
    assert str(path) in str(caught.value)


def test_recordings_that_hold_nothing_to_use_are_errors(tmp_path: Path) -> None:
    only = {name: [m for m in camera_messages(2) if m[1] == name] for name in (cdr.CAMERA_INFO, cdr.COMPRESSED_IMAGE)}
    cases = {
        "no such bag": tmp_path / "absent.mcap",
        "holds no messages": write_bag(tmp_path / "none.mcap", []),
        "holds no images": write_bag(tmp_path / "info.mcap", only[cdr.CAMERA_INFO]),
        "no sensor_msgs/CameraInfo": write_bag(tmp_path / "images.mcap", only[cdr.COMPRESSED_IMAGE]),
        "is empty": tmp_path / "zero.mcap",
        "is not an mcap file": tmp_path / "text.mcap",
        "ROS 1 bag of another format": tmp_path / "ros1.bag",
        "no metadata.yaml": tmp_path / "folder",
        "stored as 'rocksdb'": folder(tmp_path / "rocks", [b""], storage_identifier="rocksdb"),
        "no rosbag2 metadata": folder(tmp_path / "odd", [b""]),
        "is missing": folder(tmp_path / "gap", [b""], relative_file_paths=["gone.mcap"]),
        "none of the 2 images": write_bag(
            tmp_path / "spoiled.mcap",
            [*only[cdr.CAMERA_INFO], *[(m[0], m[1], m[2], image(0, encoded=b"x")) for m in only[cdr.COMPRESSED_IMAGE]]],
        ),
    }
    (tmp_path / "zero.mcap").write_bytes(b"")
    (tmp_path / "text.mcap").write_text("hello")
    (tmp_path / "ros1.bag").write_bytes(b"#ROSBAG V1.2\n")
    (tmp_path / "folder").mkdir()
    (tmp_path / "odd" / "metadata.yaml").write_text("[")
    for expected, path in cases.items():
        with pytest.raises(InputError, match=expected) as caught:
            Bag.open(path)
        assert path.name in str(caught.value)


def test_an_unknown_topic_names_those_that_are_there(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag.mcap")
    with pytest.raises(InputError, match="/camera/image/compressed"):
        Bag.open(path, image_topic="/imge")


def test_written_recordings_are_read_back_and_carry_their_definitions(tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    path = tmp_path / "written.mcap"
    with path.open("wb") as stream, BagWriter(stream) as writer:
        for topic, type_name, stamp, data in camera_messages(3):
            writer.write(topic, type_name, data, stamp)
    assert [frame.data for frame in Bag.open(path)] == IMAGES[:3]
    with path.open("rb") as recorded:
        messages = make_reader(recorded, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        decoded = [message.decoded_message for message in messages]
    assert decoded[0].k == [60.0, 0, 31.5, 0, 60.0, 23.5, 0, 0, 1]
    assert decoded[1].header.frame_id == "camera"
    assert "MSG: builtin_interfaces/Time" in message_definition(cdr.CAMERA_INFO)


def motion_messages(odometries: list[str]) -> list[tuple[str, str, int, bytes]]:
    told = [(topic, cdr.ODOMETRY, START + STEP // 2, b"odometry") for topic in odometries]
    told += [("/tf", cdr.TF, START + STEP // 3, b"moving"), ("/tf_static", cdr.TF, START + 3 * STEP, b"mounted")]
    return sorted([*camera_messages(3), *told], key=lambda message: message[2])


def test_motion_comes_between_the_frames_and_static_transforms_first(tmp_path: Path) -> None:
    bag = Bag.open(write_bag(tmp_path / "bag.mcap", motion_messages(["/odom"])))
    told = [(one.topic, one.data) if isinstance(one, MotionMessage) else one.stamp for one in bag.with_motion()]
    assert told == [
        *(("/tf_static", b"mounted"), START, ("/tf", b"moving"), ("odometry", b"odometry")),
        *(START + STEP, START + 2 * STEP),
    ]
    assert [frame.stamp for frame in bag] == [START, START + STEP, START + 2 * STEP]
    assert bag.notes == []


def test_of_several_odometries_none_is_guessed(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag.mcap", motion_messages(["/wheel", "/visual"]))
    bag = Bag.open(path)
    assert "odometry" not in bag.motion_topics.values()
    assert "--odometry-topic /visual or --odometry-topic /wheel" in bag.notes[0]
    assert Bag.open(path, odometry_topic="/wheel").motion_topics["/wheel"] == "odometry"
    with pytest.raises(InputError, match="--imu-topic /imu is not among its topics: none of that type"):
        Bag.open(path, imu_topic="/imu")
