# SPDX-License-Identifier: Apache-2.0
"""The points of a PCD file, the format of the Point Cloud Library."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from pipeprog_bringup.clouds.columns import (
    Columns,
    Field,
    check_count,
    check_length,
    read_declared_rows,
    read_records,
    wanted,
    whole_number,
)
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CLOUD_HEADER, MAX_CLOUD_RECORDS

_KINDS = {f"{letter}{size}" for letter in "IU" for size in (1, 2, 4, 8)} | {"F4", "F8"}
_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_LZF_RATIO = 88  # bytes out of one byte in: the longest match, 264 bytes, is written in 3


def read_pcd(path: Path) -> Columns:
    """The columns of the points."""
    with path.open("rb") as stream:
        header = _header(path, stream)
        names = header["FIELDS"]
        kinds = [f"{kind}{size}" for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
        counts = [whole_number(path, "COUNT", text) for text in header["COUNT"]]
        points = whole_number(path, "POINTS", header["POINTS"][0])
        sizes = [int(kind[1:]) * count for kind, count in zip(kinds, counts, strict=True)]
        fields = {}
        for name, i in wanted(path, names).items():
            if counts[i] != 1:
                raise InputError(f"{path}: {name} has {counts[i]} values a point: export the cloud with one")
            fields[name] = Field(f"<{kinds[i].lower()}", sum(counts[:i]), sum(sizes[:i]))
        match header["DATA"][0]:
            case "ascii":
                return read_declared_rows(path, stream, fields, sum(counts), points)
            case "binary":
                return read_records(path, stream, fields, sum(sizes), points)
            case "binary_compressed" | "binaryscompressed":
                return _read_compressed(path, stream, fields, sum(sizes), points)
            case other:
                raise InputError(f"{path}: DATA is '{other[:40]}', and not ascii, binary or binary_compressed")


def _header(path: Path, stream: BinaryIO) -> dict[str, list[str]]:
    """The words of each line of the header; the stream is left at the first byte of the data."""
    header: dict[str, list[str]] = {}
    while "DATA" not in header:
        line = stream.readline(MAX_CLOUD_HEADER - stream.tell())
        if not line.endswith(b"\n"):
            raise InputError(
                f"{path} is no PCD: no line DATA in its first {stream.tell()} bytes: export the cloud again"
            )
        key, *words = line.decode("ascii", "replace").split() or [""]
        if key in _KEYS and words:
            header[key] = words
    for key in ("FIELDS", "SIZE", "TYPE", "POINTS"):
        if key not in header:
            raise InputError(f"{path} has no line {key} in its header: export the cloud again")
    header.setdefault("COUNT", ["1"] * len(header["FIELDS"]))
    lengths = {key: len(header[key]) for key in ("FIELDS", "SIZE", "TYPE", "COUNT")}
    if len(set(lengths.values())) > 1:
        counted = ", ".join(f"{count} {key}" for key, count in lengths.items())
        raise InputError(f"{path}: the lines of its header do not fit together ({counted}): export the cloud again")
    for kind, size in zip(header["TYPE"], header["SIZE"], strict=True):
        if f"{kind}{size}" not in _KINDS:
            raise InputError(f"{path}: TYPE {kind[:20]} with SIZE {size[:20]} is no type of numbers of a PCD")
    return header


def _read_compressed(path: Path, stream: BinaryIO, fields: Mapping[str, Field], record: int, points: int) -> Columns:
    """Columns that follow one another, together compressed by LZF, after the two sizes."""
    import lzf

    check_count(path, points)
    check_length(path, f"{points} points", 8, path.stat().st_size - stream.tell())
    packed, unpacked = struct.unpack("<II", stream.read(8))
    check_length(path, f"{points} points", packed, path.stat().st_size - stream.tell())
    if unpacked != record * points or unpacked > _LZF_RATIO * packed:
        raise InputError(
            f"{path} is damaged: {points} points of {record} bytes do not fit into the {unpacked} bytes that it "
            f"declares to be compressed in {packed}: export the cloud again"
        )
    if unpacked > MAX_CLOUD_RECORDS:
        raise InputError(f"{path} takes {unpacked} bytes unpacked, of which {MAX_CLOUD_RECORDS} are read: thin it out")
    data = lzf.decompress(stream.read(packed), unpacked) if points else b""
    if data is None or len(data) != unpacked:
        raise InputError(f"{path} is damaged: it does not unpack to {unpacked} bytes: export the cloud again")
    return {name: np.frombuffer(data, field.kind, points, field.offset * points) for name, field in fields.items()}
