# SPDX-License-Identifier: Apache-2.0
"""The points of a LAS or LAZ file."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pipeprog_bringup.clouds.columns import NORMALS, Columns, check_count, check_length
from pipeprog_bringup.clouds.laz import decompressed
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CLOUD_POINTS_PER_BYTE

_HEADER = 227  # bytes of the header of LAS 1.0 to 1.2
_HEADER_1_4 = 375  # bytes; from LAS 1.4 on the number of points has 64 bits
_VARIABLE_RECORD = 54  # bytes of the header of a variable length record (VLR)
_POINT_FORMATS = 10  # the last of LAS 1.4
_CHUNK = 1 << 20  # points that are read at once: two looks a second at whether Ctrl-C was pressed


@dataclass(frozen=True)
class _Declared:
    """What the header declares."""

    point_format: int
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
        dimensions = {name.lower(): name for name in file.header.point_format.extra_dimension_names}
        names = [dimensions[name] for group in NORMALS for name in group if name in dimensions]
        columns: Columns = {name: np.empty(declared.points) for name in ("x", "y", "z", *map(str.lower, names))}
        done = 0
        for chunk in _points(path, declared, file):
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
    point_format = kind & 0x7F  # the highest bit: LAZ
    if point_format > _POINT_FORMATS:
        raise InputError(f"{path}: point format {point_format} is not known: export it in one of 0 to {_POINT_FORMATS}")
    scales, offsets = struct.unpack_from("<3d", head, 131), struct.unpack_from("<3d", head, 155)
    if not np.isfinite([*scales, *offsets]).all() or 0.0 in scales:
        raise InputError(
            f"{path}: scale factors {_listed(scales)} and offsets {_listed(offsets)} give no coordinates: "
            "scale factors must be above 0, and both finite: export the cloud again"
        )
    check_count(path, points)
    compressed = bool(kind & 0x80)
    # A point takes at least a record, but for LAZ, whose smallest point takes a bit.
    check_length(
        path, f"{points} points", points // MAX_CLOUD_POINTS_PER_BYTE if compressed else record * points, size - start
    )
    return _Declared(point_format, points, record, start, compressed)


def _points(path: Path, declared: _Declared, file: Any) -> Iterator[Any]:
    """laspy's records of points, in pieces."""
    import laspy

    if not declared.compressed:
        yield from file.chunk_iterator(_CHUNK)
        return
    header = file.header
    descriptions = header.vlrs.get("LasZipVlr")
    for piece in decompressed(
        path,
        declared.point_format,
        declared.points,
        declared.record,
        declared.start,
        descriptions[0].record_data if descriptions else b"",
    ):
        records = laspy.PackedPointRecord.from_buffer(piece, header.point_format)
        yield laspy.ScaleAwarePointRecord(records.array, header.point_format, header.scales, header.offsets)


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:g}" for value in values)
