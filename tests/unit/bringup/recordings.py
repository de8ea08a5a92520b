# SPDX-License-Identifier: Apache-2.0
"""Small recordings made for the tests."""

from __future__ import annotations

import bz2
import io
import sqlite3
import struct
import tempfile
from fractions import Fraction
from pathlib import Path

import cv2
import lz4.frame  # type: ignore[import-untyped]
import numpy as np
from mcap.writer import CompressionType, Writer

from pipeprog_bringup.recording import cdr
from pipeprog_camera.camera import Camera

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
START = 1_700_000_000_000_000_000
STEP = 200_000_000


def jpeg(number: int, width: int = 64, height: int = 48) -> bytes:
    """A small JPEG that differs from number to number and does not compress away."""
    pixels = np.random.default_rng(number).integers(0, 255, (height, width), dtype=np.uint8)
    return cv2.imencode(".jpg", pixels)[1].tobytes()


def image(number: int, frame_id: str = "camera", encoded: bytes | None = None) -> bytes:
    """CDR bytes of the compressed image `number`."""
    return cdr.write_compressed_image(START + number * STEP, frame_id, "jpeg", encoded or jpeg(number))


def info(number: int, camera: Camera = CAMERA, frame_id: str = "camera") -> bytes:
    """CDR bytes of its CameraInfo."""
    return cdr.write_camera_info(START + number * STEP, frame_id, camera)


def raw_image(number: int, encoding: str = "mono8") -> bytes:
    """CDR bytes of a raw sensor_msgs/Image."""
    content = {"header": cdr.header(START + number * STEP, "camera"), "height": 48, "width": 64, "step": 64}
    return cdr.write(cdr.IMAGE, {**content, "encoding": encoding, "data": bytes(64 * 48)})


def mcap_bytes(
    messages: list[tuple[str, str, int, bytes]],
    compression: CompressionType = CompressionType.ZSTD,
    chunk_size: int = 4000,
    **options: bool,
) -> bytes:
    """An mcap file of (topic, type, log time, data) messages."""
    stream = io.BytesIO()
    writer = Writer(stream, compression=compression, chunk_size=chunk_size, **options)
    writer.start(profile="ros2", library="test")
    channels: dict[str, int] = {}
    for topic, type_name, log_time, data in messages:
        if topic not in channels:
            schema = writer.register_schema(type_name, "ros2msg", b"")
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        writer.add_message(channels[topic], log_time, data, log_time)
    writer.finish()
    return stream.getvalue()


