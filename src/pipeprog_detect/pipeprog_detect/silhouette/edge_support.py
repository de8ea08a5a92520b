"""Where along a pipe its outlines are seen: verifies detections, and shows where the straight barrel stops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import Stations, frame, viewing_direction
from pipeprog_detect.silhouette.limb_edges import SHARP, LimbEdges, outline_edges, sideways
from pipeprog_detect.types import Cylinder, View

# An edge supports an outline that it meets within the sharpness of the image [px], ...
NEAR = 0.6
# ... that is placed to better than that, and that explains more than texture does of what a smooth profile leaves.
SIGMA, EXPLAINED = 0.4, 0.2
# A shadow's or a texture's edge agrees with the outline by chance in some views, but not in three and most of them.
MIN_VIEWS, MIN_SHARE = 3, 0.5
# Contrast and texture leave a view an edge at so much of a real outline (hit rate at the pipes of a generated field,
# median; beside them 0.09). Of three views all must show it, which happens at a third of the places only.
HIT_RATE = 0.7
# Nine in ten of the pipes of a generated field reach 0.55, nine in ten cylinders beside them that are not there stay
# under 0.1: the geometric mean, since what was fitted to clutter finds more of it. The stated sigma of a radius grows
# where little is seen.
MIN_SUPPORT = 0.25


@dataclass(frozen=True)
class SupportProfile:
    """Support by position: `along` (B,) from the cylinder's middle [m], and for each side (B, 2) views and hits."""

    along: FloatArray
    seen: FloatArray
    hits: FloatArray

    @property
    def share(self) -> float:
        """Share (0 to 1) of the outline, where three views or more see it, with an edge in three and in most of them.

        As a share of what so many views show of a real outline on average, so that few views count as well as many.
        """
        supported, expected = self._by_side()
        return min(float(supported.sum() / expected.sum()), 1.0) if expected.any() else 0.0

    @property
    def weaker_share(self) -> float:
        """The same of the outline on that side that has less of it; of the only one where views see no other."""
        supported, expected = self._by_side()
        return min(float((supported[expected > 0] / expected[expected > 0]).min()), 1.0) if expected.any() else 0.0

    def _by_side(self) -> tuple[FloatArray, FloatArray]:
        """Places of each side (2,) that have such edges, and places of a real outline that would have."""
        needed = np.maximum(np.ceil(MIN_SHARE * self.seen), MIN_VIEWS)
        tail = betainc(needed, np.maximum(self.seen - needed, 0.0) + 1.0, HIT_RATE)  # of the binomial distribution
        expected = np.where(self.seen >= needed, tail, 0.0)
        return (self.hits >= needed).sum(axis=0).astype(float), expected.sum(axis=0)


def hits(at: Stations, edges: LimbEdges, view_offset: FloatArray) -> NDArray[np.bool_]:
    """Mask (N,) of the stations whose outline an edge supports."""
    distance = np.abs(edges.offset - (sideways(at) * view_offset[at.view])[:, None])
    good = (distance < NEAR) & (edges.sigma < SIGMA) & (edges.explained > EXPLAINED)
    return np.asarray(good.any(axis=1), bool)


def support_profile(at: Stations, hit: NDArray[np.bool_]) -> SupportProfile:
    """Hits counted by position along the axis and side."""
    along, place = np.unique(np.round(at.along, 6), return_inverse=True)
    cell = 2 * place + at.side
    seen = np.bincount(cell, np.ones(len(cell)), 2 * len(along)).reshape(-1, 2)
    found = np.bincount(cell, hit.astype(float), 2 * len(along)).reshape(-1, 2)
    return SupportProfile(along, np.asarray(seen, float), np.asarray(found, float))


def outline_support(
    cylinder: Cylinder, views: Sequence[View], others: Sequence[Cylinder], chunk: int = 12
) -> SupportProfile:
    """Support of a cylinder's predicted outlines by the edges near them."""
    basis = frame(cylinder, viewing_direction(cylinder, views))
    none = np.zeros(len(views))
    at, edges = outline_edges(cylinder, views, others, basis, none, 1.5, SHARP, chunk)
    return support_profile(at, hits(at, edges, none))


def support(cylinder: Cylinder, views: Sequence[View], others: Sequence[Cylinder]) -> float:
    """Share (0 to 1) of the cylinder's predicted outline with a supporting edge in at least three and most views."""
    return outline_support(cylinder, views, others).share


def own_outlines(cylinders: Sequence[Cylinder], views: Sequence[View]) -> NDArray[np.bool_]:
    """Mask (N,): cylinders whose outlines are their own once all of them are known.

    A cylinder that was measured before the one that hides it was found may have taken that one's edges for its
    outlines: they leave it with less than a cylinder that is not there has.
    """
    kept = np.ones(len(cylinders), bool)
    for number, cylinder in enumerate(cylinders):
        others = [other for k, other in enumerate(cylinders) if k != number and kept[k]]
        shown = support(cylinder, views, others)
        kept[number] = shown >= MIN_SUPPORT or support(cylinder, views, []) < MIN_SUPPORT
    return kept
