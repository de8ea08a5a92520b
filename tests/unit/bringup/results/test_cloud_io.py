# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pye57
import pytest
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from pypcd4 import Encoding, PointCloud

from pipeprog_bringup.results.cloud_io import read_cloud, write_las, write_ply
from pipeprog_camera.errors import InputError

RNG = np.random.default_rng(0)
POINTS = RNG.normal(0, 2, (500, 3)).astype(np.float32).astype(float)
UTM = np.array([683_512.25, 5_247_318.5, 412.125])


def normals(count: int) -> NDArray[np.float64]:
    vectors = RNG.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def ply(path: Path, points: NDArray, kind: str = "f4", text: bool = False, order: str = "=") -> Path:
    data = np.empty(len(points), [(axis, kind) for axis in "xyz"] + [("label", "u2")])
    for i, axis in enumerate("xyz"):
        data[axis] = points[:, i]
    PlyData([PlyElement.describe(data, "vertex")], text=text, byte_order=order).write(str(path))
    return path


@pytest.mark.parametrize(
    ("kind", "text", "order"), [("f4", False, "<"), ("f8", False, ">"), ("f8", True, "="), ("f4", True, "=")]
)
def test_ply_of_any_kind(tmp_path: Path, kind: str, text: bool, order: str) -> None:
    file = read_cloud(ply(tmp_path / "cloud.ply", POINTS, kind, text, order))
    np.testing.assert_allclose(file.cloud.points, POINTS, rtol=1e-6)
    assert file.cloud.points.dtype == np.float64
    assert file.cloud.normals is None


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    vectors = normals(len(POINTS))
    colors = RNG.integers(0, 255, (len(POINTS), 3), dtype=np.uint8)
    write_ply(tmp_path / "cloud.ply", POINTS, colors, vectors)
    file = read_cloud(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(file.cloud.points, POINTS)
    assert file.cloud.normals is not None
    np.testing.assert_allclose(file.cloud.normals, vectors, atol=1e-6)
    vertex = PlyData.read(str(tmp_path / "cloud.ply"))["vertex"]
    np.testing.assert_array_equal(np.stack([vertex[name] for name in ("red", "green", "blue")], 1), colors)


def test_las_holds_points_normals_and_colours(tmp_path: Path) -> None:
    vectors = normals(len(POINTS))
    colors = RNG.integers(0, 256, (len(POINTS), 3), dtype=np.uint8)
    write_las(tmp_path / "cloud.las", POINTS, colors, vectors)
    file = read_cloud(tmp_path / "cloud.las")
    np.testing.assert_allclose(file.cloud.points, POINTS, atol=0.5001e-4)
    assert file.cloud.normals is not None
    np.testing.assert_allclose(file.cloud.normals, vectors, atol=1e-6)
    las = laspy.read(tmp_path / "cloud.las")
    np.testing.assert_array_equal(np.stack([las.red, las.green, las.blue], 1) >> 8, colors)
    assert np.max(las.red) <= 65535
    write_las(tmp_path / "again.las", POINTS, colors, vectors)
    assert (tmp_path / "again.las").read_bytes() == (tmp_path / "cloud.las").read_bytes()


def test_e57_scans_come_together_by_their_poses(tmp_path: Path) -> None:
    quarter, offset = np.sqrt([0.5, 0.0, 0.0, 0.5]), np.array([5.0, -2.0, 1.5])  # 90 deg about z
    turned = (POINTS[300:] - offset) @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    file = pye57.E57(str(tmp_path / "cloud.e57"), mode="w")
    for points, pose in ((POINTS[:300], {}), (turned, {"rotation": quarter, "translation": offset})):
        file.write_scan_raw({f"cartesian{axis}": points[:, i].copy() for i, axis in enumerate("XYZ")}, **pose)
    file.close()
    np.testing.assert_allclose(read_cloud(tmp_path / "cloud.e57").cloud.points, POINTS, atol=1e-6)  # written as 32-bit


def test_an_e57_file_without_a_scan_is_an_error(tmp_path: Path) -> None:
    pye57.E57(str(tmp_path / "cloud.e57"), mode="w").close()
    with pytest.raises(InputError, match="no scan"):
        read_cloud(tmp_path / "cloud.e57")


@pytest.mark.parametrize("encoding", list(Encoding))
def test_pcd_of_any_encoding(tmp_path: Path, encoding: Encoding) -> None:
    PointCloud.from_xyzi_points(np.c_[POINTS, np.ones(len(POINTS))]).save(tmp_path / "cloud.pcd", encoding=encoding)
    np.testing.assert_allclose(read_cloud(tmp_path / "cloud.pcd").cloud.points, POINTS, atol=1e-5)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_las_in_utm_keeps_its_numbers(tmp_path: Path, suffix: str) -> None:
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.offsets, header.scales = np.floor(UTM), np.full(3, 1e-4)
    las = laspy.LasData(header)
    las.x, las.y, las.z = (POINTS + UTM).T
    las.write(tmp_path / f"cloud.{suffix}")
    file = read_cloud(tmp_path / f"cloud.{suffix}")
    np.testing.assert_allclose(file.cloud.points, POINTS + UTM, rtol=0, atol=0.6e-4)


def test_far_coordinates_are_kept_exactly(tmp_path: Path) -> None:
    file = read_cloud(ply(tmp_path / "utm.ply", POINTS + UTM, "f8"))
    np.testing.assert_array_equal(file.cloud.points, POINTS + UTM)


@pytest.mark.parametrize(
    ("name", "head", "separator"),
    [
        ("cloud.xyz", "", " "),
        ("cloud.csv", "x,y,z,intensity\n", ","),
        ("cloud.txt", "# made by a scanner\n\n//X;Y;Z\n", ";"),
        ("cloud.pts", "500\n", "\t"),
        ("cloud.xyz", "# plain comment\n", "  "),
    ],
)
def test_text_of_any_dialect(tmp_path: Path, name: str, head: str, separator: str) -> None:
    rows = "\n".join(separator.join([*(f"{value:.6f}" for value in point), "7"]) for point in POINTS)
    (tmp_path / name).write_text(head + rows + "\n")
    np.testing.assert_allclose(read_cloud(tmp_path / name).cloud.points, POINTS, atol=1e-6)


def test_columns_are_found_by_their_names(tmp_path: Path) -> None:
    rows = "\n".join(f"{i},0,0,1,{x},{y},{z}" for i, (x, y, z) in enumerate(POINTS))
    (tmp_path / "cloud.csv").write_text("id,nx,ny,nz,X,Y,Z\n" + rows)
    cloud = read_cloud(tmp_path / "cloud.csv").cloud
    np.testing.assert_allclose(cloud.points, POINTS)
    assert cloud.normals is not None
    np.testing.assert_array_equal(cloud.normals[7], [0, 0, 1])


def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path: Path) -> None:
    spoiled = POINTS.copy()
    spoiled[3, 1] = np.nan
    spoiled[9] = np.inf
    file = read_cloud(ply(tmp_path / "nan.ply", spoiled))
    assert file.dropped == 2
    np.testing.assert_allclose(file.cloud.points, np.delete(POINTS, [3, 9], axis=0))


