# SPDX-License-Identifier: Apache-2.0
"""Keyframes of all cameras of a rig: each camera's frames are a stream of their own, in one map and one budget."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CAMERAS
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.frame_decision import FOREIGN, Decision
from pipeprog_frames.incoming.arrival import Arrival
from pipeprog_frames.overlap_feedback import OverlapReport
from pipeprog_frames.policy.keyframe_budget import KeyframeBudget
from pipeprog_frames.selection import Selected, Selection

ONE = ""  # the name of a camera that is no rig's
_MIN_MIB = 8  # of memory for a camera's frames, as for `buffer_mib`


class RigSelection:
    """A Selection for each camera.

    They share the memory for frames and the keyframes that the map may hold, and when the SfM falls behind, all of
    them choose fewer. Stamps are unique among the cameras: see `pipeprog_camera.rig`.

    Attributes:
        names: of the cameras.
        budget: keyframes that the map holds.
    """

    def __init__(self, config: FramesConfig, cameras: Sequence[str] = ()) -> None:
        """`cameras`: names of a rig's cameras; none: one camera. Raises InputError for names that cannot be."""
        self.names = tuple(cameras) or (ONE,)
        if len(set(self.names)) < len(self.names) or len(self.names) > MAX_CAMERAS:
            raise InputError(f"cameras {' '.join(self.names)[:80]!r}: name each once, {MAX_CAMERAS} at most")
        if len(self.names) > 1 and config.policy == "network":
            raise InputError("policy = network takes one camera: use policy = stream for a rig")
        share = replace(config, buffer_mib=max(config.buffer_mib // len(self.names), _MIN_MIB))
        self.budget = KeyframeBudget(config.max_keyframes)
        self._of = {name: Selection(share, self.budget) for name in self.names}
        self._frames: dict[str, str] = {}  # frame_id by camera, of a rig's

    @property
    def overlap_min(self) -> float:
        """The lowest of the minimum predicted overlaps, which are lower under load."""
        return min(selection.overlap_min for selection in self._of.values())

    @property
    def uncalibrated(self) -> list[str]:
        """Names of the cameras of which no usable calibration has come."""
        return [name for name, selection in self._of.items() if selection.calibrations.newest is None]

    def calibrate(self, name: str, stamp: int, camera: Camera | None) -> None:
        """Takes a calibration of a camera; see `Calibrations.add`."""
        if name in self._of:
            self._of[name].calibrations.add(stamp, camera)

    def is_ready(self, arrival: Arrival) -> bool:
        """Whether the calibration of an image has come, or none is needed to decide on it."""
        known = self._of.get(arrival.camera)
        return bool(arrival.refusal) or known is None or known.calibrations.is_known(arrival.stamp, arrival.size)

    def consider(self, arrival: Arrival) -> Selected:
        """Takes the next image; returns what is decided by it, on this and on earlier ones of its camera."""
        if arrival.camera not in self._of:
            return [(Decision(arrival.stamp, False, FOREIGN, frame_id=arrival.frame_id), None)]
        if arrival.camera != ONE:
            self._frames[arrival.camera] = arrival.frame_id
        return self._named(arrival.camera, self._of[arrival.camera].consider(arrival))

    def begin_anew(self) -> Selected:
        """Decides on the images that are still undecided; the next ones have no connection with those before them."""
        return [each for name, selection in self._of.items() for each in self._named(name, selection.begin_anew())]

    def flush(self) -> Selected:
        """Decides on the images that are still undecided."""
        return [each for name, selection in self._of.items() for each in self._named(name, selection.flush())]

    def lag(self, keyframes: int) -> None:
        """Notes how many keyframes, of all cameras, the SfM is behind."""
        for selection in self._of.values():
            selection.lag(keyframes)

    def answer(self, reports: Iterable[OverlapReport], readout: float = 0.0) -> Selected:
        """Takes overlap reports of any camera and the read-out in use, s; returns keyframes to add and to retire."""
        reports = tuple(reports)
        return [
            each
            for name, selection in self._of.items()
            for each in self._named(name, selection.answer(reports, readout))
        ]

    def finish_round(self) -> Selected:
        """What to add and retire once all images have come and the SfM has answered to all keyframes."""
        return [each for name, selection in self._of.items() for each in self._named(name, selection.finish_round())]

    def report_outside_band(self) -> list[Decision]:
        """The keyframes whose overlap is outside the band in the end."""
        return [decision for selection in self._of.values() for decision in selection.report_outside_band()]

    def _named(self, name: str, selected: Selected) -> Selected:
        frame_id = self._frames.get(name, "")
        return [(replace(decision, frame_id=frame_id), frame) for decision, frame in selected] if frame_id else selected
