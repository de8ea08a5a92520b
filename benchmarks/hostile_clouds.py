# SPDX-License-Identifier: Apache-2.0
"""Point clouds that are damaged or made to do harm: each read, and detected in where it can be read, under limits.

    .venv/bin/python -m benchmarks.hostile_clouds [--tried 500] [--seed 0]

First the table of named cases (NAMED), which are unit tests too, then small valid clouds of every format, mutated. Each
runs in a process of its own; what fails is a traceback, a death, over 20 s, over 2 GiB, or an error of several lines or
without the file's name. Writes results/hostile_clouds.json.
"""

from __future__ import annotations

import itertools
import os
import random
import re
import struct
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads do not survive a fork

import laspy
import lazrs
import numpy as np
import pye57
from plyfile import PlyData, PlyElement
from pypcd4 import Encoding, PointCloud

from benchmarks.limited import Outcome, count_and_seed, try_files, write_tried
from pipeprog_bringup.results.cloud_io import read_cloud
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.product.boq import BillOfQuantities

SECONDS, MEMORY = 20.0, 1 << 31
WHAT = "Point clouds (PLY, PCD, LAS, LAZ, E57, text) that are damaged or declare what they do not hold"
COUNT = 400  # points of a valid cloud
HUGE = (0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)
LAYERS = 8 + 30 + 4  # bytes from the start of a LAZ's points: position of the table, first point, number of points
PAGE, PAYLOAD = 1024, 1020  # bytes of an E57's page, and those without its checksum


