# SPDX-License-Identifier: Apache-2.0
"""Pieces of one pipe are one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.measured_pipe import MeasuredPipe, is_probable, is_shown, joined, lacks_a_side
from tests.unit.detect.pipe_and_wall import PIPE
from tests.unit.detect.silhouette.test_free_space import HALF, seen, tube


def test_a_pipe_found_by_its_lines_and_in_the_cloud_is_one() -> None:
    """As thick as the better measured one; another pipe on its line, too far on, stays one of its own."""

    def piece(low: float, high: float, radius_sigma: float, points: int) -> MeasuredPipe:
        cylinder = Cylinder(np.array([low, 0.0, 0.0]), np.array([high, 0.0, 0.002]), 0.0086 + radius_sigma)
        evidence = CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
        candidate = Candidate(cylinder, radius_sigma, points, evidence)
        return MeasuredPipe(candidate, cylinder, radius_sigma)

    far, short, long = piece(8.0, 9.0, 1e-4, 300), piece(0.0, 0.8, 3e-4, 500), piece(1.0, 3.0, 2e-4, 100)
    found = joined([far, short, long], [])
    assert len(found) == 2
    assert found[0].cylinder is far.cylinder
    assert found[1].cylinder.length > 2.99
    assert found[1].cylinder.radius == long.cylinder.radius
    assert found[1].radius_sigma == long.radius_sigma
    assert found[1].candidate.points == 600
    assert found[1].candidate.cylinder is long.cylinder
    assert joined([], []) == []


def test_pieces_are_one_pipe_where_nothing_is_seen_between_them() -> None:
    def piece(low: float, high: float, radius: float) -> MeasuredPipe:
        cylinder = Cylinder(np.array([low, 0.0, 0.0]), np.array([high, 0.0, 0.0]), radius)
        evidence = CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
        return MeasuredPipe(Candidate(cylinder, 2e-4, 100, evidence), cylinder, 2e-4)

    left, right, thicker = piece(-HALF, -0.1, 0.03), piece(0.1, HALF, 0.03), piece(0.1, HALF, 0.032)
    gap = seen(tube(-HALF, -0.1, 0.03), tube(0.1, HALF, 0.03))
    whole = seen(tube(-HALF, HALF, 0.03))
    assert len(joined([left, right], whole)) == 1
    assert len(joined([left, right], gap)) == 2
    assert len(joined([left, thicker], whole)) == 2


def test_ends_that_are_expected_beyond_each_other_are_of_one_pipe() -> None:
    """Two pieces on either side of what hides the rest.

    A gap that is left between them was judged before, unless it is shorter than what the views can see through.
    """
    for gap, count in ((-0.2, 1), (-0.01, 1), (0.02, 1), (0.04, 2), (0.2, 2)):
        assert len(joined(in_line(gap, 0.003, 0.0365, 0.0365), [], overlapping=True)) == count
    assert len(joined(in_line(-0.2, 0.003, 0.0365, 0.0575), [], overlapping=True)) == 2
    assert len(joined(in_line(-0.2, 0.03, 0.0365, 0.0365), [], overlapping=True)) == 2
    [whole] = joined(in_line(-0.2, 0.0, 0.0365, 0.0365), [], overlapping=True)
    assert abs(whole.cylinder.length - 2.0 * HALF) < 1e-9
    np.testing.assert_array_equal(whole.candidate.cylinder.row, whole.cylinder.row)  # the cloud resolves both pieces


def in_line(gap: float, offset: float, first: float, second: float) -> list[MeasuredPipe]:
    """Two pipes along x with a gap [m] about 0, the second one `offset` [m] higher, of two radii [m]."""

    def measured(low: float, high: float, height: float, radius: float) -> MeasuredPipe:
        cylinder = Cylinder(np.array([low, 0.0, height]), np.array([high, 0.0, height]), radius)
        evidence = CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
        return MeasuredPipe(Candidate(cylinder, 2e-4, 100, evidence), cylinder, 2e-4)

    return [measured(-HALF, -0.5 * gap, 0.0, first), measured(0.5 * gap, HALF, offset, second)]


SIZES = st.sampled_from([0.0365, 0.0575, 0.0841, 0.1095, 0.1223])


@given(gap=st.floats(0.02, 0.5), offset=st.floats(0.0, 0.04), first=SIZES, second=SIZES)
@settings(max_examples=50, deadline=None)
def test_pipes_in_line_of_two_radii_or_two_axes_are_two(gap: float, offset: float, first: float, second: float) -> None:
    """Whatever hides the gap between them: an axis leaves the other one by a quarter of the radius and 4 mm."""
    assume(first != second or offset > 0.25 * first + 4e-3)
    assert len(joined(in_line(gap, offset, first, second), [])) == 2


def with_contour(measured: MeasuredPipe, sideways: float, away: float, turned: float) -> MeasuredPipe:
    """A pipe along x whose contour is known to these standard deviations [m, m, rad], as seen along y."""
    covariance = np.diag([sideways, away, turned, turned, 2e-4]) ** 2
    across = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    fit = ContourFit(measured.cylinder, across, covariance, 2e-4, 0.9, 100.0, 20, (0.0, 0.0), 0.0, 0.5)
    return replace(measured, fit=fit)


@given(gap=st.floats(0.05, 0.3), offset=st.floats(0.0, 0.02), size=st.sampled_from([0.0841, 0.1095, 0.1223]))
@settings(max_examples=50, deadline=None)
def test_contours_tell_axes_apart_by_their_own_evidence(gap: float, offset: float, size: float) -> None:
    """Axes that an eye takes for one are two where the contours know them; a distance that they do not is nothing."""
    pieces = in_line(gap, offset, size, size)
    known = [with_contour(piece, 3e-4, 5e-3, 1e-4) for piece in pieces]
    sigma = np.hypot(np.hypot(3e-4, 1e-4 * 0.5 * HALF) * np.sqrt(2.0), 0.0015 * 2.0 * HALF * 2.0 / 9.0)
    assume(not 3.5 * sigma < offset < 4.5 * sigma)
    assert len(joined(known, [])) == (1 if offset < 4.0 * sigma else 2)
    vague = [with_contour(piece, 5e-3, 3e-4, 1e-4) for piece in pieces]
    assert len(joined(vague, [])) == 1
    assert len(joined(pieces, [])) == 1, "the cloud alone tells an axis to a quarter of the radius"


@given(gap=st.floats(0.1, 0.5), radius=st.sampled_from([0.0365, 0.0575]))
@settings(max_examples=5, deadline=None)
def test_a_gap_of_one_radius_parts_what_the_views_see_through(gap: float, radius: float) -> None:
    pieces = in_line(gap, 0.0, radius, radius)
    tubes = [tube(-HALF, -0.5 * gap, radius), tube(0.5 * gap, HALF, radius)]
    assert len(joined(pieces, seen(*tubes))) == 2
    assert len(joined(pieces, seen(*tubes)[:2])) == 1, "two views are too few"


@given(gap=st.floats(0.05, 0.29))
@settings(max_examples=4, deadline=None)
def test_pieces_beside_what_hides_the_gap_are_one(gap: float) -> None:
    before = np.random.default_rng(0).uniform([-0.3, -0.25, -0.3], [0.3, -0.2, 0.3], (60_000, 3))
    tubes = [tube(-HALF, -0.5 * gap, 0.0365), tube(0.5 * gap, HALF, 0.0365)]
    assert len(joined(in_line(gap, 0.0, 0.0365, 0.0365), seen(*tubes, before))) == 1


def test_edges_make_a_pipe_probable_unless_they_are_anothers(pipe_views: list[View], empty_views: list[View]) -> None:
    assert is_probable(PIPE, pipe_views, [])
    assert not is_probable(PIPE, empty_views, [])
    assert not is_probable(PIPE, pipe_views, [PIPE])


def test_a_pipe_that_others_hide_wherever_it_was_seen_is_not_shown(
    pipe_views: list[View], empty_views: list[View]
) -> None:
    before = replace(PIPE.shifted(np.array([0.0, -0.15, 0.0])), radius=0.2)
    assert is_shown(PIPE, pipe_views, [])
    assert not is_shown(PIPE, pipe_views, [before])
    assert not is_shown(PIPE, empty_views, [])


@pytest.mark.parametrize(
    ("aside", "is_hidden", "lacks"), [(0.0, False, False), (0.02, False, True), (0.02, True, False)]
)
def test_a_side_without_edges_is_lacking_unless_it_is_hidden(
    pipe_views: list[View], aside: float, is_hidden: bool, lacks: bool
) -> None:
    """A cylinder that is wider than the pipe to one side, by twice `aside` [m], has the pipe's edge on the other."""
    wider = replace(PIPE.shifted(np.array([-aside, 0.0, 0.0])), radius=PIPE.radius + aside)
    start, end = wider.at(np.array([-0.5, 1.5])) - [wider.radius, 0.1, 0.0]
    beside = Cylinder(start, end, 0.03)
    assert lacks_a_side(wider, pipe_views, [beside] if is_hidden else []) == lacks
