# SPDX-License-Identifier: Apache-2.0
"""The limit to the keyframes of a map: fewer are chosen from half of it on, and none at it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeprog_frames.config import FramesConfig
from pipeprog_frames.frame_decision import FULL, Decision
from pipeprog_frames.incoming.frame_buffer import EncodedFrame, FrameFile
from pipeprog_frames.overlap_feedback import OverlapReport
from pipeprog_frames.policy.keyframe_budget import KeyframeBudget
from pipeprog_frames.policy.keyframe_limits import LOADED_OVERLAP
from pipeprog_frames.policy.stream import FULL_LAG, KeyframeStream
from tests.unit.frames.policy.test_selector import CAMERA, load, pan, wall

__all__ = ["wall"]
STEP = 8  # px from frame to frame
PERIOD = 200_000_000  # ns


@pytest.mark.parametrize(("held", "load_of_it", "is_full"), [(5, 0.0, False), (8, 0.6, False), (10, 1.0, True)])
def test_the_load_rises_from_half_of_the_limit_to_the_limit(held: int, load_of_it: float, is_full: bool) -> None:
    budget = KeyframeBudget(10)
    budget.held = held
    assert budget.load == pytest.approx(load_of_it)
    assert budget.is_full == is_full


def test_without_a_limit_there_is_no_load() -> None:
    budget = KeyframeBudget(0)
    budget.held = 100_000
    assert (budget.load, budget.is_full) == (0.0, False)


class Walk:
    """A stream of a camera that pans along the wall, and what it decides."""

    def __init__(self, wall: NDArray[np.uint8], most: int) -> None:
        self.budget = KeyframeBudget(most)
        self._wall, self._store, self._count = wall, FrameFile(), 0
        self.stream = KeyframeStream(FramesConfig(), CAMERA, self._store.sharpest_between, self.budget)

    def go(self, frames: int) -> list[Decision]:
        decisions = []
        for _ in range(frames):
            image, stamp = pan(self._wall, STEP * self._count), 1 + self._count * PERIOD
            self._store.add(EncodedFrame(stamp, "camera", cv2.imencode(".jpg", image)[1].tobytes(), CAMERA))
            decisions += self.stream.consider(stamp, load(image))
            self._count += 1
        return decisions


def chosen(decisions: list[Decision]) -> list[int]:
    return [decision.stamp for decision in decisions if decision.chosen]


def test_near_the_limit_keyframes_are_thinned_and_at_it_none_is_chosen(wall: NDArray[np.uint8]) -> None:
    walk = Walk(wall, most=10)
    decisions = walk.go(180)
    keyframes = chosen(decisions)
    assert len(keyframes) == walk.budget.held == 10
    gaps = np.diff(keyframes)
    assert gaps[-1] > gaps[0]
    assert walk.stream.overlap_min == pytest.approx(LOADED_OVERLAP)
    left_out = [decision.stamp for decision in decisions if decision.reason == FULL]
    assert left_out
    assert min(left_out) > keyframes[-1]
    assert len({decision.stamp for decision in decisions}) == len(decisions)


def test_what_is_retired_makes_room(wall: NDArray[np.uint8]) -> None:
    walk = Walk(wall, most=6)
    keyframes = chosen(walk.go(100))
    assert walk.budget.is_full
    seen_before = [OverlapReport(stamp, True, 0.9, 0.9, 500, 500, place_overlap=0.99) for stamp in keyframes]
    retired = [decision.stamp for decision in walk.stream.answer(seen_before) if not decision.chosen]
    assert walk.budget.held == 6 - len(retired) < 6
    assert chosen(walk.go(60))


@pytest.mark.parametrize(("behind", "held", "overlap"), [(0, 8, 0.7), (FULL_LAG, 8, 0.6), (FULL_LAG, 0, 0.6)])
def test_the_larger_of_both_loads_counts(wall: NDArray[np.uint8], behind: int, held: int, overlap: float) -> None:
    walk = Walk(wall, most=10)
    walk.budget.held = held
    walk.stream.lag(behind)
    assert walk.stream.overlap_min == pytest.approx(overlap)


def test_a_new_track_begins_under_the_same_load(wall: NDArray[np.uint8]) -> None:
    walk = Walk(wall, most=0)
    walk.go(2)
    walk.stream.lag(FULL_LAG)
    walk.stream.begin_anew(CAMERA)
    walk.go(1)
    assert walk.stream.overlap_min == pytest.approx(LOADED_OVERLAP)
