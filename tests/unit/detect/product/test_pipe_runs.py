# SPDX-License-Identifier: Apache-2.0
"""Runs of pipes: what fittings connect, and the length of the centre line through them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeprog_detect.product.pipe_runs import find_joints, pipe_runs, with_fittings
from pipeprog_detect.types import Cylinder, Pipe, PipeEnd
from sitegen.field import build_field
from sitegen.primitives import Kind


def cylinder(start: tuple[float, float, float], end: tuple[float, float, float], radius: float = 0.05) -> Cylinder:
    return Cylinder(np.array(start), np.array(end), radius)


def pipes(*cylinders: Cylinder) -> list[Pipe]:
    """Pipes a, b, ... of these cylinders."""
    return [
        Pipe(name, cylinder, 1e-4, None, 0.0, 3.0, 1e-3, 100)
        for name, cylinder in zip("abcdefgh"[: len(cylinders)], cylinders, strict=True)
    ]


BEND = 0.15
ALONG = cylinder((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
UP = cylinder((1.0 + BEND, BEND, 0.0), (1.0 + BEND, 0.9, 0.0))


def test_an_elbow_joins_two_pipes_and_its_arc_counts() -> None:
    (run,) = pipe_runs(pipes(ALONG, UP))
    assert (run.id, run.pipes) == ("r01", ("a", "b"))
    assert [(joint.kind, joint.pipes) for joint in run.joints] == [("elbow", ("a", "b"))]
    assert run.barrel == pytest.approx(1.0 + 0.9 - BEND)
    assert run.centre_line == pytest.approx(run.barrel + 0.5 * np.pi * BEND)


@given(turn=st.floats(0.2, 2.2), bend=st.floats(2.0, 9.0), spin=st.floats(0.0, 6.2))
def test_elbows_of_any_turn(turn: float, bend: float, spin: float) -> None:
    radius = 0.03
    tangent = bend * radius * np.tan(0.5 * turn)
    aside = np.array([0.0, np.cos(spin), np.sin(spin)])
    out = np.cos(turn) * np.array([1.0, 0.0, 0.0]) + np.sin(turn) * aside
    corner = np.array([1.0 + tangent, 0.0, 0.0])
    joined = [
        Cylinder(np.zeros(3), np.array([1.0, 0.0, 0.0]), radius),
        Cylinder(corner + tangent * out, corner + (tangent + 0.5) * out, radius),
    ]
    (run,) = pipe_runs(pipes(*joined))
    assert run.centre_line == pytest.approx(1.5 + bend * radius * turn, rel=1e-6)
    turned = [Cylinder(pipe.end, pipe.start, pipe.radius) for pipe in reversed(joined)]
    assert pipe_runs(pipes(*turned))[0].centre_line == pytest.approx(run.centre_line)


@given(into=st.floats(0.0, 0.03), hand=st.sampled_from([(0, 1), (1, 0)]), turned=st.booleans())
def test_the_end_that_lies_in_the_bend_is_where_the_other_leg_begins(
    into: float, hand: tuple[int, int], turned: bool
) -> None:
    """Up to 35 mm of a bend on a pipe of 50 mm do not show in its contour."""
    far = cylinder((0.0, 0.0, 0.0), (1.0 + into * hand[0], 0.0, 0.0))
    up = cylinder((1.0 + BEND, BEND - into * hand[1], 0.0), (1.0 + BEND, 0.9, 0.0))
    if turned:
        far = Cylinder(far.end, far.start, far.radius)
    measured = pipes(far, up)
    runs = pipe_runs(measured)
    first, second = with_fittings(measured, runs)
    assert first.cylinder.length == pytest.approx(1.0)
    assert second.cylinder.length == pytest.approx(0.9 - BEND)
    assert runs[0].barrel == pytest.approx(first.cylinder.length + second.cylinder.length)
    assert runs[0].centre_line == pytest.approx(1.0 + 0.9 - BEND + 0.5 * np.pi * BEND)
    assert first.ends[0 if turned else 1].state == second.ends[0].state == "fitting"


@pytest.mark.parametrize(("missing", "sigma"), [(0.06, 0.002), (0.02, 0.03)])
def test_a_leg_with_a_hidden_end_does_not_shorten_the_other(missing: float, sigma: float) -> None:
    """An end that something hides lies before the elbow: no bend makes legs so unequal, or its sigma says so."""
    short = cylinder((0.0, 0.0, 0.0), (1.0 - missing, 0.0, 0.0))
    first, second = pipes(short, UP)
    measured = [replace(first, ends=(PipeEnd(), PipeEnd(sigma))), second]
    fitted = with_fittings(measured, pipe_runs(measured))
    assert [each.cylinder.length for each in fitted] == pytest.approx([1.0 - missing, 0.9 - BEND])


def test_a_tee_and_a_reducer() -> None:
    branch = cylinder((0.5, 0.06, 0.0), (0.5, 0.6, 0.0), 0.03)
    thinner = cylinder((1.1, 0.0, 0.0), (1.9, 0.0, 0.0), 0.03)
    (run,) = pipe_runs(pipes(ALONG, branch, thinner))
    assert [(joint.kind, joint.pipes) for joint in run.joints] == [("reducer", ("a", "c")), ("tee", ("b", "a"))]
    assert run.barrel == pytest.approx(1.0 + 0.54 + 0.8)
    assert run.centre_line == pytest.approx(run.barrel + 0.1 + 0.06)


@pytest.mark.parametrize(
    "other",
    [
        cylinder((0.0, 0.3, 0.0), (1.0, 0.3, 0.0)),  # beside it
        cylinder((1.15, 0.15, 0.06), (1.15, 0.9, 0.06)),  # passes it
        cylinder((0.5, 0.3, 0.0), (0.5, 0.9, 0.0)),  # ends well before it
        cylinder((0.5, -0.5, 0.11), (0.5, 0.5, 0.11)),  # crosses it
        cylinder((1.15, 0.15, 0.0), (1.15, 0.9, 0.0), 0.02),  # an elbow does not change the size
        cylinder((1.9, 0.9, 0.0), (1.9, 1.9, 0.0)),  # too far for a bend
        cylinder((2.5, 0.0, 0.0), (3.5, 0.0, 0.0)),  # on its line, but what is between is not known
        cylinder((1.254, 0.0, 0.0), (2.5, 0.0, 0.0)),  # no coupling of DN80 has 254 mm
        cylinder((1.3, 0.0, 0.0), (2.5, 0.0, 0.0), 0.07),  # nor has a reducer to it 300 mm
        cylinder((1.05, 0.0, 0.0), (2.5, 0.0, 0.0), 0.0086),  # no reducer goes from DN80 to copper of 17 mm
        cylinder((1.02, 0.0, 0.0), (2.5, 0.0, 0.0), 0.12),  # a cone of 70 mm of radius on 20 mm of length
        cylinder((0.5, 0.2, 0.0), (0.5, 0.9, 0.0), 0.03),  # a tee of DN80 has 86 mm
        cylinder((0.6, 0.08, 0.0), (1.2, 0.434, 0.0), 0.03),  # no tee leaves at 30 degrees
    ],
)
def test_pipes_that_are_not_connected(other: Cylinder) -> None:
    assert find_joints(pipes(ALONG, other)) == []
    assert [(run.id, run.pipes) for run in pipe_runs(pipes(ALONG, other))] == [("r01", ("a",)), ("r02", ("b",))]


def test_an_end_has_one_fitting() -> None:
    other = cylinder((1.0 + BEND, -BEND, 0.0), (1.0 + BEND, -0.9, 0.001))
    assert len([joint for joint in find_joints(pipes(ALONG, UP, other)) if "a" in joint.pipes]) == 1


def test_runs_are_in_the_order_of_their_first_pipes() -> None:
    beyond = cylinder((1.0 + 2 * BEND, 0.9 + BEND, 0.0), (2.5, 0.9 + BEND, 0.0))
    alone = cylinder((0.0, 3.0, 0.0), (1.0, 3.0, 0.0))
    runs = pipe_runs(pipes(beyond, alone, ALONG, UP))
    assert [run.pipes for run in runs] == [("a", "c", "d"), ("b",)]
    assert [joint.pipes for joint in runs[0].joints] == [("a", "d"), ("c", "d")]


def in_a_field(seed: int) -> tuple[list[Pipe], set[tuple[int, ...]]]:
    """The true pipes of a generated field, ends and radii off as if measured, and which of them elbows join."""
    rng = np.random.default_rng(seed)
    site = build_field(rng, 1.0, 0.0, 2.0)
    measured = []
    for number, true in enumerate(site.pipes):
        axis = (true.end - true.start) / true.length
        # 5 mm along the axis, 1 mm across it at each end.
        start, end = (place + rng.normal(0, 1e-3, 3) + rng.normal(0, 5e-3) * axis for place in (true.start, true.end))
        radius = true.radius + rng.normal(0, 2e-4)
        measured.append(Pipe(f"p{number:02d}", Cylinder(start, end, radius), 2e-4, None, 0.0, 3.0, 1e-3, 100))
    corners = [
        tuple(
            number
            for number, pipe in enumerate(site.pipes)
            if pipe.radius == elbow.size[1]
            and min(np.linalg.norm(elbow.origin - place) for place in (pipe.start, pipe.end)) < 1.01 * elbow.size[0]
        )
        for elbow in site.primitives
        if elbow.kind == Kind.ELBOW
    ]
    return measured, set(corners)


def test_a_generated_field_has_elbows_alone_and_all_of_them() -> None:
    measured, elbows = in_a_field(6)  # where two that do not belong together were joined
    joints = find_joints(measured)
    assert {joint.kind for joint in joints} <= {"elbow"}
    assert {tuple(sorted(int(name[1:]) for name in joint.pipes)) for joint in joints} == elbows
    assert all(joint.miss < 0.01 for joint in joints)


def test_no_pipes_no_runs() -> None:
    assert pipe_runs([]) == []
