# SPDX-License-Identifier: Apache-2.0
"""Columns of points out of a file, once what its header declares has been compared with the file's length."""

from __future__ import annotations

import io
import itertools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CLOUD_LINE, MAX_CLOUD_POINTS

Columns = dict[str, NDArray]  # name -> values, one a point

NORMALS = ("normal_x", "normal_y", "normal_z"), ("nx", "ny", "nz")
COLORS = ("red", "green", "blue")
WANTED = frozenset(("x", "y", "z", *itertools.chain(*NORMALS), *COLORS))
_ROWS = 1 << 16  # rows of text between two looks at whether Ctrl-C was pressed: a tenth of a second


@dataclass(frozen=True)
class Field:
    """A column in a record: its NumPy type, its position among the numbers of a line, its first byte in the record."""

    kind: str
    position: int
    offset: int


def check_count(path: Path, points: int) -> None:
    """Raises InputError where a file declares more points than are read."""
    if points > MAX_CLOUD_POINTS:
        raise InputError(
            f"{path} declares {points} points, of which {MAX_CLOUD_POINTS} at most are read: thin it out or split it"
        )


def check_length(path: Path, what: str, needed: int, available: int) -> None:
    """Raises InputError where the `needed` bytes of what a file declares are not in its `available` ones."""
    if needed > available:
        raise InputError(
            f"{path} is cut off or damaged: the {what} it declares take {needed} bytes, "
            f"and {max(available, 0)} are there: export the cloud again"
        )


def whole_number(path: Path, name: str, text: str) -> int:
    """The number of a header's line; raises InputError where it is none, or one of over 20 digits."""
    if not (text.isascii() and text.isdigit() and len(text) <= 20):
        raise InputError(f"{path}: {name} is '{text[:40]}' and not a whole number from 0: export the cloud again")
    return int(text)


def wanted(path: Path, names: Sequence[str]) -> dict[str, int]:
    """Positions of the columns that are read; raises InputError where there are two of one name."""
    lower = [name.lower() for name in names]
    found = {name: lower.index(name) for name in lower if name in WANTED}
    twice = [name for name in found if lower.count(name) > 1]
    if twice:
        raise InputError(f"{path} has {lower.count(twice[0])} columns {twice[0]}: export the cloud with one")
    return found


def read_records(path: Path, stream: BinaryIO, fields: Mapping[str, Field], record: int, count: int) -> Columns:
    """Columns of `count` binary records of `record` bytes each that begin where the stream stands."""
    check_count(path, count)
    check_length(path, f"{count} points", record * count, path.stat().st_size - stream.tell())
    kind = np.dtype(
        {
            "names": list(fields),
            "formats": [field.kind for field in fields.values()],
            "offsets": [field.offset for field in fields.values()],
            "itemsize": record,
        }
    )
    records = np.fromfile(stream, kind, count)
    return {name: records[name] for name in fields}


def read_declared_rows(path: Path, stream: BinaryIO, fields: Mapping[str, Field], width: int, count: int) -> Columns:
    """Columns of the `count` lines of `width` numbers that follow where the stream stands."""
    check_count(path, count)
    # One digit and one separator for each number; the last line may end without.
    check_length(path, f"{count} points", 2 * width * count - 1, path.stat().st_size - stream.tell())
    columns = read_rows(path, stream, fields, count)
    rows = len(next(iter(columns.values()), ()))
    if fields and rows < count:
        raise InputError(f"{path} is cut off: it declares {count} points and holds {rows}: export the cloud again")
    return columns


def read_rows(
    path: Path,
    stream: BinaryIO,
    fields: Mapping[str, Field],
    count: int = MAX_CLOUD_POINTS + 1,
    delimiter: str | None = None,
    comments: Sequence[str] | None = None,
) -> Columns:
    """Columns of the lines that follow, `count` at most; raises InputError where there are too many or one is endless.

    Lines without numbers are passed over.
    """
    _check_lines(path, stream)
    lines = io.TextIOWrapper(stream, encoding="utf-8")
    kind = np.dtype([(name, field.kind) for name, field in fields.items()])
    chunks: list[NDArray] = [np.empty(0, kind)]
    rows = 0
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "loadtxt: input contained no data", UserWarning)
        warnings.filterwarnings("error", "loadtxt", DeprecationWarning)  # whole numbers read as if they had decimals
        while fields and rows < count:
            try:
                chunk = np.loadtxt(
                    lines,
                    kind,
                    delimiter=delimiter,
                    comments=comments,
                    usecols=[field.position for field in fields.values()],
                    ndmin=1,
                    max_rows=min(_ROWS, count - rows),
                )
            except DeprecationWarning:
                raise InputError(
                    f"{path}: a number is no whole one or too large for the type its header declares: export it again"
                ) from None
            if not len(chunk):
                break
            chunks.append(chunk)
            rows += len(chunk)
    check_count(path, rows)
    table = np.concatenate(chunks)
    return {name: table[name] for name in fields}


def _check_lines(path: Path, stream: BinaryIO) -> None:
    """Raises InputError where a line is longer than MAX_CLOUD_LINE; the stream stays where it is.

    A block of the file without an end of line is such a line, or half of it.
    """
    start = stream.tell()
    while block := stream.read(MAX_CLOUD_LINE):
        if len(block) == MAX_CLOUD_LINE and b"\n" not in block and b"\r" not in block:
            raise InputError(
                f"{path}: a line has more than {MAX_CLOUD_LINE} characters: a list of points has one point a line"
            )
    stream.seek(start)
