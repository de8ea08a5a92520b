# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pipeprog_bringup.results import result_files
from pipeprog_bringup.results.cloud_io import write_ply
from pipeprog_bringup.results.results_reader import read_results
from pipeprog_camera.errors import InputError
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Cylinder, Pipe

PIPE = Pipe("p01", Cylinder(np.array([0.1, 0.2, 0.0]), np.array([0.1, 0.2, 1.5]), 0.0365), 2e-4, "DN65", 1, 2, 1e-3, 9)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    progress = [ClassProgress("DN65", 0.0365, 3.0, 1.5, 50.0)]
    result_files.write_pipes(tmp_path / "pipes.json", Product([PIPE], progress, []), result_files.Scale("board", 4e-4))
    result_files.write_trajectory(tmp_path / "trajectory.tum", [5], np.array([[1.0, 2, 3]]), np.array([[0, 0, 0, 1.0]]))
    rows = [result_files.FrameRow(5, True, "first frame", registered=True), result_files.FrameRow(6, False, "same")]
    result_files.write_frames(tmp_path / "frames.csv", rows)
    result_files.write_config(tmp_path / "config.yaml", {"boq": [{"name": "DN65", "color": "#0000ff"}]})
    write_ply(tmp_path / "cloud.ply", np.array([[0.5, 0.25, 0.125]]))
    return tmp_path


def test_reads_what_the_writers_wrote(folder: Path) -> None:
    results = read_results(str(folder))
    assert results.pipes[0]["class"] == "DN65"
    np.testing.assert_array_equal(results.cylinders[0].end, PIPE.cylinder.end)
    assert results.classes[0]["percent"] == 50.0
    assert results.scale == {"source": "board", "sigma": 4e-4}
    assert results.stamps.tolist() == [5]
    np.testing.assert_array_equal(results.map_from_camera[0, :3, 3], [1, 2, 3])
    np.testing.assert_array_equal(results.points, [[0.5, 0.25, 0.125]])
    assert results.colors == {"DN65": (0.0, 0.0, 1.0)}


def test_cells_of_frames_csv_are_values(folder: Path) -> None:
    first, second = read_results(folder).frames
    assert (first["stamp"], first["chosen"], first["registered"]) == (5, True, True)
    assert second["reason"] == "same"
    assert second["registered"] is None
    assert second["overlap_n"] is None


def test_pipes_json_alone_will_do(folder: Path) -> None:
    for path in folder.iterdir():
        if path.name != "pipes.json":
            path.unlink()
    results = read_results(folder)
    assert (results.frames, results.facts, results.config, results.cloud) == ([], {}, {}, None)
    assert results.points.shape == (0, 3)
    assert results.map_from_camera.shape == (0, 4, 4)
    assert len(results.colors["DN65"]) == 3


@pytest.mark.parametrize(("content", "complaint"), [("{", "not JSON"), (json.dumps({"pipes": [{}]}), "no pipes.json")])
def test_a_damaged_file_is_named(folder: Path, content: str, complaint: str) -> None:
    (folder / "pipes.json").write_text(content)
    with pytest.raises(InputError, match=complaint):
        read_results(folder)


def test_a_damaged_frames_csv_is_named(folder: Path) -> None:
    (folder / "frames.csv").write_text("stamp,chosen\nnow,1\n")
    with pytest.raises(InputError, match=r"frames\.csv"):
        _ = read_results(folder).frames