def test_clouds_without_use_are_errors(tmp_path: Path) -> None:
    (tmp_path / "zero.ply").write_bytes(b"")
    (tmp_path / "text.ply").write_text("no ply at all")
    (tmp_path / "words.xyz").write_text("there are no numbers\n")
    (tmp_path / "broken.xyz").write_text("1.5 2.5 3.5\n1.5 oops 3.5\n")
    (tmp_path / "cloud.obj").write_text("v 0 0 0")
    whole = ply(tmp_path / "cut.ply", POINTS).read_bytes()
    (tmp_path / "cut.ply").write_bytes(whole[: len(whole) // 2])
    ply(tmp_path / "none.ply", POINTS[:0])
    ply(tmp_path / "nan.ply", np.full((3, 3), np.nan))
    ply(tmp_path / "whole.ply", np.round(POINTS * 1000), "i4")
    ply(tmp_path / "coarse.ply", POINTS + UTM, "f4")
    (tmp_path / "bad.las").write_bytes(b"LASF" + bytes(50))
    (tmp_path / "bad.pcd").write_text("VERSION .7\nFIELDS x\n")
    cases = {
        "absent.ply": "no such cloud",
        "zero.ply": "is empty",
        "text.ply": "is no PLY",
        "cut.ply": "cut off",
        "words.xyz": "no list of points",
        "broken.xyz": "cannot be read as .xyz",
        "cloud.obj": "no cloud format",
        "none.ply": "no points",
        "nan.ply": "none is finite",
        "whole.ply": "whole number",
        "coarse.ply": "32-bit floats",
        "bad.las": "is no LAS",
        "bad.pcd": "is no PCD",
    }
    for name, expected in cases.items():
        with pytest.raises(InputError, match=expected) as caught:
            read_cloud(tmp_path / name)
        assert name in str(caught.value)