def pipe() -> np.ndarray:
    """(COUNT, 3) points of a vertical pipe of 50 mm radius before a wall [m]."""
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, np.pi, COUNT // 2), rng.uniform(0, 2, COUNT)
    barrel = np.c_[0.05 * np.cos(angle), 0.05 * np.sin(angle)]
    wall = np.c_[rng.uniform(-1, 1, COUNT // 2), np.full(COUNT // 2, -0.3)]
    return np.c_[np.r_[barrel, wall], height]


# Valid clouds.


def _ply(path: Path, text: bool = False, kind: str = "f4") -> None:
    rows = np.empty(COUNT, [*((axis, kind) for axis in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))])
    for i, axis in enumerate("xyz"):
        rows[axis] = pipe()[:, i]
    PlyData([PlyElement.describe(rows, "vertex")], text=text, byte_order="=" if text else "<").write(str(path))


def _pcd(path: Path, encoding: Encoding = Encoding.BINARY) -> None:
    PointCloud.from_xyzi_points(np.c_[pipe(), np.ones(COUNT)]).save(path, encoding=encoding)


def _las(path: Path, version: str = "1.4", point_format: int = 6) -> None:
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.creation_date = np.full(3, 1e-4), None
    las = laspy.LasData(header)
    las.xyz = pipe()
    las.write(path)


def _las_in_chunks(path: Path) -> None:
    """A LAZ whose chunks have sizes of their own, 100 points and 300."""
    _las(path)
    content = path.read_bytes()
    start, at = struct.unpack_from("<I", content, 96)[0], content.index(b"laszip encoded") - 2 + 54
    compression = lazrs.LazVlr.new_for_compression(6, 0, True)
    description = compression.record_data()
    points = laspy.read(path).points.array.tobytes()
    first = 100 * compression.item_size()
    with path.open("r+b") as stream:
        stream.seek(at)
        stream.write(description)
        stream.seek(start)
        stream.truncate()
        compressor = lazrs.LasZipCompressor(stream, compression)
        compressor.compress_many(points[:first])
        compressor.finish_current_chunk()
        compressor.compress_many(points[first:])
        compressor.done()


def _endless_time(path: Path) -> None:
    """A LAZ whose compressed bits say, again and again, that the time is one of another sequence.

    Of all symbols the last follows as long as the coded value is the interval's length less one; the decoder calls
    itself for each and has no stack left.
    """
    _las(path, "1.2", 1)
    content = path.read_bytes()
    start = struct.unpack_from("<I", content, 96)[0]
    table = struct.unpack_from("<q", content, start)[0]
    chunk = content[start + 8 : start + 36] + b"\xff\xff\xff\xfe"
    path.write_bytes(content[:start] + content[start : start + 8] + chunk.ljust(table - start - 8, b"\xff"))
    with path.open("ab") as stream:
        stream.write(content[table:])


def _e57(path: Path) -> None:
    file = pye57.E57(str(path), mode="w")
    file.write_scan_raw({f"cartesian{axis}": pipe()[:, i].copy() for i, axis in enumerate("XYZ")})
    file.close()


def _text(path: Path, head: str = "", mark: str = " ") -> None:
    path.write_text(head + "".join(mark.join(f"{value:.5f}" for value in point) + "\n" for point in pipe()))


VALID: dict[str, Callable[[Path], None]] = {
    "binary.ply": _ply,
    "text.ply": lambda path: _ply(path, text=True),
    "double.ply": lambda path: _ply(path, kind="f8"),
    "binary.pcd": _pcd,
    "text.pcd": lambda path: _pcd(path, Encoding.ASCII),
    "compressed.pcd": lambda path: _pcd(path, Encoding.BINARY_COMPRESSED),
    "new.las": _las,
    "old.las": lambda path: _las(path, "1.2", 3),
    "new.laz": _las,
    "old.laz": lambda path: _las(path, "1.2", 3),
    "chunks.laz": _las_in_chunks,
    "scan.e57": _e57,
    "points.xyz": _text,
    "points.csv": lambda path: _text(path, "x,y,z\n", ","),
    "points.pts": lambda path: _text(path, f"{COUNT}\n"),
    "points.txt": lambda path: _text(path, "//X;Y;Z\n", ";"),
}


# Named cases: each writes a file whose name has the given suffix.


def _lines(*lines: str, data: bytes = b"") -> Callable[[Path], None]:
    return lambda path: _write(path, "".join(f"{line}\n" for line in lines).encode() + data)


def _write(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def ply_head(count: int | str = COUNT, kind: str = "binary_little_endian", *properties: str) -> list[str]:
    """The lines of a PLY's header with `count` vertices."""
    properties = properties or tuple(f"property float {axis}" for axis in "xyz")
    return ["ply", f"format {kind} 1.0", f"element vertex {count}", *properties, "end_header"]


def pcd_head(points: int | str = COUNT, data: str = "binary", **lines: str) -> list[str]:
    """The lines of a PCD's header."""
    known = {"FIELDS": "x y z", "SIZE": "4 4 4", "TYPE": "F F F", "COUNT": "1 1 1"} | lines
    size = [f"WIDTH {points}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {points}", f"DATA {data}"]
    return ["VERSION .7", *(f"{key} {value}" for key, value in known.items()), *size]


def patched(make: Callable[[Path], None], *changes: tuple[int, str, Any]) -> Callable[[Path], None]:
    """A valid file in which values are overwritten: (byte, format of struct, value)."""

    def write(path: Path) -> None:
        make(path)
        content = bytearray(path.read_bytes())
        for offset, kind, value in changes:
            struct.pack_into("<" + kind, content, offset, value)
        path.write_bytes(content)

    return write


def cut(make: Callable[[Path], None], share: float) -> Callable[[Path], None]:
    """A valid file of which only the first share is left."""

    def write(path: Path) -> None:
        make(path)
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])

    return write


def in_points(offset: int, kind: str, value: int) -> Callable[[Path], None]:
    """A LAZ in which a number is overwritten, `offset` bytes behind the start of its points."""

    def write(path: Path) -> None:
        _las(path)
        content = bytearray(path.read_bytes())
        start = struct.unpack_from("<I", content, 96)[0]
        struct.pack_into("<" + kind, content, start + offset, value)
        path.write_bytes(content)

    return write


