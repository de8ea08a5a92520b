# SPDX-License-Identifier: Apache-2.0
"""Small recordings made for the tests."""

from __future__ import annotations

import io
import sqlite3
import tempfile
from pathlib import Path

import cv2
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


def write_bag(path: Path, messages: list[tuple[str, str, int, bytes]] | None = None) -> Path:
    """A recording of eight frames, or of the messages given."""
    path.write_bytes(mcap_bytes(camera_messages(8) if messages is None else messages))
    return path
