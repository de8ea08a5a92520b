# SPDX-License-Identifier: Apache-2.0
"""Keyframes that show the same, among others that do not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CAMERA, STEP, pose, view

from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.matching import MatchArray, match
from pipeprog_sfm.features.retrieval import SUBSET, Retrieval


def keyframe(n: int, x: float) -> Keyframe:
    return Keyframe.of(n * STEP, view(pose(x), n), CAMERA)


def test_the_views_that_look_alike_come_first() -> None:
    others = [keyframe(n, x) for n, x in enumerate([4.0, 0.3, 3.0, 0.1, 5.0])]
    assert Retrieval().most_similar(keyframe(9, 0.0), others, 20).tolist() == [3, 1]
    assert not len(Retrieval().most_similar(keyframe(9, 0.0), [others[0], others[4]], 20))


@pytest.mark.parametrize("count", [1, SUBSET, 23])
def test_every_view_has_its_turn(count: int) -> None:
    retrieval = Retrieval()
    turns = [retrieval.next_subset(count).tolist() for _ in range(count)]
    assert {len(set(turn)) for turn in turns} == {min(count, SUBSET)}
    assert set().union(*turns) == set(range(count))


def test_matches_are_found_once_and_anew_after_other_features() -> None:
    calls = []

    def counted(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> MatchArray:
        calls.append((len(a), len(b)))
        return match(a, b)

    first, second, retrieval = keyframe(0, 0.0), keyframe(1, 0.1), Retrieval(counted)
    found = retrieval.matches(first, second, 400)
    assert len(found) > 50
    assert retrieval.matches(first, second, 400) is found
    assert len(calls) == 1
    retrieval.forget(second.stamp)
    assert retrieval.matches(first, second, 400) is not found
    assert len(calls) == 2


def test_what_is_remembered_is_bounded() -> None:
    keyframes, retrieval = [keyframe(n, 0.1 * n) for n in range(4)], Retrieval(remembered=2)
    first = retrieval.matches(keyframes[0], keyframes[1], 50)
    for other in keyframes[2:]:
        retrieval.matches(keyframes[0], other, 50)
    assert retrieval.matches(keyframes[0], keyframes[1], 50) is not first
