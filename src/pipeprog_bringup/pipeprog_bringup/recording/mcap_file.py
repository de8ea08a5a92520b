# SPDX-License-Identifier: Apache-2.0
"""One mcap file, of which a torn or damaged one gives all it still holds: its messages in the order of their times.

Chunks are read here and not by mcap.stream_reader.StreamReader, which gives nothing of a chunk that is cut off.
"""

from __future__ import annotations

import heapq
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode

from pipeprog_bringup.recording.inflation import ZSTD_MAGIC, Allowance, inflate, plain_message
from pipeprog_bringup.recording.mcap_walk import HEAD, MAGIC, MESSAGE_HEAD, Block, Walk
from pipeprog_bringup.recording.message_file import Channel, Message
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_DESCRIPTION, MAX_WAITING

_OBJECT = 256  # bytes that a waiting message takes beside its data
_NOTES = 5  # damaged chunks that are told one by one


@dataclass
class McapFile:
    """Channels, message counts and losses of one file, and its messages; open it with `McapFile.open`."""

    path: Path
    channels: dict[int, Channel]
    counts: Counter[int]
    torn_at: int | None
    damaged: dict[int, str]  # offset of a chunk or message -> why nothing or not all of it was read
    _size: int
    _blocks: list[Block]
    _walk: Walk

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
            claimed, walk = Allowance(path, size), Walk(path, size)
            walk.follow(stream, claimed)
            for block in walk.blocks:
                claimed.take_bytes(block.uncompressed_size)
            file = cls(path, walk.channels, Counter(), walk.torn_at, walk.damaged, size, walk.blocks, walk)
            allowance = Allowance(path, size)
            for block in file._blocks:
                if block.in_chunk and (not block.counts or not set(block.counts) <= set(file.channels)):
                    block.counts = Counter(message[1] for message in file._read(stream, block, allowance))
        for block in file._blocks:
            file.counts.update(block.counts)
        file._blocks.sort(key=lambda block: (block.start, block.offset))
        return file

    @property
    def facts(self) -> dict[str, str]:
        """What `BagWriter.describe` has noted."""
        return self._walk.facts

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
            return Message(log_time, channel_id, plain_message(data, allowance))

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

    def _read(
        self, stream: BinaryIO, block: Block, allowance: Allowance
    ) -> Iterator[tuple[int, int, bytes | memoryview]]:
        """Log time, channel and data of the messages of one block: all of them, or those before the tear."""
        stream.seek(block.offset)
        data = self._content(stream.read(block.size), block, allowance) if block.in_chunk else stream.read(block.size)
        view = memoryview(data)
        position = 0
        while position + HEAD <= len(data):
            opcode, length = struct.unpack_from("<BQ", data, position)
            position += HEAD
            if opcode == 0 or length > len(data) - position:
                break
            allowance.take_records(1)
            if opcode == Opcode.MESSAGE and length >= MESSAGE_HEAD:
                channel_id, _, log_time = struct.unpack_from("<HIQ", data, position)
                yield log_time, channel_id, view[position + MESSAGE_HEAD : position + length]
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and length <= MAX_DESCRIPTION:
                self._walk.register(opcode, data[position : position + length])
            position += length

    def _content(self, data: bytes, block: Block, allowance: Allowance) -> bytes:
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


def _other_format(magic: bytes) -> str:
    if magic.startswith(ZSTD_MAGIC):
        return " but zstd-compressed as a whole: decompress it with `zstd -d`"
    return ": give an .mcap, .db3 or .bag file or a rosbag2 folder (videos go through `pipeprog ingest` first)"
