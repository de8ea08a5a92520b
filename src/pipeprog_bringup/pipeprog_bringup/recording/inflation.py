# SPDX-License-Identifier: Apache-2.0
"""Decompression within limits: nothing is inflated beyond the size that was declared and allowed."""

from __future__ import annotations

import bz2
import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import FREE_CONTENT, FREE_RECORDS, MAX_CHUNK, MAX_INFLATION, MIN_BYTES_OF_A_RECORD

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
COMPRESSIONS = ("", "lz4", "zstd")  # of mcap
_PIECE = 1 << 16  # bytes handled at a time: of a damaged stream what lies before the fault is kept


class Allowance:
    """What one pass over a file of `size` bytes may still take: inflated bytes and records, in proportion to it.

    A small file can claim, or inflate to, content without end; this bounds the time that any file takes.
    """

    def __init__(self, path: Path, size: int) -> None:
        self._path, self._size = path, size
        self._bytes = FREE_CONTENT + MAX_INFLATION * size
        self._records = FREE_RECORDS + size // MIN_BYTES_OF_A_RECORD

    def take_bytes(self, count: int) -> None:
        """Raises InputError where this many more are too many."""
        self._bytes -= count
        if self._bytes < 0:
            self._refuse("inflates to more than a hundred times as much")

    def take_records(self, count: int) -> None:
        """Raises InputError where this many more are too many."""
        self._records -= count
        if self._records < 0:
            self._refuse("claims more messages than fit")

    def _refuse(self, what: str) -> None:
        raise InputError(
            f"{self._path} has {self._size} bytes and {what}: it is no recording of a camera; copy it again"
        )


def inflate(data: bytes, compression: str, limit: int) -> bytes:
    """At most `limit` bytes of one of COMPRESSIONS or bz2; of a torn or damaged stream what lies before the fault."""
    if not compression:
        return data[:limit]
    pieces = bytearray()
    # The fault's type differs from library to library (zstandard.ZstdError, RuntimeError, EOFError); all derive from
    # Exception alone, and each means that the rest of the stream cannot be decoded.
    with contextlib.suppress(Exception):
        for piece in {"zstd": _zstd, "lz4": _lz4, "bz2": _bz2}[compression](data):
            pieces += piece
            if len(pieces) >= limit:
                break
    del pieces[limit:]
    return bytes(pieces)


def plain_message(data: bytes, allowance: Allowance) -> bytes:
    """Undo the compression of single messages (rosbag2's message mode); no CDR message starts like zstd."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    declared = zstd_size(data)
    if declared is not None and declared > MAX_CHUNK:
        return b""
    plain = inflate(data, "zstd", MAX_CHUNK if declared is None else declared)
    allowance.take_bytes(len(plain))
    return plain


def zstd_size(data: bytes) -> int | None:
    """The size that a zstd stream declares for its content, None where it declares none."""
    import zstandard

    try:
        size = zstandard.frame_content_size(data)
    except zstandard.ZstdError:
        return None
    return None if size < 0 else size


def _zstd(data: bytes) -> Iterator[bytes]:
    import zstandard

    with zstandard.ZstdDecompressor().stream_reader(data) as reader:
        while piece := reader.read(_PIECE):
            yield piece


def _lz4(data: bytes) -> Iterator[bytes]:
    import lz4.frame  # type: ignore[import-untyped]

    decompressor: Any = lz4.frame.LZ4FrameDecompressor()
    for start in range(0, len(data), _PIECE):
        given = data[start : start + _PIECE]
        while not decompressor.eof:
            piece = decompressor.decompress(given, max_length=_PIECE)
            given = b""
            yield piece
            if decompressor.needs_input or not piece:
                break


def _bz2(data: bytes) -> Iterator[bytes]:
    decompressor = bz2.BZ2Decompressor()
    piece = decompressor.decompress(data, max_length=_PIECE)
    while piece:
        yield piece
        piece = b"" if decompressor.eof else decompressor.decompress(b"", max_length=_PIECE)
