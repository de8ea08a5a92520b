"""Decides, frame by frame, which become keyframes: the last sharp one before the overlap runs out."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from pipeprog_camera.camera import Camera
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.tracker import MIN_CORNERS, GrayImage, Track, Tracker, corners, sharpness

NAN = float("nan")
# The Laplacian's variance of neighbouring sharp frames differs by content alone by a fifth or so.
BLUR_TOLERANCE = 0.8


@dataclass(frozen=True)
class Decision:
    """The fate of one frame, with the reason; fields as in pipeprog_msgs/FrameDecision."""

    stamp: int
    chosen: bool
    reason: str
    overlap: float = NAN
    parallax: float = NAN
    sharpness: float = NAN


@dataclass(frozen=True)
class _Candidate:
    stamp: int
    gray: GrayImage
    track: Track
    sharpness: float


class FrameSelector:
    """Streaming admission: every frame considered gets exactly one Decision, at most `window` frames later."""

    def __init__(self, config: FramesConfig, camera: Camera) -> None:
        self._config = config
        self._parallax_max = config.parallax_max * camera.width
        self._tracker = Tracker(camera)
        self._window: deque[_Candidate] = deque()
        self._started = False
        self._last_stamp: int | None = None

    def consider(self, stamp: int, gray: GrayImage | None) -> list[Decision]:
        """Takes the next frame, reduced and grey (None: it could not be decoded); returns what is decided by it."""
        if self._last_stamp is not None and stamp <= self._last_stamp:
            what = "repeats" if stamp == self._last_stamp else "runs backwards"
            return [Decision(stamp, False, f"stamp {what}")]
        self._last_stamp = stamp
        if gray is None:
            return [Decision(stamp, False, "damaged image")]
        sharp = sharpness(gray)
        if not self._started:
            return [self._start(stamp, gray, sharp)]
        track = self._tracker.track(gray)
        if track.tracked < MIN_CORNERS and len(corners(gray)) < MIN_CORNERS:
            self._tracker.undo()
            return [Decision(stamp, False, "too few features", track.overlap, track.parallax, sharp)]
        decisions: list[Decision] = []
        if self._is_due(track) and self._window:
            decisions += self._close_window()
            track = self._tracker.track(gray)
        if self._is_due(track):  # no frame in between: this one must carry the map on
            self._tracker.start(gray)
            decisions += [_rejected(candidate, "a later frame is due") for candidate in self._window]
            self._window.clear()
            return [*decisions, Decision(stamp, True, self._reason(track), track.overlap, track.parallax, sharp)]
        self._window.append(_Candidate(stamp, gray, track, sharp))
        if len(self._window) > self._config.window:
            decisions.append(_rejected(self._window.popleft(), "overlap suffices"))
        return decisions

    def flush(self) -> list[Decision]:
        """Decides on the frames that are still open: the last one ends the map, so it is kept if it adds anything."""
        decisions = [_rejected(candidate, "overlap suffices") for candidate in self._window]
        if self._window:
            last = self._window[-1]
            half_way = 0.5 * (1.0 + self._config.overlap_min)
            if last.track.overlap < half_way:
                decisions[-1] = Decision(
                    last.stamp, True, "last frame", last.track.overlap, last.track.parallax, last.sharpness
                )
        self._window.clear()
        return decisions

    def _start(self, stamp: int, gray: GrayImage, sharp: float) -> Decision:
        if len(corners(gray)) < MIN_CORNERS:
            return Decision(stamp, False, "too few features", sharpness=sharp)
        self._tracker.start(gray)
        self._started = True
        return Decision(stamp, True, "first frame", sharpness=sharp)

    def _is_due(self, track: Track) -> bool:
        return track.overlap < self._config.overlap_min or track.parallax > self._parallax_max

    def _reason(self, track: Track) -> str:
        if track.overlap < self._config.overlap_min:
            return f"overlap {track.overlap:.2f} < {self._config.overlap_min:.2f}"
        return f"parallax {track.parallax:.0f} px > {self._parallax_max:.0f} px"

    def _close_window(self) -> list[Decision]:
        """Chooses the last sharp frame of the window and follows the tracker from there through the later ones."""
        if not self._window:
            return []
        sharp_enough = BLUR_TOLERANCE * max(candidate.sharpness for candidate in self._window)
        best = next(candidate for candidate in reversed(self._window) if candidate.sharpness >= sharp_enough)
        decisions = []
        while self._window[0] is not best:
            decisions.append(_rejected(self._window.popleft(), "a better frame is near"))
        self._window.popleft()
        reason = f"last sharp frame before the overlap falls below {self._config.overlap_min:.2f}"
        decisions.append(Decision(best.stamp, True, reason, best.track.overlap, best.track.parallax, best.sharpness))
        later, self._window = self._window, deque()
        self._tracker.start(best.gray)
        for candidate in later:
            track = self._tracker.track(candidate.gray)
            self._window.append(_Candidate(candidate.stamp, candidate.gray, track, candidate.sharpness))
        return decisions


def _rejected(candidate: _Candidate, reason: str) -> Decision:
    return Decision(
        candidate.stamp, False, reason, candidate.track.overlap, candidate.track.parallax, candidate.sharpness
    )
