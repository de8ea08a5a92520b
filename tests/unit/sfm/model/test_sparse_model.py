# SPDX-License-Identifier: Apache-2.0
"""A sparse model of a synthetic scene: tracks, contradictions, what is dropped and taken over."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import FOCAL, POINTS, VIEWS, bundle, sparse_model

from pipeprog_sfm.model.bundle_adjustment import rotation_from_vector
from pipeprog_sfm.model.tracks import by_point
from pipeprog_sfm.sparse.registration import epipolar_errors


def test_links_become_one_track_a_point() -> None:
    built = sparse_model()
    ids, start, _ = built.observations(np.ones(len(built.points), bool))
    assert len(ids) == POINTS
    assert (np.diff(start) == VIEWS).all()
    assert np.sort(built.points[ids], axis=0) == pytest.approx(np.sort(bundle(0.0).points, axis=0), abs=1e-6)


@given(st.lists(st.integers(-1, 6), max_size=40), st.lists(st.booleans(), min_size=7, max_size=7))
def test_features_come_point_by_point(point_of: list[int], chosen: list[bool]) -> None:
    ids, start, features = by_point(np.array(point_of, np.int64), np.array(chosen))
    expected = [point for point in range(7) if chosen[point] and point in point_of]
    assert ids.tolist() == expected
    assert len(start) == len(expected) + 1
    for number, point in enumerate(expected):
        own = [feature for feature, other in enumerate(point_of) if other == point]
        assert features[start[number] : start[number + 1]].tolist() == own
    assert start[-1] == len(features)


def test_a_moved_view_contradicts_its_matches() -> None:
    built = sparse_model()
    same = np.repeat(np.arange(POINTS, dtype=np.int32)[:, None], 2, axis=1)
    assert epipolar_errors(built, 3, 2, same).max() < 1e-6
    built.translation[3] += [0.0, 0.1, 0.0]
    assert np.median(epipolar_errors(built, 3, 2, same)) > 10


def test_filter_drops_a_wrong_observation_and_a_point_without_parallax() -> None:
    built = sparse_model()
    built.rays[built.offsets[2] + 7] += 10 / FOCAL
    built.filter(*built.observations(np.ones(len(built.points), bool)))
    assert (built.point_of < 0).nonzero()[0].tolist() == [built.offsets[2] + 7]


def test_drop_and_absorb_keep_the_tracks() -> None:
    built, other = sparse_model(), sparse_model()
    built.drop(2)
    assert built.stamps == [0, 1, 3, 4, 5]
    ids, start, features = built.observations(np.ones(len(built.points), bool))
    assert (np.diff(start) == VIEWS - 1).all()
    assert built.errors(features).max() < 1e-6
    rigid = np.eye(4)
    rigid[:3, :3] = rotation_from_vector(np.array([[0.3, -0.2, 0.5]]))[0]
    rigid[:3, 3] = [1.0, 2.0, 3.0]
    built.absorb(other, 2.0, rigid)
    ids, start, features = built.observations(np.ones(len(built.points), bool))
    assert len(ids) == 2 * POINTS
    assert built.errors(features).max() < 1e-6
