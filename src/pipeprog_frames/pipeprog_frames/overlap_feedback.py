# SPDX-License-Identifier: Apache-2.0
"""Corrections of a stream of keyframes by the SfM's overlap reports: frames added in weak places, others retired."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from itertools import pairwise

from pipeprog_frames.frame_decision import Decision
from pipeprog_frames.policy.keyframe_budget import KeyframeBudget

MIN_GAIN = 0.01  # of overlap, by an added frame; with less, the next frame would not help either
MAX_BRIDGES = 3  # frames added on each side of an unregistered image: the third is at an eighth of the gap
LOOKAHEAD = 2  # later keyframes whose reports a judgement waits for
MIN_RUN = 4  # consecutive images above the band that are thinned out: the paper's "groups of more than three"

# Stamp of the best frame between two stamps, some stamps excluded; None where there is none.
BestBetween = Callable[[int, int, Collection[int]], int | None]


@dataclass(frozen=True)
class OverlapReport:
    """Overlap of one keyframe as the SfM has measured it; fields as in pipeprog_msgs/ImageOverlap.

    Attributes:
        stamp: of the keyframe [ns].
        registered: whether its pose is known; the other fields are valid only then.
        overlap: Eq. 1 of the paper, 0 to 1.
        cell_overlap: the same counted in cells of the image, which a single wrong feature cannot change.
        matches_previous: matches with the keyframe before it.
        matches_next: matches with the keyframe after it.
        place_overlap: share of what it shows that each of three keyframes of earlier visits shows from the same side.
    """

    stamp: int
    registered: bool
    overlap: float
    cell_overlap: float
    matches_previous: int
    matches_next: int
    place_overlap: float = 0.0


@dataclass
class _Keyframe:
    stamp: int
    overlap: float  # predicted, with the keyframe before it
    parallax: float  # in the unit of parallax_max
    fixed: bool = False  # added by feedback: never thinned out
    report: OverlapReport | None = None
    bridges: int = 0
    overlap_when_helped: float = -1.0


class StreamFeedback:
    """Keyframes so far, and the corrections that the overlap reports call for.

    A keyframe is judged once the SfM has answered to the next two as well: the first of them matches the other half
    of its image, the second one triangulates it. It gets a frame beside it where the smaller of its two overlaps is
    below `overlap_min`. In groups of more than three above `overlap_max`, every second one is retired where its
    neighbours still overlap by `overlap_min` with a parallax below `parallax_max` (in the unit of the
    decisions that are noted). One is retired, too, where keyframes of earlier visits show the same by more than
    `overlap_max`: what is kept grows with the site, not with the time spent there.

    No frame is added while the `budget`, which counts the keyframes so far, is full.

    This terminates: a frame that was added is never thinned out, and a retired one is never added again.

    Attributes:
        max_gap: ns. Two keyframes that are farther apart in time get a frame between them, and none is retired whose
            neighbours are, or for an earlier visit; None: no matter how far.
    """

    def __init__(
        self,
        overlap_min: float,
        overlap_max: float,
        parallax_max: float,
        best_between: BestBetween,
        budget: KeyframeBudget,
    ) -> None:
        self._overlap_min, self._overlap_max, self._parallax_max = overlap_min, overlap_max, parallax_max
        self._best_between, self._budget = best_between, budget
        self._stamps: list[int] = []
        self._keyframes: dict[int, _Keyframe] = {}
        self._retired: set[int] = set()
        self.max_gap: int | None = None

    def chosen(self, decision: Decision) -> None:
        """Notes a keyframe that the selector has chosen."""
        self._insert(_Keyframe(decision.stamp, decision.overlap, decision.parallax))

    def knows(self, stamp: int) -> bool:
        """Whether a keyframe had this stamp at any time."""
        return stamp in self._keyframes or stamp in self._retired

    def answer(self, reports: Iterable[OverlapReport], complete: bool = False) -> list[Decision]:
        """Takes overlap reports; returns the frames to add (chosen) and to retire (not chosen).

        `complete`: no more keyframes come, so the last ones are judged as well.
        """
        for report in reports:
            if report.stamp in self._keyframes:
                self._keyframes[report.stamp].report = report
        decisions = self._leave_known_places(complete)
        for stamp in list(self._stamps):
            if self._is_judged(stamp, complete):
                decisions += self._add_beside(stamp)
        return decisions + self._close_gaps() + self._thin(complete)

    def _insert(self, keyframe: _Keyframe) -> None:
        if keyframe.stamp not in self._keyframes:
            insort(self._stamps, keyframe.stamp)
            self._keyframes[keyframe.stamp] = keyframe
            self._budget.held += 1

    def _neighbours(self, stamp: int) -> tuple[int | None, int | None]:
        index = bisect_left(self._stamps, stamp)
        before = self._stamps[index - 1] if index else None
        after = self._stamps[index + 1] if index + 1 < len(self._stamps) else None
        return before, after

    def _is_judged(self, stamp: int, complete: bool) -> bool:
        """Whether the SfM has answered to this keyframe, the one before it and enough of those after it."""
        index = bisect_left(self._stamps, stamp)
        if index + LOOKAHEAD >= len(self._stamps) and not complete:
            return False
        around = self._stamps[max(index - 1, 0) : index + LOOKAHEAD + 1]
        return all(self._keyframes[other].report is not None for other in around)

    def _add_beside(self, stamp: int) -> list[Decision]:
        if self._budget.is_full:  # it is judged again once there is room
            return []
        keyframe = self._keyframes[stamp]
        report = keyframe.report
        assert report is not None
        before, after = self._neighbours(stamp)
        if not report.registered:
            if keyframe.bridges >= MAX_BRIDGES:
                return []
            keyframe.bridges += 1
            gaps = [(before, stamp), (stamp, after)]
            return [d for gap in gaps for d in self._fill(*gap, "bridges to a keyframe that did not register")]
        overlap = min(report.overlap, report.cell_overlap)
        if overlap >= self._overlap_min or overlap < keyframe.overlap_when_helped + MIN_GAIN:
            return []
        keyframe.overlap_when_helped = overlap
        reason = f"beside an image with overlap {overlap:.2f} < {self._overlap_min:.2f}"
        gaps = [(before, stamp), (stamp, after)]
        if report.matches_next < report.matches_previous:
            gaps.reverse()
        for gap in gaps:
            added = self._fill(*gap, reason)
            if added:
                return added
        return []

    def _fill(self, first: int | None, second: int | None, reason: str) -> list[Decision]:
        if first is None or second is None or self._budget.is_full:
            return []
        stamp = self._best_between(first, second, self._retired)
        if stamp is None:
            return []
        self._insert(_Keyframe(stamp, float("nan"), float("nan"), fixed=True))
        return [Decision(stamp, True, reason)]

    def _close_gaps(self) -> list[Decision]:
        """Adds a frame between registered keyframes that are too far apart in time."""
        decisions: list[Decision] = []
        for first, second in pairwise(list(self._stamps)):
            reports = self._keyframes[first].report, self._keyframes[second].report
            if self._is_gap(first, second) and all(report is not None and report.registered for report in reports):
                decisions += self._fill(first, second, "for the motion between images of a rolling shutter")
        return decisions

    def _is_gap(self, first: int, second: int) -> bool:
        return self.max_gap is not None and second - first > self.max_gap

    def _thin(self, complete: bool) -> list[Decision]:
        decisions = []
        run: list[int] = []
        for stamp in [*self._stamps, None]:
            if stamp is not None and self._is_judged(stamp, complete) and self._is_above_band(stamp):
                run.append(stamp)
                continue
            if len(run) >= MIN_RUN:
                decisions += [d for second in run[1::2] for d in self._retire(second)]
            run = []
        return decisions

    def _is_above_band(self, stamp: int) -> bool:
        report = self._keyframes[stamp].report
        assert report is not None
        return report.registered and min(report.overlap, report.cell_overlap) > self._overlap_max

    def _retire(self, stamp: int) -> list[Decision]:
        """Retires a keyframe unless the selector would fill the gap again."""
        keyframe = self._keyframes[stamp]
        before, after = self._neighbours(stamp)
        if keyframe.fixed or after is None or (before is not None and self._is_gap(before, after)):
            return []
        following = self._keyframes[after]
        overlap = keyframe.overlap + following.overlap - 1.0
        parallax = keyframe.parallax + following.parallax
        if not (overlap >= self._overlap_min and parallax <= self._parallax_max):  # NaN: not known, so it stays
            return []
        following.overlap, following.parallax = overlap, parallax
        return [self._forget(stamp, "retired: its neighbours overlap without it")]

    def _leave_known_places(self, complete: bool) -> list[Decision]:
        """Retires keyframes that show what those of earlier visits show."""
        if self.max_gap is not None:
            return []
        decisions = []
        for stamp in list(self._stamps):
            report = self._keyframes[stamp].report
            if not self._is_judged(stamp, complete) or report is None or report.place_overlap <= self._overlap_max:
                continue
            _, after = self._neighbours(stamp)
            if after is not None:  # how much it overlaps with the one before it is not known any more
                self._keyframes[after].overlap = self._keyframes[after].parallax = float("nan")
            decisions.append(self._forget(stamp, "retired: its place was seen before"))
        return decisions

    def _forget(self, stamp: int, reason: str) -> Decision:
        keyframe = self._keyframes.pop(stamp)
        self._stamps.remove(stamp)
        self._retired.add(stamp)
        self._budget.held -= 1
        return Decision(stamp, False, reason, keyframe.overlap)
