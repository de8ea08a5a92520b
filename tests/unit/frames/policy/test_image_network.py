# SPDX-License-Identifier: Apache-2.0
"""Algorithm 1 and the stream's feedback on synthetic recordings: the SfM is a formula instead of a reconstruction."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeprog_frames.frame_decision import Decision
from pipeprog_frames.overlap_feedback import OverlapReport, StreamFeedback
from pipeprog_frames.policy.image_network import START_PERIOD, ImageNetwork
from pipeprog_frames.policy.keyframe_budget import KeyframeBudget

FEATURES = 2000
FPS = 30
PERIOD = 1_000_000_000 // FPS
TEXTURE = np.random.default_rng(0).integers(0, 255, (180, 320), dtype=np.uint8)


@dataclass
class Walk:
    """A camera along a wall: places of the frames in widths of the image, and frames that never register."""

    place: NDArray[np.float64]
    blind: frozenset[int] = frozenset()

    @property
    def stamps(self) -> list[int]:
        return [1 + index * PERIOD for index in range(len(self.place))]

    def sharpest_between(self, after: int, before: int, without: Collection[int]) -> int | None:
        stamps = self.stamps
        inside = [
            stamp
            for stamp in stamps[bisect_left(stamps, after + 1) : bisect_left(stamps, before)]
            if stamp not in without
        ]
        return min(inside, key=lambda stamp: abs(2 * stamp - after - before), default=None)

    def reports(self, images: Collection[int]) -> list[OverlapReport]:
        """An image registers with half of it in common with a neighbour; tied is what one of the neighbours shows."""
        ordered = sorted(images)
        place = {stamp: self.place[(stamp - 1) // PERIOD] for stamp in ordered}
        result = []
        for index, stamp in enumerate(ordered):
            shifts = [
                place[ordered[k]] - place[stamp] if 0 <= k < len(ordered) else np.inf for k in (index - 1, index + 1)
            ]
            common = [max(1.0 - abs(shift), 0.0) for shift in shifts]
            # Neighbours on two sides show two sides of the image, on one side the same one.
            overlap = min(sum(common), 1.0) if (shifts[0] < 0) != (shifts[1] < 0) else max(common)
            registered = max(common) > 0.3 and (stamp - 1) // PERIOD not in self.blind
            matches = [round(FEATURES * share) for share in common]
            result.append(OverlapReport(stamp, registered, overlap if registered else 0.0, overlap, *matches))
        return result


def run_network(
    walk: Walk, overlap_min: float, band: float = 0.025
) -> tuple[ImageNetwork, list[OverlapReport], dict[int, int]]:
    """The network at its end, the reports of its images, and how often each frame changed."""
    network = ImageNetwork(overlap_min, overlap_min + band, walk.sharpest_between)
    changes: dict[int, int] = {}
    images: set[int] = set()

    def apply(decisions: list[Decision]) -> None:
        for decision in decisions:
            assert decision.chosen == (decision.stamp not in images), "an image is added or removed twice"
            images.symmetric_difference_update([decision.stamp])
            changes[decision.stamp] = changes.get(decision.stamp, 0) + 1

    for stamp in walk.stamps:
        apply([decision for decision in network.consider(stamp, lambda: TEXTURE) if decision.chosen])
    for _ in range(4 * len(walk.place)):
        network.answer(walk.reports(images))
        decisions = network.finish_round()
        if not decisions:
            return network, walk.reports(images), changes
        apply(decisions)
    raise AssertionError("the network does not end")


def steady(seconds: float, speed: float) -> Walk:
    """`speed` in widths of the image a second."""
    return Walk(np.arange(round(seconds * FPS)) * speed / FPS)


def test_the_network_starts_at_half_a_frame_a_second() -> None:
    walk = steady(20.0, 0.01)
    network = ImageNetwork(0.85, 0.875, walk.sharpest_between)
    chosen = [stamp for stamp in walk.stamps for d in network.consider(stamp, lambda: TEXTURE) if d.chosen]
    assert len(chosen) == 10
    assert np.diff(chosen).max() <= START_PERIOD + PERIOD


@pytest.mark.parametrize("overlap_min", [0.7, 0.8, 0.9, 0.95])
@pytest.mark.parametrize("speed", [0.05, 0.2, 0.5])
def test_every_image_is_in_the_band_or_has_its_reason(overlap_min: float, speed: float) -> None:
    network, reports, _ = run_network(steady(30.0, speed), overlap_min)
    excused = {decision.stamp for decision in network.report_outside_band()}
    outside = {report.stamp for report in reports if not overlap_min <= report.overlap <= overlap_min + 0.025}
    assert outside <= excused
    assert not [report for report in reports[1:-1] if report.overlap < overlap_min], (
        "there are frames enough to fill every gap"
    )


def test_images_that_do_not_register_get_one_frame_before_and_one_after() -> None:
    walk = steady(8.0, 0.4)  # two seconds apart nothing is in common
    network = ImageNetwork(0.7, 0.725, walk.sharpest_between)
    images = {stamp for stamp in walk.stamps for d in network.consider(stamp, lambda: TEXTURE) if d.chosen}
    reports = walk.reports(images)
    assert not any(report.registered for report in reports)
    network.answer(reports)
    added = [decision.stamp for decision in network.finish_round()]
    assert len(added) == 2 * len(images) - 2
    for first, second in pairwise(sorted(images)):
        assert sum(first < stamp < second for stamp in added) == 2


def test_a_slow_walk_loses_every_second_image_of_a_run() -> None:
    walk = steady(60.0, 0.01)
    network = ImageNetwork(0.7, 0.725, walk.sharpest_between)
    images = sorted({stamp for stamp in walk.stamps for d in network.consider(stamp, lambda: TEXTURE) if d.chosen})
    network.answer(walk.reports(images))
    gone = {decision.stamp for decision in network.finish_round() if not decision.chosen}
    assert gone == set(images[1:-1:2])


@settings(max_examples=25, deadline=None)
@given(
    steps=st.lists(st.floats(-0.2, 0.2), min_size=70, max_size=200),
    blind=st.frozensets(st.integers(0, 199), max_size=20),
    overlap_min=st.floats(0.5, 0.97),
    band=st.floats(0.001, 0.1),
)
def test_the_network_ends_whatever_the_walk(
    steps: list[float], blind: frozenset[int], overlap_min: float, band: float
) -> None:
    _, _, changes = run_network(Walk(np.cumsum(steps), blind), overlap_min, band)
    assert max(changes.values()) <= 3


def play(feedback: StreamFeedback, walk: Walk, chosen: list[int]) -> tuple[set[int], dict[int, int]]:
    """Keyframes in the end, and how often each frame was changed by feedback."""
    place = dict(zip(walk.stamps, walk.place.tolist(), strict=True))
    images: set[int] = set()
    changes: dict[int, int] = {}

    def settle(complete: bool) -> bool:
        decisions = feedback.answer(walk.reports(images), complete)
        for decision in decisions:
            assert decision.chosen == (decision.stamp not in images)
            images.symmetric_difference_update([decision.stamp])
            changes[decision.stamp] = changes.get(decision.stamp, 0) + 1
        return not decisions

    for before, stamp in zip([chosen[0], *chosen], chosen, strict=False):
        shift = abs(place[stamp] - place[before])
        feedback.chosen(Decision(stamp, True, "", 1.0 - shift, 100 * shift))
        images.add(stamp)
        settle(complete=False)
    assert any(settle(complete=True) for _ in range(len(place))), "the feedback does not end"
    return images, changes


def test_a_loose_image_gets_a_frame_on_its_looser_side() -> None:
    walk = Walk(np.r_[np.arange(40) * 0.005, 0.2 + np.arange(40) * 0.015])
    chosen = [walk.stamps[index] for index in (0, 20, 40, 79)]
    images, _ = play(StreamFeedback(0.85, 0.875, 1e9, walk.sharpest_between, KeyframeBudget(0)), walk, chosen)
    added = sorted(images - set(chosen))
    assert added
    assert min(added) > chosen[2], "the other gaps are dense enough"


def test_where_the_map_is_full_frames_are_added_once_there_is_room() -> None:
    walk = Walk(np.r_[np.arange(40) * 0.005, 0.2 + np.arange(40) * 0.015])
    chosen = [walk.stamps[index] for index in (0, 20, 40, 79)]
    budget = KeyframeBudget(len(chosen))
    feedback = StreamFeedback(0.85, 0.875, 1e9, walk.sharpest_between, budget)
    assert play(feedback, walk, chosen)[0] == set(chosen)
    budget.held -= 1  # as where another camera's keyframe is retired
    added = [decision.stamp for decision in feedback.answer((), complete=True) if decision.chosen]
    assert len(added) == 1
    assert budget.is_full


def test_a_gap_without_frames_and_a_stream_that_fits_change_nothing() -> None:
    walk = steady(10.0, 0.3)
    _, changes = play(
        StreamFeedback(0.85, 0.875, 1e9, walk.sharpest_between, KeyframeBudget(0)), walk, walk.stamps[::15]
    )
    assert not changes
    sparse = Walk(walk.place[::60])
    _, changes = play(
        StreamFeedback(0.85, 0.875, 1e9, sparse.sharpest_between, KeyframeBudget(0)), sparse, sparse.stamps
    )
    assert not changes


def test_runs_that_overlap_too_much_lose_every_second_keyframe() -> None:
    walk = steady(10.0, 0.3)
    dense = walk.stamps[::5]  # 0.05 apart: two steps still overlap by 0.9
    images, _ = play(StreamFeedback(0.85, 0.875, 1e9, walk.sharpest_between, KeyframeBudget(0)), walk, dense)
    assert len(images) < 0.6 * len(dense)
    place = walk.place[[(stamp - 1) // PERIOD for stamp in sorted(images)]]
    assert np.diff(place).max() <= 0.15 + 1e-9
    near, _ = play(StreamFeedback(0.85, 0.875, 6.0, walk.sharpest_between, KeyframeBudget(0)), walk, dense)
    assert near == set(dense), "the parallax asks for each of them"


def test_keyframes_that_are_too_far_apart_in_time_get_frames_between() -> None:
    walk = steady(10.0, 0.1)  # 0.1 of the image in a second, so that the overlap alone asks for none
    chosen = walk.stamps[::30]
    feedback = StreamFeedback(0.5, 1.0, 1e9, walk.sharpest_between, KeyframeBudget(0))
    assert play(feedback, walk, chosen)[0] == set(chosen)
    feedback = StreamFeedback(0.5, 1.0, 1e9, walk.sharpest_between, KeyframeBudget(0))
    feedback.max_gap = 10 * PERIOD
    images, changes = play(feedback, walk, chosen)
    assert set(chosen) < images
    assert np.diff(sorted(images)).max() <= feedback.max_gap
    assert np.diff(sorted(images)).min() > feedback.max_gap // 4
    assert set(changes.values()) == {1}


def test_no_keyframe_is_retired_whose_neighbours_are_too_far_apart_in_time() -> None:
    walk = steady(10.0, 0.3)
    dense = walk.stamps[::5]
    feedback = StreamFeedback(0.85, 0.875, 1e9, walk.sharpest_between, KeyframeBudget(0))
    feedback.max_gap = 9 * PERIOD
    assert play(feedback, walk, dense)[0] == set(dense)


def with_places(walk: Walk, images: Collection[int], reports: list[OverlapReport]) -> list[OverlapReport]:
    """The reports with what three images of earlier visits, more than eight before them, show of the same."""
    place = [walk.place[(stamp - 1) // PERIOD] for stamp in sorted(images)]
    shares = [sorted(1.0 - abs(place[k] - other) for other in place[: max(k - 8, 0)]) for k in range(len(place))]
    return [
        replace(report, place_overlap=share[-3] if len(share) > 2 else 0.0)
        for report, share in zip(reports, shares, strict=True)
    ]


def test_what_is_kept_grows_with_the_site_and_not_with_the_visits() -> None:
    there = steady(10.0, 0.3).place
    walk = Walk(np.concatenate([there, there[::-1]] * 4))
    chosen = walk.stamps[::13]

    def kept(place_known: bool, max_gap: int | None = None) -> list[int]:
        feedback = StreamFeedback(0.85, 0.875, 1e9, walk.sharpest_between, KeyframeBudget(0))
        feedback.max_gap = max_gap
        images: set[int] = set()
        for stamp in chosen:
            feedback.chosen(Decision(stamp, True, "", 0.87, 13.0))
            images.add(stamp)
            reports = walk.reports(images)
            for decision in feedback.answer(with_places(walk, images, reports) if place_known else reports):
                images.symmetric_difference_update([decision.stamp])
        return sorted(images)

    everything, known = kept(False), kept(True)
    first = [stamp for stamp in known if stamp <= len(there) * PERIOD]
    assert len(known) < 0.45 * len(everything)
    assert len([stamp for stamp in known if stamp > 4 * len(there) * PERIOD]) <= 4  # the newest ones
    assert np.diff(walk.place[[(stamp - 1) // PERIOD for stamp in first]]).max() < 0.15
    assert len(kept(True, 60 * PERIOD)) > len(known), "velocities of a rolling shutter need the neighbours in time"


@settings(max_examples=25, deadline=None)
@given(
    steps=st.lists(st.floats(-0.2, 0.2), min_size=60, max_size=150),
    blind=st.frozensets(st.integers(0, 199), max_size=20),
    stride=st.integers(1, 20),
    overlap_min=st.floats(0.5, 0.97),
    max_gap=st.none() | st.integers(1, 30 * PERIOD),
)
def test_nothing_is_added_and_retired_for_ever(
    steps: list[float], blind: frozenset[int], stride: int, overlap_min: float, max_gap: int | None
) -> None:
    walk = Walk(np.cumsum(steps), blind)
    feedback = StreamFeedback(overlap_min, overlap_min + 0.025, 1e9, walk.sharpest_between, KeyframeBudget(0))
    feedback.max_gap = max_gap
    _, changes = play(feedback, walk, walk.stamps[::stride])
    assert set(changes.values()) <= {1}
