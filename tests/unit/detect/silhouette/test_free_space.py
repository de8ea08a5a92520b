# SPDX-License-Identifier: Apache-2.0
"""Where views see through a cylinder: clouds of two pipes in line before a wall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import project
from pipeprog_detect.silhouette.free_space import SPACING, free_stretches, is_empty_beside
from pipeprog_detect.silhouette.occlusion import STEREO_WINDOW, with_depths
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.pipe_and_wall import PIPE, front_points, wall_points
from tests.unit.detect.straight_ahead import CAMERA, looking_along_y

AWAY = 1.2  # m, of the axes from the cameras
HALF, WALL = 0.8, 0.25  # m: half of the line's length, and how far behind it the wall is
# What a cell of the depths covers at the pipe (10 mm), on both sides of an edge, and a step of the search [m]. Beside
# that the pipe's own surface hides the axis beyond its end: by up to a radius, from aslant (45 deg at the most).
RESOLVED, HIDDEN_RADII = 0.035, 1.0


def tube(start: float, end: float, radius: float) -> FloatArray:
    """Points on a pipe along x, open at its ends."""
    x, angle = np.meshgrid(np.arange(start, end, 0.002), np.linspace(-np.pi, np.pi, 150))
    return np.stack([x, radius * np.sin(angle), radius * np.cos(angle)], axis=-1).reshape(-1, 3)


def seen(*surfaces: FloatArray) -> list[View]:
    """Seven views of surfaces before a wall, with their depths."""
    x, z = np.meshgrid(np.arange(-1.5, 1.5, 0.004), np.arange(-0.6, 0.6, 0.004))
    wall = np.stack([x, np.full_like(x, WALL), z], axis=-1).reshape(-1, 3)
    views = [looking_along_y(x, stamp) for stamp, x in enumerate(np.linspace(-0.4, 0.4, 7))]
    return with_depths(views, np.concatenate([wall, *surfaces]))


def line(radius: float) -> Cylinder:
    return Cylinder(np.array([-HALF, 0.0, 0.0]), np.array([HALF, 0.0, 0.0]), radius)


@given(middle=st.floats(-0.3, 0.3), gap=st.floats(0.3, 0.6), radius=st.floats(0.02, 0.1))
@settings(max_examples=15, deadline=None)
def test_a_gap_between_two_pipes_is_free(middle: float, gap: float, radius: float) -> None:
    low, high = middle - 0.5 * gap, middle + 0.5 * gap
    views = seen(tube(-HALF, low, radius), tube(high, HALF, radius))
    stretches = free_stretches(line(radius), views, [])
    assert len(stretches) == 1
    assert -RESOLVED < stretches[0][0] - HALF - low < RESOLVED + HIDDEN_RADII * radius
    assert -RESOLVED < high - (stretches[0][1] - HALF) < RESOLVED + HIDDEN_RADII * radius


@pytest.mark.parametrize("radius", [0.02, 0.06])
def test_nothing_is_free_along_a_whole_pipe(radius: float) -> None:
    assert free_stretches(line(radius), seen(tube(-HALF, HALF, radius)), []) == []


@pytest.mark.parametrize(("above_the_edge", "is_free"), [(0.0, False), (0.1, True)])
def test_what_stereo_misses_at_the_edge_of_all_images_is_not_free(above_the_edge: float, is_free: bool) -> None:
    """A pipe's barrel that leaves them at the bottom is in the cloud down to stereo's window, or 0.1 m above."""
    last = CAMERA.height - 1
    edge, bottom = (-(row - CAMERA.cy) / CAMERA.fy * AWAY for row in (last - STEREO_WINDOW, last))
    upright = tube(edge + above_the_edge, 0.4, 0.06)[:, [1, 2, 0]]
    pipe = Cylinder(np.array([0.0, 0.0, bottom + 0.005]), np.array([0.0, 0.0, 0.4]), 0.06)
    assert bool(free_stretches(pipe, seen(upright), [])) == is_free


def test_what_stands_before_a_gap_is_no_barrel() -> None:
    """Two risers hide the gap from most views, in part; through what is left of it all see the wall."""
    x, z = np.meshgrid(np.arange(-0.03, 0.03, 0.002), np.arange(-0.5, 0.5, 0.002))
    risers = [np.stack([x + at, np.full_like(x, -0.3), z], axis=-1).reshape(-1, 3) for at in (-0.05, 0.06)]
    radius = 0.1
    [stretch] = free_stretches(line(radius), seen(tube(-HALF, -0.14, radius), tube(0.14, HALF, radius), *risers), [])
    assert -0.14 - RESOLVED < stretch[0] - HALF < stretch[1] - HALF < 0.14 + RESOLVED


@pytest.mark.parametrize(("half_hole", "is_free"), [(0.02, False), (0.12, True)])
def test_what_shines_through_a_hole_in_a_flange_is_no_gap(half_hole: float, is_free: bool) -> None:
    """Of a ring around two ends the cloud lacks what lies nearer than this [m] to the axis, in front."""
    radius, half_gap = 0.1, 0.06
    ring = tube(-half_gap, half_gap, 1.4 * radius)
    ring = ring[np.abs(ring[:, 2]) > half_hole]
    stretches = free_stretches(
        line(radius), seen(tube(-HALF, -half_gap, radius), tube(half_gap, HALF, radius), ring), []
    )
    assert bool(stretches) == is_free


def test_a_hidden_gap_is_not_told() -> None:
    column = Cylinder(np.array([0.0, -0.3, -1.0]), np.array([0.0, -0.3, 1.0]), 0.45)
    views = seen(tube(-HALF, -0.1, 0.03), tube(0.1, HALF, 0.03))
    assert free_stretches(line(0.03), views, [])
    assert free_stretches(line(0.03), views, [column]) == []


def test_where_both_limbs_are_hidden_a_gap_is_not_told() -> None:
    """Pipes before the limbs, 0.2 m nearer, leave the axis between them to be seen."""
    views = seen(tube(-HALF, -0.1, 0.05), tube(0.1, HALF, 0.05))
    rails = [Cylinder(np.array([-HALF, -0.2, z]), np.array([HALF, -0.2, z]), 0.02) for z in (-0.042, 0.042)]
    assert free_stretches(line(0.05), views, [])
    assert free_stretches(line(0.05), views, rails) == []


def test_a_pipe_thinner_than_the_cells_is_not_judged() -> None:
    assert free_stretches(line(0.008), seen(), []) == []


@given(radius=st.floats(0.03, 0.09), times=st.floats(1.5, 1.8), side=st.sampled_from([-1.0, 1.0]))
@settings(max_examples=15, deadline=None)
def test_a_limb_that_is_a_shadows_edge_has_nothing_before_it(radius: float, times: float, side: float) -> None:
    """One limb is the pipe's, the other lies beyond it: the axis is aside by what the radius is too large."""
    views = seen(tube(-HALF, HALF, radius))
    aside = np.array([0.0, 0.0, side * (times - 1.0) * radius])
    wider = Cylinder(line(radius).start + aside, line(radius).end + aside, times * radius)
    assert is_empty_beside(wider, views, [])
    assert not is_empty_beside(wider, views[:2], [])
    assert not is_empty_beside(line(radius), views, [])


