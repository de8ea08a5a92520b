# SPDX-License-Identifier: Apache-2.0
"""Pipes that end at both sides of a pillar, and pipes behind a duct: walls are points on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud import octree
from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.types import Cylinder
from pipeprog_detect.verification.keyframe_verifier import KeyframeVerifier
from pipeprog_detect.verification.measured_pipe import MeasuredPipe, joined
from pipeprog_detect.verification.parted_by_walls import parted_by_walls
from pipeprog_detect.verification.scene_context import SceneContext
from pipeprog_detect.verification.walls_across import stretches_in_walls, walls_across
from tests.unit.detect.straight_ahead import looking_along_y

AWAY = np.array([0.0, 1.0, 0.0])  # the cameras look along y
LEFT, RIGHT = -0.15, 0.1  # m: the sides of what stands between the pipes
AXIS = 0.2  # m: of the pipes before the wall at y = 0
RADIUS = 0.0365
VIEWS = [looking_along_y(x, stamp) for stamp, x in enumerate(np.linspace(-0.4, 0.4, 5))]  # blank: no contour


def sides(back: float, front: float, low: float = -0.4, high: float = 0.4) -> SceneContext:
    """Both sides of a box from `front` to `back` [m before the wall], between two heights [m]."""
    y, z = np.meshgrid(np.arange(-front, -back, 0.01), np.arange(low, high, 0.01))
    faces = [np.stack([np.full_like(y, x), y, z], axis=-1).reshape(-1, 3) for x in (LEFT, RIGHT)]
    points = octree.build(np.concatenate(faces))
    planes = [Plane(np.array([1.0, 0.0, 0.0]), x, (front - back) * (high - low)) for x in (LEFT, RIGHT)]
    return SceneContext(points, None, planes, points, 5e-4)


PILLAR, DUCT = sides(0.0, 0.3), sides(0.26, 0.5)


def along_x(low: float, high: float) -> Cylinder:
    return Cylinder(np.array([low, -AXIS, 0.0]), np.array([high, -AXIS, 0.0]), RADIUS)


def pipe(low: float, high: float) -> MeasuredPipe:
    evidence = CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
    return MeasuredPipe(Candidate(along_x(low, high), 2e-4, 1000, evidence), along_x(low, high), 2e-4)


class Measuring:
    """Stands for a verifier: the pipe has the given ends [m] along x, where it has grown to; without, none is found."""

    def __init__(self, low: float | None = None, high: float = 0.0) -> None:
        self._ends = low, high
        self.asked: list[Cylinder] = []

    def measured(self, candidate: Candidate, others: Sequence[Cylinder], trusted: bool) -> MeasuredPipe | None:
        self.asked.append(candidate.cylinder)
        low, high = self._ends
        return None if low is None else pipe(max(low, candidate.cylinder.start[0] - 0.2), high)


def parted(whole: MeasuredPipe, context: SceneContext, verifier: Measuring | None = None) -> list[FloatArray]:
    """Ends (2,) along x of each part."""
    parts = parted_by_walls([whole], context, VIEWS, cast(KeyframeVerifier, verifier or Measuring()))
    return [np.array([part.cylinder.start[0], part.cylinder.end[0]]) for part in parts]


def test_the_sides_of_a_pillar_cross_the_axis_and_those_of_a_duct_before_it_do_not() -> None:
    whole = along_x(-1.0, 1.0)
    assert walls_across(whole, PILLAR, AWAY) == pytest.approx([1.0 + LEFT, 1.0 + RIGHT], abs=1e-3)
    assert walls_across(whole, DUCT, AWAY) == []


def test_a_wall_along_the_axis_or_beyond_its_ends_does_not_cross_it() -> None:
    assert walls_across(along_x(-1.0, LEFT + 0.5 * RADIUS), PILLAR, AWAY) == []
    upright = Cylinder(np.array([0.0, -AXIS, -1.0]), np.array([0.0, -AXIS, 1.0]), RADIUS)
    assert walls_across(upright, PILLAR, AWAY) == []


def test_what_has_no_contour_between_the_sides_is_within_the_pillar() -> None:
    whole = along_x(-1.0, 1.0)
    assert stretches_in_walls(whole, PILLAR, VIEWS, []) == [pytest.approx((1.0 + LEFT, 1.0 + RIGHT), abs=1e-3)]
    assert stretches_in_walls(whole, PILLAR, [], []) == []


def test_pipes_on_both_sides_of_a_pillar_are_two_and_one_behind_a_duct_is_one() -> None:
    first, second = parted(pipe(-1.0, 1.0), PILLAR)
    assert first == pytest.approx([-1.0, LEFT], abs=1e-3)
    assert second == pytest.approx([RIGHT, 1.0], abs=1e-3)
    assert parted(pipe(-1.0, 1.0), DUCT) == [pytest.approx([-1.0, 1.0])]


@pytest.mark.parametrize(("end", "left"), [(RIGHT - 0.01, LEFT), (LEFT + 0.4, LEFT + 0.4)])
def test_a_pipe_that_has_grown_behind_one_side_ends_there(end: float, left: float) -> None:
    """Not one that goes on for longer than what hides it: its contour may be missed for other reasons."""
    one_side = SceneContext(PILLAR.tree, None, PILLAR.planes[:1], PILLAR.walls, 5e-4)
    assert parted(pipe(-1.0, end), one_side) == [pytest.approx([-1.0, left], abs=1e-3)]


def test_parts_are_measured_anew_and_do_not_grow_into_the_pillar_again() -> None:
    verifier = Measuring(-1.1, 0.7)
    ends = parted(pipe(-1.0, 1.0), PILLAR, verifier)
    assert [each.length for each in verifier.asked] == pytest.approx([1.0 + LEFT, 1.0 - RIGHT], abs=1e-3)
    assert ends == [pytest.approx([-1.1, LEFT], abs=1e-3), pytest.approx([RIGHT, 0.7], abs=1e-3)]


def test_pieces_on_both_sides_of_a_pillar_are_not_joined() -> None:
    pieces = [pipe(-1.0, LEFT - 0.02), pipe(RIGHT + 0.02, 1.0)]
    assert len(joined(pieces, VIEWS, context=PILLAR)) == 2
    assert len(joined(pieces, VIEWS, context=DUCT)) == 1
