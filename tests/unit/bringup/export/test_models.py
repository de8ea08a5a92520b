# SPDX-License-Identifier: Apache-2.0
"""DXF, GLB, LAZ and COLMAP as second readers have them."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from pipeprog_bringup.export.control_points import Alignment
from pipeprog_bringup.export.formats import export
from pipeprog_bringup.export.survey import Site
from pipeprog_bringup.results.cloud_io import read_cloud
from pipeprog_camera.errors import InputError
from tests.unit.bringup.export.conftest import BOTH, PIPES
from tests.unit.bringup.report.filmed import CAMERA, looking_along_y, run

FAR = np.array([691_234.5, 5_334_567.25, 512.125])
SITE_FROM_MAP = np.eye(4)
SITE_FROM_MAP[:3, 3] = FAR
THERE = Alignment(Site(SITE_FROM_MAP, "EPSG:25832"), np.zeros(4), 1.0)


@pytest.mark.skipif(find_spec("ezdxf") is None, reason="ezdxf is not installed: make setup EXCHANGE=1")
def test_dxf_has_the_axes_on_layers_of_their_classes(folder: Path, tmp_path: Path) -> None:
    import ezdxf

    (path,) = export(folder, ["dxf"], tmp_path / "out", alignment=THERE)
    document = ezdxf.readfile(path)
    assert not document.audit().errors
    assert document.header["$INSUNITS"] == 6
    lines = list(document.modelspace().query("LINE"))
    assert [line.dxf.layer for line in lines] == ["_DN65", "unplanned", BOTH]
    for line, pipe in zip(lines, PIPES, strict=True):
        ends = np.array([line.dxf.start, line.dxf.end]) - FAR
        np.testing.assert_allclose(ends, [pipe.cylinder.start, pipe.cylinder.end], atol=1e-6)
    assert document.layers.get("_DN65").rgb == (0, 0, 255)
    assert [text.dxf.text for text in document.modelspace().query("TEXT")] == ["p01", "p02", "p03"]


def test_without_ezdxf_it_says_how_to_get_it(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ezdxf", None)
    with pytest.raises(InputError, match="pip install ezdxf=="):
        export(folder, ["dxf"], tmp_path / "out")


@pytest.mark.parametrize("alignment", [None, THERE])
def test_glb_has_a_closed_cylinder_for_each_pipe(folder: Path, tmp_path: Path, alignment: Alignment | None) -> None:
    (path,) = export(folder, ["glb"], tmp_path / "out", alignment=alignment)
    scene = trimesh.load(path)
    origin = np.zeros(3) if alignment is None else np.round(FAR, -2)
    y_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    for pipe in PIPES:
        matrix, name = scene.graph.get(pipe.id)
        mesh = scene.geometry[name].copy()
        mesh.merge_vertices(merge_norm=True)
        assert mesh.is_watertight
        assert mesh.volume > 0.0  # the triangles look outward
        vertices = (mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]) @ y_up
        vertices += origin - (np.zeros(3) if alignment is None else FAR)
        along = pipe.cylinder.along(vertices)
        assert (along.min(), along.max()) == pytest.approx((0.0, pipe.cylinder.length), abs=1e-4)
        rims = np.linalg.norm(pipe.cylinder.from_axis(vertices), axis=1)
        assert rims == pytest.approx(np.full(len(rims), pipe.cylinder.radius), abs=1e-4)


def test_laz_has_the_cloud_in_site_coordinates(folder: Path, tmp_path: Path) -> None:
    (path,) = export(folder, ["laz"], tmp_path / "out", alignment=THERE)
    assert path.name == "cloud.laz"
    cloud = read_cloud(path).cloud
    np.testing.assert_allclose(cloud.points, read_cloud(folder / "cloud.ply").cloud.points + FAR, atol=1.1e-4)


def test_what_the_results_lack_is_told(folder: Path, tmp_path: Path) -> None:
    (folder / "cloud.ply").unlink()
    with pytest.raises(InputError, match=r"has no cloud\.ply"):
        export(folder, ["laz"], tmp_path / "out")
    with pytest.raises(InputError, match="has no sparse model"):
        export(folder, ["colmap"], tmp_path / "out")


def test_colmap_has_its_images_without_distortion(tmp_path: Path) -> None:
    folder = run(tmp_path, [looking_along_y(-0.4), looking_along_y(0.3)])
    (folder / "colmap").mkdir()
    for name in ("cameras", "images", "points3D", "frames", "rigs"):
        (folder / "colmap" / f"{name}.bin").write_bytes(name.encode())
    (path,) = export(folder, ["colmap"], tmp_path / "out")
    assert (path / "sparse" / "0" / "points3D.bin").read_bytes() == b"points3D"
    first, second = sorted((path / "images").iterdir())
    assert (first.name, second.name) == ("1700000000000000000.jpg", "1700000000100000000.jpg")
    image = cv2.imread(str(second))
    assert image is not None
    # The upright pipe's axis is straight in it, at the pixel where the ideal camera sees it.
    for v in (130, 240, 350):
        columns = np.flatnonzero(image[v, :, 1] > 170)
        assert columns.mean() == pytest.approx(CAMERA.fx * (0.2 - 0.3) / 2.0 + CAMERA.cx, abs=1.0)


def test_glb_is_the_same_twice(folder: Path, tmp_path: Path) -> None:
    names = ["glb", "laz"] + ["dxf"] * (find_spec("ezdxf") is not None)
    once, again = (export(folder, names, tmp_path / name) for name in ("once", "again"))
    assert [path.read_bytes() for path in once] == [path.read_bytes() for path in again]
