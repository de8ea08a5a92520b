# SPDX-License-Identifier: Apache-2.0
"""A thin pipe of which each view shows a short piece is proposed whole along a direction that other pipes have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeprog_detect.silhouette.apparent_contour import project
from pipeprog_detect.thin.line_segments import SegmentPairs
from pipeprog_detect.thin.pair_views import PairView
from pipeprog_detect.thin.parallel_axes import (
    HIDDEN,
    LEAST_PARALLEL,
    MIN_VIEWS,
    Proposal,
    parallel_directions,
    propose_parallel,
)
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.straight_ahead import looking_along_y

RADIUS = 0.0086
AXIS = np.array([1.0, 0.0, 0.0])
PIPE = Cylinder(np.array([-0.6, 0.0, 0.1]), np.array([0.6, 0.0, 0.1]), RADIUS)


def walk(heights: tuple[float, ...]) -> list[View]:
    """Six views at each height that look straight ahead at the pipe from 1.2 m."""
    places = [(x, z) for z in heights for x in np.linspace(-0.5, 0.5, 6)]
    views = [looking_along_y(float(x), number) for number, (x, _) in enumerate(places)]
    return [raised(view, z) for view, (_, z) in zip(views, places, strict=True)]


def moved(pipe: Cylinder, x: float, z: float) -> Cylinder:
    """The pipe, `x` [m] along and `z` [m] higher."""
    offset = np.array([x, 0.0, z])
    return Cylinder(pipe.start + offset, pipe.end + offset, pipe.radius)


def raised(view: View, height: float) -> View:
    """The view from `height` [m] higher."""
    pose = view.camera_from_map.copy()
    pose[:3, 3] -= pose[:3, :3] @ np.array([0.0, 0.0, height])
    return View(view.stamp, view.image, view.camera, pose)


def pieces(pipes: list[Cylinder], views: list[View], share: float, seed: int) -> list[PairView]:
    """Each view with one segment pair of each pipe: a piece of it of the given share of its length, anywhere on it."""
    random = np.random.default_rng(seed)
    seen = []
    for view in views:
        ends, widths = [], []
        for pipe in pipes:
            first = random.uniform(0.0, 1.0 - share)
            pixel, depth = project(view, pipe.at(np.array([first, first + share])))
            ends.append(pixel + random.normal(0.0, 0.4, (2, 2)))
            widths.append(2.0 * view.camera.fx * pipe.radius / depth + random.normal(0.0, 0.5, 2))
        pairs = SegmentPairs(np.array(ends).reshape(-1, 2, 2), np.array(widths).reshape(-1, 2))
        free = np.full(len(pipes), np.inf)
        seen.append(PairView(view, pairs, (0.5, 3.0), np.full((len(pipes), 2), np.nan), free))
    return seen


def aside(found: Proposal, pipe: Cylinder) -> float:
    """Distance [m] of the middle of a proposal from the axis of a pipe."""
    return float(np.linalg.norm(pipe.from_axis(found.cylinder.middle[None])[0]))


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 1000), st.floats(0.15, 0.5))
def test_pieces_at_different_places_make_one_whole_pipe(seed: int, share: float) -> None:
    found = propose_parallel(pieces([PIPE], walk((-0.5, 0.0, 0.6)), share, seed), [AXIS], [RADIUS])
    assert len(found) == 1
    assert aside(found[0], PIPE) < RADIUS
    assert found[0].depth_sigma < RADIUS
    assert found[0].cylinder.length > PIPE.length - 2.0 * HIDDEN
    assert found[0].cylinder.length < PIPE.length + 0.05


def test_views_from_one_height_leave_the_depth_to_the_widths() -> None:
    found = propose_parallel(pieces([PIPE], walk((0.6,)), 0.5, 1), [AXIS], [RADIUS])
    assert len(found) == 1
    assert found[0].depth_sigma > 3.0 * RADIUS
    assert aside(found[0], PIPE) < 3.0 * found[0].depth_sigma


@pytest.mark.parametrize("apart", [0.06, 0.12])
def test_pipes_side_by_side_and_in_line_stay_two(apart: float) -> None:
    for other in (moved(PIPE, 0.0, apart), moved(PIPE, PIPE.length + HIDDEN + 5.0 * apart, 0.0)):
        found = propose_parallel(pieces([PIPE, other], walk((-0.5, 0.0, 0.6)), 0.4, 3), [AXIS], [RADIUS])
        assert len(found) == 2
        for pipe in (PIPE, other):
            along = [abs(float((each.cylinder.middle - pipe.middle) @ AXIS)) for each in found]
            assert min(aside(each, pipe) + off for each, off in zip(found, along, strict=True)) < 0.2


@pytest.mark.parametrize(("gap", "stands"), [(-0.05, False), (0.0, False), (2.5 * RADIUS, True), (0.3, True)])
def test_what_is_seen_before_a_known_pipe_lies_before_it(gap: float, stands: bool) -> None:
    """A pipe whose surface is `gap` [m] behind the axis; lines on it, or farther than it, are its own."""
    views = walk((-0.5, 0.0, 0.6))
    depth = views[0].camera_from_map[2] @ np.append(PIPE.middle, 1.0)
    seen = [replace(each, behind=np.array([depth + gap])) for each in pieces([PIPE], views, 0.5, 1)]
    found = propose_parallel(seen, [AXIS], [RADIUS])
    assert any(aside(each, PIPE) < RADIUS for each in found) == stands
    assert not any(len(each.beside_pipes().pairs) for each in seen)
    assert all(len(each.beside_pipes().pairs) == 1 for each in pieces([PIPE], views, 0.5, 1))


def test_other_widths_other_directions_and_few_views_propose_nothing() -> None:
    views = walk((-0.5, 0.0, 0.6))
    thick = Cylinder(PIPE.start, PIPE.end, 4.0 * RADIUS)
    rising = Cylinder(PIPE.start, moved(PIPE, 0.0, 0.5).end, RADIUS)
    assert propose_parallel(pieces([rising], views, 0.5, 2), [AXIS], [RADIUS]) == []
    assert propose_parallel(pieces([PIPE], views[: MIN_VIEWS - 1], 0.5, 2), [AXIS], [RADIUS]) == []
    assert propose_parallel(pieces([], views, 0.5, 2), [AXIS], [RADIUS]) == []
    assert propose_parallel([], [AXIS], [RADIUS]) == []
    for each in propose_parallel(pieces([thick], views, 0.5, 2), [AXIS], [RADIUS]):
        assert each.cylinder.middle[1] < -0.5, "a thin one much nearer looks as wide"


def test_three_pipes_make_a_direction() -> None:
    level = [moved(PIPE, 0.0, float(k)) for k in range(LEAST_PARALLEL)]
    upright = [Cylinder(np.array([k, 0.0, 0.0]), np.array([k, 0.0, 1.0]), 0.05) for k in range(LEAST_PARALLEL - 1)]
    turned = [Cylinder(each.end, each.start, each.radius) for each in level[:1]]
    directions = parallel_directions([*upright, *level[1:], *turned])
    assert len(directions) == 1
    assert abs(directions[0] @ AXIS) > np.cos(np.radians(1.0))
    assert parallel_directions([]) == []
