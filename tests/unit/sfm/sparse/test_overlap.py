# SPDX-License-Identifier: Apache-2.0
"""Eq. 1 of the paper on a map that is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import BASE, CAMERA, STEP, pose, view

from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.features.keyframe import Keyframe, hull_area
from pipeprog_sfm.features.sift import Features
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.overlap import OverlapTracker, place_overlap


def keyframe(stamp: int, corners: list[tuple[float, float]]) -> Keyframe:
    return Keyframe.of(stamp, Features(np.array(corners, np.float32), np.zeros((len(corners), 128), np.uint8)), CAMERA)


SQUARE = [(100.0, 100.0), (500.0, 100.0), (500.0, 500.0), (100.0, 500.0)]


def test_overlap_is_the_share_of_the_hull_and_of_the_cells_that_tie_points_span() -> None:
    first, second = keyframe(0, SQUARE), keyframe(STEP, SQUARE)
    model = SparseModel()
    for one in (first, second):
        model.add_view(one.stamp, one.rays, one.focal, np.eye(4))
    model.points = np.zeros((4, 3))
    model.point_of[:] = [0, 1, 2, 3, 0, 1, 2, -1]
    keyframes = {0: first, STEP: second, 2 * STEP: keyframe(2 * STEP, SQUARE)}
    told = {tie.stamp: tie for tie in OverlapTracker().changed(keyframes, model, places=True)}
    assert (told[0].overlap, told[0].cell_overlap, told[0].tie_points) == (1.0, 1.0, 4)
    # Three corners span half of the square, in three of four cells.
    assert (told[STEP].overlap, told[STEP].cell_overlap) == (pytest.approx(0.5), 0.75)
    assert (told[STEP].tie_points, told[STEP].features) == (3, 4)
    assert told[0].matches_next == told[STEP].matches_previous == 3
    assert not told[2 * STEP].registered
    assert (told[2 * STEP].overlap, told[STEP].matches_next) == (0.0, 0)


def test_the_keyframes_before_and_after_are_those_of_the_same_camera() -> None:
    left = [replace(keyframe(STEP * number, SQUARE), frame="left") for number in range(2)]
    right = [replace(keyframe(STEP * number + 1, SQUARE), frame="right") for number in range(2)]
    model = SparseModel()
    for one in (*left, *right):
        model.add_view(one.stamp, one.rays, one.focal, np.eye(4))
    model.points = np.zeros((8, 3))
    model.point_of[:] = [0, 1, 2, 3, 0, 1, 2, -1, 4, 5, 6, 7, 4, 5, -1, -1]
    told = OverlapTracker().changed({one.stamp: one for one in (*left, *right)}, model, places=True)
    assert [tie.stamp for tie in told] == [0, 1, STEP, STEP + 1]
    assert [tie.matches_next for tie in told] == [3, 2, 0, 0]
    assert [tie.matches_previous for tie in told] == [0, 0, 3, 2]


def test_features_shifted_to_the_middle_row_span_no_more_than_the_image_as_it_is() -> None:
    moving = RowMotion(0.03, CAMERA.height, np.array([0.0, -2.0, 0.0]), np.zeros(3))
    wider = keyframe(0, SQUARE).unrolled(moving, np.ones(4))
    assert hull_area(wider.features.keypoints) > 1.02 * wider.hull
    model = SparseModel()
    model.add_view(0, wider.rays, wider.focal, np.eye(4))
    model.points = np.zeros((4, 3))
    model.point_of[:] = [0, 1, 2, 3]
    assert [tie.overlap for tie in OverlapTracker().changed({0: wider}, model, places=True)] == [1.0]


def test_it_is_told_again_when_it_changes_and_when_it_was_forgotten() -> None:
    one, overlaps, model = keyframe(0, SQUARE), OverlapTracker(), SparseModel()
    assert len(overlaps.changed({0: one}, model, places=True)) == 1
    assert overlaps.changed({0: one}, model, places=True) == []
    overlaps.forget(0)
    assert len(overlaps.changed({0: one}, model, places=True)) == 1
    model.add_view(0, one.rays, one.focal, np.eye(4))
    assert [tie.registered for tie in overlaps.changed({0: one}, model, places=True)] == [True]


def visits(*places: float) -> tuple[SparseModel, dict[int, Keyframe]]:
    """Views from these places of the walk along the corner, and the points that they see, all true."""
    model, keyframes = SparseModel(), {}
    for number, place in enumerate(places):
        seen = Keyframe.of(STEP * number, view(pose(BASE * place), 7), CAMERA)
        keyframes[seen.stamp] = seen
        model.add_view(seen.stamp, seen.rays, seen.focal, pose(BASE * place))
    wall = np.c_[np.linspace(-2, 6, 4000), np.zeros(4000), np.full(4000, 2.0)]
    model.points = wall
    for each in range(len(places)):
        inside = wall @ model.rotation[each].T + model.translation[each]
        shown = np.flatnonzero(np.abs(inside[:, 0] / inside[:, 2]) < 639 / 900)[: len(keyframes[STEP * each].rays)]
        model.point_of[model.features(each)][: len(shown)] = shown
    return model, keyframes


def seen_before(model: SparseModel, view: int, keyframes: dict[int, Keyframe]) -> float:
    return place_overlap(model, view, model.covisible(np.array([view]))[0], keyframes)


def test_a_place_was_seen_by_keyframes_of_an_earlier_visit_and_not_by_later_ones() -> None:
    model, keyframes = visits(*range(5), *range(14), 3.2)
    others = [0.2, 0.2, 0.8]  # of 3 and 4, which both visits have
    shown = [1 - shift * BASE / (2 * 1280 / 900) for shift in others]
    assert seen_before(model, 19, keyframes) == pytest.approx(min(shown), abs=0.02)
    assert [seen_before(model, each, keyframes) for each in range(5)] == [0.0] * 5


def test_views_share_the_points_that_both_see() -> None:
    model, _ = visits(0, 1, 3, 1)
    model.point_of[model.features(3)] = -1
    shared = model.covisible(np.arange(4))
    for number in range(4):
        own = set(model.seen(number).tolist())
        expected = [0 if other == number else len(own & set(model.seen(other).tolist())) for other in range(4)]
        assert shared[number].tolist() == expected
    assert 0 < shared[0, 2] < shared[0, 1]
    np.testing.assert_array_equal(model.covisible(np.array([2, 0])), shared[[2, 0]])


def test_neighbours_in_time_and_views_that_nothing_ties_are_no_earlier_visit() -> None:
    model, keyframes = visits(*range(5), 3.2)
    assert seen_before(model, 5, keyframes) == 0.0
    model, keyframes = visits(*range(5), *range(14), 3.2)
    last = model.features(19)
    model.points = np.concatenate([model.points, model.points])  # the same points, not yet known to be the same
    model.point_of[last] += np.where(model.point_of[last] >= 0, 4000, 0)
    assert seen_before(model, 19, keyframes) == 0.0


def test_a_rig_has_as_many_more_neighbours_in_time_as_it_has_cameras() -> None:
    model, keyframes = visits(*range(5), *range(14), 3.2)
    sides = {stamp: replace(each, frame="left" if stamp // STEP % 2 else "right") for stamp, each in keyframes.items()}
    assert seen_before(model, 19, keyframes) > 0.9
    assert seen_before(model, 19, sides) == 0.0
