# SPDX-License-Identifier: Apache-2.0
"""Ends that something hides lie where they are expected; those that the views show stay."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.refinement.extension import CERTAIN, LEAST
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.measured_pipe import MeasuredPipe
from pipeprog_detect.verification.open_ends import with_open_ends
from tests.unit.detect.pipe_and_wall import PIPE
from tests.unit.detect.verification.test_wall_ends import cut, floor, height_of_start, hiding

FAR_FLOOR = floor(-3.0)
# Heights [m] between which the pipe is hidden from all views, and its end where it was not followed there.
HIDDEN, KNOWN = (-0.27, -0.05), -0.05


def measured(cylinder: Cylinder, rims: tuple[float, float] = (0.0, 0.0)) -> MeasuredPipe:
    evidence = CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
    return MeasuredPipe(Candidate(cylinder, 2e-4, 100, evidence), cylinder, 2e-4, rims)


def behind(others: list[Cylinder]) -> list[MeasuredPipe]:
    """The upper part of the pipe, and what hides its lower one."""
    return [measured(cut(KNOWN - PIPE.start[2])), *(measured(other, (2.0 * CERTAIN,) * 2) for other in others)]


def test_a_hidden_end_lies_within_what_hides_it(pipe_views: list[View]) -> None:
    pipe, _ = with_open_ends(behind(hiding(*HIDDEN)), FAR_FLOOR, pipe_views)
    assert HIDDEN[0] < height_of_start(pipe.cylinder) < KNOWN - LEAST
    np.testing.assert_allclose(pipe.cylinder.end, PIPE.end)
    assert pipe.rims == (0.0, 0.0)


def test_it_lies_before_the_floor_and_before_another_pipe(pipe_views: list[View]) -> None:
    pipe, _ = with_open_ends(behind(hiding(*HIDDEN)), floor(KNOWN - 0.08), pipe_views)
    assert KNOWN - 0.08 < height_of_start(pipe.cylinder) < KNOWN
    below = Cylinder(PIPE.start - 0.3 * PIPE.axis, PIPE.start + 0.07 * PIPE.axis, PIPE.radius)
    pipe = with_open_ends(behind([*hiding(*HIDDEN), below]), FAR_FLOOR, pipe_views)[0]
    assert below.end[2] - 1e-3 < height_of_start(pipe.cylinder) < KNOWN


def test_an_end_farther_than_a_short_piece_is_looked_ahead_of_is_reached(pipe_views: list[View]) -> None:
    (whole,) = with_open_ends([measured(cut(0.85 * PIPE.length))], FAR_FLOOR, pipe_views)
    assert height_of_start(whole.cylinder) == pytest.approx(PIPE.start[2], abs=0.02)
    np.testing.assert_allclose(whole.cylinder.end, PIPE.end)


@pytest.mark.parametrize("rims", [(0.0, 0.0), (2.0 * CERTAIN, 2.0 * CERTAIN)])
def test_an_end_that_the_views_show_stays(pipe_views: list[View], rims: tuple[float, float]) -> None:
    (whole,) = with_open_ends([measured(PIPE, rims)], FAR_FLOOR, pipe_views)
    assert whole.cylinder.length == pytest.approx(PIPE.length, abs=1e-9)
    assert whole.rims == rims
    (alone,) = with_open_ends([measured(PIPE)], FAR_FLOOR, [])
    assert alone.cylinder is PIPE


def test_a_certain_rim_is_an_end_whatever_hides_what_is_behind_it(pipe_views: list[View]) -> None:
    pipe, cover = behind(hiding(*HIDDEN))
    kept, _ = with_open_ends([measured(pipe.cylinder, (2.0 * CERTAIN, 0.0)), cover], FAR_FLOOR, pipe_views)
    np.testing.assert_allclose(kept.cylinder.start, pipe.cylinder.start)


def test_a_rim_is_a_clamps_where_the_contour_goes_on_behind_what_hides_it(pipe_views: list[View]) -> None:
    pipe, cover = behind(hiding(KNOWN - 0.04, KNOWN))
    longer, _ = with_open_ends([measured(pipe.cylinder, (1.1 * CERTAIN, 0.0)), cover], FAR_FLOOR, pipe_views)
    assert height_of_start(longer.cylinder) == pytest.approx(PIPE.start[2], abs=0.02)
    assert longer.rims == (0.0, 0.0)
