# SPDX-License-Identifier: Apache-2.0
"""Point clouds from files, and to them: PLY, PCD, LAS/LAZ, E57 and text, in metres.

The readers are plyfile, pypcd4, laspy and pye57, and not Open3D's read_point_cloud: that returns 0 points for a file
that is missing and 3 points, with a warning and no exception, for a PLY that is cut off, and it turns all coordinates
into doubles, so that nobody can see that a file's 32-bit coordinates are too coarse (see RESOLUTION).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_detect.types import Cloud

# Coordinates with steps above this cannot show a pipe of 8.6 mm radius, the thinnest of the paper.
RESOLUTION = 0.005  # m
LAS_STEP = 1e-4  # m between the whole numbers that LAS keeps: a hundredth of the noise of a point
_NORMALS = ("normal_x", "normal_y", "normal_z"), ("nx", "ny", "nz")


@dataclass(frozen=True)
class CloudFile:
    """The cloud of a file, less `dropped` points that were not finite; colours (N, 3) where a PLY has them."""

    cloud: Cloud
    dropped: int
    colors: NDArray[np.uint8] | None = None


def read_cloud(path: str | Path) -> CloudFile:
    """Read .ply, .pcd, .las, .laz, .e57, .xyz, .txt, .csv, .pts; raises InputError where it holds no usable cloud."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no such cloud: {path}")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path}: '{path.suffix}' is no cloud format: use one of {', '.join(_READERS)}")
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty (0 bytes): export the cloud again")
    try:
        columns = reader(path)
    except InputError:
        raise
    except MemoryError:
        raise InputError(f"{path} does not fit into memory: thin it out first") from None
    # The four libraries raise exceptions of any type for damaged files.
    except Exception as error:
        raise InputError(f"{path} cannot be read as {path.suffix}: {error or type(error).__name__}") from None
    return _cloud_file(path, columns)


def write_ply(
    path: Path,
    points: NDArray[np.floating],
    colors: NDArray[np.uint8] | None = None,
    normals: NDArray[np.floating] | None = None,
) -> None:
    """Binary PLY of points (N, 3) [m] as float32, with colours (N, 3) and normals (N, 3) where they are given."""
    from plyfile import PlyData, PlyElement

    columns: list[tuple[str, str, NDArray]] = [(axis, "<f4", points[:, i]) for i, axis in enumerate("xyz")]
    if normals is not None:
        columns += [(name, "<f4", normals[:, i]) for i, name in enumerate(("nx", "ny", "nz"))]
    if colors is not None:
        columns += [(name, "u1", colors[:, i]) for i, name in enumerate(("red", "green", "blue"))]
    vertices = np.empty(len(points), [(name, kind) for name, kind, _ in columns])
    for name, _, values in columns:
        vertices[name] = values
    PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(path))


def write_las(
    path: Path,
    points: NDArray[np.floating],
    colors: NDArray[np.uint8] | None = None,
    normals: NDArray[np.floating] | None = None,
) -> None:
    """LAS 1.4 of points (N, 3) [m] to the tenth of a millimetre, as `write_ply`; normals as extra dimensions."""
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6 if colors is None else 7)
    header.scales, header.offsets = np.full(3, LAS_STEP), np.zeros(3)
    header.creation_date = None  # the same cloud, the same bytes
    if normals is not None:
        header.add_extra_dims([laspy.ExtraBytesParams(name, np.float32) for name in _NORMALS[0]])
    las = laspy.LasData(header)
    las.xyz = points
    if colors is not None:
        # 16 bits, of which 8-bit colours fill the range.
        las.red, las.green, las.blue = (257 * colors.astype(np.uint16)).T
    if normals is not None:
        for name, values in zip(_NORMALS[0], normals.T, strict=True):
            las[name] = values
    las.write(path)


def _cloud_file(path: Path, columns: dict[str, NDArray]) -> CloudFile:
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise InputError(f"{path} has no column {', '.join(missing)}: it has {', '.join(columns) or 'none'}")
    points = np.stack([np.asarray(columns[axis], float) for axis in "xyz"], axis=1)
    finite = np.isfinite(points).all(axis=1)
    dropped = len(points) - int(finite.sum())
    if dropped == len(points):
        what = "no points" if not len(points) else f"{dropped} points and none is finite"
        raise InputError(f"{path} holds {what}: export the cloud again")
    if dropped:
        points = points[finite]
    extent = float(np.abs(points).max())
    if all(columns[axis].dtype == np.float32 for axis in "xyz") and np.spacing(np.float32(extent)) > RESOLUTION:
        step = 1e3 * float(np.spacing(np.float32(extent)))
        raise InputError(
            f"{path}: coordinates of {extent:.0f} m in 32-bit floats are {step:.0f} mm apart: "
            "export it with a local origin, in double precision or as LAS"
        )
    if (points == np.round(points)).all():
        raise InputError(
            f"{path}: every coordinate is a whole number, and metres in whole numbers hold no pipe: "
            "export it in metres with decimals (millimetres: divide by 1000)"
        )
    return CloudFile(Cloud(points, _normals(columns, finite)), dropped, _colors(columns, finite))


