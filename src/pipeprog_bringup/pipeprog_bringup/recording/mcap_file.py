# SPDX-License-Identifier: Apache-2.0
"""One mcap file, read record by record, so that a torn or damaged one gives all it still holds.

A power loss takes the file's summary first; the walk over the record headers costs one small read per chunk and works
on every file alike (format: https://mcap.dev/spec). The walk and the reading of chunks are our own:
mcap.stream_reader.StreamReader reads every chunk whole to find the next record (to open a recording of 500 MB it reads
500 MB, this module 20 kB), tells no byte offsets, gives nothing of a chunk that is cut off, and believes a record's
length (one that says 3 GiB reserves 3 GiB). Schemas and channels are parsed by mcap.records.
"""

from __future__ import annotations

import contextlib
import heapq
import io
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from pipeprog_camera.errors import InputError

MAGIC = b"\x89MCAP0\r\n"
_PIECE = 1 << 16  # bytes given to a decompressor at a time: of a damaged stream what lies before the fault is kept
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True)
class Channel:
    """A topic of the file: its message type and how its messages are encoded."""

    topic: str
    type_name: str
    encoding: str


@dataclass(frozen=True)
class Message:
    """One message: log time [ns], channel number in its file, serialised data."""

    log_time: int
    channel_id: int
    data: bytes


@dataclass
class _Block:
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


@dataclass
class McapFile:
    """Channels, message counts and losses of one file, and its messages; open it with `McapFile.open`."""

    path: Path
    channels: dict[int, Channel]
    counts: Counter[int]
    torn_at: int | None
    damaged: set[int]
    _blocks: list[_Block]
    _schemas: dict[int, str]

    @classmethod
    def open(cls, path: Path) -> McapFile:
        """Walk the records of `path`; raises InputError where it is no mcap file at all."""
        size = path.stat().st_size
        if size == 0:
            raise InputError(f"{path} is empty (0 bytes): record or copy it again")
        with path.open("rb") as stream:
            magic = stream.read(len(MAGIC))
            if magic != MAGIC[: len(magic)]:
                hint = _other_format(magic)
                raise InputError(f"{path} is not an mcap file{hint}")
            if len(magic) < len(MAGIC):
                raise InputError(
                    f"{path} is cut off after {size} bytes, before its first message: record or copy it again"
                )
            file = cls(path, {}, Counter(), None, set(), [], {})
            file._walk(stream, size)
            for block in file._blocks:
                if block.in_chunk and (not block.counts or not set(block.counts) <= set(file.channels)):
                    block.counts = Counter(message.channel_id for message in file._read(stream, block))
        for block in file._blocks:
            file.counts.update(block.counts)
        return file

    @property
    def message_count(self) -> int:
        """Messages of all channels that can be read."""
        return sum(self.counts.values())

    def messages(self, channel_ids: set[int]) -> Iterator[Message]:
        """The messages of these channels in the order of their log times; holds one chunk and its overlap in memory."""
        waiting: list[tuple[int, int, int, Message]] = []
        with self.path.open("rb") as stream:
            for block in sorted(self._blocks, key=lambda block: (block.start, block.offset)):
                if not channel_ids & set(block.counts):
                    continue
                while waiting and waiting[0][0] < block.start:
                    yield heapq.heappop(waiting)[3]
                for number, message in enumerate(self._read(stream, block)):
                    if message.channel_id in channel_ids:
                        heapq.heappush(waiting, (message.log_time, block.offset, number, message))
            while waiting:
                yield heapq.heappop(waiting)[3]

    def losses(self) -> list[str]:
        """The parts that cannot be read, one sentence each; a damaged chunk is known once its messages were read."""
        notes = []
        if self.torn_at is not None:
            notes.append(
                f"{self.path} is torn: read {self.message_count} messages, lost the rest after byte {self.torn_at}; "
                f"`mcap recover {self.path.name} -o mended.mcap` writes a file with what is left"
            )
        notes += [f"{self.path} is damaged: lost the messages of the chunk at byte {at}" for at in sorted(self.damaged)]
        return notes

    def _walk(self, stream: BinaryIO, size: int) -> None:
        """Find blocks and channels up to the footer, or up to the tear."""
        position, data_section = len(MAGIC), True
        summary: list[tuple[int, bytes]] = []
        while True:
            stream.seek(position)
            head = stream.read(9)
            opcode, length = struct.unpack("<BQ", head) if len(head) == 9 else (0, 0)
            end = position + 9 + length
            whole = len(head) == 9 and opcode != 0 and end <= size
            if opcode == Opcode.CHUNK and data_section:
                self._add_chunk(stream, position, min(end, size), whole)
            if not whole:
                # Zeros or noise behind the last record are a tear as well: after a power loss a file system may keep
                # the length of a file without its data.
                self.torn_at = size if opcode == Opcode.CHUNK else position
                self._drop_unwritten(stream, position)
                return
            if opcode == Opcode.FOOTER:
                stream.seek(end)
                if stream.read(len(MAGIC)) != MAGIC:
                    self.torn_at = end
                    return
                for record in summary:
                    self._register(*record)
                return
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and data_section:
                self._register(opcode, stream.read(length))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):  # believed if the file ends well: a tear may run through it
                summary.append((opcode, stream.read(length)))
            elif opcode == Opcode.MESSAGE and data_section and length >= 22:
                channel_id, _, log_time = struct.unpack("<HIQ", stream.read(14))
                counts = Counter({channel_id: 1})
                self._blocks.append(_Block(position, log_time, 9 + length, in_chunk=False, counts=counts))
            elif opcode == Opcode.MESSAGE_INDEX and data_section and self._blocks and length >= 6:
                channel_id, entries = struct.unpack("<HI", stream.read(6))
                if entries:
                    self._blocks[-1].counts[channel_id] += entries // 16
            elif opcode == Opcode.DATA_END:
                data_section = False
            position = end

    def _drop_unwritten(self, stream: BinaryIO, torn_at: int) -> None:
        """Forget a single message before the tear whose data is all zeros: the tear may run through its log time."""
        block = self._blocks[-1] if self._blocks else None
        if block is not None and not block.in_chunk and block.offset + block.size == torn_at:
            stream.seek(block.offset + 9 + 22)
            if not any(stream.read(block.size - 9 - 22)):
                self._blocks.pop()
                self.torn_at = block.offset

    def _add_chunk(self, stream: BinaryIO, position: int, end: int, whole: bool) -> None:
        head = stream.read(32)
        if len(head) < 32:
            return
        start, _, uncompressed_size, crc, name_length = struct.unpack("<QQQII", head)
        name = stream.read(name_length) if name_length < 64 else b""
        if len(name) < name_length or len(stream.read(8)) < 8:
            return
        offset = position + 9 + 40 + name_length
        if offset > end:  # a length of zeros that never reached the disk
            return
        self._blocks.append(
            _Block(offset, start, end - offset, name.decode("ascii", "replace"), uncompressed_size, crc, whole)
        )

    def _register(self, opcode: int, data: bytes) -> None:
        """Note a schema or a channel; the first of its number counts, since a tear damages the summary first."""
        stream = ReadDataStream(io.BytesIO(data))
        with contextlib.suppress(McapError, struct.error, UnicodeDecodeError):
            if opcode == Opcode.SCHEMA:
                schema = records.Schema.read(stream)
                self._schemas.setdefault(schema.id, schema.name)
            else:
                channel = records.Channel.read(stream)
                type_name = self._schemas.get(channel.schema_id, "")
                self.channels.setdefault(channel.id, Channel(channel.topic, type_name, channel.message_encoding))

    def _read(self, stream: BinaryIO, block: _Block) -> list[Message]:
        """The messages of one block: all of them, or those before the tear."""
        stream.seek(block.offset)
        data = stream.read(block.size)
        if block.in_chunk:
            data = _inflate(data, block.compression)
            if block.complete and (
                len(data) < block.uncompressed_size or (block.crc and len(data) and zlib.crc32(data) != block.crc)
            ):
                self.damaged.add(block.offset)
                data = data if len(data) < block.uncompressed_size else b""
        messages = []
        position = 0
        while position + 9 <= len(data):
            opcode, length = struct.unpack_from("<BQ", data, position)
            record = data[position + 9 : position + 9 + length]
            if opcode == 0 or len(record) < length:
                break
            if opcode == Opcode.MESSAGE and length >= 22:
                channel_id, _, log_time = struct.unpack_from("<HIQ", record)
                messages.append(Message(log_time, channel_id, _plain(record[22:])))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._register(opcode, record)
            position += 9 + length
        return messages


