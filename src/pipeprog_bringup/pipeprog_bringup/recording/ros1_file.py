# SPDX-License-Identifier: Apache-2.0
"""One .bag file of ROS 1 (format 2.0), those of RealSense's SDK among them; a torn or damaged one gives what it holds.

It is our own: rosbags.rosbag1.Reader gives nothing of a file without an index, which is what a crash leaves, and
inflates a chunk to whatever size it has. Format: wiki.ros.org/Bags/Format/2.0. A record is a header of fields
`name=value`, each with its length before it, and data.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.recording.inflation import Allowance, inflate
from pipeprog_bringup.recording.message_file import Channel, Message
from pipeprog_bringup.recording.ros1_messages import ENCODING, ros2_type
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CHANNELS, MAX_CHUNK, MAX_DESCRIPTION, MAX_NAME

MAGIC = b"#ROSBAG V"
_VERSION = b"#ROSBAG V2.0\n"
_MESSAGE, _INDEX, _CHUNK, _CONNECTION = 2, 4, 5, 7  # kinds of records
_COMPRESSIONS = {b"none": "", b"bz2": "bz2", b"lz4": "lz4"}
_MAX_HEADER = 1 << 16  # bytes; a topic's name and some numbers
_SECOND = 1_000_000_000  # ns
_KEPT = 4  # chunks that are kept inflated: those that overlap in time


@dataclass(frozen=True)
class _Chunk:
    """Where a chunk's content is in the file, and how long it is inflated."""

    offset: int
    size: int
    compression: str
    inflated: int


@dataclass
class Ros1File:
    """Channels, message counts and losses of one file, and its messages; open it with `Ros1File.open`."""

    path: Path
    channels: dict[int, Channel]
    counts: Counter[int]
    _size: int
    _chunks: list[_Chunk]
    _rows: NDArray[np.int64]  # (N, 4): time [ns], chunk, offset of the record in it, channel; in the order of time
    _torn_at: int | None
    _unreadable: set[tuple[int, int]] = field(default_factory=set)  # chunk and offset of records that were asked for

    @classmethod
    def open(cls, path: Path) -> Ros1File:
        """List the messages of `path`; raises InputError where it is no recording, or claims more than it can hold."""
        size = path.stat().st_size
        with path.open("rb") as stream:
            if stream.read(len(_VERSION)) != _VERSION:
                raise InputError(f"{path} is a ROS 1 bag of another format than 2.0: run `rosbag fix` on it")
            walk = _Walk(path, size)
            walk.follow(stream)
        rows: NDArray[np.int64] = np.array(walk.rows, np.int64).reshape(-1, 4)
        rows = rows[np.isin(rows[:, 3], list(walk.channels))]
        rows = rows[np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0]))]
        counts = Counter(rows[:, 3].tolist())
        return cls(path, walk.channels, counts, size, walk.chunks, rows, walk.torn_at)

    def messages(self, channel_ids: set[int]) -> Iterator[Message]:
        """The messages of these channels in the order of their log times; holds a few chunks in memory.

        Raises InputError where they inflate to more than a file can hold.
        """
        allowance = Allowance(self.path, self._size)
        wanted = self._rows[np.isin(self._rows[:, 3], list(channel_ids))]
        kept: dict[int, bytes] = {}
        with self.path.open("rb") as stream:
            for log_time, number, offset, channel_id in wanted.tolist():
                if number not in kept:
                    if len(kept) == _KEPT:
                        kept.pop(next(iter(kept)))
                    kept[number] = _content(stream, self._chunks[number], allowance)
                record = _record(kept[number], offset)
                if record is None or not record.is_message_of(channel_id):
                    self._unreadable.add((number, offset))
                    continue
                yield Message(log_time, channel_id, record.data)

    def losses(self) -> list[str]:
        """The parts that cannot be read, one sentence each; messages with damaged data once they were read."""
        notes = []
        if self._torn_at is not None:
            notes.append(
                f"{self.path} is torn: read {self.counts.total()} messages, lost the rest after byte {self._torn_at}"
            )
        if self._unreadable:
            notes.append(f"{self.path} is damaged: {len(self._unreadable)} messages cannot be read")
        return notes


