# SPDX-License-Identifier: Apache-2.0
"""Algorithm 1 of the paper: chooses the images of a recording so that their overlap is within a band."""

from __future__ import annotations

from bisect import insort
from collections.abc import Iterable

from pipeprog_camera.camera import Camera
from pipeprog_frames.corners import corners
from pipeprog_frames.frame_decision import DAMAGED, Decision, Load
from pipeprog_frames.overlap_feedback import MIN_RUN, BestBetween, OverlapReport
from pipeprog_frames.tracker import MIN_CORNERS

START_PERIOD = 2_000_000_000  # ns: 0.5 frames a second
TOLERANCE = 1e-6  # of an overlap, which travels as a float of 32 bits


class ImageNetwork:
    """Starts at 0.5 frames a second; each round adds and removes images by the overlap that the SfM has measured.

    A round: while images are unregistered, each of them gets one frame before and one after it. Otherwise each image
    whose overlap (Eq. 1) is below `overlap_min` gets one frame between it and the neighbour with which it has fewer
    matches, and of each group of more than three consecutive images above `overlap_max` every second one is removed;
    the first and the last image stay, since no other shows their outer halves.

    This terminates: an image that was removed and added again is never removed again, so each frame changes three
    times at most, and a round without a change is the last.
    """

    def __init__(self, overlap_min: float, overlap_max: float, best_between: BestBetween) -> None:
        self._overlap_min, self._overlap_max = overlap_min, overlap_max
        self._best_between = best_between
        self._images: list[int] = []
        self._removed: set[int] = set()
        self._fixed: set[int] = set()
        self._reports: dict[int, OverlapReport] = {}
        self._last_stamp: int | None = None
        self._next_start = 0  # stamp before which no further image starts the network
        self.rounds = 0

    def consider(self, stamp: int, load: Load | None) -> list[Decision]:
        """Takes the next frame, as FrameSelector does."""
        if self._last_stamp is not None and stamp <= self._last_stamp:
            what = "repeats" if stamp == self._last_stamp else "runs backwards"
            return [Decision(stamp, False, f"stamp {what}")]
        self._last_stamp = stamp
        if load is None:
            return [Decision(stamp, False, DAMAGED)]
        if stamp in self._images or stamp in self._removed:  # after the clock was set back
            return [Decision(stamp, False, "stamp repeats")]
        if stamp < self._next_start:
            return [Decision(stamp, False, "not in the network")]
        gray = load()
        if gray is None:
            return [Decision(stamp, False, DAMAGED)]
        if len(corners(gray)) < MIN_CORNERS:
            return [Decision(stamp, False, "too few features")]
        insort(self._images, stamp)
        self._next_start = stamp + START_PERIOD
        return [Decision(stamp, True, "start at 0.5 frames a second")]

    def flush(self) -> list[Decision]:
        """Nothing: every frame was decided on as it came."""
        return []

    def begin_anew(self, camera: Camera) -> list[Decision]:
        """Has the next frame start the network, whatever its stamp is."""
        self._last_stamp, self._next_start = None, 0
        return []

    def answer(self, reports: Iterable[OverlapReport], readout: float = 0.0) -> list[Decision]:
        """Takes overlap reports; nothing changes before the SfM has answered to all images, nor by the read-out."""
        self._reports.update((report.stamp, report) for report in reports)
        return []

    def finish_round(self) -> list[Decision]:
        """One round, once the SfM has answered to all images: what to add (chosen) and to remove; empty: done."""
        decisions = self._connect() or self._fill() + self._thin()
        self.rounds += bool(decisions)
        return decisions

    def report_outside_band(self) -> list[Decision]:
        """The images whose overlap is outside the band, each with the reason."""
        return [Decision(stamp, True, reason) for stamp in self._images if (reason := self._reason_outside(stamp))]

    def _overlap(self, stamp: int) -> float | None:
        """Eq. 1; None where the image is not registered."""
        report = self._reports.get(stamp)
        return report.overlap if report is not None and report.registered else None

    def _gaps(self, stamp: int) -> list[tuple[int, int]]:
        """The image with its neighbour before and its neighbour after."""
        index = self._images.index(stamp)
        return [(self._images[k], self._images[k + 1]) for k in (index - 1, index) if 0 <= k < len(self._images) - 1]

    def _connect(self) -> list[Decision]:
        lost = [stamp for stamp in self._images if self._overlap(stamp) is None]
        reason = "beside an image that does not register"
        return [d for stamp in lost for gap in self._gaps(stamp) for d in self._add(gap, reason)]

    def _fill(self) -> list[Decision]:
        decisions = []
        for stamp in list(self._images):
            overlap = self._overlap(stamp)
            if overlap is None or overlap >= self._overlap_min - TOLERANCE:
                continue
            gaps = self._gaps(stamp)
            if len(gaps) == 2 and self._reports[stamp].matches_next < self._reports[stamp].matches_previous:
                gaps.reverse()
            reason = f"beside an image with overlap {overlap:.3f} < {self._overlap_min:.3f}"
            for gap in gaps:
                added = self._add(gap, reason)
                if added:
                    decisions += added
                    break
        return decisions

    def _add(self, gap: tuple[int, int], reason: str) -> list[Decision]:
        stamp = self._best_between(*gap, ())
        if stamp is None:
            return []
        insort(self._images, stamp)
        if stamp in self._removed:
            self._fixed.add(stamp)
        self._reports.pop(stamp, None)
        return [Decision(stamp, True, reason)]

    def _thin(self) -> list[Decision]:
        removed: list[int] = []
        for run in self._runs():
            if len(run) >= MIN_RUN:
                removed += [stamp for stamp in run[1::2] if self._is_removable(stamp)]
        for stamp in removed:
            self._images.remove(stamp)
        self._removed.update(removed)
        return [Decision(stamp, False, "removed: every second image of a run above the band") for stamp in removed]

    def _runs(self) -> list[list[int]]:
        """Groups of consecutive images above the band."""
        runs: list[list[int]] = [[]]
        for stamp in self._images:
            if self._is_above(stamp):
                runs[-1].append(stamp)
            elif runs[-1]:
                runs.append([])
        return runs

    def _is_above(self, stamp: int) -> bool:
        overlap = self._overlap(stamp)
        return overlap is not None and overlap > self._overlap_max + TOLERANCE

    def _is_removable(self, stamp: int) -> bool:
        return stamp not in self._fixed and stamp not in (self._images[0], self._images[-1])

    def _reason_outside(self, stamp: int) -> str:
        overlap = self._overlap(stamp)
        if overlap is None:
            return "does not register, and no frame is left before or after it"
        if overlap < self._overlap_min - TOLERANCE:
            return f"overlap {overlap:.3f} < {self._overlap_min:.3f}, and no frame is left beside it"
        if not self._is_above(stamp):
            return ""
        above = f"overlap {overlap:.3f} > {self._overlap_max:.3f}"
        run = next(run for run in self._runs() if stamp in run)
        if len(run) < MIN_RUN:
            return f"{above}, in a group of no more than three"
        if stamp in run[1::2]:
            return f"{above}, but without it another image falls below the band or an end is lost"
        return f"{above}, but only every second image of a group goes"
