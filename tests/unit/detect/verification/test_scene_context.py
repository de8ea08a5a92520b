# SPDX-License-Identifier: Apache-2.0
"""Cylinders beside and within walls that are known as points on a grid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud import octree
from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.types import Cylinder
from pipeprog_detect.verification.scene_context import SceneContext

SIGMA = 5e-4
SPACING = 0.01
AWAY = np.array([0.0, 1.0, 0.0])  # the camera stands at negative y
RADIUS = 0.0086


def wall(low: list[float], high: list[float]) -> FloatArray:
    """Points (N, 3) of an upright rectangle, with the cloud's noise across it."""
    axes = [np.arange(a, b + 1e-9, SPACING) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    across = next(k for k in range(3) if low[k] == high[k])
    points[:, across] += np.random.default_rng(0).normal(0.0, SIGMA, len(points))
    return points


BACK = wall([-0.5, 0.0, 0.0], [0.5, 0.0, 1.0])
SIDE = wall([-0.5, -1.0, 0.0], [-0.5, 0.0, 1.0])


def surroundings(*walls: FloatArray, planes: Sequence[Plane] = ()) -> SceneContext:
    points = octree.build(np.concatenate([np.array([[9.0, 9.0, 9.0]]), *walls]))
    return SceneContext(points, None, planes, points, SIGMA)


def upright(x: float, y: float, radius: float = RADIUS, low: float = 0.1, high: float = 0.9) -> Cylinder:
    return Cylinder(np.array([x, y, low]), np.array([x, y, high]), radius)


@pytest.mark.parametrize("radius", [0.0086, 0.0365, 0.11])
def test_a_pipe_that_touches_the_wall_is_not_embedded(radius: float) -> None:
    assert not surroundings(BACK).is_embedded(upright(0.0, -radius, radius), 1e-4, AWAY)


def test_a_pipe_whose_axis_lies_behind_the_wall_is_embedded() -> None:
    assert surroundings(BACK).is_embedded(upright(0.0, 0.006), 1e-4, AWAY)


def test_a_radius_that_is_not_known_may_have_led_the_axis_behind_the_wall() -> None:
    assert not surroundings(BACK).is_embedded(upright(0.0, 0.006), 4e-3, AWAY)


def test_a_pipe_half_in_the_wall_is_embedded_and_one_on_it_is_not() -> None:
    assert surroundings(BACK).is_embedded(upright(0.0, 0.0), 1e-4, AWAY)
    assert not surroundings(BACK).is_embedded(upright(0.0, -RADIUS), 1e-4, AWAY)


def test_the_line_where_two_walls_meet_is_embedded_and_a_pipe_before_it_is_not() -> None:
    corner = surroundings(BACK, SIDE)
    aslant = np.array([-0.3, 1.0, 0.0])
    assert corner.is_embedded(upright(-0.507, 0.006), 1e-4, aslant)
    assert not corner.is_embedded(upright(-0.5 + RADIUS, -RADIUS), 1e-4, aslant)


def test_a_thick_pipe_near_a_corner_looked_at_aslant_is_not_embedded() -> None:
    """Both walls come nearer than its axis, but only far beside it: a DN200 before its wall was taken for a part."""
    thick = upright(-0.27, -0.14, 0.1095)
    assert not surroundings(BACK, SIDE).is_embedded(thick, 3e-4, np.array([-0.37, 0.93, 0.0]))


def test_a_wall_that_goes_through_a_pipe_or_before_it_covers_it_and_one_that_touches_it_does_not() -> None:
    """As the face of a duct, of which the edge was taken for a contour, and that of a wall that carries the pipe."""
    radius = 0.0579
    duct = surroundings(wall([-0.5, 0.0, 0.0], [0.04, 0.0, 1.0]))
    for depth in (0.051, 0.067):
        assert duct.is_covered(upright(0.0, depth, radius), 3e-4, AWAY)
        assert not duct.is_embedded(upright(0.0, depth, radius), 3e-4, AWAY)
    assert not surroundings(BACK).is_covered(upright(0.0, -radius, radius), 3e-4, AWAY)


def test_a_wall_far_before_a_pipe_or_beside_it_does_not_cover_it() -> None:
    assert not surroundings(BACK).is_covered(upright(0.0, 0.08, 0.0365), 1e-4, AWAY)
    assert not surroundings(SIDE).is_covered(upright(-0.5 + 0.0365, -0.5, 0.0365), 1e-4, AWAY)


def test_a_pipe_that_goes_on_into_a_wall_is_not_covered() -> None:
    across = Cylinder(np.array([0.0, -0.8, 0.5]), np.array([0.0, 0.1, 0.5]), 0.0365)
    assert not surroundings(BACK).is_covered(across, 1e-4, np.array([1.0, 0.0, 0.0]))


def test_a_wall_on_one_side_hides_one_side_only() -> None:
    beside = wall([0.01, -0.2, 0.0], [0.5, -0.2, 1.0])
    assert not surroundings(beside).is_embedded(upright(-0.01, 0.0), 1e-4, AWAY)


def test_a_pipe_that_leaves_the_wall_for_most_of_its_length_stands() -> None:
    low, high = wall([-0.5, -0.02, 0.0], [0.5, -0.02, 0.41]), wall([-0.5, 0.0, 0.41], [0.5, 0.0, 1.0])
    assert not surroundings(low, high).is_embedded(upright(0.0, -RADIUS), 1e-4, AWAY)
    assert surroundings(low, high).is_embedded(upright(0.0, -RADIUS, high=0.6), 1e-4, AWAY)


@pytest.mark.parametrize(("seen", "embedded"), [(0.3, True), (0.1, False)])
def test_a_line_in_a_wall_is_embedded_though_most_of_the_wall_is_not_seen(seen: float, embedded: bool) -> None:
    """`seen`: how far up the wall is seen beside 0.8 m of the line [m]."""
    part = wall([-0.5, 0.0, 0.1], [0.5, 0.0, 0.1 + seen])
    assert surroundings(part).is_embedded(upright(0.0, 0.006), 1e-4, AWAY) is embedded


def test_without_walls_nothing_is_embedded() -> None:
    assert not surroundings().is_embedded(upright(0.0, 0.0), 1e-4, AWAY)


@pytest.mark.parametrize(("before", "touches"), [(-0.002, True), (0.0, True), (1.0, True), (1.8, False), (4.0, False)])
def test_what_is_no_farther_from_a_wall_than_its_radius_touches_it(before: float, touches: bool) -> None:
    """`before`: distance of the axis from the wall, in radii."""
    assert surroundings(BACK).touches_wall(upright(0.0, -before * RADIUS)) is touches


def test_a_pipe_that_ends_at_a_wall_does_not_touch_it() -> None:
    beside = Cylinder(np.array([0.0, -0.8, 0.5]), np.array([0.0, 0.0, 0.5]), RADIUS)
    assert not surroundings(BACK).touches_wall(beside)


@pytest.mark.parametrize(("gap", "before", "touches"), [(0.025, 0.5, True), (0.025, 1.8, False), (0.06, 0.5, False)])
def test_a_wall_that_ends_beside_a_line_goes_on_to_it(gap: float, before: float, touches: bool) -> None:
    """`gap` [m]: from the wall's last points to the axis; `before`: distance of the axis from its plane, in radii."""
    ends = wall([gap, 0.0, 0.0], [0.5, 0.0, 1.0])
    around = surroundings(ends, planes=[Plane(AWAY, 0.0, 0.5)])
    assert around.touches_wall(upright(0.0, -before * RADIUS)) is touches


@pytest.mark.parametrize(("behind", "touches"), [(0.0, True), (0.02, False)])
def test_a_strip_of_a_wall_that_was_found_as_no_plane_is_a_wall(behind: float, touches: bool) -> None:
    """`behind` [m]: of the strip's points, from the plane that was found elsewhere."""
    strip = octree.build(wall([-0.02, behind, 0.0], [0.02, behind, 1.0]))
    elsewhere = octree.build(wall([0.3, 0.0, 0.0], [0.5, 0.0, 1.0]))
    around = SceneContext(strip, None, [Plane(AWAY, 0.0, 0.2)], elsewhere, SIGMA)
    assert around.touches_wall(upright(0.0, -0.5 * RADIUS)) is touches


@pytest.mark.parametrize(
    ("gap", "crossing", "touches"), [(0.15, 0.005, True), (0.25, 0.005, False), (0.15, 0.02, False)]
)
def test_a_wall_goes_on_farther_to_a_line_in_which_another_one_crosses_it(
    gap: float, crossing: float, touches: bool
) -> None:
    """Of the floor at a wall's foot little was seen. `crossing`: distance of the axis from the other plane [m]."""
    ends = wall([gap, 0.0, 0.0], [0.5, 0.0, 1.0])
    around = surroundings(ends, planes=[Plane(AWAY, 0.0, 0.5), Plane(np.array([1.0, 0.0, 0.0]), 0.0, 0.1)])
    assert around.touches_wall(upright(crossing, 0.0)) is touches


@pytest.mark.parametrize(("low", "high", "rejected"), [(0.0, 1.0, True), (0.45, 1.0, True), (0.7, 1.0, False)])
def test_the_rounding_of_a_corner_is_one_of_planes_that_are_seen_beside_it(
    low: float, high: float, rejected: bool
) -> None:
    """`low`, `high` [m]: where one of the two planes begins and ends; the candidate reaches from 0.1 to 0.9 m."""
    radius = 0.03
    back, side = Plane(AWAY, 0.0, 1.0), Plane(np.array([1.0, 0.0, 0.0]), -0.5, 1.0)
    rounding = upright(-0.5 + radius, -radius, radius)
    angle = np.linspace(0.5 * np.pi, np.pi, 50)  # the quarter of its section that faces the corner
    section = np.stack([np.cos(angle), np.sin(angle)], axis=1) * radius + rounding.start[:2]
    surface = np.concatenate([np.column_stack([section, np.full(50, z)]) for z in np.arange(0.1, 0.9, SPACING)])
    walls = octree.build(np.concatenate([BACK, wall([-0.5, -1.0, low], [-0.5, 0.0, high])]))
    around = SceneContext(octree.build(surface), None, [back, side], walls, SIGMA)
    evidence = CloudEvidence(arc=0.5 * np.pi, coverage=1.0, inside=0.0, noise=SIGMA, roundness=0.0, flatness=100.0)
    assert around.rejects(Candidate(rounding, 1e-3, len(surface), evidence)) is rejected


def test_a_wall_bounds_the_room_where_next_to_nothing_is_seen_behind_it() -> None:
    board = BACK[BACK[:, 2] < 0.5] - 0.3 * AWAY
    far, near = Plane(AWAY, 0.0, 1.0), Plane(-AWAY, 0.3, 0.51)
    around = surroundings(BACK, board, planes=[far, near])
    assert around.bounds_room(far, AWAY)  # one point behind it is astray
    assert not around.bounds_room(far, -AWAY)
    assert not around.bounds_room(near, AWAY)
