# SPDX-License-Identifier: Apache-2.0
"""The program that decompresses a LAZ file for `laz.py`, in a process of its own.

Sizes are compared with the file before lazrs, which believes them, allocates what they say.

Writes pieces to stdout: 8 bytes with a length, and as many bytes of decoded points. A length of 0 is the end, a
negative one that of a text that says why the file cannot be read.
"""

from __future__ import annotations

import signal
import struct
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CLOUD_CHUNKS, MAX_CLOUD_RECORDS

LENGTH = struct.Struct("<q")  # before each piece
_PIECE = 1 << 25  # bytes of decoded points, a million: two looks a second at whether Ctrl-C was pressed
_OWN_SIZES = 2**32 - 1  # the size of the chunks where each has its own

Chunk = tuple[int, int]  # points, and bytes in the file


@dataclass(frozen=True)
class Packed:
    """The points of a LAZ file, as its header declares them."""

    path: str
    points: int
    record: int  # bytes of a point, decoded
    start: int  # first byte of the points
    description: bytes  # of the compression: the record "laszip encoded" of the file
    layers: int  # streams into which a chunk is compressed, 0 where it is one


def main(packed: Packed) -> None:
    """Writes the points to stdout, or why they cannot be read."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the reader gets it, too, and ends this process
    out = sys.stdout.buffer
    try:
        for records in _decompressed(packed):
            out.write(LENGTH.pack(len(records)))
            out.write(records)
        out.write(LENGTH.pack(0))
    except BrokenPipeError:  # the reader has ended
        return
    # Panics of lazrs are no Exceptions.
    except BaseException as error:
        damaged = f"{packed.path} is damaged, its points cannot be decoded ({str(error)[:200]}): export the cloud again"
        text = str(error) if isinstance(error, InputError) else damaged.replace("\n", " ")
        out.write(LENGTH.pack(-len(text.encode(errors="replace"))) + text.encode(errors="replace"))
    out.flush()


def _decompressed(packed: Packed) -> Iterator[memoryview]:
    """The records of the points, some chunks at a time; valid until the next ones."""
    import lazrs

    memory = bytearray()  # one for all: pages that are new each time cost as much as to copy them
    with Path(packed.path).open("rb") as stream:
        chunks = wanted_chunks(packed, stream)
        stream.seek(packed.start + 8)
        for batch in _batches(chunks, packed.record):
            data = stream.read(sum(length for _, length in batch))
            _check_layers(packed, data, batch)
            size = packed.record * sum(points for points, _ in batch)
            if size > len(memory):
                memory = bytearray(size)
            records = memoryview(memory)[:size]
            lazrs.decompress_points_with_chunk_table(data, packed.description, records, batch)
            yield records


def wanted_chunks(packed: Packed, stream: BinaryIO) -> list[Chunk]:
    """The chunks with the points that are wanted of each; together these are the points of the file."""
    import lazrs

    end = _find_table(packed, stream)
    entries = lazrs.read_chunk_table_only(stream, lazrs.LazVlr(packed.description))
    (chunk_size,) = struct.unpack_from("<I", packed.description, 12)
    chunks, left, start = [], packed.points, packed.start + 8
    for held, length in entries:
        points = min(left, held if chunk_size == _OWN_SIZES else chunk_size)
        start += length
        if start > end or points * packed.record > MAX_CLOUD_RECORDS:
            raise InputError(
                f"{packed.path} is damaged: a chunk of {points} points takes {length} bytes, "
                f"and ends {start - end} bytes behind the last: export the cloud again"
            )
        chunks.append((points, length))
        left -= points
        if not left:
            return chunks
    raise InputError(
        f"{packed.path} is damaged: {packed.points} points in chunks for {packed.points - left}: export the cloud again"
    )


def _find_table(packed: Packed, stream: BinaryIO) -> int:
    """First byte of the table of chunks, where the stream then stands."""
    size = stream.seek(0, 2)
    stream.seek(packed.start)
    (table,) = LENGTH.unpack(stream.read(8).ljust(8, b"\0"))
    if table == -1:  # written after the points, by who could not go back
        stream.seek(-8, 2)
        (table,) = LENGTH.unpack(stream.read(8))
    if not packed.start + 8 <= table <= size - 8:
        raise InputError(
            f"{packed.path} is cut off or damaged: its table of chunks at byte {table} is not in the file: "
            "export the cloud again"
        )
    stream.seek(table)
    _, chunks = struct.unpack("<II", stream.read(8))
    if chunks > MAX_CLOUD_CHUNKS or chunks * packed.record > table - packed.start - 8:  # the first point is as it is
        raise InputError(
            f"{packed.path} is cut off or damaged: {chunks} chunks in {table - packed.start - 8} bytes "
            f"({MAX_CLOUD_CHUNKS} chunks at most are read): export the cloud again"
        )
    stream.seek(table)
    return table


def _batches(chunks: list[Chunk], record: int) -> Iterator[list[Chunk]]:
    """Chunks that are decoded at once, as many as there are processors."""
    batch: list[Chunk] = []
    decoded = 0
    for chunk in chunks:
        batch.append(chunk)
        decoded += chunk[0] * record
        if decoded >= _PIECE:
            yield batch
            batch, decoded = [], 0
    if batch:
        yield batch


def _check_layers(packed: Packed, data: bytes, batch: list[Chunk]) -> None:
    """Raises InputError where the layers of a chunk take more than its bytes.

    A chunk in layers begins with its first point, the number of the others and the length of each layer.
    """
    if not packed.layers:
        return
    head = packed.record + 4
    at = 0
    for points, length in batch:
        held = length - head - 4 * packed.layers
        needed = sum(struct.unpack_from(f"<{packed.layers}I", data, at + head)) if held >= 0 else 0
        if points and needed > held:
            raise InputError(
                f"{packed.path} is damaged: the layers of a chunk take {needed} bytes, "
                f"and {max(held, 0)} are there: export the cloud again"
            )
        at += length
