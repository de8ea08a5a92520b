# SPDX-License-Identifier: Apache-2.0
"""Planned pipes against measured ones: what was moved and what is missing is told, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.product.boq import PlannedPipe
from pipeprog_detect.product.installed_where_planned import FoundPipe, PlannedState, installed_where_planned
from pipeprog_detect.types import Cylinder

RADII = {"DN50": 0.03015, "DN65": 0.03805, "DN100": 0.05715}
SPACING = 0.2  # m between pipes of a bundle


def pipe(name: str, start: FloatArray, end: FloatArray, kind: str = "DN50") -> PlannedPipe:
    return PlannedPipe(name, name, Cylinder(start, end, RADII[kind]), kind, 0)


def found(name: str, place: Cylinder, kind: str = "DN50") -> FoundPipe:
    return FoundPipe(name, place, kind)


def site() -> list[PlannedPipe]:
    """58 segments: bundles along a wall and under a ceiling, in line behind each other, and risers."""
    pipes = []
    for level in range(4):
        for bay in range(8):
            start = np.array([3.0 * bay, 0.1, 2.0 + SPACING * level])
            pipes.append(pipe(f"w{level}.{bay}", start, start + np.array([2.9, 0, 0]), list(RADII)[level % 3]))
    for row in range(4):
        for bay in range(4):
            start = np.array([1.0 + SPACING * row, 0.5 + 2.5 * bay, 3.5])
            pipes.append(pipe(f"c{row}.{bay}", start, start + np.array([0, 2.4, 0.02]), list(RADII)[row % 3]))
    for number in range(10):
        start = np.array([2.0 * number + 0.4, 0.3, 0.1])
        pipes.append(pipe(f"r{number}", start, start + np.array([0, 0, 1.7]), list(RADII)[number % 3]))
    return pipes


def across(axis: FloatArray, rng: np.random.Generator) -> FloatArray:
    """A unit vector across an axis."""
    vector = rng.normal(size=3)
    vector -= (vector @ axis) * axis
    return np.asarray(vector / np.linalg.norm(vector))


def survey(
    planned: list[PlannedPipe], rng: np.random.Generator
) -> tuple[list[FoundPipe], dict[str, FloatArray], set[str]]:
    """Measured pipes: barrels shortened by fittings, some hidden at one end or parted; 10 moved, 6 missing."""
    chosen = rng.permutation(len(planned))
    moved = {planned[k].id: rng.uniform(0.03, 0.08) * across(planned[k].cylinder.axis, rng) for k in chosen[:10]}
    missing = {planned[k].id for k in chosen[10:16]}
    measured = []
    for one in planned:
        if one.id in missing:
            continue
        place = one.cylinder.shifted(moved.get(one.id, np.zeros(3)))
        low, high = rng.uniform(0.02, 0.1), place.length - rng.uniform(0.02, 0.1)
        high -= rng.choice([0.0, 0.4 * place.length], p=[0.8, 0.2])
        cuts = [(low, high)] if rng.random() < 0.7 else [(low, 0.45 * high), (0.55 * high, high)]
        for number, (first, last) in enumerate(cuts):
            part = place.cut(first, last)
            noisy = Cylinder(part.start + rng.normal(0, 0.002, 3), part.end + rng.normal(0, 0.002, 3), part.radius)
            if rng.random() < 0.5:
                noisy = Cylinder(noisy.end, noisy.start, noisy.radius)
            kind = one.class_name if rng.random() < 0.9 else ""
            measured.append(FoundPipe(f"{one.id}.{number}", noisy, kind))
    return [measured[k] for k in rng.permutation(len(measured))], moved, missing


@pytest.mark.parametrize("seed", range(20))
def test_of_58_segments_10_moved_and_6_missing_all_16_are_told_and_none_else(seed: int) -> None:
    planned = site()
    assert len(planned) == 58
    measured, moved, missing = survey(planned, np.random.default_rng(seed))
    states = {state.planned.id: state for state in installed_where_planned(planned, measured)}
    assert {name for name, state in states.items() if state.state == "moved"} == set(moved)
    assert {name for name, state in states.items() if state.state == "not found"} == missing
    for name, by in moved.items():
        assert states[name].across == pytest.approx(float(np.linalg.norm(by)), abs=0.012)
    for state in states.values():
        assert all(name.rpartition(".")[0] == state.planned.id for name in state.found)
        assert state.length <= state.planned.cylinder.length


def joined(built: list[PlannedPipe], rng: np.random.Generator) -> list[FoundPipe]:
    """Measured pipes: two bays in line along the wall as one where both are there, ends up to 80 mm short."""
    parts: dict[str, list[PlannedPipe]] = {}
    for one in built:
        row, _, bay = one.id.partition(".")
        parts.setdefault(f"{row}.{int(bay) // 2}" if row.startswith("w") else one.id, []).append(one)
    measured = []
    for name, (first, *others) in parts.items():
        last = others[-1] if others else first
        start = first.cylinder.start + rng.uniform(0.0, 0.08) * first.cylinder.axis + rng.normal(0, 0.002, 3)
        end = last.cylinder.end - rng.uniform(0.0, 0.08) * last.cylinder.axis + rng.normal(0, 0.002, 3)
        measured.append(FoundPipe(name, Cylinder(start, end, first.cylinder.radius), first.class_name))
    return measured


@pytest.mark.parametrize("seed", range(20))
def test_pipes_in_line_that_are_measured_as_one_are_not_told_as_moved(seed: int) -> None:
    rng = np.random.default_rng(seed)
    as_built, order = site(), rng.permutation(58)
    moved, missing = ({as_built[k].id for k in some} for some in (order[:10], order[10:16]))
    planned = [
        replace(one, cylinder=one.cylinder.shifted(rng.uniform(0.03, 0.08) * across(one.cylinder.axis, rng)))
        if one.id in moved
        else one
        for one in as_built
    ]
    measured = joined([one for one in as_built if one.id not in missing], rng)
    assert len(measured) < 52  # some are two bays
    states = installed_where_planned(planned, measured)
    assert {state.planned.id for state in states if state.state == "moved"} == moved
    assert {state.planned.id for state in states if state.state == "not found"} == missing


def only(planned: PlannedPipe, *measured: FoundPipe) -> PlannedState:
    (state,) = installed_where_planned([planned], measured)
    return state


ONE = pipe("one", np.array([0.0, 0, 0]), np.array([2.0, 0, 0]))


def test_a_pipe_shifted_along_its_axis_is_told_and_one_hidden_at_an_end_is_not() -> None:
    shifted = only(ONE, found("p01", ONE.cylinder.cut(0.05, 2.05)))
    assert (shifted.state, shifted.along) == ("moved", pytest.approx(0.05))
    assert only(ONE, found("p01", ONE.cylinder.cut(0.05, 1.2))).state == "installed"
    assert only(ONE, found("p01", ONE.cylinder.cut(-1.0, 3.2))).state == "installed"


def test_one_measured_pipe_may_be_two_planned_ones() -> None:
    next_one = pipe("next", np.array([2.1, 0, 0]), np.array([4.0, 0, 0]))
    states = installed_where_planned(
        [ONE, next_one], [found("p01", Cylinder(np.zeros(3), np.array([4.0, 0, 0]), 0.03))]
    )
    assert [(state.state, state.length) for state in states] == [
        ("installed", pytest.approx(2.0)),
        ("installed", pytest.approx(1.9)),
    ]


def test_another_size_or_direction_or_place_is_not_the_planned_pipe() -> None:
    assert only(ONE, found("p01", ONE.cylinder, "DN65")).state == "not found"
    assert only(ONE, FoundPipe("p01", replace(ONE.cylinder, radius=0.0381), "")).state == "not found"
    assert only(ONE, FoundPipe("p01", replace(ONE.cylinder, radius=0.0305), "")).state == "installed"
    turned = Cylinder(np.zeros(3), np.array([1.9, 0.3, 0]), 0.03015)
    assert only(ONE, found("p01", turned)).state == "not found"
    assert only(ONE, found("p01", ONE.cylinder.shifted(np.array([0, 0.3, 0])))).state == "not found"


def test_a_moved_pipe_beside_a_missing_one_is_not_taken_for_it() -> None:
    other = pipe("other", np.array([0, SPACING, 0]), np.array([2.0, SPACING, 0]))
    states = installed_where_planned([ONE, other], [found("p01", ONE.cylinder.shifted(np.array([0, 0.08, 0])))])
    assert [state.state for state in states] == ["moved", "not found"]