def test_a_limb_that_others_hide_is_not_told_to_be_empty() -> None:
    views = seen(tube(-HALF, HALF, 0.04))
    aside = np.array([0.0, 0.0, 0.03])
    wider = Cylinder(line(0.04).start + aside, line(0.04).end + aside, 0.07)
    before = Cylinder(np.array([-HALF, -0.3, 0.07]), np.array([HALF, -0.3, 0.07]), 0.05)
    assert is_empty_beside(wider, views, [])
    assert not is_empty_beside(wider, views, [before])
    board = tube(-HALF, HALF, 0.05) + np.array([0.0, -0.3, 0.07])
    assert not is_empty_beside(wider, seen(tube(-HALF, HALF, 0.04), board), [])


def test_where_no_pipe_is_neither_limb_is_told_from_the_other() -> None:
    assert not is_empty_beside(line(0.05), seen(), [])


def test_two_views_are_too_few() -> None:
    views = seen(tube(-HALF, -0.1, 0.03), tube(0.1, HALF, 0.03))
    assert free_stretches(line(0.03), views[:2], []) == []


def test_a_hole_in_the_cloud_of_a_pipe_is_not_free_where_its_contour_is_seen(
    pipe_views: list[View], empty_views: list[View]
) -> None:
    low, high = PIPE.start + 0.15 * PIPE.axis, PIPE.start + 0.25 * PIPE.axis
    surface = front_points(PIPE)
    along = (surface - PIPE.start) @ PIPE.axis
    torn = np.concatenate([wall_points(), surface[(along < 0.15) | (along > 0.25)]])
    hole = Cylinder(low, high, PIPE.radius)
    assert free_stretches(hole, with_depths(empty_views, torn), [])
    assert free_stretches(hole, with_depths(pipe_views, torn), []) == []


def test_a_hole_is_no_gap_where_its_contour_is_seen_in_part(pipe_views: list[View]) -> None:
    """Behind a gap a tenth of a contour has edges, by chance; a barrel before a wall of its own colour shows more."""
    low, high = 0.15, 0.25
    surface = front_points(PIPE)
    along = (surface - PIPE.start) @ PIPE.axis
    torn = np.concatenate([wall_points(), surface[(along < low) | (along > high)]])
    views = []
    for view in pipe_views:
        image, seen_to = view.image.copy(), project(view, PIPE.start[None] + 0.17 * PIPE.axis)[0][0, 1]
        image[: int(seen_to)] = 128
        views.append(replace(view, image=image))
    hole = PIPE.cut(low, high)
    assert 0.3 < Scene.of(hole, with_depths(views, torn), []).support(spacing=SPACING).share < 0.45
    assert free_stretches(hole, with_depths(views, torn), []) == []


@pytest.mark.parametrize(
    ("torn", "known", "free"),
    [
        ([], (0.0, 0.25), True),
        ([(0.05, 0.2)], (0.0, 0.25), False),
        ([], (0.1, 0.25), False),
    ],
    ids=["no holes", "as many holes", "too short to tell"],
)
def test_beyond_a_pipe_without_holes_a_contour_is_that_of_something_in_line(
    pipe_views: list[View], torn: list[tuple[float, float]], known: tuple[float, float], free: bool
) -> None:
    surface = front_points(PIPE)
    along = (surface - PIPE.start) @ PIPE.axis
    kept = along < 0.25
    for low, high in torn:
        kept &= (along < low) | (along > high)
    views = with_depths(pipe_views, np.concatenate([wall_points(), surface[kept]]))
    assert free_stretches(PIPE.cut(0.25, 0.35), views, []) == []
    assert bool(free_stretches(PIPE.cut(0.25, 0.35), views, [], known=PIPE.cut(*known))) is free