def with_longer_layer(more: int) -> Callable[[Path], None]:
    """A LAZ whose chunk declares its first layer longer by `more` bytes than it is."""

    def write(path: Path) -> None:
        _las(path)
        content = path.read_bytes()
        at = struct.unpack_from("<I", content, 96)[0] + LAYERS
        in_points(LAYERS, "I", struct.unpack_from("<I", content, at)[0] + more)(path)

    return write


def in_chunk_table(value: int) -> Callable[[Path], None]:
    """A LAZ whose table declares that number of chunks."""

    def write(path: Path) -> None:
        _las(path)
        content = bytearray(path.read_bytes())
        table = struct.unpack_from("<q", content, struct.unpack_from("<I", content, 96)[0])[0]
        struct.pack_into("<I", content, table + 4, value)
        path.write_bytes(content)

    return write


def in_compression(offset: int, kind: str, value: int) -> Callable[[Path], None]:
    """A LAZ in which a number of the record that describes the compression is overwritten."""

    def write(path: Path) -> None:
        _las(path)
        content = bytearray(path.read_bytes())
        struct.pack_into("<" + kind, content, content.index(b"laszip encoded") - 2 + 54 + offset, value)
        path.write_bytes(content)

    return write


def e57_described(pattern: str, replacement: str) -> Callable[[Path], None]:
    """An E57 with valid checksums in whose XML a pattern is replaced."""

    def write(path: Path) -> None:
        _e57(path)
        path.write_bytes(with_description(path.read_bytes(), lambda xml: re.sub(pattern, replacement, xml)))

    return write


def with_description(content: bytes, change: Callable[[str], str]) -> bytes:
    """An E57 whose XML, the last part of the file, is changed; checksums and lengths are made right."""
    pages = [content[i : i + PAYLOAD] for i in range(0, len(content), PAGE)]
    start, length = struct.unpack_from("<QQ", content, 24)
    first = start // PAGE * PAYLOAD + start % PAGE
    data = bytearray(b"".join(pages))
    xml = change(data[first : first + length].decode()).encode()
    data[first:] = xml
    data += bytes(-len(data) % PAYLOAD)
    struct.pack_into("<Q", data, 16, len(data) // PAYLOAD * PAGE)
    struct.pack_into("<Q", data, 32, len(xml))
    return with_checksums(bytes(data))


def with_checksums(data: bytes) -> bytes:
    """Pages of an E57: each payload with its checksum."""
    payloads = [data[i : i + PAYLOAD] for i in range(0, len(data), PAYLOAD)]
    return b"".join(payload + struct.pack(">I", crc32c(payload)) for payload in payloads)


def crc32c(data: bytes) -> int:
    """The checksum of Castagnoli (RFC 3720, appendix B.4)."""
    value = 0xFFFFFFFF
    for byte in data:
        value = _CRC[(value ^ byte) & 0xFF] ^ value >> 8
    return value ^ 0xFFFFFFFF


def _crc_table() -> list[int]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    return table


_CRC = _crc_table()
_POINTS = pipe().astype("<f4").tobytes()
_ROWS = "".join("{:.4f} {:.4f} {:.4f}\n".format(*point) for point in pipe()).encode()
_BOMB = (
    '<!DOCTYPE e57Root [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY {b} "{10 * f"&{a};"}">' for a, b in itertools.pairwise("abcdefghijk"))
    + "]>"
)


