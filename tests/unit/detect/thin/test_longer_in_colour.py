# SPDX-License-Identifier: Apache-2.0
"""A thin pipe of which grey shows a piece goes on to where its colour ends, and no farther."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud import octree
from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.detector import _abutted
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.silhouette.occlusion import with_depths
from pipeprog_detect.thin.longer_in_colour import longer_in_colour
from pipeprog_detect.thin.thin_pipes import in_colour
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.measured_pipe import MeasuredPipe
from pipeprog_detect.verification.scene_context import SceneContext
from sitegen.primitives import cylinder
from sitegen.site import CONCRETE
from tests.unit.detect.pipe_and_wall import front_points
from tests.unit.detect.rendered_site import walk_past

COPPER = replace(CONCRETE, name="copper", colour=(0.75, 0.41, 0.12))
PIPE = Cylinder(np.array([-0.45, -0.08, 0.02]), np.array([0.45, -0.08, 0.02]), 0.0086)
NEXT = Cylinder(np.array([0.6, -0.08, 0.02]), np.array([1.0, -0.08, 0.02]), 0.0086)


@cache
def wall() -> FloatArray:
    """Points of a wall in y = 0."""
    x, z = np.meshgrid(np.arange(-1.5, 1.5, 0.01), np.arange(-0.5, 1.0, 0.01))
    return np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)


@pytest.fixture(scope="module")
def views() -> list[View]:
    """Views in colour, with what the cloud shows, of two copper pipes in line before the wall, 15 cm apart."""
    pipes = (PIPE, NEXT)
    seen = walk_past([cylinder(each.start, each.end, each.radius, COPPER) for each in pipes])
    return in_colour(with_depths(seen, np.vstack([wall(), *(front_points(each) for each in pipes)])))


def measured(piece: Cylinder) -> MeasuredPipe:
    """A piece whose axis is known to a millimetre at its middle and to a milliradian."""
    across = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    covariance = np.diag([1e-6, 1e-6, 1e-6, 1e-6, 1e-8])
    fit = ContourFit(piece, across, covariance, 1e-4, 0.9, 50.0, 20, (9.0, 9.0), 0.0, 0.1)
    return MeasuredPipe.of_contour(Candidate(piece, 1e-4, 100, CloudEvidence(np.pi, 0.9, 0.0, 1e-3, 0.0, 3.0)), fit)


@pytest.mark.parametrize(("low", "high"), [(0.0, 0.4), (0.25, 0.65), (0.5, 0.9)])
def test_a_pipe_goes_on_to_where_its_colour_ends(low: float, high: float, views: list[View]) -> None:
    piece = measured(PIPE.cut(low, high))
    (found,) = longer_in_colour([piece], 0.02, views)
    for end, true, was in ((found.cylinder.start, PIPE.start, low == 0.0), (found.cylinder.end, PIPE.end, high == 0.9)):
        assert np.linalg.norm(end - true) < (1e-9 if was else 0.015)
    assert np.linalg.norm(PIPE.from_axis(np.stack([found.cylinder.start, found.cylinder.end]))) < 1e-9
    assert found.candidate.cylinder.length == pytest.approx(found.cylinder.length)
    assert found.fit is not None
    shift = abs(float((found.cylinder.middle - piece.cylinder.middle) @ PIPE.axis))
    assert np.sqrt(found.fit.covariance[0, 0]) == pytest.approx(np.hypot(1e-3, 1e-3 * shift))


def test_a_whole_pipe_a_thick_one_and_one_without_colour_stay(views: list[View]) -> None:
    whole, thick, part = measured(PIPE), measured(replace(PIPE.cut(0.0, 0.4), radius=0.03)), measured(PIPE.cut(0, 0.4))
    same = longer_in_colour([whole, thick], 0.02, views)
    assert same[0] is whole
    assert same[1] is thick
    assert longer_in_colour([part], 0.02, [])[0] is part


def test_colour_knows_an_end_that_grey_leaves_open(views: list[View]) -> None:
    """In grey the wall alone is seen: the pipe may end anywhere."""
    tree = octree.build(wall())
    around = SceneContext(tree, None, [Plane(np.array([0.0, -1.0, 0.0]), 0.0, 4.5)], tree, 1e-3)
    grey = with_depths(walk_past([]), wall())
    open_one, _ = _abutted([measured(PIPE), measured(NEXT)], around, grey, [])
    assert all(end.sigma > 0.05 for end in open_one.ends)
    known, _ = _abutted([measured(PIPE), measured(NEXT)], around, grey, views)
    assert all(end.sigma < 0.01 and end.state == "free" for end in known.ends)
    (thick,) = _abutted([measured(replace(PIPE, radius=0.04))], around, grey, views)
    assert all(end.sigma > 0.05 for end in thick.ends)
