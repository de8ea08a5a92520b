# SPDX-License-Identifier: Apache-2.0
"""The points of a LAS or LAZ file."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pipeprog_bringup.clouds.columns import NORMALS, Columns, check_count, check_length
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CLOUD_POINTS_PER_BYTE

_HEADER = 227  # bytes of the header of LAS 1.0 to 1.2
_HEADER_1_4 = 375  # bytes; from LAS 1.4 on the number of points has 64 bits
_VARIABLE_RECORD = 54  # bytes of the header of a variable length record (VLR)
_POINT_FORMATS = 10  # the last of LAS 1.4
_CHUNK = 1 << 20  # points that are decoded at once: two looks a second at whether Ctrl-C was pressed
_NO_FIXED_SIZE = 2**32 - 1  # the size of a LAZ file's chunks where each has its own


@dataclass(frozen=True)
class _Declared:
    """What the header declares."""

    points: int
    record: int  # bytes of a point, decoded
    start: int  # first byte of the points
    compressed: bool


def read_las(path: Path) -> Columns:
    """Coordinates in double precision, and normals where they are among the extra dimensions."""
    import laspy

    size = path.stat().st_size
    with path.open("rb") as stream:
        declared = _declared(path, stream, size)
    with laspy.open(path, read_evlrs=False) as file:
        if declared.compressed:
            _check_compression(path, declared, file.header.vlrs, size)
        dimensions = {name.lower(): name for name in file.header.point_format.extra_dimension_names}
        names = [dimensions[name] for group in NORMALS for name in group if name in dimensions]
        columns: Columns = {name: np.empty(declared.points) for name in ("x", "y", "z", *map(str.lower, names))}
        done = 0
        for chunk in _chunks(path, file):
            rows = slice(done, done + len(chunk))
            for axis in "xyz":
                columns[axis][rows] = getattr(chunk, axis)
            for name in names:
                columns[name.lower()][rows] = chunk[name]
            done = rows.stop
    return columns


def _declared(path: Path, stream: BinaryIO, size: int) -> _Declared:
    """What the header declares, compared with the file's length and with what is read."""
    head = stream.read(_HEADER_1_4)
    if head[:4] != b"LASF" or len(head) < _HEADER:
        raise InputError(f"{path} is no LAS: it does not begin with a header of {_HEADER} bytes: export it again")
    minor = head[25]
    if minor >= 4 and len(head) < _HEADER_1_4:
        raise InputError(f"{path} is cut off within its header of {_HEADER_1_4} bytes: export the cloud again")
    length, start, variable_records, kind, record, points = struct.unpack_from("<HIIBHI", head, 94)
    if minor >= 4:
        (points,) = struct.unpack_from("<Q", head, 247)
    if not _HEADER <= length <= start <= size:
        raise InputError(
            f"{path} is damaged: header of {length} bytes, points from byte {start} on, {size} bytes in all: "
            "export the cloud again"
        )
    if _VARIABLE_RECORD * variable_records > start - length:
        raise InputError(
            f"{path} is damaged: {variable_records} variable length records do not fit into {start - length} bytes: "
            "export the cloud again"
        )
    if kind & 0x3F > _POINT_FORMATS:
        raise InputError(f"{path}: point format {kind & 0x3F} is not known: export it in one of 0 to {_POINT_FORMATS}")
    scales, offsets = struct.unpack_from("<3d", head, 131), struct.unpack_from("<3d", head, 155)
    if not np.isfinite([*scales, *offsets]).all() or 0.0 in scales:
        raise InputError(
            f"{path}: scale factors {_listed(scales)} and offsets {_listed(offsets)} give no coordinates: "
            "scale factors must be above 0, and both finite: export the cloud again"
        )
    check_count(path, points)
    compressed = bool(kind & 0x80)  # the highest bit: LAZ
    # A point takes at least a record, but for LAZ, whose smallest point takes a bit.
    check_length(
        path, f"{points} points", points // MAX_CLOUD_POINTS_PER_BYTE if compressed else record * points, size - start
    )
    return _Declared(points, record, start, compressed)


def _check_compression(path: Path, declared: _Declared, variable_records: Any, size: int) -> None:
    """Raises InputError where what describes the compression does not fit together; the decoder believes it."""
    import lazrs

    descriptions = variable_records.get("LasZipVlr")
    data = descriptions[0].record_data if descriptions else b""
    items = struct.unpack_from("<H", data, 32)[0] if len(data) >= 34 else 0
    if not items or len(data) < 34 + 6 * items:
        raise InputError(f"{path} is damaged: the record that describes its compression is missing: export it again")
    chunk_size = struct.unpack_from("<I", data, 12)[0]
    record = sum(struct.unpack_from("<H", data, 34 + 6 * i + 2)[0] for i in range(items))
    if record != declared.record or not chunk_size:
        raise InputError(
            f"{path} is damaged: points of {record} bytes in chunks of {chunk_size} are compressed, "
            f"and its header declares points of {declared.record}: export the cloud again"
        )
    if not declared.points:
        return
    with path.open("rb") as stream:
        stream.seek(declared.start)
        table = struct.unpack("<q", stream.read(8).ljust(8, b"\0"))[0]
        if table == -1:  # written after the points, by who could not go back
            stream.seek(-8, 2)
            table = struct.unpack("<q", stream.read(8))[0]
        if not declared.start + 8 <= table <= size - 8:
            raise InputError(
                f"{path} is cut off or damaged: its table of chunks at byte {table} is not in the file: export it again"
            )
        stream.seek(table)
        _, chunks = struct.unpack("<II", stream.read(8))
        # The first point of a chunk is written as it is.
        check_length(path, f"{chunks} chunks", chunks * declared.record, table - declared.start - 8)
        stream.seek(declared.start)
        entries = lazrs.read_chunk_table(stream, lazrs.LazVlr(data))
    held = sum(count for count, _ in entries) if chunk_size == _NO_FIXED_SIZE else chunks * chunk_size
    check_length(path, f"{chunks} chunks", sum(length for _, length in entries), table - declared.start - 8)
    if held < declared.points:
        raise InputError(f"{path} is damaged: {declared.points} points in chunks for {held}: export the cloud again")


def _chunks(path: Path, file: Any) -> Any:
    """Points in pieces; the decoder's own panics, which are no Exceptions, become an InputError."""
    try:
        yield from file.chunk_iterator(_CHUNK)
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise InputError(f"{path} is damaged: its points cannot be decoded: export the cloud again") from None


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:g}" for value in values)
