"""Keyframes out of a stream: a cheap prediction chooses at once, what the SfM answers corrects it."""

from __future__ import annotations

from collections.abc import Iterable

from pipeprog_camera.camera import Camera
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.feedback import BestBetween, OverlapReport, StreamFeedback
from pipeprog_frames.selector import Decision, FrameSelector, Load

UNLOADED_LAG = 5  # keyframes that the SfM may be behind without being overloaded: it adjusts for seconds at times
FULL_LAG = 25  # half of what its queue holds


class KeyframeStream:
    """FrameSelector and StreamFeedback together."""

    def __init__(self, config: FramesConfig, camera: Camera, middle: BestBetween) -> None:
        self._selector = FrameSelector(config, camera)
        parallax_max = config.parallax_max * camera.width
        self._feedback = StreamFeedback(
            config.overlap_min, config.overlap_min + config.overlap_band, parallax_max, middle
        )

    @property
    def overlap_min(self) -> float:
        """The least predicted overlap as relieved."""
        return self._selector.overlap_min

    def consider(self, stamp: int, load: Load | None) -> list[Decision]:
        """Takes the next frame; see FrameSelector.consider."""
        return self._noted(self._selector.consider(stamp, load))

    def flush(self) -> list[Decision]:
        """Decides on the frames that are still open."""
        return self._noted(self._selector.flush())

    def lag(self, keyframes: int) -> None:
        """Tells how many keyframes the SfM is behind: the further, the fewer are chosen."""
        self._selector.relax(min(max((keyframes - UNLOADED_LAG) / (FULL_LAG - UNLOADED_LAG), 0.0), 1.0))

    def answer(self, reports: Iterable[OverlapReport]) -> list[Decision]:
        """Takes the SfM's answers; returns frames to add (chosen) and to give back (not chosen)."""
        return self._feedback.answer(reports)

    def finish_round(self) -> list[Decision]:
        """What is to change when no frames come any more and the SfM has answered to all keyframes."""
        return self._feedback.answer((), complete=True)

    def report_outside_band(self) -> list[Decision]:
        """Nothing: a stream promises no band."""
        return []

    def _noted(self, decisions: list[Decision]) -> list[Decision]:
        for decision in decisions:
            if decision.chosen:
                self._feedback.chosen(decision)
        return decisions
