"""Classes by fixed nominal radii: posterior, rejection, ambiguity, progress."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_detect.bill import Bill, PipeClass
from pipeprog_detect.classify import SURE, classify, progress
from pipeprog_detect.pipe import Cylinder, Pipe


def bill(*radii: float) -> Bill:
    return Bill(tuple(PipeClass(f"{1e3 * r:g}", r, 4.0, (1.0, 0.0, 0.0), max(0.01 * r, 1e-4)) for r in radii))


PAPER = bill(0.0086, 0.0365, 0.0575, 0.0841, 0.1095, 0.1223)


@pytest.mark.parametrize("radius", [0.0086, 0.0365, 0.0575, 0.0841, 0.1095, 0.1223])
def test_a_measured_radius_gets_its_class(radius: float) -> None:
    name, probability = classify(radius + 0.0005, 0.0005, PAPER)
    assert name == f"{1e3 * radius:g}"
    assert probability > SURE


@pytest.mark.parametrize("radius", [0.02, 0.047, 0.07, 0.098, 0.3])
def test_a_radius_between_the_classes_is_none_of_them(radius: float) -> None:
    assert classify(radius, 0.0005, PAPER) == (None, 0.0)


def test_classes_nearer_than_the_sigma_are_ambiguous() -> None:
    name, probability = classify(0.0302, 0.001, bill(0.030, 0.0305))
    assert name is not None
    assert 0.5 < probability < SURE


def test_a_rough_measurement_keeps_a_pipe_that_a_fine_one_rejects() -> None:
    assert classify(0.0345, 0.0001, PAPER)[0] is None
    assert classify(0.0345, 0.001, PAPER)[0] == "36.5"


def test_progress_sums_the_barrels_of_each_class() -> None:
    def pipe(length: float, name: str | None) -> Pipe:
        barrel = Cylinder(np.zeros(3), np.array([0.0, 0.0, length]), 0.03)
        return Pipe("p", barrel, 1e-4, name, 1.0, 2.0, 1e-3, 100)

    table = progress([pipe(1.0, "30"), pipe(0.5, "30"), pipe(9.0, None)], bill(0.03, 0.05))
    assert [(row.name, row.installed, row.percent) for row in table] == [("30", 1.5, 37.5), ("50", 0.0, 0.0)]