NAMED: dict[str, Callable[[Path], None]] = {
    # PLY
    "x is a list.ply": _lines(
        *ply_head(2, "ascii", "property list uchar float x", "property float y", "property float z"),
        data=b"1 0.5 1 2\n1 0.7 1 2\n",
    ),
    "a list beside x.ply": _lines(*ply_head(1, "ascii", "property list uint int w"), data=b"4294967295 1\n"),
    "a list before the vertices.ply": _lines(
        "ply",
        "format binary_little_endian 1.0",
        "element face 1",
        "property list uint int i",
        "element vertex 1",
        *(f"property float {axis}" for axis in "xyz"),
        "end_header",
        data=b"\xff" * 60,
    ),
    "a trillion vertices.ply": _lines(*ply_head(10**12), data=_POINTS),
    "vertices of 30 digits.ply": _lines(*ply_head("9" * 30), data=_POINTS),
    "vertices of 5000 digits.ply": _lines(*ply_head("9" * 5000), data=_POINTS),
    "minus one vertex.ply": _lines(*ply_head(-1), data=_POINTS),
    "one vertex too many.ply": _lines(*ply_head(COUNT + 1), data=_POINTS),
    "a trillion vertices in text.ply": _lines(*ply_head(10**12, "ascii"), data=_ROWS),
    "a million vertices in text.ply": _lines(*ply_head(10**6, "ascii"), data=_ROWS),
    "a trillion faces first.ply": _lines(
        "ply", "format ascii 1.0", f"element face {10**12}", "property int i", *ply_head(COUNT)[2:], data=_ROWS
    ),
    "two x.ply": _lines(*ply_head(COUNT, "ascii", *(f"property float {axis}" for axis in "xXyz")), data=_ROWS),
    "two vertices.ply": _lines(*ply_head()[:-1], *ply_head()[2:], data=_POINTS),
    "an unknown type.ply": _lines(*ply_head(COUNT, "ascii", "property float128 x"), data=_ROWS),
    "a property of nothing.ply": _lines("ply", "format ascii 1.0", "property float x", "end_header"),
    "no format.ply": _lines("ply", *ply_head()[2:], data=_POINTS),
    "no end of header.ply": lambda path: _write(path, b"ply\nformat ascii 1.0\n" + b"comment no end\n" * 100_000),
    "a line without end.ply": lambda path: _write(path, b"ply\ncomment " + bytes(1 << 24)),
    "a row without end.ply": lambda path: _write(
        path, "\n".join([*ply_head(COUNT, "ascii"), ""]).encode() + b"1" * (1 << 24)
    ),
    "a million properties.ply": _lines(*ply_head(1, "ascii", *(f"property float p{i}" for i in range(10**6)))),
    "no properties.ply": _lines("ply", "format binary_little_endian 1.0", "element vertex 100000000", "end_header"),
    "without z.ply": _lines(*ply_head(COUNT, "ascii", "property float x", "property float y"), data=_ROWS),
    "words in text.ply": _lines(*ply_head(2, "ascii"), data=b"1 2 3\none two three\n"),
    "a short row.ply": _lines(*ply_head(3, "ascii"), data=b"1.5 2 3\n1 2\n1 2 3\n"),
    "colour beyond its type.ply": _lines(
        *ply_head(1, "ascii", *(f"property float {axis}" for axis in "xyz"), "property uchar red"),
        data=b"1.5 2 3 99999\n",
    ),
    "a coordinate with decimals in whole numbers.ply": _lines(
        *ply_head(1, "ascii", *(f"property int {axis}" for axis in "xyz")), data=b"1.5 2 3\n"
    ),
    "normals not finite.ply": _lines(
        *ply_head(2, "ascii", *(f"property double {name}" for name in ("x", "y", "z", "nx", "ny", "nz"))),
        data=b"1.5 2 3 nan inf -inf\n1 2 3.5 1e300 1e300 1e308\n",
    ),
    "nothing is finite.ply": _lines(*ply_head(2, "ascii"), data=b"nan inf -inf\nnan nan nan\n"),
    "coordinates of 1e308.ply": _lines(
        *ply_head(2, "ascii", *(f"property double {axis}" for axis in "xyz")), data=b"1e308 -1e308 0\n1.5 0 0\n"
    ),
    "coordinates at the limit.ply": _lines(
        *ply_head(COUNT + 2, "ascii", *(f"property double {axis}" for axis in "xyz")),
        data=b"1e8 1e8 1e8\n-1e8 -1e8 -1e8\n" + _ROWS,
    ),
    "all points are one.ply": _lines(*ply_head(1000, "ascii"), data=b"0.5 0.25 0.125\n" * 1000),
    "one point.ply": _lines(*ply_head(1, "ascii"), data=b"0.5 0.25 0.125\n"),
    "smallest numbers.ply": _lines(
        *ply_head(3, "ascii", *(f"property double {axis}" for axis in "xyz")), data=b"5e-324 0 0\n0 5e-324 0\n0 0 0.5\n"
    ),
    # PCD
    "a trillion points in text.pcd": _lines(*pcd_head(10**12, "ascii"), data=b"0.5 1.5 2.5\n"),
    "a trillion points.pcd": _lines(*pcd_head(10**12), data=_POINTS),
    "points of 5000 digits.pcd": _lines(*pcd_head("9" * 5000), data=_POINTS),
    "minus one point.pcd": _lines(*pcd_head(-1), data=_POINTS),
    "one point in text.pcd": _lines(*pcd_head(1, "ascii"), data=b"0.5 1.5 2.5\n"),
    "fewer lines than points.pcd": _lines(*pcd_head(COUNT, "ascii"), data=b"0.5 1.5 2.5 3.5 4.5 5.5 6.5\n" * 150),
    "count of a billion.pcd": _lines(*pcd_head(1, COUNT="1 1 1000000000"), data=_POINTS),
    "count of a billion beside z.pcd": _lines(
        *pcd_head(COUNT, "ascii", FIELDS="x y z w", SIZE="4 4 4 4", TYPE="F F F F", COUNT=f"1 1 1 {10**9}"), data=_ROWS
    ),
    "count of a billion, no points.pcd": _lines(*pcd_head(0, COUNT=f"{10**9} 1 1")),
    "count of nothing.pcd": _lines(*pcd_head(COUNT, COUNT="0 0 0"), data=_POINTS),
    "size of a billion.pcd": _lines(*pcd_head(COUNT, SIZE=f"4 4 {10**9}"), data=_POINTS),
    "sizes and types do not fit.pcd": _lines(*pcd_head(COUNT, SIZE="4 4"), data=_POINTS),
    "fields without end.pcd": _lines(*pcd_head(COUNT, FIELDS="x y z" + " w" * 10**6), data=_POINTS),
    "cut in a point.pcd": _lines(*pcd_head(), data=_POINTS[:1000]),
    "cut between two points.pcd": _lines(*pcd_head(), data=_POINTS[:1200]),
    "no data.pcd": _lines(*pcd_head()[:-1], data=_POINTS),
    "an unknown encoding.pcd": _lines(*pcd_head(COUNT, "brotli"), data=_POINTS),
    "a header without end.pcd": lambda path: _write(path, b"#" * (1 << 24)),
    "unpacks to 4 GB.pcd": _lines(
        *pcd_head(COUNT, "binary_compressed"), data=struct.pack("<II", 100, 2**32 - 1) + bytes(100)
    ),
    "unpacks to its points' size.pcd": _lines(
        *pcd_head(MAX := 1 << 26, "binary_compressed"), data=struct.pack("<II", 100, 12 * MAX) + bytes(100)
    ),
    "packed size of 4 GB.pcd": _lines(
        *pcd_head(COUNT, "binary_compressed"), data=struct.pack("<II", 2**32 - 1, 12 * COUNT) + bytes(100)
    ),
    "packed garbage.pcd": _lines(
        *pcd_head(COUNT, "binary_compressed"), data=struct.pack("<II", 400, 12 * COUNT) + b"\xff" * 400
    ),
    "no sizes.pcd": _lines(*pcd_head(COUNT, "binary_compressed")),
    # LAS and LAZ
    "points of 32 bits.las": patched(lambda path: _las(path, "1.2", 3), (107, "I", 2**32 - 1)),
    "points of 64 bits.las": patched(_las, (247, "Q", 2**64 - 1)),
    "points of 32 bits.laz": patched(lambda path: _las(path, "1.2", 3), (107, "I", 2**32 - 1)),
    "as many points as are read.laz": patched(_las, (247, "Q", 1 << 26)),
    "as many points as fit into a bit each.laz": patched(_las, (247, "Q", 20_000)),
    "one point too many.las": patched(_las, (247, "Q", COUNT + 1)),
    "one point too many.laz": patched(_las, (247, "Q", COUNT + 1)),
    "no points.las": patched(_las, (247, "Q", 0)),
    "variable length records.las": patched(_las, (100, "I", 2**32 - 1)),
    "variable length records.laz": patched(_las, (100, "I", 2**32 - 1)),
    "extended records.las": patched(_las, (235, "Q", 400), (243, "I", 2**32 - 1)),
    "extended records beyond the file.las": patched(_las, (235, "Q", 2**63), (243, "I", 5)),
    "points before the header.las": patched(_las, (96, "I", 10)),
    "points beyond the file.las": patched(_las, (96, "I", 2**32 - 1)),
    "header of no bytes.las": patched(_las, (94, "H", 0)),
    "header of 65535 bytes.las": patched(_las, (94, "H", 65535)),
    "record of no bytes.las": patched(_las, (105, "H", 0)),
    "record of 65535 bytes.las": patched(_las, (105, "H", 65535)),
    "record of 65535 bytes.laz": patched(_las, (105, "H", 65535)),
    "point format 99.las": patched(_las, (104, "B", 99)),
    "compressed, it says.las": patched(_las, (104, "B", 0x86)),
    "not compressed, it says.laz": patched(_las, (104, "B", 6)),
    "version 9.9.las": patched(_las, (24, "B", 9), (25, "B", 9)),
    "scale of zero.las": patched(_las, (131, "d", 0.0)),
    "scale not finite.las": patched(_las, (139, "d", float("nan"))),
    "scale of 1e300.las": patched(_las, (131, "d", 1e300)),
    "offset not finite.las": patched(_las, (155, "d", float("inf"))),
    "offset of 1e300.laz": patched(_las, (163, "d", 1e300)),
    "chunks at minus one.laz": in_points(0, "q", -1),
    "chunks far away.laz": in_points(0, "q", 2**62),
    "chunks at the start.laz": in_points(0, "q", 0),
    "chunks of 32 bits.laz": in_chunk_table(2**32 - 1),
    "chunks that might fit.laz": in_chunk_table(100),
    "no chunks.laz": in_chunk_table(0),
    "chunks of no points.laz": in_compression(12, "I", 0),
    "chunks of their own sizes.laz": in_compression(12, "I", 2**32 - 1),
    "chunks of 2 points.laz": in_compression(12, "I", 2),
    "chunks of two billion points.laz": in_compression(12, "I", 0x8000C350),
    "chunks of four billion points.laz": in_compression(12, "I", 2**32 - 2),
    "a layer of 4 GB.laz": in_points(LAYERS, "I", 2**32 - 1),
    "a last layer of 4 GB.laz": in_points(LAYERS + 8 * 4, "I", 2**32 - 1),
    "a layer one byte too long.laz": with_longer_layer(1),
    "a time without end.laz": _endless_time,
    "one point too many for its chunks.laz": patched(_las_in_chunks, (247, "Q", COUNT + 1)),
    "the bit of an old LASzip.laz": patched(_las, (104, "B", 0xC6)),
    "compressor of one chunk.laz": in_compression(0, "H", 1),
    "compressor 99.laz": in_compression(0, "H", 99),
    "items of no number.laz": in_compression(32, "H", 0),
    "items of 16 bits.laz": in_compression(32, "H", 65535),
    "item of another type.laz": in_compression(34, "H", 6),
    "item of an unknown type.laz": in_compression(34, "H", 999),
    "item of 65535 bytes.laz": in_compression(36, "H", 65535),
    "cut in its points.laz": cut(_las, 0.7),
    "cut in its points.las": cut(_las, 0.7),
    "cut in its header.las": cut(_las, 0.02),
    # E57
    "points of 64 bits.e57": e57_described('recordCount="[0-9]+"', f'recordCount="{2**63 - 1}"'),
    "points of 65 bits.e57": e57_described('recordCount="[0-9]+"', f'recordCount="{2**65}"'),
    "minus one point.e57": e57_described('recordCount="[0-9]+"', 'recordCount="-1"'),
    "as many points as are read.e57": e57_described('recordCount="[0-9]+"', f'recordCount="{1 << 26}"'),
    "one point too many.e57": e57_described('recordCount="[0-9]+"', f'recordCount="{COUNT + 1}"'),
    "points beyond the file.e57": e57_described('fileOffset="[0-9]+"', f'fileOffset="{2**62}"'),
    "points in the header.e57": e57_described('fileOffset="[0-9]+"', 'fileOffset="0"'),
    "entities that multiply.e57": e57_described(r"<e57Root", _BOMB + "<e57Root"),
    "entities in a text.e57": lambda path: (
        e57_described(r"<e57Root", _BOMB + "<e57Root")(path),
        path.write_bytes(with_description(path.read_bytes(), lambda xml: re.sub("pye57 v[0-9.]+", "&k;", xml))),
    )[0],
    "deep nesting.e57": e57_described("<images2D", '<a type="Structure">' * 20_000 + "<images2D"),
    "no XML.e57": e57_described("(?s).*", ""),
    "no scans.e57": e57_described("(?s)<data3D.*</data3D>", '<data3D type="Vector" allowHeterogeneousChildren="1"/>'),
    "scans that are a number.e57": e57_described("(?s)<data3D.*</data3D>", '<data3D type="Integer">7</data3D>'),
    "without x.e57": e57_described("cartesianX", "cartesianW"),
    "rotation of zeros.e57": e57_described('<w type="Float">[^<]*</w>', '<w type="Float">0</w>'),
    "rotation not finite.e57": e57_described('<w type="Float">[^<]*</w>', '<w type="Float">nan</w>'),
    "translation of 1e300.e57": e57_described(
        '<translation type="Structure">\\s*<x type="Float"[^>]*/?>([^<]*</x>)?',
        '<translation type="Structure"><x type="Float">1e300</x>',
    ),
    "XML beyond the file.e57": patched(_e57, (24, "Q", 2**63)),
    "XML of 64 bits.e57": patched(_e57, (32, "Q", 2**64 - 1)),
    "pages of no bytes.e57": patched(_e57, (40, "Q", 0)),
    "pages of 64 bits.e57": patched(_e57, (40, "Q", 2**64 - 1)),
    "cut.e57": cut(_e57, 0.5),
    "a checksum is wrong.e57": patched(_e57, (1500, "I", 0xDEADBEEF)),
    # text
    "a line without end.xyz": lambda path: _write(path, b"1.5 2.5 3.5\n" + b"1" * (1 << 24)),
    "the first line has no end.xyz": lambda path: _write(path, b"1.5 " * (1 << 22)),
    "numbers of 5000 digits.xyz": lambda path: _write(path, b"0.5 1.5 2.5\n" + b" ".join([b"9" * 5000] * 3) + b"\n"),
    "bytes that are no text.xyz": lambda path: _write(path, b"0.5 1.5 2.5\n" + bytes(range(128, 256)) * 10),
    "zeros.xyz": lambda path: _write(path, bytes(100_000)),
    "fewer columns.csv": lambda path: _write(path, b"x,y,z\n0.5,1.5,2.5\n0.5,1.5\n"),
    "two z.csv": lambda path: _write(path, b"x,y,z,Z\n0.5,1.5,2.5,3.5\n"),
    "names without numbers.csv": lambda path: _write(path, b"x,y,z\n"),
    "not finite.xyz": lambda path: _write(path, b"nan inf -inf\n" * 10),
    "1e400.xyz": lambda path: _write(path, b"1e400 0 0\n0.5 0 0\n"),
    "other digits.xyz": lambda path: _write(path, "\u0661.\u0665 2.5 3.5\n".encode()),
    # no file
    "a pipe.ply": lambda path: os.mkfifo(path),
    "a folder.las": lambda path: path.mkdir(),
    "an endless device.xyz": lambda path: path.symlink_to("/dev/zero"),
    "a link to itself.e57": lambda path: path.symlink_to(path),
    "empty.laz": lambda path: _write(path, b""),
}