def _colors(columns: dict[str, NDArray], finite: NDArray[np.bool_]) -> NDArray[np.uint8] | None:
    names = ("red", "green", "blue")
    if not all(name in columns and columns[name].dtype == np.uint8 for name in names):
        return None
    return np.stack([columns[name][finite] for name in names], axis=1)


def _normals(columns: dict[str, NDArray], finite: NDArray[np.bool_]) -> FloatArray | None:
    """Unit normals, or None where the file has none for every point."""
    names = next((names for names in _NORMALS if all(name in columns for name in names)), None)
    if names is None:
        return None
    normals = np.stack([np.asarray(columns[name], float)[finite] for name in names], axis=1)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    if not (np.isfinite(lengths) & (lengths > 1e-6)).all():
        return None
    return normals / lengths


def _structured(data: NDArray) -> dict[str, NDArray]:
    return {name.lower(): data[name] for name in data.dtype.names or ()}


def _read_ply(path: Path) -> dict[str, NDArray]:
    from plyfile import PlyData

    elements = PlyData.read(str(path))
    if "vertex" not in elements:
        raise InputError(f"{path} holds no vertices")
    return _structured(elements["vertex"].data)


def _read_pcd(path: Path) -> dict[str, NDArray]:
    from pypcd4 import PointCloud

    return _structured(PointCloud.from_path(path).pc_data)


def _read_las(path: Path) -> dict[str, NDArray]:
    import laspy

    with laspy.open(path) as file:
        las = file.read()
    columns = {axis: np.asarray(getattr(las, axis), float) for axis in "xyz"}
    names = {name.lower(): name for name in las.point_format.extra_dimension_names}
    return columns | {name: np.asarray(las[names[name]]) for group in _NORMALS for name in group if name in names}


def _read_e57(path: Path) -> dict[str, NDArray]:
    """The valid points of all scans, each moved by its pose into the file's common frame."""
    import pye57

    file = pye57.E57(str(path))
    try:
        scans = [file.read_scan(number, ignore_missing_fields=True) for number in range(file.scan_count)]
    finally:
        file.close()
    if not scans:
        raise InputError(f"{path} holds no scan: export the cloud again")
    return {axis: np.concatenate([scan[f"cartesian{axis.upper()}"] for scan in scans]) for axis in "xyz"}


def _read_text(path: Path) -> dict[str, NDArray]:
    """Columns of numbers (blanks, commas or semicolons between them), x y z first unless a line of names differs."""
    names, skipped, separator = ["x", "y", "z"], 0, None
    with path.open(encoding="utf-8", errors="replace") as stream:
        for line in itertools.islice(stream, 100):
            text = line.strip().lstrip("#/").strip()
            separator = next((mark for mark in (";", ",") if mark in text), None)
            cells = [cell.strip() for cell in text.split(separator)] if text else []
            if len(cells) >= 3 and _numeric(cells[:3]) and not line.strip().startswith(("#", "/")):
                break
            # A line of fewer numbers is the count that opens a .pts file.
            if {"x", "y", "z"} <= {cell.lower().strip('"') for cell in cells}:
                names = [cell.lower().strip('"') for cell in cells]
            skipped += 1
        else:
            raise InputError(f"{path}: no line of three numbers among the first {skipped}: it is no list of points")
    names = names[: len(cells)]
    wanted = [name for name in names if name in ("x", "y", "z", *itertools.chain(*_NORMALS))]
    table = np.loadtxt(
        path,
        delimiter=separator,
        comments=["#", "//"],
        skiprows=skipped,
        usecols=[names.index(name) for name in wanted],
        ndmin=2,
        encoding="utf-8",
    )
    return {name: table[:, i] for i, name in enumerate(wanted)}


def _numeric(cells: list[str]) -> bool:
    try:
        return bool([float(cell) for cell in cells])
    except ValueError:
        return False


_READERS: dict[str, Callable[[Path], dict[str, NDArray]]] = {
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".las": _read_las,
    ".laz": _read_las,
    ".e57": _read_e57,
    ".xyz": _read_text,
    ".txt": _read_text,
    ".csv": _read_text,
    ".pts": _read_text,
}
