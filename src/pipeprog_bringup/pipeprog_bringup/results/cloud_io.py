# SPDX-License-Identifier: Apache-2.0
"""Point clouds from files, and to them: PLY, PCD, LAS/LAZ, E57 and text, in metres.

The readers are those of the room `clouds`, and not Open3D's read_point_cloud: that returns 0 points for a file that is
missing and 3 points, with a warning and no exception, for a PLY that is cut off, and it turns all coordinates into
doubles, so that nobody can see that a file's 32-bit coordinates are too coarse (see RESOLUTION).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.clouds.columns import COLORS, NORMALS, Columns
from pipeprog_bringup.clouds.e57 import read_e57
from pipeprog_bringup.clouds.las import read_las
from pipeprog_bringup.clouds.pcd import read_pcd
from pipeprog_bringup.clouds.ply import read_ply
from pipeprog_bringup.clouds.text import read_text
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_COORDINATE
from pipeprog_detect.types import Cloud

# Coordinates with steps above this cannot show a pipe of 8.6 mm radius, the thinnest of the paper.
RESOLUTION = 0.005  # m
LAS_STEP = 1e-4  # m between the whole numbers that LAS keeps: a hundredth of the noise of a point


@dataclass(frozen=True)
class CloudFile:
    """The cloud of a file, less `dropped` points that were not finite or beyond MAX_COORDINATE; colours (N, 3) where
    a PLY has them.
    """

    cloud: Cloud
    dropped: int
    colors: NDArray[np.uint8] | None = None


def read_cloud(path: str | Path) -> CloudFile:
    """Read .ply, .pcd, .las, .laz, .e57, .xyz, .txt, .csv, .pts; raises InputError where it holds no usable cloud."""
    path = Path(path)
    if not path.is_file():
        if path.exists():
            raise InputError(f"{path} is a folder, pipe or device: give a regular file")
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
    # NumPy, laspy and pye57 raise exceptions of any type for damaged files.
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        raise InputError(f"{path} cannot be read as {path.suffix} ({reason}): export the cloud again") from None
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
    offset: NDArray[np.floating] | None = None,
) -> None:
    """LAS 1.4 of points (N, 3) [m] to the tenth of a millimetre, as `write_ply`; normals as extra dimensions.

    A path that ends with .laz is compressed; `offset` (3,) [m] lies near points that are far from the origin.
    """
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6 if colors is None else 7)
    header.scales, header.offsets = np.full(3, LAS_STEP), np.zeros(3) if offset is None else offset
    header.creation_date = None  # the same cloud, the same bytes
    if normals is not None:
        header.add_extra_dims([laspy.ExtraBytesParams(name, np.float32) for name in NORMALS[0]])
    las = laspy.LasData(header)
    las.xyz = points
    if colors is not None:
        # 16 bits, of which 8-bit colours fill the range.
        las.red, las.green, las.blue = (257 * colors.astype(np.uint16)).T
    if normals is not None:
        for name, values in zip(NORMALS[0], normals.T, strict=True):
            las[name] = values
    las.write(path)


def _cloud_file(path: Path, columns: Columns) -> CloudFile:
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise InputError(f"{path} has no column {', '.join(missing)}: it has {', '.join(columns) or 'none'}")
    points: FloatArray = np.empty((len(columns["x"]), 3))
    for i, axis in enumerate("xyz"):
        points[:, i] = columns[axis]
    # NaN is not within.
    usable: NDArray[np.bool_] = np.all((points >= -MAX_COORDINATE) & (points <= MAX_COORDINATE), axis=1)
    dropped = len(points) - int(usable.sum())
    if dropped == len(points):
        what = "no points" if not len(points) else f"{dropped} points and none is finite"
        raise InputError(f"{path} holds {what}: export the cloud again")
    if dropped:
        points = points[usable]
    extent = float(max(points.max(), -points.min()))
    if all(columns[axis].dtype == np.float32 for axis in "xyz") and np.spacing(np.float32(extent)) > RESOLUTION:
        step = 1e3 * float(np.spacing(np.float32(extent)))
        raise InputError(
            f"{path}: coordinates of {extent:.0f} m in 32-bit floats are {step:.0f} mm apart: "
            "export it with a local origin, in double precision or as LAS"
        )
    if all((values == np.round(values)).all() for values in points.T):
        raise InputError(
            f"{path}: every coordinate is a whole number, and metres in whole numbers hold no pipe: "
            "export it in metres with decimals (millimetres: divide by 1000)"
        )
    return CloudFile(Cloud(points, _normals(columns, usable)), dropped, _colors(columns, usable))


def _colors(columns: Columns, usable: NDArray[np.bool_]) -> NDArray[np.uint8] | None:
    if not all(name in columns and columns[name].dtype == np.uint8 for name in COLORS):
        return None
    return np.stack([columns[name][usable] for name in COLORS], axis=1)


def _normals(columns: Columns, usable: NDArray[np.bool_]) -> FloatArray | None:
    """Unit normals, or None where the file has none for every point."""
    names = next((names for names in NORMALS if all(name in columns for name in names)), None)
    if names is None:
        return None
    normals = np.stack([np.asarray(columns[name], float)[usable] for name in names], axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    if not (np.isfinite(lengths) & (lengths > 1e-6)).all():
        return None
    return normals / lengths


_READERS: dict[str, Callable[[Path], Columns]] = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".las": read_las,
    ".laz": read_las,
    ".e57": read_e57,
    ".xyz": read_text,
    ".txt": read_text,
    ".csv": read_text,
    ".pts": read_text,
}
