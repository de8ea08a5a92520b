# SPDX-License-Identifier: Apache-2.0
"""Results of a small survey to export: three pipes of two classes, one of which has no class."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeprog_bringup.results import result_files
from pipeprog_bringup.results.cloud_io import write_ply
from pipeprog_detect.product.boq import load_boq
from pipeprog_detect.product.classification import progress
from pipeprog_detect.product.pipe_runs import pipe_runs
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Cylinder, Pipe

BOQ = """
classes:
  - {name: =DN65, outer_radius_mm: 36.5, planned_length_m: 3.2, color: '#0000ff', system: water, activity: A1010}
  - {name: heating DN40, outer_radius_mm: 24.15, planned_length_m: 2, system: heating, activity: A1020}
  - {name: sprinkler DN40, outer_radius_mm: 24.15, planned_length_m: 1.5, system: sprinkler, activity: A1030}
"""
BOTH = "heating DN40 + sprinkler DN40"
PIPES = [
    Pipe("p01", Cylinder(np.array([0.1, 0.2, 0.0]), np.array([0.1, 0.2, 1.906]), 0.0365), 2e-4, "=DN65", 1, 2, 1e-3, 9),
    Pipe("p02", Cylinder(np.array([0.5, -0.2, 1.0]), np.array([1.7, 0.5, 1.0]), 0.02), 2e-4, None, 0, 2, 1e-3, 9),
    Pipe("p03", Cylinder(np.array([-1.25, 0, 0.3]), np.array([0.0, 0, 0.3]), 0.0241), 2e-4, BOTH, 1, 2, 1e-3, 9),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A results folder."""
    folder = tmp_path / "results"
    folder.mkdir()
    (tmp_path / "boq.yaml").write_text(BOQ)
    boq = load_boq(tmp_path / "boq.yaml")
    product = Product(PIPES, progress(PIPES, boq), pipe_runs(PIPES))
    result_files.write_pipes(folder / "pipes.json", product, result_files.Scale("board", 4e-4))
    result_files.write_config(folder / "config.yaml", {"boq": result_files.boq_entries(boq)})
    (folder / "run.json").write_text(
        '{"command": "replay", "bag": "/data/site.mcap", "finished": "2026-03-02T10:00:00+00:00"}'
    )
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    write_ply(folder / "cloud.ply", points, np.full((500, 3), 190, np.uint8))
    return folder
