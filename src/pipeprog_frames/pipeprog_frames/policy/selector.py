# SPDX-License-Identifier: Apache-2.0
"""Decides, frame by frame, which become keyframes: the last sharp one before the overlap runs out."""

from __future__ import annotations

from collections import deque

from pipeprog_camera.camera import Camera
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.corners import corners, sharpness
from pipeprog_frames.frame_decision import DAMAGED, JUMP, UNMATCHED, Candidate, Decision, Load
from pipeprog_frames.incoming.decoding import GrayImage
from pipeprog_frames.policy.decode_schedule import MAX_UNSEEN, DecodeSchedule
from pipeprog_frames.policy.keyframe_limits import KeyframeLimits
from pipeprog_frames.tracker import MIN_CORNERS, Tracker

BLUR_TOLERANCE = 0.8  # of the sharpest frame's Laplacian; sharp neighbours differ by up to a fifth by content alone


class FrameSelector:
    """Streaming selection: every frame considered gets exactly one Decision, at most `window` frames later.

    Decoding is most of the cost. While the motion so far says that no keyframe is due for long, frames are held
    undecoded; if one turns out to be due, those that were passed over are tracked in turn, as if each had been
    tracked on arrival.

    A frame that shows nothing of the frames before it is a jump of the camera or an accident: a hand before the lens,
    a damaged image. It is a keyframe unless the earlier view comes back within the window, or the next frame follows
    too soon for any camera to have turned away and shows nothing of it either.
    """

    def __init__(self, config: FramesConfig, camera: Camera) -> None:
        self.limits = KeyframeLimits(config.overlap_min, config.parallax_max * camera.width)
        self._size = config.window
        self._camera = camera
        self._tracker = Tracker(camera)
        self._schedule = DecodeSchedule(self.limits)
        # Undecided frames, three queues in order of time, together no longer than the window:
        self._window: deque[Candidate] = deque()  # tracked, no keyframe due
        self._undecoded: deque[Candidate] = deque()
        self._unmatched: deque[Candidate] = deque()  # show nothing of what was seen before
        self._started = False
        self._last_stamp: int | None = None

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
        candidate = Candidate(stamp, load)
        if stamp < self._schedule.next_look and len(self._undecoded) < self._size - 1:
            self._undecoded.append(candidate)
            return self._trim()
        return self._catch_up(candidate)

    def flush(self) -> list[Decision]:
        """Decides on the frames that are still undecided; the last one is kept if it adds anything to the map."""
        decisions = self._catch_up(self._undecoded.pop()) if self._undecoded else []
        decisions += [unmatched.decided(False, UNMATCHED) for unmatched in self._unmatched]
        self._unmatched.clear()
        return decisions + self._leave_window()

    def _catch_up(self, candidate: Candidate) -> list[Decision]:
        """Tracks a frame; where a keyframe is due by then, those passed over are tracked before it."""
        gray = candidate.gray
        if gray is None:
            return [candidate.decided(False, DAMAGED)]
        passed, self._undecoded = self._undecoded, deque()
        if passed:
            candidate.track = self._tracker.track(gray)
            if not self.limits.is_due(candidate.track):
                passed_over = [other.decided(False, "overlap suffices") for other in passed]
                return passed_over + self._decide_tracked(candidate, gray)
            self._tracker.undo()
        return [decision for other in (*passed, candidate) for decision in self._track(other)]

    def _track(self, candidate: Candidate) -> list[Decision]:
        gray = candidate.gray
        if gray is None:
            return [candidate.decided(False, DAMAGED)]
        if not self._started:
            return [self._start(candidate, gray)]
        candidate.track = self._tracker.track(gray)
        return self._judge_unmatched(candidate, gray) + self._decide_tracked(candidate, gray)

    def _decide_tracked(self, candidate: Candidate, gray: GrayImage) -> list[Decision]:
        """Decides after the tracker has followed the corners into `candidate`."""
        candidate.sharpness = sharpness(gray)
        if candidate.track.tracked < MIN_CORNERS and len(corners(gray)) < MIN_CORNERS:
            self._tracker.undo()
            return [candidate.decided(False, "too few features")]
        if not candidate.track.tracked:
            self._tracker.undo()
            self._unmatched.append(candidate)
            self._schedule.look_again(candidate.stamp)
            return self._trim()
        decisions: list[Decision] = []
        if self.limits.is_due(candidate.track) and self._window:
            decisions += self._close_window()
            candidate.track = self._tracker.track(gray)
        if self.limits.is_due(candidate.track):  # no frame in between: this one must carry the map on
            decisions += [earlier.decided(False, "a later frame is due") for earlier in self._window]
            self._window.clear()
            decisions.append(candidate.decided(True, self.limits.reason(candidate.track)))
            self._carry_on(candidate, gray)
            return decisions
        self._window.append(candidate)
        self._schedule.looked(candidate.stamp, candidate.track)
        return decisions + self._trim()

    def _start(self, candidate: Candidate, gray: GrayImage) -> Decision:
        if len(corners(gray)) < MIN_CORNERS:
            return candidate.decided(False, "too few features")
        self._tracker.start(gray)
        self._schedule.start(candidate.stamp)
        self._started = True
        return candidate.decided(True, "first frame")

    def _judge_unmatched(self, candidate: Candidate, gray: GrayImage) -> list[Decision]:
        """Decides on unmatched frames by the frame after them; tracks on from the last of them if it matches."""
        if not self._unmatched:
            return []
        if candidate.track.tracked:
            decisions = [unmatched.decided(False, UNMATCHED) for unmatched in self._unmatched]
            self._unmatched.clear()
            return decisions
        last = self._unmatched[-1].gray
        assert last is not None
        probe = Tracker(self._camera)
        probe.start(last)
        if not probe.track(gray).tracked:
            return []
        decisions = self._leave_window()
        while len(self._unmatched) > 1:
            decisions.append(self._dismiss_unmatched())
        unmatched = self._unmatched.pop()
        decisions.append(unmatched.decided(True, JUMP))
        self._carry_on(unmatched, last)
        candidate.track = self._tracker.track(gray)
        return decisions

    def _carry_on(self, keyframe: Candidate, gray: GrayImage) -> None:
        """Tracks from a new keyframe on."""
        self._schedule.chosen(keyframe.stamp, keyframe.track)
        self._tracker.start(gray)

    def _trim(self) -> list[Decision]:
        """Decides on the oldest undecided frames, so that no more than the window remain."""
        decisions = []
        while len(self._window) + len(self._undecoded) + len(self._unmatched) > self._size:
            if self._window or self._undecoded:
                held = self._window or self._undecoded
                decisions.append(held.popleft().decided(False, "overlap suffices"))
            else:
                decisions.append(self._dismiss_unmatched())
        return decisions

    def _dismiss_unmatched(self) -> Decision:
        """Decides on the oldest frame that matches neither the frames before it nor the next one."""
        unmatched = self._unmatched.popleft()
        if self._unmatched[0].stamp - unmatched.stamp < MAX_UNSEEN:
            return unmatched.decided(False, UNMATCHED)
        return unmatched.decided(True, JUMP)

    def _leave_window(self) -> list[Decision]:
        """Decides on the window where no frame continues it; its last frame is kept if it adds anything."""
        decisions = [candidate.decided(False, "overlap suffices") for candidate in self._window]
        if self._window and self._window[-1].track.overlap < 0.5 * (1.0 + self.limits.overlap_min):
            decisions[-1] = self._window[-1].decided(True, "the last that shows this view")
        self._window.clear()
        return decisions

    def _close_window(self) -> list[Decision]:
        """Chooses the last sharp frame of the window and tracks from it through the later ones."""
        sharp_enough = BLUR_TOLERANCE * max(candidate.sharpness for candidate in self._window)
        best = next(candidate for candidate in reversed(self._window) if candidate.sharpness >= sharp_enough)
        decisions = []
        while self._window[0] is not best:
            decisions.append(self._window.popleft().decided(False, "a better frame is near"))
        self._window.popleft()
        decisions.append(
            best.decided(True, f"last sharp frame before the overlap falls below {self.limits.overlap_min:.2f}")
        )
        assert best.gray is not None
        self._carry_on(best, best.gray)
        for candidate in self._window:
            assert candidate.gray is not None
            candidate.track = self._tracker.track(candidate.gray)
        return decisions
