# SPDX-License-Identifier: Apache-2.0
"""Thin pipes are parallel to others where that is more probable, and never lie within another pipe."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud import octree
from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.thin import thin_pipes
from pipeprog_detect.thin.line_fitter import LineFitter
from pipeprog_detect.thin.thin_pipes import _Search, find_thin_pipes, is_shadow, seeking_edges, turned_parallel
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.measured_pipe import MeasuredPipe
from pipeprog_detect.verification.scene_context import SceneContext
from sitegen.primitives import cylinder
from sitegen.site import CONCRETE
from tests.unit.detect.pipe_and_wall import front_points
from tests.unit.detect.rendered_site import walk_past
from tests.unit.detect.straight_ahead import level, looking_along_y

BOQ = BillOfQuantities((PipeClass("copper 17", 0.0086, 10.0, (1.0, 0.0, 1.0), 4e-4),))


def measured(cylinder: Cylinder, log_odds: float) -> MeasuredPipe:
    """A pipe whose contour has these odds."""
    across = np.asarray(np.cross(cylinder.axis, np.eye(3)[1:]), np.float64)
    fit = ContourFit(cylinder, across, np.eye(5), 1e-4, 0.9, log_odds, 20, (0.0, 0.0), 0.0, 0.1)
    return MeasuredPipe.of_contour(Candidate(cylinder, 1e-4, 100, CloudEvidence(np.pi, 0.9, 0.0, 1e-3, 0.0, 3.0)), fit)


@pytest.mark.parametrize(
    ("degrees", "log_odds", "is_turned"),
    [(0.5, 110.0, True), (0.5, 90.0, False), (0.2, 110.0, False), (4.5, 110.0, True), (5.5, 110.0, False)],
)
def test_a_thin_pipe_is_turned_parallel_to_others_where_that_is_more_probable(
    degrees: float, log_odds: float, is_turned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its contour as measured has odds of 100 (logarithm), and of `log_odds` where it is parallel to the others."""
    started = []

    def fits(self: LineFitter, start: Cylinder, known: list[Cylinder]) -> list[ContourFit]:
        started.append(start)
        return [each.fit for odds in (80.0, log_odds) if (each := measured(start, odds)).fit is not None]

    monkeypatch.setattr(LineFitter, "in_direction", fits)
    views: list[View] = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    beside = [measured(Cylinder(each.start, each.end, 0.05), 100.0) for each in (level(1.0), level(2.0), level(3.0))]
    given_pipes = [*beside, measured(level(0.7, np.radians(degrees)), 100.0)]
    *others, after = turned_parallel(given_pipes, np.zeros((0, 3)), 0.02, views, BOQ)
    assert others == beside  # thick ones stay
    assert (after is not given_pipes[-1]) is is_turned
    if is_turned:
        assert after.cylinder == started[0]
        assert abs(float(after.cylinder.axis @ level(1.0).axis)) > np.cos(1e-6)


@pytest.mark.parametrize(("apart", "shadow"), [(0.012, True), (0.0155, True), (0.0175, False), (0.04, False)])
def test_two_pipes_cannot_lie_within_each_other(apart: float, shadow: bool) -> None:
    beside = level(0.35).shifted(np.array([0.1, 0.0, apart]))
    assert is_shadow(beside, [level(1.6)]) is shadow
    assert not is_shadow(beside.shifted(np.array([1.0, 0.0, 0.0])), [level(1.6)])  # beyond its end
    assert not is_shadow(level(0.35, turn=np.radians(30.0)).shifted(np.array([0.0, 0.01, 0.0])), [level(1.6)])


def test_only_what_looks_like_a_known_pipe_is_its_rival() -> None:
    """One in line with it, beyond its end, is another pipe, however short the gap."""
    views: list[View] = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    known = level(1.0)
    tree = octree.build(np.zeros((1, 3)))
    search = _Search(np.zeros((1, 3), np.float32), SceneContext(tree, None, [], tree, 1e-3), 0.03, [], BOQ, [known])
    thin = replace(known.cut(0.0, 0.5), radius=0.0086)
    assert search._is_rival(thin, views)
    assert search._is_rival(thin.shifted(np.array([0.0, 0.05, 0.0])), views)  # its depth is what is known worst
    beyond = thin.shifted((known.length + 0.01) * known.axis)
    assert not search._is_rival(beyond, views)
    assert not search._is_rival(thin.shifted(np.array([0.0, 0.0, 0.1])), views)


