"""Ends of a pipe by its rims on ray-cast images."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_detect.outline import frame
from pipeprog_detect.pipe import Cylinder, View
from pipeprog_detect.rim import find_end

# The pipe of `pipe_views`.
PIPE = Cylinder(np.array([0.01, 0.0, -0.2]), np.array([-0.01, 0.01, 0.2]), 0.04)
# A third of a pixel at 1.2 m.
END_TOLERANCE = 1.2e-3
BASIS = frame(PIPE, np.array([0.0, 1.0, 0.0]))


@pytest.mark.parametrize("at_end", [False, True])
@pytest.mark.parametrize("error", [-0.04, 0.0, 0.03])
def test_rim_is_found(pipe_views: list[View], at_end: bool, error: float) -> None:
    axis = PIPE.axis
    start = PIPE.start - (0.0 if at_end else error) * axis
    end = PIPE.end + (error if at_end else 0.0) * axis
    found = find_end(Cylinder(start, end, PIPE.radius), at_end, pipe_views, [], BASIS, np.zeros(len(pipe_views)), 0.5)
    assert found is not None
    assert found.position == pytest.approx(-error, abs=END_TOLERANCE)
    assert abs(found.position + error) < 3.0 * found.sigma < 0.01


def test_no_end_where_the_pipe_goes_on_or_leaves_the_images(pipe_views: list[View]) -> None:
    still = np.zeros(len(pipe_views))
    inner = Cylinder(PIPE.start, PIPE.start + 0.02 * PIPE.axis, PIPE.radius)
    assert find_end(inner, True, pipe_views, [], BASIS, still, 0.5) is None
    beyond = Cylinder(PIPE.start, PIPE.end + 1.0 * PIPE.axis, PIPE.radius)
    assert find_end(beyond, True, pipe_views, [], BASIS, still, 0.5) is None
