"""What the SfM's answers ask of a stream of keyframes: frames added where it is loose, others given back."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

from pipeprog_frames.decision import Decision

MIN_GAIN = 0.01  # of overlap that an added frame must bring, or the next one would not help either
MAX_BRIDGES = 3  # frames on each side of an image that does not register: the last comes within an eighth of the gap
LOOKAHEAD = 2  # later keyframes that a judgement waits for
MIN_RUN = 4  # "groups of more than three"

BestBetween = Callable[[int, int, Collection[int]], "int | None"]  # the best frame between two stamps, without some


@dataclass(frozen=True)
class OverlapReport:
    """The SfM's answer for one keyframe: fields as in pipeprog_msgs/ImageOverlap."""

    stamp: int
    registered: bool
    overlap: float
    cell_overlap: float
    matches_previous: int
    matches_next: int


@dataclass
class _Keyframe:
    stamp: int
    overlap: float  # predicted, with the keyframe before it
    parallax: float
    fixed: bool = False  # asked for by feedback: never given back
    report: OverlapReport | None = None
    bridges: int = 0
    overlap_when_helped: float = -1.0


class StreamFeedback:
    """Keyframes so far, and what to change about them.

    A keyframe is judged once the SfM has answered to the next two as well: the first of them connects the other half of
    what it shows, the second one makes points of it.
    It counts as loose when the lower of hull and cell overlap (Eq. 1 of the paper, and its version that a single stray
    feature cannot move) is below `overlap_min`. Of runs of more than three above `overlap_max` every second one is
    given back where its neighbours still overlap by `overlap_min` and see each other within `parallax_max` px.

    It ends: a frame that was added is never given back, one that was given back is never added again.
    """

    def __init__(self, overlap_min: float, overlap_max: float, parallax_max: float, middle: BestBetween) -> None:
        self._overlap_min, self._overlap_max, self._parallax_max = overlap_min, overlap_max, parallax_max
        self._middle = middle
        self._stamps: list[int] = []
        self._keyframes: dict[int, _Keyframe] = {}
        self._retired: set[int] = set()

    def chosen(self, decision: Decision) -> None:
        """Notes a keyframe that the selector has chosen."""
        self._insert(_Keyframe(decision.stamp, decision.overlap, decision.parallax))

    def answer(self, reports: Iterable[OverlapReport], complete: bool = False) -> list[Decision]:
        """Takes the SfM's answers; returns the frames to add (chosen) and to give back (not chosen).

        `complete`: no more keyframes come, so the last one is judged as well.
        """
        for report in reports:
            if report.stamp in self._keyframes:
                self._keyframes[report.stamp].report = report
        decisions: list[Decision] = []
        for stamp in list(self._stamps):
            if self._is_judged(stamp, complete):
                decisions += self._tighten(stamp)
        return decisions + self._thin(complete)

    def _insert(self, keyframe: _Keyframe) -> None:
        if keyframe.stamp not in self._keyframes:
            insort(self._stamps, keyframe.stamp)
            self._keyframes[keyframe.stamp] = keyframe

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

    def _tighten(self, stamp: int) -> list[Decision]:
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
        if first is None or second is None:
            return []
        stamp = self._middle(first, second, self._retired)
        if stamp is None:
            return []
        self._insert(_Keyframe(stamp, float("nan"), float("nan"), fixed=True))
        return [Decision(stamp, True, reason)]

    def _thin(self, complete: bool) -> list[Decision]:
        decisions = []
        run: list[int] = []
        for stamp in [*self._stamps, None]:
            if stamp is not None and self._is_judged(stamp, complete) and self._is_ample(stamp):
                run.append(stamp)
                continue
            if len(run) >= MIN_RUN:
                decisions += [d for second in run[1::2] for d in self._give_back(second)]
            run = []
        return decisions

    def _is_ample(self, stamp: int) -> bool:
        report = self._keyframes[stamp].report
        assert report is not None
        return report.registered and min(report.overlap, report.cell_overlap) > self._overlap_max

    def _give_back(self, stamp: int) -> list[Decision]:
        """Retires a keyframe, where the gap that it leaves is not one that the selector would have filled."""
        keyframe = self._keyframes[stamp]
        _, after = self._neighbours(stamp)
        if keyframe.fixed or after is None:
            return []
        following = self._keyframes[after]
        overlap = keyframe.overlap + following.overlap - 1.0
        parallax = keyframe.parallax + following.parallax
        if not (overlap >= self._overlap_min and parallax <= self._parallax_max):  # NaN: not known, so it stays
            return []
        following.overlap, following.parallax = overlap, parallax
        self._stamps.remove(stamp)
        del self._keyframes[stamp]
        self._retired.add(stamp)
        return [Decision(stamp, False, "retired: its neighbours overlap without it", keyframe.overlap)]
