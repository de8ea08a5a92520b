# SPDX-License-Identifier: Apache-2.0
"""Ends of a pipe by its rims on ray-cast images."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.refinement.axial_evidence import AxialEvidence
from pipeprog_detect.refinement.pipe_ends import (
    AT_ELBOW,
    FATTENED,
    THICKNESS,
    all_around,
    before_bend,
    find_end,
    into_bend,
)
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.pipe_and_wall import PIPE

# A third of a pixel at 1.2 m.
END_TOLERANCE = 1.2e-3


@pytest.mark.parametrize("at_end", [False, True])
@pytest.mark.parametrize("error", [-0.04, 0.0, 0.03])
def test_end_rim_is_found(pipe_views: list[View], at_end: bool, error: float) -> None:
    axis = PIPE.axis
    start = PIPE.start - (0.0 if at_end else error) * axis
    end = PIPE.end + (error if at_end else 0.0) * axis
    given = Cylinder(start, end, PIPE.radius)
    found = find_end(Scene.of(given, pipe_views, []), at_end, None)
    assert found is not None
    assert found.position == pytest.approx(-error, abs=END_TOLERANCE)
    assert abs(found.position + error) < 3.0 * found.sigma < 0.01


def test_no_end_where_the_pipe_goes_on_or_leaves_the_images(pipe_views: list[View]) -> None:
    inner = Cylinder(PIPE.start, PIPE.start + 0.02 * PIPE.axis, PIPE.radius)
    assert find_end(Scene.of(inner, pipe_views, []), True, None) is None
    beyond = Cylinder(PIPE.start, PIPE.end + 1.0 * PIPE.axis, PIPE.radius)
    assert find_end(Scene.of(beyond, pipe_views, []), True, None) is None


def test_surface_of_the_cloud_is_not_cut_off(pipe_views: list[View]) -> None:
    longer = Cylinder(PIPE.start, PIPE.end + 0.1 * PIPE.axis, PIPE.radius)
    found = find_end(Scene.of(longer, pipe_views, []), True, 0.0)
    assert found is not None
    # The cloud may go on over the end by half a stereo window and into a bend by the surface's thickness, no farther.
    assert -(FATTENED + np.sqrt(6.0 * PIPE.radius * THICKNESS)) < found.position < 0.0
    grown = find_end(Scene.of(longer, pipe_views, []), True, -0.1)
    assert grown is not None
    assert grown.position == pytest.approx(-0.1, abs=END_TOLERANCE)


def test_the_edge_of_what_hides_a_pipe_is_not_its_end(pipe_views: list[View]) -> None:
    """A thicker pipe crosses before the end; only what is seen of the barrel is told."""
    across = PIPE.end + np.array([0.0, -0.2, 0.0])
    hides = Cylinder(across - np.array([0.5, 0.0, 0.0]), across + np.array([0.5, 0.0, 0.0]), 0.06)
    found = find_end(Scene.of(PIPE, pipe_views, [hides]), True, 0.0)
    assert found is not None
    assert found.position == pytest.approx(0.0, abs=END_TOLERANCE)


def test_an_end_rim_raises_the_odds_of_an_end(pipe_views: list[View]) -> None:
    found = find_end(Scene.of(PIPE, pipe_views, []), True, None)
    assert found is not None
    # A clamp has such edges, too, two in each metre: to a pixel (3.5 mm) that is one in 144.
    assert 1.0 < found.odds < np.log(144.0)


def test_what_ends_may_be_an_elbow_unless_it_is_hidden() -> None:
    """As far back as the contour of an elbow stays within the reach of edges, and not from what hides the end."""
    position: FloatArray = np.linspace(-0.1, 0.1, 201, dtype=np.float64)
    odds = -1e3 * np.abs(position)
    radius, pixel = 0.05, 2e-3
    bend = into_bend(radius, 0.6 * pixel)
    assert bend**2 / (2.0 * 3.0 * radius) == pytest.approx(0.6 * pixel)
    steps: FloatArray = np.linspace(-0.1, 0.1, 21, dtype=np.float64)
    shown = AxialEvidence(steps, np.zeros(len(steps)), np.full(len(steps), 9))
    hidden = AxialEvidence(steps, np.zeros(len(steps)), np.where(steps > -0.015, 0, 9))
    back = before_bend(odds, position, shown, radius, pixel)
    at = np.searchsorted(position, [-0.9 * bend, -1.5 * bend, 0.05])
    assert back[at[0]] == pytest.approx(np.log(AT_ELBOW), abs=1e-6)
    assert back[at[1]] < -0.4e3 * bend
    assert back[at[2]] == odds[at[2]]
    assert before_bend(odds, position, hidden, radius, pixel)[at[0]] < -5.0


@pytest.mark.parametrize(("sectors", "told"), [(6, True), (4, True), (3, False)])
def test_a_rim_is_told_where_more_than_half_of_the_barrel_is_seen(sectors: int, told: bool) -> None:
    strength = np.full((6, 50), 0.1)
    strength[:, 20] = 0.8
    seen = np.zeros((6, 50), bool)
    seen[:sectors] = True
    found = all_around(np.where(seen, strength, 0.0), seen)
    assert (int(np.argmax(found)) == 20 and found[20] > 0.3) == told
