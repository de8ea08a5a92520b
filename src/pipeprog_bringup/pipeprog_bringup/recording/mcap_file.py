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

from pipeprog_bringup.recording.inflation import COMPRESSIONS, ZSTD_MAGIC, Allowance, inflate, zstd_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CHANNELS, MAX_CHUNK, MAX_DESCRIPTION, MAX_NAME, MAX_WAITING

MAGIC = b"\x89MCAP0\r\n"
_HEAD = 9  # bytes before a record's content: opcode, length
_MESSAGE_HEAD = 22  # bytes before a message's data: channel, sequence, log time, publish time
_OBJECT = 256  # bytes that a waiting message takes beside its data
_NOTES = 5  # damaged chunks that are told one by one


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


@dataclass(slots=True)
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
    damaged: dict[int, str]  # offset of a chunk or message -> why nothing or not all of it was read
    _size: int
    _blocks: list[_Block]
    _schemas: dict[int, str]

    @classmethod
    def open(cls, path: Path) -> McapFile:
        """Walk the records of `path`; raises InputError where it is none, or claims more than it can hold."""
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
            file = cls(path, {}, Counter(), None, {}, size, [], {})
            claimed = Allowance(path, size)
            file._walk(stream, claimed)
            for block in file._blocks:
                claimed.take_bytes(block.uncompressed_size)
            allowance = Allowance(path, size)
            for block in file._blocks:
                if block.in_chunk and (not block.counts or not set(block.counts) <= set(file.channels)):
                    block.counts = Counter(message[1] for message in file._read(stream, block, allowance))
        for block in file._blocks:
            file.counts.update(block.counts)
        file._blocks.sort(key=lambda block: (block.start, block.offset))
        return file

    @property
    def message_count(self) -> int:
        """Messages of all channels that can be read."""
        return sum(self.counts.values())

    def messages(self, channel_ids: set[int]) -> Iterator[Message]:
        """The messages of these channels in the order of their log times; holds one chunk and its overlap in memory.

        Raises InputError where chunks overlap in time by more than is held, or inflate to more than a file can hold.
        """
        allowance = Allowance(self.path, self._size)
        waiting: list[tuple[int, int, int, int, bytes]] = []
        held = 0

        def earliest() -> Message:
            nonlocal held
            log_time, _, _, channel_id, data = heapq.heappop(waiting)
            held -= _OBJECT + len(data)
            return Message(log_time, channel_id, _plain(data, allowance))

        with self.path.open("rb") as stream:
            for block in self._blocks:
                if not channel_ids & set(block.counts):
                    continue
                while waiting and waiting[0][0] < block.start:
                    yield earliest()
                for number, (log_time, channel_id, data) in enumerate(self._read(stream, block, allowance)):
                    if channel_id not in channel_ids:
                        continue
                    heapq.heappush(waiting, (log_time, block.offset, number, channel_id, bytes(data)))
                    held += _OBJECT + len(data)
                    if held > MAX_WAITING:
                        raise InputError(
                            f"{self.path}: up to byte {block.offset}, {held >> 20} MB of messages belong to one time: "
                            "sort the recording with `mcap sort`"
                        )
            while waiting:
                yield earliest()

    def losses(self) -> list[str]:
        """The parts that cannot be read, one sentence each; a damaged chunk is known once its messages were read."""
        notes = []
        if self.torn_at is not None:
            notes.append(
                f"{self.path} is torn: read {self.message_count} messages, lost the rest after byte {self.torn_at}; "
                f"`mcap recover {self.path.name} -o mended.mcap` writes a file with what is left"
            )
        notes += [f"{self.path} is damaged: {self.damaged[at]}" for at in sorted(self.damaged)[:_NOTES]]
        if len(self.damaged) > _NOTES:
            notes.append(f"{self.path} is damaged at {len(self.damaged) - _NOTES} more places")
        unknown = sum(count for channel_id, count in self.counts.items() if channel_id not in self.channels)
        if unknown:
            notes.append(f"{self.path} is damaged: {unknown} messages are on channels that it does not describe")
        return notes

    def _walk(self, stream: BinaryIO, claimed: Allowance) -> None:
        """Find blocks and channels up to the footer, or up to the tear."""
        position, data_section = len(MAGIC), True
        summary: list[tuple[int, int, int]] = []
        while True:
            stream.seek(position)
            head = stream.read(_HEAD)
            opcode, length = struct.unpack("<BQ", head) if len(head) == _HEAD else (0, 0)
            end = position + _HEAD + length
            whole = len(head) == _HEAD and opcode != 0 and end <= self._size
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
            elif data_section:
                self._add_messages(stream, opcode, position, length, claimed)
            data_section = data_section and opcode != Opcode.DATA_END
            position = end

    def _add_messages(self, stream: BinaryIO, opcode: int, position: int, length: int, claimed: Allowance) -> None:
        """Note a message outside any chunk, or how many messages of a channel the last chunk has."""
        if opcode == Opcode.MESSAGE and length > MAX_CHUNK:
            self.damaged[position] = f"lost the message at byte {position}, which has {length} bytes"
        elif opcode == Opcode.MESSAGE and length >= _MESSAGE_HEAD:
            channel_id, _, log_time = struct.unpack("<HIQ", stream.read(14))
            counts = Counter({channel_id: 1})
            self._blocks.append(_Block(position, log_time, _HEAD + length, in_chunk=False, counts=counts))
        elif opcode == Opcode.MESSAGE_INDEX and self._blocks and self._blocks[-1].in_chunk and length >= 6:
            channel_id, size = struct.unpack("<HI", stream.read(6))
            if count := min(size, length - 6) // 16:  # an entry is a time and an offset of eight bytes each
                claimed.take_records(count)
                self._blocks[-1].counts[channel_id] += count

    def _drop_unwritten(self, stream: BinaryIO, torn_at: int) -> None:
        """Forget a single message before the tear whose data is all zeros: the tear may run through its log time."""
        block = self._blocks[-1] if self._blocks else None
        if block is not None and not block.in_chunk and block.offset + block.size == torn_at:
            stream.seek(block.offset + _HEAD + _MESSAGE_HEAD)
            if not any(stream.read(block.size - _HEAD - _MESSAGE_HEAD)):
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
        offset = position + _HEAD + 40 + name_length
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
                f"{self.path}: the chunk at byte {offset} is compressed with {compression!a}: "
                "use one of zstd, lz4, none"
            )
        self._blocks.append(_Block(offset, start, end - offset, compression, uncompressed_size, crc, whole))

    def _describe(self, stream: BinaryIO, opcode: int, position: int, length: int) -> None:
        """Note the schema or channel of the record at `position`."""
        if length <= MAX_DESCRIPTION:
            stream.seek(position + _HEAD)
            self._register(opcode, stream.read(length))

    def _register(self, opcode: int, data: bytes) -> None:
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
                if _is_name(channel.topic):
                    self.channels[channel.id] = Channel(channel.topic, type_name, channel.message_encoding)

    def _read(
        self, stream: BinaryIO, block: _Block, allowance: Allowance
    ) -> Iterator[tuple[int, int, bytes | memoryview]]:
        """Log time, channel and data of the messages of one block: all of them, or those before the tear."""
        stream.seek(block.offset)
        data = self._content(stream.read(block.size), block, allowance) if block.in_chunk else stream.read(block.size)
        view = memoryview(data)
        position = 0
        while position + _HEAD <= len(data):
            opcode, length = struct.unpack_from("<BQ", data, position)
            position += _HEAD
            if opcode == 0 or length > len(data) - position:
                break
            allowance.take_records(1)
            if opcode == Opcode.MESSAGE and length >= _MESSAGE_HEAD:
                channel_id, _, log_time = struct.unpack_from("<HIQ", data, position)
                yield log_time, channel_id, view[position + _MESSAGE_HEAD : position + length]
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and length <= MAX_DESCRIPTION:
                self._register(opcode, data[position : position + length])
            position += length

    def _content(self, data: bytes, block: _Block, allowance: Allowance) -> bytes:
        """The records of a chunk; of a damaged one what is certain."""
        allowance.take_bytes(block.uncompressed_size)
        content = inflate(data, block.compression, block.uncompressed_size)
        if not block.complete:
            return content
        is_short = len(content) < block.uncompressed_size
        if is_short or (block.crc and content and zlib.crc32(content) != block.crc):
            self.damaged[block.offset] = f"lost the messages of the chunk at byte {block.offset}"
            return content if is_short else b""
        return content


def _plain(data: bytes, allowance: Allowance) -> bytes:
    """Undo the compression of single messages (rosbag2's message mode); no CDR message starts like zstd."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    declared = zstd_size(data)
    if declared is not None and declared > MAX_CHUNK:
        return b""
    plain = inflate(data, "zstd", MAX_CHUNK if declared is None else declared)
    allowance.take_bytes(len(plain))
    return plain


def _is_name(text: str) -> bool:
    return len(text) <= MAX_NAME and text.isprintable()


def _other_format(magic: bytes) -> str:
    if magic.startswith(b"#ROSBAG"):
        return " but a ROS 1 bag: convert it with `mcap convert in.bag out.mcap`"
    if magic.startswith(b"SQLite"):
        return " but a rosbag2 sqlite3 file: convert it with `ros2 bag convert` (storage_id: mcap)"
    if magic.startswith(ZSTD_MAGIC):
        return " but zstd-compressed as a whole: decompress it with `zstd -d`"
    return ": give an .mcap file or a rosbag2 folder (videos go through `pipeprog ingest` first)"
