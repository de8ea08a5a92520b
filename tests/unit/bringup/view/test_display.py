# SPDX-License-Identifier: Apache-2.0
"""`pipeprog view` as its users meet it: a process that writes a file, or says why it cannot."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from pipeprog_bringup.results import result_files
from pipeprog_bringup.results.cloud_io import write_ply
from pipeprog_bringup.results.results_reader import UNPLANNED
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Cylinder, Pipe

needs_open3d = pytest.mark.skipif(find_spec("open3d") is None, reason="Open3D is not installed: make setup VIEW=1")
BLUE = (0.0, 0.0, 1.0)
PIPES = [
    Pipe("p01", Cylinder(np.array([0.1, 0.2, 0.0]), np.array([0.1, 0.2, 1.5]), 0.0365), 2e-4, "DN65", 1, 2, 1e-3, 9),
    Pipe("p02", Cylinder(np.array([0.5, 0.2, 1.0]), np.array([1.7, 0.5, 1.0]), 0.02), 2e-4, None, 0, 2, 1e-3, 9),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Results of two pipes before a wall, seen from two places."""
    folder = tmp_path / "results"
    folder.mkdir()
    classes = [ClassProgress("DN65", 0.0365, 3.0, 1.5, 50.0)]
    result_files.write_pipes(folder / "pipes.json", Product(PIPES, classes, []), result_files.Scale("board", 4e-4))
    result_files.write_config(folder / "config.yaml", {"boq": [{"name": "DN65", "color": "#0000ff"}]})
    places, turns = np.array([[0.0, -2, 1], [0.5, -2, 1]]), np.array([[-0.7071, 0, 0, 0.7071]] * 2)
    result_files.write_trajectory(folder / "trajectory.tum", [1, 2], places, turns)
    x, z = np.meshgrid(np.linspace(-1, 2, 300), np.linspace(0, 2, 200))
    wall = np.stack([x, np.full_like(x, 1.0), z], axis=-1).reshape(-1, 3)
    write_ply(folder / "cloud.ply", wall, np.full((len(wall), 3), 190, np.uint8))
    return folder


def view(*arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pipeprog_bringup.cli", "view", *map(str, arguments)]
    without = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    surroundings = {**without, **environment}
    return subprocess.run(command, capture_output=True, text=True, env=surroundings, timeout=200, check=False)


def axis_and_radii(vertices: np.ndarray, cylinder: Cylinder) -> tuple[np.ndarray, np.ndarray]:
    """Places of the vertices along the axis [m], and their distances from it [m]."""
    along = (vertices - cylinder.start) @ cylinder.axis
    return along, np.linalg.norm(vertices - cylinder.start - along[:, None] * cylinder.axis, axis=1)


@needs_open3d
@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_another_reader_finds_lengths_radii_and_colors_in_the_mesh(folder: Path, tmp_path: Path, suffix: str) -> None:
    result = view(folder, "--mesh", tmp_path / f"pipes.{suffix}")
    assert result.returncode == 0, result.stderr
    mesh = trimesh.load(tmp_path / f"pipes.{suffix}", force="mesh", process=False)
    vertices = np.asarray(mesh.vertices)
    if suffix == "glb":
        vertices = vertices[:, [0, 2, 1]] * [1, -1, 1]  # y up to z up
    halves = np.array_split(np.arange(len(vertices)), len(PIPES))
    for rows, pipe, color in zip(halves, PIPES, (BLUE, UNPLANNED), strict=True):
        along, radii = axis_and_radii(vertices[rows], pipe.cylinder)
        np.testing.assert_allclose([along.min(), along.max()], [0, pipe.cylinder.length], atol=1e-5)
        # Besides the rims there are the middles of the two ends.
        np.testing.assert_allclose(radii[radii > 1e-4], pipe.cylinder.radius, atol=1e-5)
        wanted = np.array(color) ** (2.2 if suffix == "glb" else 1.0)
        np.testing.assert_allclose(
            mesh.visual.vertex_colors[rows, :3] / 255, np.tile(wanted, (len(rows), 1)), atol=0.01
        )


@needs_open3d
def test_a_picture_needs_no_display(folder: Path, tmp_path: Path) -> None:
    result = view(folder, "--image", tmp_path / "view.png")
    if result.returncode:
        assert "Open3D cannot draw here" in result.stderr
        pytest.skip(result.stderr)
    image = cv2.cvtColor(cv2.imread(str(tmp_path / "view.png")), cv2.COLOR_BGR2RGB).astype(int)
    assert image.shape == (1000, 1600, 3)
    blue = (image[..., 2] > image[..., 0] + 60) & (image[..., 2] > image[..., 1] + 60)
    # The blue pipe fills most of the height that shows both pipes; how wide it is depends on the side looked from.
    rows = np.flatnonzero(blue.any(axis=1))
    assert np.ptp(rows) > 400


def test_without_a_display_it_says_what_to_do(folder: Path) -> None:
    result = view(folder)
    assert result.returncode == 1
    assert "--image" in result.stderr
    assert "Traceback" not in result.stderr


@needs_open3d
def test_a_display_that_does_not_answer_is_an_error_and_no_crash(folder: Path) -> None:
    result = view(folder, DISPLAY=":4711")
    assert result.returncode == 1
    assert "Open3D cannot draw here" in result.stderr
    assert "Traceback" not in result.stderr


def test_where_open3d_is_missing_it_says_how_to_get_it(folder: Path, tmp_path: Path) -> None:
    # A module of that name that cannot be imported, ahead of the real one.
    (tmp_path / "missing").mkdir()
    (tmp_path / "missing" / "open3d.py").write_text("raise ImportError('libGL.so.1: cannot open shared object file')")
    result = view(folder, "--mesh", tmp_path / "pipes.glb", PYTHONPATH=str(tmp_path / "missing"))
    assert result.returncode == 1
    assert "libGL.so.1" in result.stderr
    assert "pip install open3d-cpu" in result.stderr
    assert "apt-get install" in result.stderr
    assert not (tmp_path / "pipes.glb").exists()


@pytest.mark.parametrize(("option", "name"), [("--image", "view.gif"), ("--mesh", "pipes.stl")])
def test_other_formats_are_refused(folder: Path, tmp_path: Path, option: str, name: str) -> None:
    result = view(folder, option, tmp_path / name)
    assert result.returncode == 1
    assert "is no format" in result.stderr


def test_no_folder_of_results_is_named(tmp_path: Path) -> None:
    result = view(tmp_path / "nowhere")
    assert result.returncode == 1
    assert "no such folder" in result.stderr
