# SPDX-License-Identifier: Apache-2.0
"""Ends of a pipe by its rims on ray-cast images."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_detect.silhouette.pipe_ends import FATTENED, THICKNESS, find_end
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
    assert found.odds > 1.0
