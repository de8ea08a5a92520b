# SPDX-License-Identifier: Apache-2.0
"""The vertices of a PLY file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from pipeprog_bringup.clouds.columns import (
    Columns,
    Field,
    check_length,
    read_declared_rows,
    read_records,
    wanted,
    whole_number,
)
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CLOUD_HEADER

_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_KINDS = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float": "f4",
    "double": "f8",
    "float32": "f4",
    "float64": "f8",
}


@dataclass
class _Element:
    """Rows of one kind, such as vertices: their number, the names and NumPy types of their properties."""

    count: int
    names: list[str] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    lists: list[str] = field(default_factory=list)

    @property
    def size(self) -> int:
        """Bytes of a row without lists."""
        return sum(np.dtype(kind).itemsize for kind in self.kinds)


def read_ply(path: Path) -> Columns:
    """The columns of the vertices; what follows them, such as faces, is not read."""
    with path.open("rb") as stream:
        order, elements = _header(path, stream)
        if "vertex" not in elements:
            raise InputError(f"{path} holds no vertices: export the cloud as points")
        vertex = elements["vertex"]
        before = list(elements.values())[: list(elements).index("vertex")]
        for element in (*before, vertex):
            if element.lists:
                raise InputError(
                    f"{path}: property {element.lists[0][:40]} is a list: export the cloud as points, "
                    "with single numbers for x, y and z and without lists"
                )
        fields = {
            name: Field(order + vertex.kinds[i], i, sum(np.dtype(kind).itemsize for kind in vertex.kinds[:i]))
            for name, i in wanted(path, vertex.names).items()
        }
        if order == "=":
            _skip_lines(path, stream, sum(element.count for element in before))
            return read_declared_rows(path, stream, fields, len(vertex.names), vertex.count)
        stream.seek(sum(element.count * element.size for element in before), 1)
        return read_records(path, stream, fields, vertex.size, vertex.count)


def _header(path: Path, stream: BinaryIO) -> tuple[str, dict[str, _Element]]:
    """Byte order ("=" for text) and elements; the stream is left at the first byte of the data."""
    head = stream.read(MAX_CLOUD_HEADER)
    # Old files of Macintosh end their lines with a carriage return alone.
    end = b"\n" if b"\n" in head[:5] else b"\r"
    order, elements, start = "", dict[str, _Element](), 0
    while True:
        stop = head.find(end, start)
        if stop < 0:
            raise InputError(f"{path} is no PLY: no end_header in its first {len(head)} bytes: export the cloud again")
        words = head[start:stop].decode("ascii", "replace").split()
        if start == 0 and words != ["ply"]:
            raise InputError(f"{path} is no PLY: its first line is not 'ply': export the cloud again")
        start = stop + 1
        match words:
            case ["end_header"]:
                break
            case ["format", name, _] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if name not in elements:
                elements[name] = _Element(whole_number(path, f"element {name[:40]}", count))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= _KINDS.keys():
                list(elements.values())[-1].lists.append(name)
            case ["property", kind, name] if elements and kind in _KINDS:
                list(elements.values())[-1].names.append(name)
                list(elements.values())[-1].kinds.append(_KINDS[kind])
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise InputError(
                    f"{path}: the line '{' '.join(words)[:80]}' is none of a PLY's header: export the cloud again"
                )
    if not order:
        raise InputError(f"{path} has no line 'format ascii 1.0' or 'format binary_... 1.0': export the cloud again")
    stream.seek(start)
    return order, elements


def _skip_lines(path: Path, stream: BinaryIO, count: int) -> None:
    check_length(path, f"{count} lines before its points", count, path.stat().st_size - stream.tell())
    for _ in range(count):
        stream.readline()
