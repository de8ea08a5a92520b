# SPDX-License-Identifier: Apache-2.0
"""Fits of proposed thin pipes: their slope from what runs beside them, and what is no pipe."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.refinement.contour_refinement import Start
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.thin import line_fitter
from pipeprog_detect.thin.axis_sweep import Proposal
from pipeprog_detect.thin.line_fitter import LINE_DEPTH_SIGMA, LineFitter, aligned, turned
from pipeprog_detect.thin.parallel_directions import NEARLY_PARALLEL
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.pipe_and_wall import PIPE
from tests.unit.detect.straight_ahead import level, looking_along_y


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.2, 0.2), st.floats(0.005, 0.08))
def test_a_slope_that_may_be_wrong_is_that_of_the_pipes_beside(slope: float, known_to: float) -> None:
    """Up to three standard deviations of the proposal's own slope, at least 5 degrees; seen from ahead it stays."""
    steepest = max(np.tan(NEARLY_PARALLEL), 3.0 * known_to)
    assume(abs(abs(np.tan(slope)) - steepest) > 1e-9)  # rounding
    views = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    beside = [level(length) for length in (1.0, 2.0, 3.0)]
    proposed = level(0.7, slope)
    found, sigma = aligned(proposed, beside, views, known_to)
    if abs(np.tan(slope)) < steepest:
        assert np.isfinite(sigma)
        assert abs(found.axis @ beside[0].axis) > np.cos(1e-6)
    else:
        assert not np.isfinite(sigma)
        assert found == proposed


def test_what_runs_in_another_direction_in_the_image_is_not_parallel() -> None:
    views = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    beside = [level(length, turn=np.radians(8.0)) for length in (1.0, 2.0, 3.0)]
    assert not np.isfinite(aligned(level(0.7), beside, views, 0.1)[1])
    assert not np.isfinite(aligned(level(0.7), [*beside[:2], level(1.0)], views, 0.1)[1])


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_a_turned_pipe_keeps_its_image(slope: float, turn: float, to: float) -> None:
    """It is turned in the plane of the lines of sight; what the direction has beside that plane is left out."""
    views = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    before = level(0.7, slope, turn)
    after = turned(before, level(1.0, to, 0.1).axis, views)
    across = np.cross(before.axis, [0.0, 1.0, 0.0])
    assert abs(after.axis @ across) < 1e-9
    assert np.allclose(after.middle, before.middle)
    assert after.length == pytest.approx(before.length)
    same = turned(before, before.axis, views)
    assert np.allclose(same.axis, before.axis)


@pytest.mark.parametrize(("sigmas", "stands"), [(1.7, True), (2.9, True), (3.3, False)])
def test_a_rod_of_another_size_is_no_thin_pipe(sigmas: float, stands: bool) -> None:
    """The bracket of a clamp, 18 mm square, has two edges as a pipe of 17.2 mm has."""
    planned, sigma = 0.0086, 1.76e-4
    boq = BillOfQuantities((PipeClass("copper 17", planned, 10.0, (1.0, 0.0, 1.0), 4e-4),))
    views = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    rod = Cylinder(np.zeros(3), np.array([0.5, 0.0, 0.0]), planned + sigmas * sigma)
    fit = ContourFit(rod, np.eye(3)[1:], np.eye(5), sigma, 0.9, 100.0, 20, (0.0, 0.0), 0.0, 0.1)
    lines = LineFitter(views, np.zeros((0, 3), np.float32), [planned], boq)
    assert lines._accepts(fit, [], (0.6, 0.0)) is stands


@pytest.mark.parametrize(("share", "stands"), [(0.05, True), (0.15, True), (0.17, False), (0.7, False)])
def test_what_may_have_any_radius_is_no_thin_pipe(share: float, stands: bool) -> None:
    """Half of the radii with that standard deviation lie nearer to another standard size than to the true one."""
    planned = 0.0086
    boq = BillOfQuantities((PipeClass("copper 17", planned, 10.0, (1.0, 0.0, 1.0), 4e-4),))
    views = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    line = Cylinder(np.zeros(3), np.array([0.5, 0.0, 0.0]), planned)
    fit = ContourFit(line, np.eye(3)[1:], np.eye(5), share * planned, 0.9, 100.0, 20, (0.0, 0.0), 0.0, 0.1)
    lines = LineFitter(views, np.zeros((0, 3), np.float32), [planned], boq)
    assert lines._accepts(fit, [], (0.6, 0.0)) is stands