def mutated(folder: Path, count: int, seed: int) -> Iterator[Path]:
    """Valid clouds of every format, in turn, with one to eight mutations each."""
    rng = random.Random(seed)
    valid = {}
    for name, make in VALID.items():
        make(folder / name)
        valid[name] = (folder / name).read_bytes()
    for number, name in zip(range(count), itertools.cycle(valid)):
        content = bytearray(valid[name])
        if name == "scan.e57":
            content = bytearray(b"".join(content[i : i + PAYLOAD] for i in range(0, len(content), PAGE)))
        for _ in range(rng.choice((1, 1, 2, 3, 8))):
            rng.choice(MUTATIONS)(rng, content)
        if name == "scan.e57":
            content = bytearray(with_checksums(bytes(content) + bytes(-len(content) % PAYLOAD)))
        path = folder / f"{number} {name}"
        path.write_bytes(content)
        yield path


def _place(rng: random.Random, content: bytearray) -> int:
    """A place in the file, half of the time in its header."""
    return rng.randrange(max(1, min(len(content), rng.choice((500, len(content))))))


def _flip(rng: random.Random, content: bytearray) -> None:
    if content:
        content[_place(rng, content)] ^= 1 << rng.randrange(8)


def _overwrite(rng: random.Random, content: bytearray) -> None:
    place, size = _place(rng, content), rng.choice((1, 2, 4, 8))
    content[place : place + size] = (rng.choice(HUGE) & (1 << 8 * size) - 1).to_bytes(size, "little")


