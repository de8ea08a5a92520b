# SPDX-License-Identifier: Apache-2.0
"""A pipe seen by a camera that moves while its rows are read out is measured as well as by one that stands still."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeprog_detect.refinement.contour_refinement import Start, refine
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.pipe_and_wall import PIPE
from tests.unit.detect.refinement.test_contour_refinement import AXIS_TOLERANCE, RADIUS_TOLERANCE

SHORT = Cylinder(PIPE.start + 0.04 * PIPE.axis, PIPE.end - 0.04 * PIPE.axis, 0.95 * PIPE.radius)


def off_axis(cylinder: Cylinder) -> float:
    """How far the ends are from the true axis, at the most [m]."""
    return max(float(np.linalg.norm(np.cross(end - PIPE.start, PIPE.axis))) for end in (cylinder.start, cylinder.end))


def test_radius_axis_and_ends_are_those_of_a_still_camera(rolled_views: list[View]) -> None:
    fit = refine(Start(SHORT, 0.1 * PIPE.radius), rolled_views, [])
    assert fit is not None
    assert fit.cylinder.radius == pytest.approx(PIPE.radius, abs=RADIUS_TOLERANCE)
    assert off_axis(fit.cylinder) < AXIS_TOLERANCE
    assert fit.cylinder.length == pytest.approx(PIPE.length, abs=3.5e-3)
    assert fit.support > 0.8


def test_taken_for_a_still_camera_the_pipe_is_somewhere_else(rolled_views: list[View]) -> None:
    still = [replace(view, rolled=None) for view in rolled_views]
    fit = refine(Start(SHORT, 0.1 * PIPE.radius), still, [])
    assert fit is None or off_axis(fit.cylinder) > 2.0 * AXIS_TOLERANCE
