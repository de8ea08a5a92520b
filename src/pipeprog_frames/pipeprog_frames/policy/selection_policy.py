# SPDX-License-Identifier: Apache-2.0
"""What chooses keyframes: a policy is shown every frame and the SfM's overlap reports, and returns decisions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from pipeprog_camera.camera import Camera
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.frame_decision import Decision, Load
from pipeprog_frames.overlap_feedback import BestBetween, OverlapReport
from pipeprog_frames.policy.image_network import ImageNetwork
from pipeprog_frames.policy.keyframe_budget import KeyframeBudget
from pipeprog_frames.policy.stream import KeyframeStream


class Policy(Protocol):
    """KeyframeStream or ImageNetwork."""

    def consider(self, stamp: int, load: Load | None) -> list[Decision]:
        """Takes the next frame: its stamp [ns], and what decodes it (None: it cannot be decoded)."""

    def flush(self) -> list[Decision]:
        """Decides on the frames that are still undecided, after the last one."""

    def begin_anew(self, camera: Camera) -> list[Decision]:
        """Decides on the frames that are still undecided; the next one has no connection with those before it.

        Its camera may be another, and its stamp earlier.
        """

    def answer(self, reports: Iterable[OverlapReport], readout: float = 0.0) -> list[Decision]:
        """Takes overlap reports of the SfM; returns keyframes to add (chosen) and to retire (not chosen).

        readout: of the rolling shutter in use, s; 0: none, or none known yet.
        """

    def finish_round(self) -> list[Decision]:
        """What to add and retire once all frames have come and the SfM has answered to all keyframes; empty: done."""

    def report_outside_band(self) -> list[Decision]:
        """The keyframes whose overlap is outside the band in the end, each with the reason."""


def make_policy(config: FramesConfig, camera: Camera, best_between: BestBetween, budget: KeyframeBudget) -> Policy:
    """The policy that `config.policy` names; `best_between` finds a frame between two stamps.

    `budget`: of the map, which a stream keeps; a network has the keyframes that its overlaps ask for.
    """
    if config.policy == "network":
        return ImageNetwork(config.overlap_min, config.overlap_min + config.overlap_band, best_between)
    return KeyframeStream(config, camera, best_between, budget)
