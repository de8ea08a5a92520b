# SPDX-License-Identifier: Apache-2.0
"""When a keyframe is due: limits of overlap and parallax, which are relaxed while the SfM cannot keep up."""

from __future__ import annotations

from pipeprog_frames.tracker import Track

LOADED_OVERLAP = 0.6  # under full load; with less than 0.5 a point is not in two neighbours, as a 3-D point needs
LOADED_PARALLAX = 3.0  # under full load, times the configured limit


class KeyframeLimits:
    """Limits of the overlap and of the parallax with the last keyframe.

    Args:
        overlap_min: minimum overlap, 0 to 1.
        parallax_max: maximum median parallax, px of the full image.
    """

    def __init__(self, overlap_min: float, parallax_max: float) -> None:
        self._configured = overlap_min, parallax_max
        self.relax(0.0)

    def relax(self, load: float) -> None:
        """Sets the limits for a load of the SfM: 0 as configured, 1 for the fewest keyframes that still make a map."""
        overlap, parallax = self._configured
        self.overlap_min = overlap - load * max(overlap - LOADED_OVERLAP, 0.0)
        self.parallax_max = parallax * (1 + load * (LOADED_PARALLAX - 1))

    def is_due(self, track: Track) -> bool:
        """Whether a frame is beyond the limits, so that a keyframe is needed at or before it."""
        return track.overlap < self.overlap_min or track.parallax > self.parallax_max

    def reason(self, track: Track) -> str:
        """Which limit it is beyond, for people."""
        if track.overlap < self.overlap_min:
            return f"overlap {track.overlap:.2f} < {self.overlap_min:.2f}"
        return f"parallax {track.parallax:.0f} px > {self.parallax_max:.0f} px"

    def progress(self, track: Track) -> float:
        """How far the view has moved from the last keyframe (0) to where the next is due (1)."""
        by_overlap = (1.0 - track.overlap) / (1.0 - self.overlap_min)
        return max(by_overlap, track.parallax / self.parallax_max)
