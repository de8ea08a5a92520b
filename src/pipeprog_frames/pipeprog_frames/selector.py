"""Decides, frame by frame, which become keyframes: the last sharp one before the overlap runs out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from pipeprog_camera.camera import Camera
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.corners import corners, sharpness
from pipeprog_frames.decoding import GrayImage
from pipeprog_frames.tracker import MIN_CORNERS, Track, Tracker

NAN = float("nan")
DAMAGED = "damaged image"
UNMATCHED = "shows nothing of the frames before and after it"
JUMP = "shows nothing of the frames before it"
# The Laplacian's variance of neighbouring sharp frames differs by content alone by a fifth or so.
BLUR_TOLERANCE = 0.8
MAX_UNSEEN = 200_000_000  # ns between two looks: a turn of 90 degrees a second is caught within the tracker's reach
LOADED_OVERLAP = 0.6  # below, neighbours alone no longer cover an image twice, which a point of the map takes
LOADED_PARALLAX = 3.0  # times the usual one

Load = Callable[[], GrayImage | None]


@dataclass(frozen=True)
class Decision:
    """The fate of one frame, with the reason; fields as in pipeprog_msgs/FrameDecision."""

    stamp: int
    chosen: bool
    reason: str
    overlap: float = NAN
    parallax: float = NAN
    sharpness: float = NAN


@dataclass
class _Candidate:
    stamp: int
    load: Load
    track: Track = field(default_factory=lambda: Track(NAN, NAN, 0))
    sharpness: float = NAN
    _gray: GrayImage | None = None

    @property
    def gray(self) -> GrayImage | None:
        """The image, decoded once."""
        if self._gray is None:
            self._gray = self.load()
        return self._gray

    def decided(self, chosen: bool, reason: str) -> Decision:
        return Decision(self.stamp, chosen, reason, self.track.overlap, self.track.parallax, self.sharpness)


class FrameSelector:
    """Streaming admission: every frame considered gets exactly one Decision, at most `window` frames later.

    Decoding is most of the cost. While the motion so far says that a keyframe is not due for long, frames are held
    without a look; should one turn out to be due, those that were passed over are looked at in turn, as if each had
    been looked at on arrival.

    A frame that shows nothing of what came before is a jump of the camera or an accident: a hand before the lens, a
    damaged image. It is a keyframe unless the view from before it comes back within the window, or the next frame, too
    soon after it for any camera to have turned away, shows nothing of it either.
    """

    def __init__(self, config: FramesConfig, camera: Camera) -> None:
        self._config = config
        self._parallax_base = config.parallax_max * camera.width
        self._camera = camera
        self._tracker = Tracker(camera)
        self._window: deque[_Candidate] = deque()  # looked at, not due
        self._unseen: deque[_Candidate] = deque()  # later than those
        self._strangers: deque[_Candidate] = deque()  # later than all: nothing in them has been seen before
        self._keyframe: int | None = None
        self._last_stamp: int | None = None
        self._pace = 0.0  # share of the way to the next keyframe, per ns
        self._look_at = 0
        self.relax(0.0)

    def relax(self, relief: float) -> None:
        """Asks for fewer keyframes: 0 as configured, 1 as few as still make a map."""
        overlap = self._config.overlap_min
        self.overlap_min = overlap - relief * max(overlap - LOADED_OVERLAP, 0.0)
        self._parallax_max = self._parallax_base * (1 + relief * (LOADED_PARALLAX - 1))

    def consider(self, stamp: int, load: Load | None) -> list[Decision]:
        """Takes the next frame; returns what is decided by it.

        `load` decodes it, reduced and grey, when it is looked at (None: it cannot be decoded).
        """
        if self._last_stamp is not None and stamp <= self._last_stamp:
            what = "repeats" if stamp == self._last_stamp else "runs backwards"
            return [Decision(stamp, False, f"stamp {what}")]
        self._last_stamp = stamp
        if load is None:
            return [Decision(stamp, False, DAMAGED)]
        candidate = _Candidate(stamp, load)
        if stamp < self._look_at and len(self._unseen) < self._config.window - 1:
            self._unseen.append(candidate)
            return self._trim()
        return self._catch_up(candidate)

    def flush(self) -> list[Decision]:
        """Decides on the frames that are still open: the last one ends the map, so it is kept if it adds anything."""
        decisions = self._catch_up(self._unseen.pop()) if self._unseen else []
        decisions += [stranger.decided(False, UNMATCHED) for stranger in self._strangers]
        self._strangers.clear()
        return decisions + self._leave_window()

    def _catch_up(self, candidate: _Candidate) -> list[Decision]:
        """Looks at a frame, and before it at those passed over when it turns out that they matter."""
        gray = candidate.gray
        if gray is None:
            return [candidate.decided(False, DAMAGED)]
        passed, self._unseen = self._unseen, deque()
        if passed:
            candidate.track = self._tracker.track(gray)
            if not self._is_due(candidate.track):
                return [*(other.decided(False, "overlap suffices") for other in passed), *self._settle(candidate, gray)]
            self._tracker.undo()
        return [decision for other in (*passed, candidate) for decision in self._look(other)]

    def _look(self, candidate: _Candidate) -> list[Decision]:
        gray = candidate.gray
        if gray is None:
            return [candidate.decided(False, DAMAGED)]
        if self._keyframe is None:
            return [self._start(candidate, gray)]
        candidate.track = self._tracker.track(gray)
        return self._judge_strangers(candidate, gray) + self._settle(candidate, gray)

    def _settle(self, candidate: _Candidate, gray: GrayImage) -> list[Decision]:
        """What follows from a frame that the tracker has just been led into."""
        candidate.sharpness = sharpness(gray)
        if candidate.track.tracked < MIN_CORNERS and len(corners(gray)) < MIN_CORNERS:
            self._tracker.undo()
            return [candidate.decided(False, "too few features")]
        if not candidate.track.tracked:
            self._tracker.undo()
            self._strangers.append(candidate)
            self._look_at = candidate.stamp
            return self._trim()
        decisions: list[Decision] = []
        if self._is_due(candidate.track) and self._window:
            decisions += self._close_window()
            candidate.track = self._tracker.track(gray)
        if self._is_due(candidate.track):  # no frame in between: this one must carry the map on
            decisions += [earlier.decided(False, "a later frame is due") for earlier in self._window]
            self._window.clear()
            decisions.append(candidate.decided(True, self._reason(candidate.track)))
            self._carry_on(candidate, gray)
            return decisions
        self._window.append(candidate)
        self._plan(candidate)
        return decisions + self._trim()

    def _start(self, candidate: _Candidate, gray: GrayImage) -> Decision:
        if len(corners(gray)) < MIN_CORNERS:
            return candidate.decided(False, "too few features")
        self._tracker.start(gray)
        self._keyframe = self._look_at = candidate.stamp
        return candidate.decided(True, "first frame")

    def _judge_strangers(self, candidate: _Candidate, gray: GrayImage) -> list[Decision]:
        """What a frame says of those that showed nothing known; leads the tracker into it from the last of them."""
        if not self._strangers:
            return []
        if candidate.track.tracked:
            decisions = [stranger.decided(False, UNMATCHED) for stranger in self._strangers]
            self._strangers.clear()
            return decisions
        last = self._strangers[-1].gray
        assert last is not None
        probe = Tracker(self._camera)
        probe.start(last)
        if not probe.track(gray).tracked:
            return []
        decisions = self._leave_window()
        while len(self._strangers) > 1:
            decisions.append(self._dismiss_stranger())
        stranger = self._strangers.pop()
        decisions.append(stranger.decided(True, JUMP))
        self._carry_on(stranger, last)
        candidate.track = self._tracker.track(gray)
        return decisions

    def _is_due(self, track: Track) -> bool:
        return track.overlap < self.overlap_min or track.parallax > self._parallax_max

    def _reason(self, track: Track) -> str:
        if track.overlap < self.overlap_min:
            return f"overlap {track.overlap:.2f} < {self.overlap_min:.2f}"
        return f"parallax {track.parallax:.0f} px > {self._parallax_max:.0f} px"

    def _carry_on(self, keyframe: _Candidate, gray: GrayImage) -> None:
        """Follows from a new keyframe on, which ended its way at the pace that the next one is likely to keep."""
        assert self._keyframe is not None
        self._pace = self._way(keyframe.track) / (keyframe.stamp - self._keyframe)
        self._keyframe = keyframe.stamp
        self._tracker.start(gray)
        self._look_at = keyframe.stamp + self._patience(0.0)

    def _plan(self, candidate: _Candidate) -> None:
        """When to look again: half-way to where the next keyframe would be due at the pace so far."""
        assert self._keyframe is not None
        way = self._way(candidate.track)
        self._pace = way / (candidate.stamp - self._keyframe)
        self._look_at = candidate.stamp + self._patience(way)

    def _patience(self, way: float) -> int:
        return int(min(0.5 * max(1.0 - way, 0.0) / max(self._pace, 1e-12), MAX_UNSEEN))

    def _way(self, track: Track) -> float:
        """Share of the way from the keyframe to where the next one is due."""
        by_overlap = (1.0 - track.overlap) / (1.0 - self.overlap_min)
        return max(by_overlap, track.parallax / self._parallax_max)

    def _trim(self) -> list[Decision]:
        """Decides on what is too old to be chosen any more."""
        decisions = []
        while len(self._window) + len(self._unseen) + len(self._strangers) > self._config.window:
            if self._window or self._unseen:
                held = self._window or self._unseen
                decisions.append(held.popleft().decided(False, "overlap suffices"))
            else:
                decisions.append(self._dismiss_stranger())
        return decisions

    def _dismiss_stranger(self) -> Decision:
        """Decides on a frame that neither the frames before it nor the next one know."""
        stranger = self._strangers.popleft()
        if self._strangers[0].stamp - stranger.stamp < MAX_UNSEEN:
            return stranger.decided(False, UNMATCHED)
        return stranger.decided(True, JUMP)

    def _leave_window(self) -> list[Decision]:
        """Decides on the window where nothing follows on from it: its last frame is kept if it adds anything."""
        decisions = [candidate.decided(False, "overlap suffices") for candidate in self._window]
        if self._window and self._window[-1].track.overlap < 0.5 * (1.0 + self.overlap_min):
            decisions[-1] = self._window[-1].decided(True, "the last that shows this view")
        self._window.clear()
        return decisions

    def _close_window(self) -> list[Decision]:
        """Chooses the last sharp frame of the window and follows the tracker from there through the later ones."""
        sharp_enough = BLUR_TOLERANCE * max(candidate.sharpness for candidate in self._window)
        best = next(candidate for candidate in reversed(self._window) if candidate.sharpness >= sharp_enough)
        decisions = []
        while self._window[0] is not best:
            decisions.append(self._window.popleft().decided(False, "a better frame is near"))
        self._window.popleft()
        decisions.append(best.decided(True, f"last sharp frame before the overlap falls below {self.overlap_min:.2f}"))
        assert best.gray is not None
        self._carry_on(best, best.gray)
        for candidate in self._window:
            assert candidate.gray is not None
            candidate.track = self._tracker.track(candidate.gray)
        return decisions
