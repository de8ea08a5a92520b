# SPDX-License-Identifier: Apache-2.0
"""The points of a LAZ file, decompressed by lazrs in a process of its own.

No check of sizes makes lazrs safe: it decodes times by a recursion as deep as the compressed bits say, and a file of a
few kilobytes overflows its stack. That ends the process, which must not be this one.
"""

from __future__ import annotations

import contextlib
import fcntl
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from pipeprog_bringup.clouds.laz_decoder import LENGTH, Packed
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_COMPRESSED_POINT

# What LASzip compresses of a point of each format, in this order: kinds of items, and the bytes of each kind.
_ITEMS = (
    (6,),
    (6, 7),
    (6, 8),
    (6, 7, 8),
    (6, 7, 9),
    (6, 7, 8, 9),
    (10,),
    (10, 11),
    (10, 12),
    (10, 13),
    (10, 12, 13),
)
_BYTES = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # extra bytes have one each
_EXTRA, _EXTRA_IN_LAYERS = 0, 14  # kinds of the bytes that a format does not define
_DESCRIPTION = 34  # bytes before the items
_ITEM = struct.Struct("<HHH")  # kind, bytes, version
_PIPE = 1 << 20  # bytes; fs.pipe-max-size of Linux where nobody has changed it
_COMPRESSORS = 2, 3  # of chunks, and of chunks in layers


def decompressed(
    path: Path, point_format: int, points: int, record: int, start: int, description: bytes
) -> Iterator[bytearray]:
    """The `points` records of `record` bytes each, in pieces; raises InputError where they cannot be decoded.

    They begin at the byte `start`; `description` is what the file's record "laszip encoded" holds.
    """
    if not points:
        return
    description, layers = _checked(path, point_format, record, description)
    packed = Packed(str(path), points, record, start, description, layers)
    program = (
        f"import sys; sys.path[:] = {sys.path!r}; "
        f"from pipeprog_bringup.clouds.laz_decoder import Packed, main; main({packed!r})"
    )
    with subprocess.Popen(
        [sys.executable, "-I", "-c", program],
        bufsize=0,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,  # words of panics, of which the pieces tell
    ) as process:
        try:
            _widen(process)
            yield from _pieces(path, process)
        finally:
            process.kill()


def _checked(path: Path, point_format: int, record: int, description: bytes) -> tuple[bytes, int]:
    """The description of a compression without what follows it, and the layers of a chunk."""
    kinds = _ITEMS[point_format]
    expected = [(kind, _BYTES[kind]) for kind in kinds]
    extra = record - sum(size for _, size in expected)
    layers = sum(_LAYERS[kind] for kind in kinds) + extra if point_format >= 6 else 0
    if extra:
        expected.append((_EXTRA_IN_LAYERS if layers else _EXTRA, extra))
    length = _DESCRIPTION + _ITEM.size * len(expected)
    compressor, number = 0, 0
    if len(description) >= length:
        (compressor,), (number,) = struct.unpack_from("<H", description), struct.unpack_from("<H", description, 32)
    items = [(kind, size) for kind, size, _ in _ITEM.iter_unpack(description[_DESCRIPTION:length])] if number else []
    if compressor not in _COMPRESSORS or number != len(expected) or items != expected:
        raise InputError(
            f"{path} is damaged or of an old LASzip: the record that describes its compression is missing or is not "
            f"that of points of format {point_format} with {record} bytes: export the cloud again"
        )
    if record > MAX_COMPRESSED_POINT:
        raise InputError(
            f"{path}: points of {record} bytes are not read from LAZ, {MAX_COMPRESSED_POINT} at most: "
            "export it as LAS, or without extra dimensions"
        )
    return description[:length], layers


def _pieces(path: Path, process: subprocess.Popen[bytes]) -> Iterator[bytearray]:
    """What the program writes, until its end; raises InputError where it says so, or ends before."""
    while length := LENGTH.unpack(_read(path, process, LENGTH.size))[0]:
        piece = _read(path, process, abs(length))
        if length < 0:
            raise InputError(piece.decode(errors="replace"))
        yield piece


def _widen(process: subprocess.Popen[bytes]) -> None:
    """Lets the pipe hold as much as an unprivileged user may have, so that the two processes wait less."""
    assert process.stdout is not None
    with contextlib.suppress(OSError):  # another limit, or all that this user may have is in use: it stays as it is
        fcntl.fcntl(process.stdout, fcntl.F_SETPIPE_SZ, _PIPE)


def _read(path: Path, process: subprocess.Popen[bytes], size: int) -> bytearray:
    """The next `size` bytes that the program writes."""
    assert process.stdout is not None
    data = bytearray(size)
    view = memoryview(data)
    while view and (read := process.stdout.readinto(view)):  # type: ignore[attr-defined]  # a file without buffer
        view = view[read:]
    if view:
        code = process.wait()
        how = f"exit code {code}"
        with contextlib.suppress(ValueError):  # no signal
            how = signal.Signals(-code).name
        raise InputError(
            f"{path} is damaged, or too large for this machine's memory: it ended the program that decodes its points "
            f"({how}): export the cloud again"
        )
    return data
