# SPDX-License-Identifier: Apache-2.0
"""docs/pipes.schema.json against what is written, and against what must not be."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from pipeprog_bringup.results import result_files
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.pipe_runs import pipe_runs
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Cylinder, Pipe
from tests.schemas import SCHEMA, faults_of_pipes

UPRIGHT = Pipe(
    "p01", Cylinder(np.zeros(3), np.array([0, 0, 1.0]), 0.05), 3e-4, "DN100", 0.99, 2.6, 1e-3, 20411, "DN100"
)
LYING = replace(UPRIGHT, id="p02", cylinder=Cylinder(np.array([0, 0.1, 1.1]), np.array([0, 1.1, 1.1]), 0.05))
ASIDE = Cylinder(np.array([3.0, 0, 0]), np.array([0, 3.0, 0]), 0.05)
UNSURE = replace(UPRIGHT, id="p03", class_name=None, class_probability=0.6, cylinder=ASIDE)
PIPES = [UPRIGHT, LYING, UNSURE]
CLASSES = [ClassProgress("DN100", 0.05, 24.0, 2.0, 100 * 2 / 24)]


@pytest.fixture
def content(tmp_path: Path) -> Any:
    """A pipes.json with a run of two pipes and an elbow, and a pipe that two classes explain."""
    scale = result_files.Scale("board+odometry", None)
    result_files.write_pipes(tmp_path / "pipes.json", Product(PIPES, CLASSES, pipe_runs(PIPES)), scale)
    return json.loads((tmp_path / "pipes.json").read_text())


def test_the_schema_is_one() -> None:
    Draft202012Validator.check_schema(json.loads(SCHEMA.read_text()))


def test_what_is_written_is_valid(content: Any) -> None:
    assert faults_of_pipes(content) == []
    assert content["runs"][0]["joints"][0]["kind"] == "elbow"
    assert content["pipes"][2]["ambiguous"]


@pytest.mark.parametrize(
    ("spoil", "where"),
    [
        (lambda pipes: pipes.pop("runs"), "$"),
        (lambda pipes: pipes.update(units="mm"), "$"),
        (lambda pipes: pipes["scale"].update(source="guess"), "$.scale.source"),
        (lambda pipes: pipes["pipes"][0].update(radius=-0.05), "$.pipes[0].radius"),
        (lambda pipes: pipes["pipes"][0].update(start=[0, 0]), "$.pipes[0].start"),
        (lambda pipes: pipes["pipes"][0].update(class_probability=1.2), "$.pipes[0].class_probability"),
        (lambda pipes: pipes["pipes"][0].pop("class_kmeans"), "$.pipes[0]"),
        (lambda pipes: pipes["pipes"][0].update(ambiguous=True), "$.pipes[0].class"),
        (lambda pipes: pipes["pipes"][0]["ends"][1].update(state="gone"), "$.pipes[0].ends[1].state"),
        (lambda pipes: pipes["classes"][0].update(installed_m="2.0"), "$.classes[0].installed_m"),
        (lambda pipes: pipes["runs"][0]["joints"][0].update(kind="bend"), "$.runs[0].joints[0].kind"),
    ],
)
def test_what_is_wrong_is_refused(content: Any, spoil: Callable[[Any], object], where: str) -> None:
    hostile = copy.deepcopy(content)
    spoil(hostile)
    assert [fault.split(": ")[0] for fault in faults_of_pipes(hostile)] == [where]
