# SPDX-License-Identifier: Apache-2.0
"""Support: the share of a cylinder's visible contour samples at which several views show a limb edge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import ContourSamples
from pipeprog_detect.silhouette.limb_edges import LimbEdges

# An edge supports a contour sample where it lies within the sharpness of the image [px], ...
NEAR = 0.6
# ... is placed to two thirds of that [px], and explains more of what a smooth profile leaves than a profile without an
# edge does (the median of such profiles is below 0.2, as the tests hold).
SIGMA, EXPLAINED = 0.4, 0.2
# A shadow's or a texture's edge agrees with a contour by chance in some views, but not in three and half of them.
MIN_VIEWS, MIN_SHARE = 3, 0.5
# Share of the views that show an edge at one position of a real contour; contrast and texture cost the rest. Measured,
# not derived: the median at the pipes of a rendered field, where the rate beside them is 0.09. It says how much of a
# real contour a number of views supports (0.34 of it by three views, 0.94 by eight); with 0.6 or 0.8 instead the
# support changes by up to 60 % for three views and by up to 25 % for seven or more.
HIT_RATE = 0.7
# Rate of edges of texture, and the correlation between views of the evidence at one position: specks of texture and
# dark areas are common to them.
TEXTURE, COMMON = 0.2, 0.3
# Logarithm of how much more probable an edge is on a pipe's contour than on texture, and that none is seen.
EDGE, NO_EDGE = float(np.log(HIT_RATE / TEXTURE)), float(np.log((1.0 - HIT_RATE) / (1.0 - TEXTURE)))
# Support of what is taken for seen: one side along half of its length, or both along a quarter. Texture with an edge in
# one of five views has at most 0.11 (by the binomial distribution, for any number of views).
MIN_SUPPORT = 0.25


@dataclass(frozen=True)
class SupportProfile:
    """Support by position along a cylinder.

    Attributes:
        along: position (B,) from the cylinder's middle [m].
        seen: number (B, 2) of views that see each side there.
        hits: number (B, 2) of those that show a limb edge there.
        gain: median displacement of the contour for one metre of the surface [px/m].
    """

    along: FloatArray
    seen: FloatArray
    hits: FloatArray
    gain: float = float("nan")

    @property
    def share(self) -> float:
        """Share (0 to 1) of the positions, seen by three views or more, with an edge in three and in half of them.

        Relative to the share that as many views show of a real contour on average, so that three views count as well
        as thirty.
        """
        supported, expected = self._by_side()
        return min(float(supported.sum() / expected.sum()), 1.0) if expected.any() else 0.0

    @property
    def weaker_share(self) -> float:
        """The same on the side that has less of it; on the only one where the views see no other."""
        supported, expected = self._by_side()
        return min(float((supported[expected > 0] / expected[expected > 0]).min()), 1.0) if expected.any() else 0.0

    def log_odds(self) -> FloatArray:
        """Logarithm (B, 2) of how much more probable the edges are on a pipe than on texture, by position and side."""
        total = self.hits * EDGE + (self.seen - self.hits) * NO_EDGE
        return np.asarray(total / (1.0 + COMMON * np.maximum(self.seen - 1.0, 0.0)))

    def _by_side(self) -> tuple[FloatArray, FloatArray]:
        """Number of positions of each side (2,) with such edges, and the number expected of a real contour."""
        needed = np.maximum(np.ceil(MIN_SHARE * self.seen), MIN_VIEWS)
        tail = betainc(needed, np.maximum(self.seen - needed, 0.0) + 1.0, HIT_RATE)  # of the binomial distribution
        expected = np.where(self.seen >= needed, tail, 0.0)
        return (self.hits >= needed).sum(axis=0).astype(float), expected.sum(axis=0)


def hits(edges: LimbEdges, displacement: FloatArray) -> NDArray[np.bool_]:
    """Mask (N,) of the samples that an edge supports, the contour being displaced outwards by (N,) [px] there."""
    distance = np.abs(edges.offset - displacement[:, None])
    good = (distance < NEAR) & (edges.sigma < SIGMA) & (edges.explained > EXPLAINED)
    return np.asarray(good.any(axis=1), bool)


def support_profile(samples: ContourSamples, hit: NDArray[np.bool_]) -> SupportProfile:
    """Hits (N,) counted by position along the axis and side."""
    along, position = samples.positions()
    cell = 2 * position + samples.side
    seen = np.bincount(cell, np.ones(len(cell)), 2 * len(along)).reshape(-1, 2)
    found = np.bincount(cell, hit.astype(float), 2 * len(along)).reshape(-1, 2)
    gain = float(np.median(samples.gain)) if len(samples) else float("nan")
    return SupportProfile(along, np.asarray(seen, float), np.asarray(found, float), gain)
