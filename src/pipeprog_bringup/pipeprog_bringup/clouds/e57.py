# SPDX-License-Identifier: Apache-2.0
"""The points of an E57 file."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from pipeprog_bringup.clouds.columns import Columns, check_count, check_length
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CLOUD_DESCRIPTION, MAX_CLOUD_POINTS_PER_BYTE

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_PAGE, _PAYLOAD = 1024, 1020  # bytes of a page, and those before its checksum
_CHUNK = 1 << 20  # points that are decoded at once: two looks a second at whether Ctrl-C was pressed


def read_e57(path: Path) -> Columns:
    """The valid points of all scans, each moved by its pose into the file's common frame."""
    import pye57

    size = path.stat().st_size
    _check_description(path, size)
    file = pye57.E57(str(path))
    try:
        headers = [file.get_header(number) for number in range(file.scan_count)]
        if not headers:
            raise InputError(f"{path} holds no scan: export the cloud again")
        points = sum(max(header.point_count, 0) for header in headers)
        check_count(path, points)
        check_length(path, f"{points} points", points // MAX_CLOUD_POINTS_PER_BYTE, size)
        scans = [_scan(path, file, header) for header in headers]
    finally:
        file.close()
    return {axis: np.concatenate([scan[:, i] for scan in scans]) for i, axis in enumerate("xyz")}


def _check_description(path: Path, size: int) -> None:
    """Raises InputError where the XML that describes the scans is not in the file, too long or one that grows."""
    with path.open("rb") as stream:
        head = stream.read(48)
        if head[:8] != b"ASTM-E57" or len(head) < 48:
            raise InputError(f"{path} is no E57: it does not begin with a header of 48 bytes: export the cloud again")
        length, start, description, page = struct.unpack_from("<4Q", head, 16)
        if length > size or start + description > size or page != _PAGE:
            raise InputError(
                f"{path} is cut off or damaged: it declares {length} bytes in pages of {page}, of which {description} "
                f"from byte {start} on describe the scans, and has {size}: export the cloud again"
            )
        if description > MAX_CLOUD_DESCRIPTION:
            raise InputError(
                f"{path}: {description} bytes describe the scans, of which {MAX_CLOUD_DESCRIPTION} at most are read: "
                "export fewer scans in one file"
            )
        stream.seek(start // _PAGE * _PAGE)
        pages = stream.read(size - stream.tell())
    xml = b"".join(pages[i : i + _PAYLOAD] for i in range(0, len(pages), _PAGE))[start % _PAGE :][:description]
    # A document type can declare entities that multiply; in UTF-16, which no E57 uses, it would not be seen.
    if b"<!DOCTYPE" in xml or b"\0" in xml:
        raise InputError(f"{path}: the XML that describes its scans is none of an E57's: export the cloud again")


def _scan(path: Path, file: Any, header: Any) -> FloatArray:
    """(N, 3) valid points of a scan in the file's frame [m]."""
    from pye57.utils import convert_spherical_to_cartesian

    cartesian = set(_CARTESIAN) <= set(header.point_fields)
    axes, state = (_CARTESIAN, "cartesianInvalidState") if cartesian else (_SPHERICAL, "sphericalInvalidState")
    if not set(axes) <= set(header.point_fields):
        raise InputError(
            f"{path}: a scan has the columns {', '.join(header.point_fields)[:200]}, and of neither kind of "
            f"coordinates all three ({', '.join(_CARTESIAN)}; {', '.join(_SPHERICAL)}): export the cloud again"
        )
    fields = [*axes, *([state] if state in header.point_fields else [])]
    table = _table(path, file, header, fields)
    points = np.stack(table[:3], axis=1)
    if len(fields) > 3:
        points = points[table[3] == 0]
    if not cartesian:
        points = convert_spherical_to_cartesian(points)
    if not header.has_pose():
        return points
    rotation, translation = header.rotation, header.translation
    if not (np.isfinite([*rotation, *translation]).all() and np.any(rotation)):
        raise InputError(
            f"{path}: the pose of a scan (rotation {rotation}, translation {translation}) is none: export it again"
        )
    return file.to_global(points, rotation, translation)


def _table(path: Path, file: Any, header: Any, fields: list[str]) -> list[FloatArray]:
    """The columns `fields` of all points of a scan."""
    count = header.point_count
    if not count:
        return [np.empty(0) for _ in fields]
    columns, done = [np.empty(count) for _ in fields], 0
    data, buffers = file.make_buffers(fields, min(count, _CHUNK))
    reader = header.points.reader(buffers)
    while done < count and (read := reader.read()):
        for column, name in zip(columns, fields, strict=True):
            column[done : done + read] = data[name][:read]
        done += read
    if done < count:
        raise InputError(
            f"{path} is cut off or damaged: a scan declares {count} points and holds {done}: export it again"
        )
    return columns
