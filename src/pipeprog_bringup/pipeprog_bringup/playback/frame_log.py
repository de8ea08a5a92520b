# SPDX-License-Identifier: Apache-2.0
"""The state of each frame of a replay: sent and not decided on yet, or chosen or not and why."""

from __future__ import annotations

import contextlib
from collections import Counter, defaultdict, deque
from dataclasses import replace

from pipeprog_bringup.results.result_files import FrameRow
from pipeprog_frames.frame_decision import FAULTS, FULL
from pipeprog_node.processes.journal import Journal

LOST_AFTER = 3  # keyframes in a row without a place in the map: one may be blurred, two may be its neighbours


class FrameLog:
    """Rows of frames.csv in the order of playing, filled by the decisions and the SfM's feedback as they come.

    Attributes:
        chosen: number of keyframes.
        beyond_limit: number of frames that would be keyframes, and the map may hold no more.
    """

    def __init__(self) -> None:
        self.chosen = self.beyond_limit = 0
        self._rows: list[FrameRow | None] = []
        self._pending: defaultdict[int, deque[int]] = defaultdict(deque)
        self._first: dict[int, int] = {}
        self._overlap: dict[int, tuple[float, float, int, bool]] = {}
        self._motion_lost: Counter[str] = Counter()

    @property
    def in_flight(self) -> int:
        """Frames that were played and not decided on."""
        return sum(len(rows) for rows in self._pending.values())

    @property
    def considered(self) -> int:
        """Frames that were decided on."""
        return len(self._rows) - self.in_flight

    def play(self, stamp: int) -> None:
        """A frame was sent to the selector."""
        self._pending[stamp].append(len(self._rows))
        self._first.setdefault(stamp, len(self._rows))
        self._rows.append(None)

    def skip(self, stamp: int, reason: str) -> None:
        """A frame was not sent, for this reason."""
        self._rows.append(FrameRow(stamp, False, reason))

    def skip_motion(self, topic: str) -> None:
        """A message of motion was not sent: it is damaged."""
        self._motion_lost[topic] += 1

    def decide(self, row: FrameRow) -> None:
        """A decision came; a second one about the same frame replaces the first."""
        waiting = self._pending.get(row.stamp)
        if waiting:
            self._fill(waiting.popleft(), row)
            if not waiting:
                del self._pending[row.stamp]
        elif row.stamp in self._first:
            self._fill(self._first[row.stamp], row)

    def overlap(self, stamp: int, overlap: float, cell_overlap: float, tie_points: int, registered: bool) -> None:
        """The SfM reported the overlap of a keyframe: Ov_N (Eq. 1), and the share of the image's cells."""
        self._overlap[stamp] = overlap, cell_overlap, tie_points, registered

    def rows(self) -> list[FrameRow]:
        """One row a frame that was considered, keyframes with their last overlap."""
        result = []
        for row in self._rows:
            if row is None:
                continue
            if row.chosen and row.stamp in self._overlap:
                overlap, cells, tie_points, registered = self._overlap[row.stamp]
                row = replace(row, registered=registered)
                if registered:
                    row = replace(row, overlap_n=overlap, cell_overlap=cells, tie_points=tie_points)
            result.append(row)
        return result

    def common_reasons(self) -> str:
        """The reasons most frequent among the frames that were not chosen, for an error's text."""
        groups = sorted(self._reasons().values(), key=len, reverse=True)[:3]
        return "; ".join(f"{len(group)} x {self._reason(group[0])}" for group in groups)

    def faults(self) -> list[str]:
        """The faults of the recording's frames and of its motion, one sentence each."""
        groups = sorted((kind, group) for kind, group in self._reasons().items() if kind.startswith(FAULTS))
        frames = [f"{len(group)} frames left out: {self._named(group[0])}" for _, group in groups]
        motion = sorted(self._motion_lost.items())
        return frames + [f"{count} messages of {topic} left out: damaged" for topic, count in motion]

    def _fill(self, number: int, row: FrameRow) -> None:
        before, self._rows[number] = self._rows[number], row
        self.chosen += row.chosen - (before is not None and before.chosen)
        self.beyond_limit += (row.reason == FULL) - (before is not None and before.reason == FULL)

    def _reasons(self) -> dict[str, list[int]]:
        """The frames that were not chosen, by what their reasons begin with: the rest differs from frame to frame."""
        groups: defaultdict[str, list[int]] = defaultdict(list)
        for number, row in enumerate(self._rows):
            if row is not None and not row.chosen:
                groups[row.reason.partition(": ")[0]].append(number)
        return groups

    def _reason(self, number: int) -> str:
        row = self._rows[number]
        return row.reason if row is not None else ""

    def _named(self, number: int) -> str:
        """The reason of a frame, and which one it is, where the reason tells more than its kind."""
        reason = self._reason(number)
        return f"{reason} (frame {number + 1}, the first of them)" if ": " in reason else reason


class LiveFrameLog(FrameLog):
    """The frames of a camera: nobody says that one was sent, so it is known by its first decision."""

    def __init__(self, journal: Journal | None = None) -> None:
        """`journal`: where decisions are kept, and those of a process before this one are."""
        super().__init__()
        self._journal: Journal | None = None
        self._last_keyframes: deque[int] = deque(maxlen=LOST_AFTER)
        for _, row in journal.commands() if journal is not None else ():
            self.decide(row)
        self._journal = journal

    @property
    def is_tracking(self) -> bool:
        """Whether one of the last keyframes has a place in the map, or is not worked off yet."""
        last = list(self._last_keyframes)
        return len(last) < LOST_AFTER or any(stamp not in self._overlap or self._overlap[stamp][3] for stamp in last)

    def decide(self, row: FrameRow) -> None:
        """A decision came; a second one about the same frame replaces the first."""
        if self._journal is not None:
            with contextlib.suppress(OSError):  # the disk is full: the survey ends by that
                self._journal.write(self._journal.end, row)
        if row.stamp not in self._first:
            self.play(row.stamp)
        if row.chosen and row.stamp not in self._last_keyframes:
            self._last_keyframes.append(row.stamp)
        super().decide(row)
