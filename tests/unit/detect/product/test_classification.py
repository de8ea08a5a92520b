# SPDX-License-Identifier: Apache-2.0
"""Classes by fixed nominal radii: posterior, rejection, ambiguity, progress."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.product.classification import (
    SURE,
    Verdict,
    by_kmeans,
    classify,
    named_by_kmeans,
    progress,
    with_kmeans,
)
from pipeprog_detect.types import Cylinder, Pipe


def boq(*radii: float) -> BillOfQuantities:
    return BillOfQuantities(
        tuple(PipeClass(f"{1e3 * r:g}", r, 4.0, (1.0, 0.0, 0.0), max(0.01 * r, 1e-4)) for r in radii)
    )


PAPER = boq(0.0086, 0.0365, 0.0575, 0.0841, 0.1095, 0.1223)


@pytest.mark.parametrize("radius", [0.0086, 0.0365, 0.0575, 0.0841, 0.1095, 0.1223])
def test_a_measured_radius_gets_its_class(radius: float) -> None:
    verdict = classify(radius + 0.0005, 0.0005, PAPER)
    assert verdict.name == f"{1e3 * radius:g}"
    assert verdict.probability > SURE


@pytest.mark.parametrize("radius", [0.02, 0.047, 0.07, 0.098, 0.3])
def test_a_radius_between_the_classes_is_none_of_them(radius: float) -> None:
    assert classify(radius, 0.0005, PAPER) == Verdict(None, 0.0)


def test_classes_nearer_than_the_sigma_are_ambiguous() -> None:
    verdict = classify(0.0302, 0.001, boq(0.030, 0.0305))
    assert verdict.name is None
    assert 0.5 < verdict.probability < SURE
    assert classify(
        0.0300, 0.0001, BillOfQuantities(tuple(replace(each, tolerance=1e-5) for each in boq(0.030, 0.0305).classes))
    ).name


def test_a_rough_measurement_keeps_a_pipe_that_a_fine_one_rejects() -> None:
    assert classify(0.0345, 0.0001, PAPER).name is None
    assert classify(0.0345, 0.001, PAPER).name == "36.5"


def test_kmeans_starts_at_the_planned_radii_and_names_everything() -> None:
    radii = [0.0362, 0.0368, 0.058, 0.0495]
    assert by_kmeans(radii, [0.0365, 0.0575, 0.0841]) == [0, 0, 1, 1]
    assert by_kmeans([], [0.0365]) == []
    # The means have moved to what they gathered: at the nominal radii 0.0505 would be the thicker one's.
    assert by_kmeans([0.045, 0.047, 0.0505, 0.070], [0.040, 0.060]) == [0, 0, 0, 1]


def test_kmeans_leaves_classes_that_are_not_built_empty() -> None:
    """Five planned classes, the second and fifth not built: no pipe of another class is moved into these."""
    radii = [0.0200, 0.0399, 0.0401, 0.0500, 0.0502]
    assert by_kmeans(radii, [0.020, 0.030, 0.040, 0.050, 0.060]) == [0, 2, 2, 3, 3]


RADII = st.lists(st.floats(0.005, 0.2), min_size=1, max_size=20)


@given(radii=RADII, nominal=RADII)
def test_kmeans_converges(radii: list[float], nominal: list[float]) -> None:
    """In the end no pipe is nearer to the mean of another class that has pipes than to that of its own."""
    labels = np.array(by_kmeans(radii, nominal))
    classes, own = np.unique(labels, return_inverse=True)
    means = [np.mean(np.array(radii)[labels == k]) for k in classes]
    gaps = np.abs(np.subtract.outer(radii, means))
    assert gaps[np.arange(len(radii)), own] == pytest.approx(gaps.min(axis=1), abs=1e-9)


def test_kmeans_as_the_classifier() -> None:
    def pipe(radius: float) -> Pipe:
        barrel = Cylinder(np.zeros(3), np.array([0.0, 0.0, 1.0]), radius)
        return Pipe("p", barrel, 1e-4, "none of k-means's", 0.5, 2.0, 1e-3, 100)

    found = with_kmeans([pipe(0.0365), pipe(0.0495)], PAPER)
    assert [each.class_kmeans for each in found] == ["36.5", "57.5"]
    named = named_by_kmeans(found, PAPER)
    assert [each.class_name for each in named] == ["36.5", "57.5"]
    assert named[0].class_probability > 0.99
    assert named[1].class_probability == 0.0, "no class is near"


@pytest.mark.parametrize("diameter_mm", [180, 195, 200, 340, 400])
def test_sewers_are_classed_by_their_bore(diameter_mm: int) -> None:
    sewers = boq(*(0.5e-3 * nominal for nominal in (180, 195, 200, 340, 400)))
    for wall in (1 / 34, 1 / 41):  # EN 1401: SDR 34 and 41
        bore = 0.5e-3 * diameter_mm * (1 - 2 * wall)
        assert classify(bore, 0.0003, sewers, concave=True).name == f"{0.5 * diameter_mm:g}"
    bores = boq(*(0.5e-3 * 0.946 * nominal for nominal in (180, 195, 200, 340, 400)))
    assert classify(0.473e-3 * diameter_mm, 0.0003, bores, concave=True).name == f"{0.473 * diameter_mm:g}"
    assert classify(0.110, 0.0003, sewers, concave=True).name is None


def test_a_wall_thickness_that_the_boq_gives_is_used() -> None:
    thick = BillOfQuantities(tuple(replace(each, wall=0.01) for each in boq(0.1, 0.11).classes))
    assert classify(0.1, 0.0002, thick, concave=True).name == "110"


def test_progress_sums_the_barrels_of_each_class() -> None:
    def pipe(length: float, name: str | None) -> Pipe:
        barrel = Cylinder(np.zeros(3), np.array([0.0, 0.0, length]), 0.03)
        return Pipe("p", barrel, 1e-4, name, 1.0, 2.0, 1e-3, 100)

    table = progress([pipe(1.0, "30"), pipe(0.5, "30"), pipe(9.0, None)], boq(0.03, 0.05))
    assert [(row.name, row.installed, row.percent) for row in table] == [("30", 1.5, 37.5), ("50", 0.0, 0.0)]