def sqlite_bytes(messages: list[tuple[str, str, int, bytes]]) -> bytes:
    """A .db3 file of (topic, type, log time, data) messages, as rosbag2's sqlite3 storage writes it on Humble."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "bag.db3")
        database = sqlite3.connect(path)
        database.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
            "serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, "
            "data BLOB NOT NULL);"
            "CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
        )
        topics: dict[str, int] = {}
        for topic, type_name, log_time, data in messages:
            if topic not in topics:
                topics[topic] = len(topics) + 1
                database.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (topics[topic], topic, type_name))
            row = (topics[topic], log_time, data)
            database.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", row)
        database.commit()
        database.close()
        return path.read_bytes()


def camera_messages(count: int, prefix: str = "/camera") -> list[tuple[str, str, int, bytes]]:
    """Images and CameraInfo of one camera."""
    messages = []
    for number in range(count):
        log_time = START + number * STEP
        messages.append((f"{prefix}/camera_info", cdr.CAMERA_INFO, log_time, info(number)))
        messages.append((f"{prefix}/image/compressed", cdr.COMPRESSED_IMAGE, log_time, image(number)))
    return messages


def pictures(count: int) -> list[np.ndarray]:
    """Smooth pictures (48, 64, 3) that move, so that coded frames refer to each other."""
    noise = np.random.default_rng(0).integers(0, 255, (48, 64 + 2 * count, 3), np.uint8)
    wide = cv2.GaussianBlur(noise, (0, 0), 3)
    return [np.ascontiguousarray(wide[:, 2 * n : 2 * n + 64]) for n in range(count)]


def coded_frames(count: int, encoder: str = "libx264", key_every: int = 8) -> list[bytes]:
    """The pictures as video, one frame each, without frames that refer to later ones; PyAV must be installed."""
    import av

    context = av.CodecContext.create(encoder, "w")
    context.width, context.height, context.pix_fmt = 64, 48, "yuv444p" if encoder == "libx264" else "yuv420p"
    context.time_base, context.gop_size = Fraction(1, 30), key_every
    context.options = {"tune": "zerolatency", "preset": "ultrafast", "crf": "10"}
    if encoder == "libx265":
        context.options |= {"x265-params": f"log-level=none:keyint={key_every}"}
    coded = []
    for number, picture in enumerate(pictures(count)):
        frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
        frame.pts = number
        coded += [bytes(packet) for packet in context.encode(frame)]
    return coded + [bytes(packet) for packet in context.encode(None)]


def video_message(type_name: str, number: int, coded: bytes, codec: str = "h264") -> bytes:
    """CDR bytes of one coded frame, as foxglove_msgs, ffmpeg_image_transport or sensor_msgs lay them out."""
    if type_name == cdr.COMPRESSED_IMAGE:
        return cdr.write_compressed_image(START + number * STEP, "camera", codec, coded)
    cdr_bytes = bytearray(b"\0\1\0\0" + struct.pack("<iI", *divmod(START + number * STEP, 10**9)))

    def add(kind: str, *numbers: int) -> None:
        cdr_bytes.extend(bytes(-len(cdr_bytes[4:]) % struct.calcsize(kind)) + struct.pack(f"<{kind}", numbers[0]))
        for one in numbers[1:]:
            add(kind, one)

    def add_bytes(content: bytes) -> None:
        add("I", len(content))
        cdr_bytes.extend(content)

    add_bytes(b"camera\0")
    if type_name == cdr.COMPRESSED_VIDEO:
        add_bytes(coded)
        add_bytes(codec.encode() + b"\0")
    else:
        add("i", 64, 48)
        add_bytes(codec.encode() + b";yuv420p;bgr8;bgr8\0")
        add("Q", number)
        add("B", 0, 0)
        add_bytes(coded)
    return bytes(cdr_bytes)


def video_messages(
    coded: list[bytes], type_name: str = cdr.COMPRESSED_VIDEO, codec: str = "h264"
) -> list[tuple[str, str, int, bytes]]:
    """CameraInfo and coded frames of one camera."""
    messages = []
    for number, frame in enumerate(coded):
        log_time = START + number * STEP
        messages.append(("/camera/camera_info", cdr.CAMERA_INFO, log_time, info(number)))
        messages.append(("/camera/video", type_name, log_time, video_message(type_name, number, frame, codec)))
    return messages


def ros1_header(number: int, frame_id: str = "camera") -> bytes:
    """The header of a message of ROS 1."""
    stamp = struct.pack("<II", *divmod(START + number * STEP, 10**9))
    return struct.pack("<I", number) + stamp + ros1_text(frame_id)


def ros1_text(value: str | bytes) -> bytes:
    """A text or sequence of bytes of ROS 1."""
    encoded = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(encoded)) + encoded


def ros1_camera_messages(count: int, model: str = "plumb_bob") -> list[tuple[str, str, int, bytes]]:
    """The messages of `camera_messages`, of ROS 1."""
    messages = []
    for number in range(count):
        k = CAMERA.matrix.ravel()
        calibration = ros1_header(number) + struct.pack("<II", 48, 64) + ros1_text(model)
        calibration += struct.pack("<I9d9d12d", 0, *k, *np.eye(3).ravel(), *np.eye(3, 4).ravel())
        picture = ros1_header(number) + ros1_text("jpeg") + ros1_text(jpeg(number))
        log_time = START + number * STEP
        messages.append(("/camera/camera_info", "sensor_msgs/CameraInfo", log_time, calibration + bytes(25)))
        messages.append(("/camera/image/compressed", "sensor_msgs/CompressedImage", log_time, picture))
    return messages


def ros1_bytes(
    messages: list[tuple[str, str, int, bytes]], compression: str = "none", index: bool = True, a_chunk: int = 10
) -> bytes:
    """A ROS 1 bag of (topic, type, log time, data) messages, in chunks of ten."""

    def record(data: bytes, **fields: bytes) -> bytes:
        header = b"".join(ros1_text(name.encode() + b"=" + value) for name, value in fields.items())
        return ros1_text(header) + ros1_text(data)

    topics = {topic: type_name for topic, type_name, *_ in messages}
    numbers = {topic: struct.pack("<I", at) for at, topic in enumerate(topics)}
    connections = {
        topic: record(
            b"".join(ros1_text(f"{key}={value}") for key, value in (("topic", topic), ("type", type_name))),
            op=b"\7",
            conn=numbers[topic],
            topic=topic.encode(),
        )
        for topic, type_name in topics.items()
    }
    content = b""
    told: set[str] = set()
    for start in range(0, len(messages), a_chunk):
        chunk = b""
        entries: dict[str, bytes] = {}
        for topic, _, log_time, data in messages[start : start + a_chunk]:
            time = struct.pack("<II", *divmod(log_time, 10**9))
            chunk += b"" if topic in told else connections[topic]
            told.add(topic)
            entries[topic] = entries.get(topic, b"") + time + struct.pack("<I", len(chunk))
            chunk += record(data, op=b"\2", conn=numbers[topic], time=time)
        packed = {"none": bytes, "bz2": bz2.compress, "lz4": lz4.frame.compress}[compression](chunk)
        size = struct.pack("<I", len(chunk))
        content += record(packed, op=b"\5", compression=compression.encode(), size=size)
        if index:
            for topic, times in entries.items():
                count = struct.pack("<I", len(times) // 12)
                content += record(times, op=b"\4", ver=struct.pack("<I", 1), conn=numbers[topic], count=count)
    end = b"".join(connections.values()) if index else b""
    head = record(b" " * 4000, op=b"\3", index_pos=bytes(8), conn_count=bytes(4), chunk_count=bytes(4))
    return b"#ROSBAG V2.0\n" + head + content + end


def write_bag(path: Path, messages: list[tuple[str, str, int, bytes]] | None = None) -> Path:
    """A recording of eight frames, or of the messages given."""
    path.write_bytes(mcap_bytes(camera_messages(8) if messages is None else messages))
    return path
