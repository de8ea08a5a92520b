# SPDX-License-Identifier: Apache-2.0
"""From arriving images to keyframes: what is refused, with which calibration the rest is shown to the policy."""

from __future__ import annotations

from collections.abc import Iterable

from pipeprog_camera.camera import Camera
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.frame_decision import DAMAGED, OTHER_SIZE, UNCALIBRATED, Decision
from pipeprog_frames.incoming.arrival import Arrival
from pipeprog_frames.incoming.calibrations import Calibrations
from pipeprog_frames.incoming.decoding import GrayImage, is_cut_off, reduced_size
from pipeprog_frames.incoming.frame_buffer import EncodedFrame, FrameFile, FrameRing, FrameStore
from pipeprog_frames.incoming.stamp_order import StampOrder
from pipeprog_frames.overlap_feedback import OverlapReport
from pipeprog_frames.policy.keyframe_budget import KeyframeBudget
from pipeprog_frames.policy.selection_policy import Policy, make_policy
from pipeprog_frames.policy.stream import KeyframeStream

Selected = list[tuple[Decision, EncodedFrame | None]]  # decisions, those for a keyframe with the frame


class Selection:
    """Decides on each arriving image, in order, and corrects the choice by the SfM's reports.

    The policy begins anew, on the next image, where the camera switches to another size and where the clock was set.
    """

    def __init__(self, config: FramesConfig, budget: KeyframeBudget | None = None) -> None:
        """`budget`: of the map; None: no other camera's keyframes are in it."""
        self._config = config
        self._budget = KeyframeBudget(config.max_keyframes) if budget is None else budget
        self.calibrations = Calibrations(paired=config.lockstep)
        # In a replay the disk that holds the recording can hold its images, too.
        self._store: FrameStore = FrameFile() if config.lockstep else FrameRing(config.buffer_mib << 20)
        self._order: StampOrder[Arrival] = StampOrder()
        self._policy: Policy | None = None
        self._camera: Camera | None = None  # of the last image that the policy was shown

    @property
    def overlap_min(self) -> float:
        """The minimum predicted overlap, which is lower under load."""
        return self._policy.overlap_min if isinstance(self._policy, KeyframeStream) else self._config.overlap_min

    def consider(self, arrival: Arrival) -> Selected:
        """Takes the next image; returns what is decided by it, on this and on earlier ones."""
        if arrival.refusal:
            return [(Decision(arrival.stamp, False, arrival.refusal), None)]
        placed = self._order.place(arrival.stamp, arrival)
        selected = _refused(placed.refused)
        if placed.anew:
            selected += self.begin_anew()
            self._store.forget_from(placed.taken[0].stamp)
        return selected + [each for taken in placed.taken for each in self._show(taken)]

    def begin_anew(self) -> Selected:
        """Decides on the images that are still undecided; the next one has no connection with those before it."""
        if self._policy is None or self._camera is None:
            return []
        return self._selected(self._policy.begin_anew(self._camera))

    def flush(self) -> Selected:
        """Decides on the images that are still undecided."""
        return _refused(self._order.flush()) + self._selected(self._policy.flush() if self._policy else [])

    def lag(self, keyframes: int) -> None:
        """Notes how many keyframes the SfM is behind."""
        if isinstance(self._policy, KeyframeStream):
            self._policy.lag(keyframes)

    def answer(self, reports: Iterable[OverlapReport], readout: float = 0.0) -> Selected:
        """Takes overlap reports and the read-out in use, s; returns keyframes to add and to retire."""
        return self._selected(self._policy.answer(reports, readout) if self._policy else [])

    def finish_round(self) -> Selected:
        """What to add and retire once all images have come and the SfM has answered to all keyframes."""
        return self._selected(self._policy.finish_round() if self._policy else [])

    def report_outside_band(self) -> list[Decision]:
        """The keyframes whose overlap is outside the band in the end."""
        return self._policy.report_outside_band() if self._policy else []

    def _show(self, arrival: Arrival) -> Selected:
        """Shows an image to the policy, if its size is the one that it is calibrated for."""
        camera = self.calibrations.of(arrival.stamp, arrival.size)
        if camera is None:
            return [(Decision(arrival.stamp, False, UNCALIBRATED), None)]
        size = camera.width, camera.height
        if arrival.size != size:
            reason = f"{OTHER_SIZE}: {arrival.size[0]} x {arrival.size[1]}, not {size[0]} x {size[1]}"
            return [(Decision(arrival.stamp, False, reason), None)]
        encoded = arrival.encode()
        if is_cut_off(encoded):
            return [(Decision(arrival.stamp, False, DAMAGED), None)]
        selected: Selected = []
        if self._policy is None or self._camera is None:
            self._policy = make_policy(self._config, camera, self._store.sharpest_between, self._budget)
        elif (self._camera.width, self._camera.height) != size:
            selected = self._selected(self._policy.begin_anew(camera))
        self._camera = camera
        self._store.add(EncodedFrame(arrival.stamp, arrival.frame_id, encoded, camera))
        return selected + self._selected(self._policy.consider(arrival.stamp, lambda: _loaded(arrival)))

    def _selected(self, decisions: Iterable[Decision]) -> Selected:
        return [(decision, self._store.get(decision.stamp) if decision.chosen else None) for decision in decisions]


def _refused(refused: Iterable[tuple[Arrival, str]]) -> Selected:
    return [(Decision(arrival.stamp, False, reason), None) for arrival, reason in refused]


def _loaded(arrival: Arrival) -> GrayImage | None:
    """The reduced image; None where it is damaged, or decodes to another size than its header declares."""
    gray = arrival.load()
    return gray if gray is not None and (gray.shape[1], gray.shape[0]) == reduced_size(*arrival.size) else None
