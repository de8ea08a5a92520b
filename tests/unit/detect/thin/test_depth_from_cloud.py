# SPDX-License-Identifier: Apache-2.0
"""Thin pipes from where they are seen: pieces of one line, and the depth that the cloud gives it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.thin.depth_from_cloud import at_cloud_depth, covers, is_edge_of_face, mean_centre
from pipeprog_detect.thin.line_triangulation import SAME_LINE
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.pipe_and_wall import PIPE, WALL, front_points, wall_points


def test_a_thin_pipe_is_laid_at_the_depth_of_the_points_before_the_wall() -> None:
    thin = Cylinder(PIPE.start, PIPE.end, 0.0086)
    centre = np.array([0.0, -1.2, 0.0])
    sparse = front_points(thin)[::7]
    deep = np.array([0.0, 0.05, 0.0])
    proposed = Cylinder(centre + 1.05 * (thin.start - centre) + deep, centre + 1.05 * (thin.end - centre), thin.radius)
    found = at_cloud_depth(proposed, np.concatenate([wall_points(), sparse]).astype(np.float32), centre)
    assert found is not None
    for end, true in ((found.start, thin.start), (found.end, thin.end)):
        assert end[1] == pytest.approx(true[1], abs=thin.radius)
    assert at_cloud_depth(proposed, np.zeros((0, 3), np.float32), centre) is None


def test_the_wall_beside_and_behind_a_pipe_does_not_lay_it() -> None:
    """Stereo keeps half of a thin pipe and draws the rest to the wall, up to it: the depth is that of the near half."""
    thin = Cylinder(np.array([-0.3, 0.0, 0.0]), np.array([0.3, 0.0, 0.0]), 0.0086)
    centre = np.array([0.0, -1.2, 0.0])
    near = front_points(Cylinder(thin.start, thin.start + 0.5 * thin.length * thin.axis, thin.radius))[::7]
    rng = np.random.default_rng(5)
    drawn = np.stack([rng.uniform(0.0, 0.3, 400), rng.uniform(0.0, WALL, 400), rng.uniform(-0.009, 0.009, 400)], axis=1)
    points = np.concatenate([wall_points(), near, drawn]).astype(np.float32)
    proposed = Cylinder(np.array([-0.31, 0.04, 0.0]), np.array([0.31, 0.04, 0.0]), thin.radius)
    found = at_cloud_depth(proposed, points, centre, sloping=False)
    assert found is not None
    assert found.start[1] == pytest.approx(thin.start[1], abs=thin.radius)
    assert found.end[1] == pytest.approx(thin.end[1], abs=thin.radius)
    assert at_cloud_depth(proposed, wall_points().astype(np.float32), centre) is None


@pytest.mark.parametrize(
    ("above", "below", "behind", "edge"),
    [
        (0.3, 0.0, 0.0, True),
        (None, 0.0, 0.0, True),
        (0.0, 0.0, 0.0, False),
        (0.3, 0.3, 0.0, False),
        (0.012, 0.0, 0.0, False),
        (0.3, 0.012, 0.0, True),  # a face that is seen aslant
        (0.3, 0.0, 0.03, True),  # the line is laid behind the face, where no pipe can be seen
        (0.3, 0.0, -0.03, False),  # before it
    ],
)
def test_a_line_with_a_face_on_one_side_is_that_faces_edge(
    above: float | None, below: float, behind: float, edge: bool, pipe_views: list[View]
) -> None:
    """A face goes on at its depth on one side; on the other one the next surface lies a diameter deeper, or nothing."""
    line = Cylinder(np.array([-0.3, behind, 0.0]), np.array([0.3, behind, 0.0]), 0.0086)
    rng = np.random.default_rng(3)
    height = np.concatenate([rng.uniform(-0.07, 0.009, 9000), rng.uniform(0.009, 0.07, 9000)])
    deeper = np.where(height > 0.009, np.nan if above is None else above, np.where(height < -0.009, below, 0.0))
    points = np.stack(
        [rng.uniform(-0.35, 0.35, len(height)), deeper + rng.normal(0.0, 2e-3, len(height)), height], axis=1
    )
    points = points[np.isfinite(points).all(axis=1)].astype(np.float32)
    assert is_edge_of_face(line, points, pipe_views, [], []) == edge


def test_a_wall_that_is_seen_aslant_has_no_edge_behind_a_pipe(pipe_views: list[View]) -> None:
    """15 degrees aslant it is 28 mm farther away from one strip beside the pipe to the other; stereo fills the pipe in.

    A line along the edge of a board, 15 mm before the same wall, is that board's.
    """
    line = Cylinder(np.array([-0.3, 0.0, 0.0]), np.array([0.3, 0.0, 0.0]), 0.0086)
    rng = np.random.default_rng(3)
    slope, height = float(np.tan(np.radians(15.0))), rng.uniform(-0.07, 0.07, 18000)
    along, noise = rng.uniform(-0.35, 0.35, len(height)), rng.normal(0.0, 2e-3, len(height))
    wall = Plane(np.array([0.0, 1.0, -slope]) / np.hypot(1.0, slope), 0.022 / float(np.hypot(1.0, slope)), 4.0)

    def edge(nearer: FloatArray) -> bool:
        cloud = np.stack([along, 0.022 + slope * height - nearer + noise, height], axis=1).astype(np.float32)
        return is_edge_of_face(line, cloud, pipe_views, [wall], [])

    assert not edge(np.where(np.abs(height) < 0.009, 0.008, 0.0))
    assert edge(np.where(height < 0.009, 0.015, 0.0))


def test_the_barrel_of_a_neighbour_is_no_face(pipe_views: list[View]) -> None:
    """A thin pipe runs 11 mm beside a DN100, 33 mm before its axis, before nothing."""
    line = Cylinder(np.array([-0.3, 0.0, 0.0]), np.array([0.3, 0.0, 0.0]), 0.0086)
    neighbour = Cylinder(np.array([-0.35, 0.033, -0.07]), np.array([0.35, 0.033, -0.07]), 0.0575)
    on_line = front_points(line)[::4]
    points = np.concatenate([front_points(neighbour), on_line]).astype(np.float32)
    assert is_edge_of_face(line, points, pipe_views, [], [])
    assert not is_edge_of_face(line, points, pipe_views, [], [neighbour])


@pytest.mark.parametrize("apart", [0.045, 0.06, 0.08])
def test_the_other_one_of_two_pipes_is_no_face(apart: float, pipe_views: list[View]) -> None:
    """Stereo spreads each by half its width; between them the cloud shows what is behind."""
    line = Cylinder(np.array([-0.3, 0.0, 0.0]), np.array([0.3, 0.0, 0.0]), 0.0086)
    rng = np.random.default_rng(3)
    along, height = rng.uniform(-0.35, 0.35, 20000), rng.uniform(-0.1, 0.1, 20000)
    is_pipe = np.minimum(np.abs(height), np.abs(height + apart)) < 1.5 * line.radius
    deep = np.where(is_pipe, 0.0, 0.2) + rng.normal(0.0, 2e-3, len(height))
    points = np.stack([along, deep, height], axis=1).astype(np.float32)
    assert not is_edge_of_face(line, points, pipe_views, [], [])
    plate = np.stack([along, np.where(height < line.radius, 0.0, deep), height], axis=1).astype(np.float32)
    assert is_edge_of_face(line, plate, pipe_views, [], [])


def test_mean_centre_is_of_the_views_that_show_a_pipe(pipe_views: list[View]) -> None:
    centre = mean_centre(PIPE, pipe_views)
    assert centre is not None
    assert centre[1] < -0.5
    far = np.array([50.0, 0.0, 0.0])
    assert mean_centre(Cylinder(PIPE.start + far, PIPE.end + far, PIPE.radius), pipe_views) is None


@settings(max_examples=50, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(0.85, 1.15), st.floats(-0.5, 1.0))
def test_lines_are_pieces_of_one_pipe_by_what_the_image_shows(radii: float, farther: float, ahead: float) -> None:
    """Whatever their depths: beside each other by less than the given radii, and no farther on than a clamp hides."""
    one = Cylinder(np.array([-0.3, 0.0, 0.0]), np.array([0.3, 0.0, 0.0]), 0.0086)
    centre = np.array([0.0, -1.2, 0.0])
    moved = np.array([ahead, 0.0, radii * one.radius])
    start, end = (centre + farther * (end + moved - centre) for end in (one.start, one.end))
    other = Cylinder(start, end, one.radius)
    assume(min(abs(abs(radii) - SAME_LINE), abs(abs(radii) - 2.0), abs(ahead - 0.9)) > 1e-9)  # rounding
    for allowed in (SAME_LINE, 2.0):
        assert covers(one, other, centre, allowed) == (abs(radii) < allowed and ahead < 0.9)


def test_cylinders_that_pass_each_other_have_what_both_show_in_common() -> None:
    """Two pipes side by side, one behind the other, of which the second begins 0.55 m before the first one ends."""
    centre = np.array([2.0, -2.5, 0.0])
    one = Cylinder(np.array([0.0, 0.0, 0.0]), np.array([3.0, 0.0, 0.0]), 0.0086)
    other = Cylinder(np.array([2.45, 0.0, 0.015]), np.array([5.45, 0.0, 0.015]), 0.0086)
    assert covers(one, other, centre, 2.0)
    assert covers(one, other, centre, 2.0, 0.5)
    assert not covers(one, other, centre, 2.0, 0.6)
    assert not covers(one, other, centre, 1.0)
