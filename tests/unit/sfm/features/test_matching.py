# SPDX-License-Identifier: Apache-2.0
"""Matching of random descriptors with a known permutation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeprog_sfm.features import matching
from pipeprog_sfm.features.matching import match, match_guided
from pipeprog_sfm.features.sift import root_sift

COUNT = 400


def descriptors(seed: int, count: int = COUNT) -> NDArray[np.float32]:
    return np.random.default_rng(seed).gamma(0.7, 1.0, (count, 128)).astype(np.float32)


def noisy(looks: NDArray[np.float32], seed: int) -> NDArray[np.uint8]:
    return root_sift(looks * np.random.default_rng(seed).lognormal(0, 0.15, looks.shape).astype(np.float32))


def test_match_finds_a_permutation() -> None:
    looks = descriptors(0)
    order = np.random.default_rng(1).permutation(COUNT)
    found = match(noisy(looks, 2), noisy(looks[order], 3))
    assert len(found) > 0.95 * COUNT
    assert (order[found[:, 1]] == found[:, 0]).all()


def test_match_refuses_unrelated_and_ambiguous_features() -> None:
    looks = descriptors(0)
    assert len(match(root_sift(looks), root_sift(descriptors(9)))) == 0
    assert len(match(noisy(looks, 2), root_sift(np.concatenate([looks, looks])))) == 0


def test_the_largest_of_each_column_is_the_first_one() -> None:
    values = np.random.default_rng(0).integers(0, 5, (30, 200)).astype(np.float32)  # many are as large
    np.testing.assert_array_equal(matching._largest_of_columns(values), values.argmax(axis=0))


def test_match_of_nothing_is_empty() -> None:
    empty = np.empty((0, 128), np.uint8)
    assert match(empty, root_sift(descriptors(0))).shape == (0, 2)
    nowhere = np.empty((0, 2))
    assert match_guided(
        empty, nowhere, nowhere, root_sift(descriptors(0)), np.zeros((COUNT, 2), np.float32), 4.0
    ).shape == (0, 2)


def test_guided_match_tells_twins_apart_by_place() -> None:
    rng = np.random.default_rng(4)
    looks = descriptors(0)
    places = rng.uniform([0, 0], [1000, 700], (COUNT, 2))
    twins = places + np.array([300, 0])
    near = places + np.array([-20, 1])
    far = places + np.array([20, 1])
    found = match_guided(
        noisy(looks, 2),
        near,
        far,
        noisy(np.concatenate([looks, looks]), 3),
        np.concatenate([places, twins]).astype(np.float32),
        4.0,
    )
    assert len(found) > 0.95 * COUNT
    assert (found[:, 0] == found[:, 1]).all()


def test_guided_match_stays_within_the_radius_of_the_segment() -> None:
    looks = descriptors(0, 4)
    near = np.array([[100.0, 100], [100, 200], [100, 300], [np.nan, 0]])
    far = np.array([[200.0, 100], [200, 200], [200, 300], [200, 400]])
    places = np.array([[150, 103.9], [150, 204.1], [203.9, 300], [150, 400]], np.float32)
    found = match_guided(noisy(looks, 1), near, far, noisy(looks, 2), places, 4.0)
    assert found.tolist() == [[0, 0], [2, 2]]


def test_guided_match_uses_no_feature_twice() -> None:
    looks = descriptors(0, 1)
    both = np.concatenate([noisy(looks, 1), noisy(looks, 1)])
    place = np.array([[50.0, 50.0]])
    twice = np.concatenate([place, place])
    found = match_guided(both, twice, twice, noisy(looks, 2), place.astype(np.float32), 4.0)
    assert len(found) == 1