def _inflate(data: bytes, compression: str) -> bytes:
    """Decompress as much as decodes: a torn or damaged stream gives what lies before the fault."""
    if not compression:
        return data
    decompressor: Any
    if compression == "zstd":
        import zstandard

        decompressor = zstandard.ZstdDecompressor().decompressobj()
    elif compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        decompressor = lz4.frame.LZ4FrameDecompressor()
    else:
        raise InputError(f"chunks are compressed with '{compression}': use one of zstd, lz4, none")
    pieces = []
    # The fault's type differs from library to library (zstandard.ZstdError, RuntimeError, EOFError); all derive from
    # Exception alone, and each means that the rest of the stream cannot be decoded.
    with contextlib.suppress(Exception):
        for start in range(0, len(data), _PIECE):
            pieces.append(decompressor.decompress(data[start : start + _PIECE]))
    return b"".join(pieces)


def _plain(data: bytes) -> bytes:
    """Undo the compression of single messages (rosbag2's message mode); no CDR message starts like zstd."""
    return _inflate(data, "zstd") if data.startswith(_ZSTD_MAGIC) else data


def _other_format(magic: bytes) -> str:
    if magic.startswith(b"#ROSBAG"):
        return " but a ROS 1 bag: convert it with `mcap convert in.bag out.mcap`"
    if magic.startswith(b"SQLite"):
        return " but a rosbag2 sqlite3 file: convert it with `ros2 bag convert` (storage_id: mcap)"
    if magic.startswith(_ZSTD_MAGIC):
        return " but zstd-compressed as a whole: decompress it with `zstd -d`"
    return ": give an .mcap file or a rosbag2 folder (videos go through `pipeprog ingest` first)"
