# SPDX-License-Identifier: Apache-2.0
"""The walk over the records of an mcap file: where its messages are and which channels it has.

A power loss takes the file's summary first; the walk over the record headers costs one small read per chunk and works
on every file alike (format: https://mcap.dev/spec). It is our own: mcap.stream_reader.StreamReader reads every chunk
whole to find the next record (to open a recording of 500 MB it reads 500 MB, this module 20 kB), tells no byte offsets
and believes a record's length (one that says 3 GiB reserves 3 GiB). Schemas and channels are parsed by mcap.records.
"""

from __future__ import annotations

import contextlib
import io
import struct
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from pipeprog_bringup.recording.inflation import COMPRESSIONS, Allowance
from pipeprog_bringup.recording.message_file import Channel
from pipeprog_bringup.recording.ros1_messages import ENCODING as ROS1
from pipeprog_bringup.recording.ros1_messages import ros2_type
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CHANNELS, MAX_CHUNK, MAX_DESCRIPTION, MAX_NAME

MAGIC = b"\x89MCAP0\r\n"
HEAD = 9  # bytes before a record's content: opcode, length
MESSAGE_HEAD = 22  # bytes before a message's data: channel, sequence, log time, publish time


@dataclass(slots=True)
class Block:
    """A chunk, or a single message outside any chunk; `size` bytes of its content are in the file."""

    offset: int
    start: int
    size: int
    compression: str = ""
    uncompressed_size: int = 0
    crc: int = 0
    complete: bool = True
    in_chunk: bool = True
    counts: Counter[int] = field(default_factory=Counter)