def test_a_pipe_behind_another_one_is_no_rival_where_views_from_two_heights_part_them() -> None:
    tree = octree.build(np.zeros((1, 3)))
    around = SceneContext(tree, None, [], tree, 1e-3)
    search = _Search(np.zeros((1, 3), np.float32), around, 0.03, [], BOQ, [replace(level(1.0), radius=0.0086)])
    behind = replace(level(0.8), radius=0.0086).shifted(np.array([0.0, 0.24, 0.0]))
    one_height = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    lower, higher = (
        [replace(view, camera_from_map=_raised(view.camera_from_map, by)) for view in one_height] for by in (-0.3, 0.3)
    )
    assert search._is_rival(behind, one_height)
    assert not search._is_rival(behind, lower + one_height + higher)


def _raised(pose: FloatArray, by: float) -> FloatArray:
    raised: FloatArray = pose.copy()
    raised[:3, 3] -= pose[:3, :3] @ np.array([0.0, 0.0, by])
    return raised


def before_a_wall(points: FloatArray | None = None) -> tuple[FloatArray, SceneContext]:
    """The cloud of a wall, with what stands before it, and what is around."""
    x, z = np.meshgrid(np.arange(-1.5, 1.5, 0.01), np.arange(-0.5, 1.0, 0.01))
    wall = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    tree = octree.build(wall)
    around = SceneContext(tree, None, [Plane(np.array([0.0, -1.0, 0.0]), 0.0, 4.5)], tree, 1e-3)
    return wall if points is None else np.vstack([wall, points]), around


def test_edges_that_are_sought_beforehand_are_those_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    views = walk_past([cylinder([-0.45, -0.08, 0.02], [0.45, -0.08, 0.02], 0.0086, CONCRETE)])
    cloud, around = before_a_wall()
    needed: dict[tuple[int, int, bool], FloatArray] = {}
    find_thin_pipes(cloud, around, 0.02, [], views, BOQ, needed)

    def at_once(function: Callable[[View], object], parts: list[View]) -> nullcontext[None]:
        for part in parts:
            function(part)
        return nullcontext()

    monkeypatch.setattr(thin_pipes, "beside", at_once)
    found: dict[tuple[int, int, bool], FloatArray] = {}
    with seeking_edges(cloud.astype(np.float32), 0.02, views, BOQ, found):
        pass
    assert found.keys() == needed.keys()
    assert {is_in_colour for *_, is_in_colour in found} == {False, True}
    for key, edges in found.items():
        np.testing.assert_array_equal(edges, needed[key])


@pytest.mark.parametrize("rise", [0.0, 0.4])
def test_a_pipe_as_bright_as_the_wall_is_found_by_its_colour(rise: float) -> None:
    """Grey shows the wall as it is without the pipe, which runs along known ones or, if it rises, along none."""
    copper = replace(CONCRETE, name="copper", colour=(0.75, 0.41, 0.12))
    pipe = Cylinder(np.array([-0.45, -0.08, 0.02 - rise / 2]), np.array([0.45, -0.08, 0.02 + rise / 2]), 0.0086)
    grey = [replace(view, chromaticity=None) for view in walk_past([])]
    coloured = walk_past([cylinder(pipe.start, pipe.end, pipe.radius, copper)])
    views = [replace(view, chromaticity=other.chromaticity) for view, other in zip(grey, coloured, strict=True)]
    cloud, around = before_a_wall(front_points(pipe))
    above = [Cylinder(np.array([-1.0, y, 3.0]), np.array([1.0, y, 3.0]), 0.05) for y in (-0.1, -0.3, -0.5)]
    known = [measured(each, 100.0) for each in above]
    assert find_thin_pipes(cloud, around, 0.02, known, grey, BOQ, {}) == []
    (found,) = find_thin_pipes(cloud, around, 0.02, known, views, BOQ, {})
    ends = np.stack([found.cylinder.start, found.cylinder.end])
    assert np.linalg.norm(pipe.from_axis(ends), axis=1).max() < 0.003
    assert found.cylinder.length == pytest.approx(pipe.length, abs=0.02)
    assert abs(found.cylinder.radius - pipe.radius) < 3.0 * found.radius_sigma