def _number(rng: random.Random, content: bytearray) -> None:
    """Another number in the place of one that is written in digits."""
    numbers = list(re.finditer(rb"-?[0-9]+(\.[0-9]+)?", bytes(content)))
    if numbers:
        number = rng.choice(numbers[: rng.choice((20, len(numbers)))])
        content[number.start() : number.end()] = rng.choice(
            (b"0", b"-1", b"nan", b"1e308", b"x", b"", *(str(value).encode() for value in HUGE), b"9" * 400)
        )


def _remove(rng: random.Random, content: bytearray) -> None:
    place = _place(rng, content)
    del content[place : place + rng.choice((1, 3, 50, len(content)))]


def _repeat(rng: random.Random, content: bytearray) -> None:
    place = _place(rng, content)
    content[place:place] = content[place : place + rng.choice((1, 10, 300))] * rng.choice((1, 50))


MUTATIONS = (_flip, _overwrite, _number, _remove, _repeat)


def read_and_detect(path: Path) -> None:
    """What `pipeprog detect` does with the file."""
    detect(read_cloud(path).cloud, BillOfQuantities.of_radii({"DN80": 0.05}), DetectConfig())


def judged(path: Path, outcome: Outcome) -> str:
    """Why the outcome is a failure, or nothing."""
    if outcome.kind == "done":
        return ""
    if outcome.kind == "refused":
        clear = "\n" not in outcome.text and path.name in outcome.text and len(outcome.text) < 600
        return "" if clear else f"unclear: {outcome.text[:300]}"
    return f"{outcome.kind}: {outcome.text}"


def main() -> None:
    """Tries the clouds and writes what failed."""
    arguments = count_and_seed(__doc__)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _ply(folder / "warm.ply")
        read_and_detect(folder / "warm.ply")  # compiles what the processes share
        more = mutated(folder, max(0, arguments.tried - len(NAMED)), arguments.seed)
        tried = try_files(itertools.chain(_named(folder), more), read_and_detect, judged, SECONDS, MEMORY)
    write_tried("hostile_clouds", WHAT, arguments, tried)


def _named(folder: Path) -> Iterator[Path]:
    for name, make in NAMED.items():
        make(folder / name)
        yield folder / name


if __name__ == "__main__":
    main()