class Walk:
    """Blocks in the order of the file, channels by number, the byte of a tear, and what is lost, by its offset."""

    def __init__(self, path: Path, size: int) -> None:
        self._path, self._size = path, size
        self.channels: dict[int, Channel] = {}
        self.blocks: list[Block] = []
        self.torn_at: int | None = None
        self.damaged: dict[int, str] = {}
        self.facts: dict[str, str] = {}  # of the metadata records named pipeprog
        self._schemas: dict[int, str] = {}

    def follow(self, stream: BinaryIO, claimed: Allowance) -> None:
        """Find blocks and channels up to the footer, or up to the tear."""
        position, data_section = len(MAGIC), True
        summary: list[tuple[int, int, int]] = []
        while True:
            stream.seek(position)
            head = stream.read(HEAD)
            opcode, length = struct.unpack("<BQ", head) if len(head) == HEAD else (0, 0)
            end = position + HEAD + length
            whole = len(head) == HEAD and opcode != 0 and end <= self._size
            claimed.take_records(1)
            if opcode == Opcode.CHUNK and data_section:
                self._add_chunk(stream, position, min(end, self._size), whole)
            if not whole:
                # Zeros or noise behind the last record are a tear as well: after a power loss a file system may keep
                # the length of a file without its data.
                self.torn_at = self._size if opcode == Opcode.CHUNK else position
                self._drop_unwritten(stream, position)
                return
            if opcode == Opcode.FOOTER:
                stream.seek(end)
                if stream.read(len(MAGIC)) != MAGIC:
                    self.torn_at = end
                    return
                for record in summary:  # believed if the file ends well: a tear may run through it
                    self._describe(stream, *record)
                return
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                if data_section:
                    self._describe(stream, opcode, position, length)
                else:
                    summary.append((opcode, position, length))
            elif opcode == Opcode.METADATA and data_section and length <= MAX_DESCRIPTION:
                self._note_facts(stream.read(length))
            elif data_section:
                self._add_messages(stream, opcode, position, length, claimed)
            data_section = data_section and opcode != Opcode.DATA_END
            position = end

    def _add_messages(self, stream: BinaryIO, opcode: int, position: int, length: int, claimed: Allowance) -> None:
        """Note a message outside any chunk, or how many messages of a channel the last chunk has."""
        if opcode == Opcode.MESSAGE and length > MAX_CHUNK:
            self.damaged[position] = f"lost the message at byte {position}, which has {length} bytes"
        elif opcode == Opcode.MESSAGE and length >= MESSAGE_HEAD:
            channel_id, _, log_time = struct.unpack("<HIQ", stream.read(14))
            counts = Counter({channel_id: 1})
            self.blocks.append(Block(position, log_time, HEAD + length, in_chunk=False, counts=counts))
        elif opcode == Opcode.MESSAGE_INDEX and self.blocks and self.blocks[-1].in_chunk and length >= 6:
            channel_id, size = struct.unpack("<HI", stream.read(6))
            if count := min(size, length - 6) // 16:  # an entry is a time and an offset of eight bytes each
                claimed.take_records(count)
                self.blocks[-1].counts[channel_id] += count

    def _drop_unwritten(self, stream: BinaryIO, torn_at: int) -> None:
        """Forget a single message before the tear whose data is all zeros: the tear may run through its log time."""
        block = self.blocks[-1] if self.blocks else None
        if block is not None and not block.in_chunk and block.offset + block.size == torn_at:
            stream.seek(block.offset + HEAD + MESSAGE_HEAD)
            if not any(stream.read(block.size - HEAD - MESSAGE_HEAD)):
                self.blocks.pop()
                self.torn_at = block.offset

    def _add_chunk(self, stream: BinaryIO, position: int, end: int, whole: bool) -> None:
        head = stream.read(32)
        if len(head) < 32:
            return
        start, _, uncompressed_size, crc, name_length = struct.unpack("<QQQII", head)
        name = stream.read(name_length) if name_length < 64 else b""
        if len(name) < name_length or len(stream.read(8)) < 8:
            return
        offset = position + HEAD + 40 + name_length
        if offset > end:  # a length of zeros that never reached the disk
            return
        compression = name.decode("ascii", "replace")
        if max(uncompressed_size, end - offset) > MAX_CHUNK:
            self.damaged[offset] = (
                f"lost the chunk at byte {offset}, which declares {uncompressed_size / 1e6:.0f} MB, "
                f"{(end - offset) / 1e6:.0f} MB in the file: {MAX_CHUNK / 1e6:.0f} MB at most are read; "
                "`mcap compress` writes smaller chunks"
            )
            return
        if compression not in COMPRESSIONS:
            raise InputError(
                f"{self._path}: the chunk at byte {offset} is compressed with {compression!a}: "
                "use one of zstd, lz4, none"
            )
        self.blocks.append(Block(offset, start, end - offset, compression, uncompressed_size, crc, whole))

    def _note_facts(self, data: bytes) -> None:
        with contextlib.suppress(McapError, struct.error, UnicodeDecodeError):
            record = records.Metadata.read(ReadDataStream(io.BytesIO(data)))
            if record.name == "pipeprog":
                self.facts |= record.metadata

    def _describe(self, stream: BinaryIO, opcode: int, position: int, length: int) -> None:
        """Note the schema or channel of the record at `position`."""
        if length <= MAX_DESCRIPTION:
            stream.seek(position + HEAD)
            self.register(opcode, stream.read(length))

    def register(self, opcode: int, data: bytes) -> None:
        """Note a schema or a channel; the first of its number counts, since a tear damages the summary first."""
        known: dict[int, Any] = self._schemas if opcode == Opcode.SCHEMA else self.channels
        number = int.from_bytes(data[:2], "little")
        if number in known or len(known) >= MAX_CHANNELS:
            return
        stream = ReadDataStream(io.BytesIO(data))
        with contextlib.suppress(McapError, struct.error, UnicodeDecodeError):
            if opcode == Opcode.SCHEMA:
                schema = records.Schema.read(stream)
                if _is_name(schema.name):
                    self._schemas[schema.id] = schema.name
            else:
                channel = records.Channel.read(stream)
                type_name = self._schemas.get(channel.schema_id, "")
                if channel.message_encoding == ROS1:
                    type_name = ros2_type(type_name)
                if _is_name(channel.topic):
                    self.channels[channel.id] = Channel(channel.topic, type_name, channel.message_encoding)


def _is_name(text: str) -> bool:
    return len(text) <= MAX_NAME and text.isprintable()
