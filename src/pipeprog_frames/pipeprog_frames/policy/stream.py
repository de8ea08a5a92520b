# SPDX-License-Identifier: Apache-2.0
"""Keyframes of a stream: a fast prediction chooses at once, and the SfM's overlap reports correct the choice."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from pipeprog_camera.camera import Camera
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.frame_decision import FULL, Decision, Load
from pipeprog_frames.overlap_feedback import BestBetween, OverlapReport, StreamFeedback
from pipeprog_frames.policy.keyframe_budget import KeyframeBudget
from pipeprog_frames.policy.selector import FrameSelector

# Keyframes that the SfM may be behind without load: two or three come during the adjustment of a large map (0.8 s).
UNLOADED_LAG = 3
# ns between two keyframes of a rolling shutter, whose velocities are those of a curve through their poses: a step sways
# the camera at 1.7 Hz, which such a curve knows to a fifth at 0.2 s, and not at all at 0.3 s.
MAX_GAP = 220_000_000
# Keyframes behind at which the load counts as full. As many are worked off with a short queue as with a long one, and
# what waits delays the last map: ten are 4 s of work on two cores.
FULL_LAG = 10


class KeyframeStream:
    """FrameSelector and StreamFeedback together.

    The more keyframes the SfM is behind, and the fuller the `budget` is, the fewer are chosen: the larger of both loads
    counts. None is chosen while the budget is full.
    """

    def __init__(self, config: FramesConfig, camera: Camera, best_between: BestBetween, budget: KeyframeBudget) -> None:
        self._config, self._camera, self._budget = config, camera, budget
        self._lag_load = 0.0
        self._selector = FrameSelector(config, camera)
        # Parallax as a fraction of the image's width, since keyframes before and after a switch differ in size.
        self._feedback = StreamFeedback(
            config.overlap_min, config.overlap_min + config.overlap_band, config.parallax_max, best_between, budget
        )

    @property
    def overlap_min(self) -> float:
        """The minimum predicted overlap, which is lower under load."""
        return self._selector.limits.overlap_min

    def consider(self, stamp: int, load: Load | None) -> list[Decision]:
        """Takes the next frame; see FrameSelector.consider."""
        if self._feedback.knows(stamp):  # after the clock was set back
            return [Decision(stamp, False, "stamp repeats")]
        self._relax()
        return self._recorded(self._selector.consider(stamp, load))

    def flush(self) -> list[Decision]:
        """Decides on the frames that are still undecided."""
        return self._recorded(self._selector.flush())

    def begin_anew(self, camera: Camera) -> list[Decision]:
        """Decides on the frames that are still undecided; the next one, of whatever camera, starts a new track."""
        decisions = self.flush()
        self._camera, self._selector = camera, FrameSelector(self._config, camera)
        return decisions

    def lag(self, keyframes: int) -> None:
        """Notes how many keyframes the SfM is behind: the more, the fewer are chosen."""
        self._lag_load = min(max((keyframes - UNLOADED_LAG) / (FULL_LAG - UNLOADED_LAG), 0.0), 1.0)
        self._relax()

    def answer(self, reports: Iterable[OverlapReport], readout: float = 0.0) -> list[Decision]:
        """Takes overlap reports and the read-out in use, s; returns frames to add (chosen) and to retire (not chosen).

        With a rolling shutter keyframes are dense in time, while there is no load.
        """
        loaded = self.overlap_min < self._config.overlap_min
        self._feedback.max_gap = MAX_GAP if readout and not loaded else None
        return self._feedback.answer(reports)

    def finish_round(self) -> list[Decision]:
        """What to add and retire once all frames have come and the SfM has answered to all keyframes."""
        return self._feedback.answer((), complete=True)

    def report_outside_band(self) -> list[Decision]:
        """Nothing: a stream has no overlap band to keep."""
        return []

    def _relax(self) -> None:
        self._selector.limits.relax(max(self._lag_load, self._budget.load))

    def _recorded(self, decisions: list[Decision]) -> list[Decision]:
        return [self._allowed(decision) if decision.chosen else decision for decision in decisions]

    def _allowed(self, decision: Decision) -> Decision:
        """Notes a keyframe; the decision not to take it where the map holds as many as it may."""
        if self._budget.is_full:
            return replace(decision, chosen=False, reason=FULL)
        self._feedback.chosen(replace(decision, parallax=decision.parallax / self._camera.width))
        return decision