class _Walk:
    """Chunks, channels and messages in the order of the file; the messages by the index, where a chunk has one."""

    def __init__(self, path: Path, size: int) -> None:
        self._path, self._size = path, size
        self._allowance = Allowance(path, size)
        self.channels: dict[int, Channel] = {}
        self.chunks: list[_Chunk] = []
        self.rows = array("q")
        self.torn_at: int | None = None
        self._is_listed = True  # the last chunk

    def follow(self, stream: BinaryIO) -> None:
        """Read all records, and the content of chunks that have no index or channels that nothing else describes."""
        position = len(_VERSION)
        while position < self._size:
            head = _head(stream, position)
            if head is None or head.start + head.length > self._size:
                self.torn_at = position
                if head is not None and head.kind == _CHUNK:
                    self._begin_chunk(stream, head, self._size - head.start)
                break
            self._allowance.take_records(1)
            if head.kind == _CHUNK:
                self._begin_chunk(stream, head, head.length)
            elif head.kind == _INDEX and self.chunks:
                self._add_index(stream, head)
            elif head.kind == _CONNECTION and head.length <= MAX_DESCRIPTION:
                stream.seek(head.start)
                self._connect(head.fields, stream.read(head.length))
            position = head.start + head.length
        self._list_chunk(stream)
        rows = np.array(self.rows, np.int64).reshape(-1, 4)
        for number in np.unique(rows[~np.isin(rows[:, 3], list(self.channels)), 1]).tolist():
            for record, _ in self._records(stream, self.chunks[number]):
                if record.kind == _CONNECTION:
                    self._connect(record.fields, record.data)

    def _begin_chunk(self, stream: BinaryIO, head: _Head, size: int) -> None:
        self._list_chunk(stream)
        name, inflated = head.fields.get(b"compression", b""), head.number(b"size")
        if name not in _COMPRESSIONS:
            raise InputError(
                f"{self._path}: the chunk at byte {head.start} is compressed with {name[:20]!a}: use one of bz2, lz4"
            )
        if max(inflated, size) > MAX_CHUNK:
            raise InputError(
                f"{self._path}: the chunk at byte {head.start} declares {inflated / 1e6:.0f} MB: "
                f"{MAX_CHUNK / 1e6:.0f} MB at most are read; record it again"
            )
        self.chunks.append(_Chunk(head.start, size, _COMPRESSIONS[name], inflated))
        self._is_listed = False

    def _add_index(self, stream: BinaryIO, head: _Head) -> None:
        """Times and offsets of the messages of one channel in the last chunk."""
        count = head.length // 12
        self._allowance.take_records(count)
        stream.seek(head.start)
        entries = np.frombuffer(stream.read(12 * count), "<u4").reshape(-1, 3).astype(np.int64)
        rows = np.empty((count, 4), np.int64)
        rows[:, 0] = entries[:, 0] * _SECOND + entries[:, 1]
        rows[:, 1], rows[:, 2], rows[:, 3] = len(self.chunks) - 1, entries[:, 2], head.number(b"conn")
        self.rows.frombytes(rows.tobytes())
        self._is_listed = True

    def _list_chunk(self, stream: BinaryIO) -> None:
        """List the messages of the last chunk where the file has no index of it."""
        if self._is_listed:
            return
        self._is_listed = True
        for record, offset in self._records(stream, self.chunks[-1]):
            if record.kind == _CONNECTION:
                self._connect(record.fields, record.data)
            elif record.kind == _MESSAGE:
                time = record.number(b"time") * _SECOND + record.number(b"time", 4)
                self.rows.extend((time, len(self.chunks) - 1, offset, record.number(b"conn")))

    def _records(self, stream: BinaryIO, chunk: _Chunk) -> Iterator[tuple[_Record, int]]:
        """The records of a chunk and their offsets in it."""
        content = _content(stream, chunk, self._allowance)
        offset = 0
        while (record := _record(content, offset)) is not None:
            self._allowance.take_records(1)
            yield record, offset
            offset = record.end

    def _connect(self, fields: dict[bytes, bytes], data: bytes) -> None:
        """Note a channel; the first of its number counts."""
        number = int.from_bytes(fields.get(b"conn", b"")[:4], "little")
        topic, kind = (
            value.decode("utf-8", "replace") for value in (fields.get(b"topic", b""), _fields(data).get(b"type", b""))
        )
        if number in self.channels or len(self.channels) >= MAX_CHANNELS:
            return
        if all(0 < len(name) <= MAX_NAME and name.isprintable() for name in (topic, kind)):
            self.channels[number] = Channel(topic, ros2_type(kind), ENCODING)


@dataclass(frozen=True)
class _Head:
    """A record's header; its data are `length` bytes from `start` on."""

    fields: dict[bytes, bytes]
    start: int
    length: int

    @property
    def kind(self) -> int:
        """Which kind of record it is."""
        return self.number(b"op")

    def number(self, name: bytes, at: int = 0) -> int:
        """The number of up to 32 bits in a field; 0 where it is missing."""
        return int.from_bytes(self.fields.get(name, b"")[at : at + 4], "little")


@dataclass(frozen=True)
class _Record(_Head):
    """A record within a chunk, with its data."""

    data: bytes

    @property
    def end(self) -> int:
        """Where in the chunk the next one begins."""
        return self.start + self.length

    def is_message_of(self, channel_id: int) -> bool:
        """Whether it is what the index says that it is."""
        return self.kind == _MESSAGE and self.number(b"conn") == channel_id


def _head(stream: BinaryIO, position: int) -> _Head | None:
    """The header of the record at `position`; None where the file ends in it or it is none."""
    stream.seek(position)
    size = int.from_bytes(stream.read(4), "little")
    if not 0 < size <= _MAX_HEADER:
        return None
    header = stream.read(size + 4)
    if len(header) < size + 4:
        return None
    fields = _fields(header[:size])
    return _Head(fields, position + size + 8, int.from_bytes(header[size:], "little")) if b"op" in fields else None


def _record(content: bytes, offset: int) -> _Record | None:
    """The whole record at `offset` of a chunk; None where there is none."""
    size = int.from_bytes(content[offset : offset + 4], "little")
    start = offset + size + 8
    if not 0 < size <= _MAX_HEADER or start > len(content):
        return None
    length = int.from_bytes(content[start - 4 : start], "little")
    fields = _fields(content[offset + 4 : start - 4])
    if start + length > len(content) or b"op" not in fields:
        return None
    return _Record(fields, start, length, content[start : start + length])


def _fields(data: bytes) -> dict[bytes, bytes]:
    """The fields of a header, up to the first that is none."""
    fields = {}
    position = 0
    while position + 4 <= len(data):
        size = int.from_bytes(data[position : position + 4], "little")
        name, equals, value = data[position + 4 : position + 4 + size].partition(b"=")
        if not equals or len(name) + 1 + len(value) < size:
            break
        fields[name] = value
        position += 4 + size
    return fields


def _content(stream: BinaryIO, chunk: _Chunk, allowance: Allowance) -> bytes:
    """The records of a chunk; of a damaged one those before the damage."""
    stream.seek(chunk.offset)
    data = stream.read(chunk.size)
    allowance.take_bytes(chunk.inflated)
    return inflate(data, chunk.compression, chunk.inflated)
