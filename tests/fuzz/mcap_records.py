# SPDX-License-Identifier: Apache-2.0
"""mcap files record by record, so that any of their numbers can lie (format: https://mcap.dev/spec)."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.opcode import Opcode

from tests.unit.bringup.recordings import START, STEP, image, info

MAGIC = b"\x89MCAP0\r\n"
IMAGE_TYPE, INFO_TYPE = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
IMAGE_TOPIC, INFO_TOPIC = "/camera/image/compressed", "/camera/camera_info"
INFO, IMAGE = 1, 2  # channels


def text(value: str | bytes) -> bytes:
    """A text with its length before it."""
    encoded = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(encoded)) + encoded


def record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    """A record that says it is as long as it is, or `length`."""
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


def schema(number: int, name: str | bytes, definition: bytes = b"", encoding: str = "ros2msg") -> bytes:
    """A schema record."""
    content = struct.pack("<H", number) + text(name) + text(encoding) + text(definition)
    return record(Opcode.SCHEMA, content)


def channel(number: int, schema_number: int, topic: str | bytes, encoding: str = "cdr", metadata: bytes = b"") -> bytes:
    """A channel record."""
    content = struct.pack("<HH", number, schema_number) + text(topic) + text(encoding) + text(metadata)
    return record(Opcode.CHANNEL, content)


def message(number: int, log_time: int, data: bytes) -> bytes:
    """A message record."""
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", number, 0, log_time, log_time) + data)


def index(number: int, entries: Sequence[tuple[int, int]], size: int | None = None) -> bytes:
    """A message index record; `size` is what it says that its entries take."""
    content = b"".join(struct.pack("<QQ", *entry) for entry in entries)
    return record(Opcode.MESSAGE_INDEX, struct.pack("<HI", number, len(content) if size is None else size) + content)


def chunk(content: bytes, compression: str = "zstd", **lies: Any) -> bytes:
    """A chunk of records; `lies` replace its start, end, size, crc, name, stored (bytes), length (of stored)."""
    compress = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}.get(compression, bytes)
    stored = lies.get("stored")
    stored = compress(content) if stored is None else stored
    head = struct.pack(
        "<QQQI",
        lies.get("start", START),
        lies.get("end", START + 8 * STEP),
        lies.get("size", len(content)),
        lies.get("crc", zlib.crc32(content)),
    )
    length = struct.pack("<Q", lies.get("length", len(stored)))
    return record(Opcode.CHUNK, head + text(lies.get("name", compression)) + length + stored)


def topics() -> bytes:
    """Schemas and channels of one camera."""
    return schema(1, INFO_TYPE) + channel(INFO, 1, INFO_TOPIC) + schema(2, IMAGE_TYPE) + channel(IMAGE, 2, IMAGE_TOPIC)


def camera_records(images: Mapping[int, bytes] | None = None, infos: Mapping[int, bytes] | None = None) -> list[bytes]:
    """CameraInfo and image of eight frames; those that are given stand in place of good ones."""
    records = []
    for number in range(8):
        records.append(message(INFO, START + number * STEP, (infos or {}).get(number, info(number))))
        records.append(message(IMAGE, START + number * STEP, (images or {}).get(number, image(number))))
    return records


def end(summary: bytes = b"", footer: tuple[int, int, int] = (0, 0, 0), data_end: bool = True) -> bytes:
    """The end of a file: data end, summary, footer, magic."""
    closed = record(Opcode.DATA_END, bytes(4)) if data_end else b""
    return closed + summary + record(Opcode.FOOTER, struct.pack("<QQI", *footer)) + MAGIC


def file(*parts: bytes, tail: bytes | None = None) -> bytes:
    """A whole file around its data section."""
    return (
        MAGIC + record(Opcode.HEADER, text("ros2") + text("test")) + b"".join(parts) + (end() if tail is None else tail)
    )


def good(*before: bytes, compression: str = "zstd") -> bytes:
    """A file of eight good frames in one chunk, after the records `before`."""
    return file(*before, topics(), chunk(b"".join(camera_records()), compression))