@pytest.mark.parametrize(("nearer", "stands"), [(0.0, True), (0.04, True), (0.06, False), (0.347, False)])
def test_a_fit_that_leaves_the_depth_that_was_expected_is_refused(
    nearer: float, stands: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Edges beside a pipe make it too wide: with its radius held it was drawn to the cameras, by twenty sigma."""
    boq = BillOfQuantities((PipeClass("copper 17", 0.0086, 10.0, (1.0, 0.0, 1.0), 4e-4),))
    views = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    start = level(0.5)
    towards = np.array([0.0, -nearer, 0.0])
    moved = Cylinder(start.start + towards, start.end + towards, start.radius)
    fit = ContourFit(moved, np.eye(3)[1:], np.eye(5), 1.6e-4, 0.73, 46.0, 20, (0.0, 0.0), 0.0, 0.1)
    monkeypatch.setattr(line_fitter, "refine", lambda *_: fit)
    monkeypatch.setattr(LineFitter, "_accepts", lambda *_: True)
    lines = LineFitter(views, np.zeros((0, 3), np.float32), [start.radius], boq)
    found = lines.along_known_pipes(Proposal(start, 0.0157, 30.0), [])
    assert found is (fit if stands else None)


@pytest.mark.parametrize(("displaced", "expected"), [(0.0, 0.0), (0.5, 0.5)])
def test_where_edges_are_displaced_the_radius_is_held_the_less(
    displaced: float, expected: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Held to a hundredth of a millimetre, a pipe that looks thinner than it is was put far behind its place."""
    views = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    started: list[Start] = []
    monkeypatch.setattr(line_fitter, "refine", lambda start, *_: started.append(start))
    lines = LineFitter(views, np.zeros((0, 3), np.float32), [0.0086], BillOfQuantities(()), displaced)
    lines.along_known_pipes(Proposal(level(0.5), 0.1, 30.0), [])
    gain = float(np.median([view.camera.fx / np.linalg.norm(view.centre) for view in views]))
    assert [each.radius_error for each in started if each.radius_fixed] == [pytest.approx(expected / gain, rel=0.05)]


@pytest.mark.parametrize(
    ("at_depth", "whole", "stands"),
    [(0.05, False, True), (0.12, False, False), (None, False, False), (0.05, True, False)],
)
def test_a_piece_stands_where_the_cloud_has_it_and_the_whole_is_no_pipe(
    at_depth: float | None, whole: bool, stands: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three standard deviations of a depth that lines tell are 9 cm; a whole that is a pipe is the answer itself."""
    cylinder = level(0.4)
    across = np.asarray(np.cross(cylinder.axis, np.eye(3)[1:]), np.float64)
    piece, longer = (
        ContourFit(each, across, np.eye(5), 1e-4, 0.9, 90.0, 20, (0.0, 0.0), 0.0, 0.1)
        for each in (cylinder, level(0.9))
    )
    farther = None if at_depth is None else cylinder.shifted(np.array([0.0, at_depth, 0.0]))
    monkeypatch.setattr(line_fitter, "at_cloud_depth", lambda *_: farther)
    monkeypatch.setattr(LineFitter, "measure", lambda *_: longer if whole else None)
    views = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    boq = BillOfQuantities((PipeClass("copper 17", 0.0086, 10.0, (1.0, 0.0, 1.0), 4e-4),))
    lines = LineFitter(views, np.zeros((0, 3), np.float32), [0.0086], boq)
    assert lines.follow(piece, 0.0086, []) is (piece if stands else longer if whole else None)


def test_of_a_proposal_that_goes_on_beyond_the_pipe_the_pipe_counts(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next pipe in line, at another depth, shows edges to some of the views only."""
    boq = BillOfQuantities((PipeClass("DN 65", PIPE.radius, 10.0, (1.0, 0.0, 1.0), 4e-4),))
    lines = LineFitter(pipe_views, np.zeros((0, 3), np.float32), [PIPE.radius], boq)
    longer = PIPE.cut(0.0, PIPE.length + 0.35)
    whole = ContourFit(longer, np.eye(3)[:2], np.eye(5), 1e-4, 0.5, 20.0, 8, (0.0, 0.0), 0.0, 0.1)
    monkeypatch.setattr(LineFitter, "_at_its_depth", lambda *_: whole)
    found = lines.along_known_pipes(Proposal(longer, 2e-3, 50.0), [])
    assert found is not None
    assert found.cylinder.length == pytest.approx(PIPE.length, abs=0.02)
    assert found.cylinder.radius == pytest.approx(PIPE.radius, abs=1e-3)
    monkeypatch.setattr(LineFitter, "_parallel", lambda *_: None)
    assert lines.along_known_pipes(Proposal(longer, 2e-3, 50.0), []) is whole


def test_displaced_edges_make_radius_and_depth_uncertain(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the fit's covariance as well: what observes the pipe later updates that.

    From one height the depth is as uncertain as it is before anything is measured, from two by what they differ in.
    """
    views: list[View] = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    across = np.eye(3)[[2, 1]]
    fit = ContourFit(level(1.0), across, 1e-8 * np.eye(5), 1e-4, 0.9, 50.0, 20, (0.0, 0.0), 0.0, 0.1)
    monkeypatch.setattr(line_fitter, "refine", lambda *_: fit)
    lines = LineFitter(views, np.zeros((0, 3), np.float32), [0.0086], BillOfQuantities(()), displaced=0.5)
    found = lines._refined(Start(level(1.0), 0.0086), [])
    assert found is not None
    gain = float(np.median([view.camera.fx / np.linalg.norm(view.centre) for view in views]))
    assert found.radius_sigma == pytest.approx(np.hypot(1e-4, 0.5 / gain), rel=0.02)
    assert np.sqrt(found.covariance[4, 4]) == pytest.approx(found.radius_sigma)
    deep = np.diag([0.0, LINE_DEPTH_SIGMA**2, 0.0, 0.0])
    assert found.covariance[:4, :4] == pytest.approx(1e-8 * np.eye(4) + deep)
    higher = [replace(view, camera_from_map=_raised(view.camera_from_map, 0.4)) for view in views]
    found = replace(lines, views=views + higher)._refined(Start(level(1.0), 0.0086), [])
    assert found is not None
    distance = float(np.mean([np.linalg.norm(level(1.0).from_axis(view.centre[None])) for view in views + higher]))
    error = np.sqrt(found.covariance[4, 4] - 1e-8)
    assert np.sqrt(found.covariance[1, 1] - 1e-8) == pytest.approx(error / (0.5 * 0.4 / distance), rel=0.05)


def _raised(camera_from_map: FloatArray, by: float) -> FloatArray:
    """The pose of a camera that stands higher [m]."""
    pose = camera_from_map.copy()
    pose[:3, 3] -= pose[:3, 2] * by
    return pose


def fit_of(radius: float, sigma: float, odds: float) -> ContourFit:
    cylinder = replace(level(1.0), radius=radius)
    return ContourFit(cylinder, np.eye(3)[1:], sigma**2 * np.eye(5), sigma, 0.9, odds, 20, (0.0, 0.0), 0.0, 0.1)


@pytest.mark.parametrize(
    ("radius", "weaker", "expected"),
    [
        (9e-3, 0.3, "both"),
        (6e-3, 0.6, "none"),  # a rod: both of its sides are seen
        (6e-3, 0.4, "one"),  # a shadow's edge for a side
        (9e-3, 0.2, "one"),
        (None, 0.0, "one"),
    ],
)
def test_other_images_tell_axis_and_radius_as_well(
    radius: float | None, weaker: float, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They begin with the axis as well as it is known; the more probable fit tells how long the pipe is."""
    boq = BillOfQuantities((PipeClass("copper 17", 0.0086, 10.0, (1.0, 0.0, 1.0), 4e-4),))
    views = [looking_along_y(x, number) for number, x in enumerate((-0.3, 0.0, 0.3))]
    one, here = fit_of(8e-3, 1e-4, 90.0), None if radius is None else fit_of(radius, 2e-4, 70.0)
    if here is not None:
        here = replace(here, cylinder=here.cylinder.cut(0.1, 0.9).shifted(np.array([0.0, 5e-3, 0.0])))
    starts: list[Start] = []

    def refined(start: Start, *_: object) -> ContourFit | None:
        starts.append(start)
        return here

    monkeypatch.setattr(line_fitter, "refine", refined)
    monkeypatch.setattr(Scene, "own_support", lambda _: SimpleNamespace(weaker_share=weaker))
    found = LineFitter(views, np.zeros((0, 3), np.float32), [0.0086], boq).again(one, [])
    if expected != "both":
        assert found is (one if expected == "one" else None)
        return
    assert found is not None
    assert found.log_odds == 90.0
    assert found.cylinder.radius == pytest.approx(8.2e-3)  # weights of 4 to 1
    assert found.radius_sigma == pytest.approx(1e-4 * np.sqrt(0.8))
    assert np.diag(found.covariance) == pytest.approx([4e-8, 4e-8, 4e-8, 4e-8, found.radius_sigma**2])
    assert (starts[0].depth_sigma, starts[0].slope_sigma) == pytest.approx((1e-4, 1e-4))
    assert here is not None
    assert np.linalg.norm(here.cylinder.from_axis(np.stack([found.cylinder.start, found.cylinder.end]))) < 1e-9
    assert found.cylinder.length == pytest.approx(one.cylinder.length)
