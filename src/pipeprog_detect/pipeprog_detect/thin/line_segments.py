# SPDX-License-Identifier: Apache-2.0
"""Segment pairs in one keyframe: two nearly parallel lines no farther apart than the sides of a thin pipe."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray

# Segments shorter than this [px] are texture more often than not.
SHORTEST = 10.0
# Segments belong to one edge if they are off its line by less than this [px], turned by less than this [rad] (1.2 px
# over half of `LEAST_SEEN` are 6 deg), and apart by less than a clamp or a stain hides [px].
OFF_LINE, TURNED, GAP = 1.2, np.radians(4.0), 40.0
# Seen parts of an edge [px] that make a line of it, and the share of its extent that they must cover.
LEAST_SEEN, LEAST_SHARE = 24.0, 0.4
# The two sides of a pipe converge by less than its width over its length; with noise by less than this [rad].
TAPER = np.radians(3.0)


@dataclass(frozen=True)
class SegmentPairs:
    """N pairs of lines in one image: `ends` (N, 2, 2) of their centre lines [px] and `width` (N, 2) there [px]."""

    ends: FloatArray
    width: FloatArray

    def __len__(self) -> int:
        return len(self.ends)

    def select(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> SegmentPairs:
        """Those that a mask or an index array names."""
        return SegmentPairs(self.ends[keep], self.width[keep])


def straight_edges(image: NDArray[np.uint8]) -> FloatArray:
    """Long straight edges (N, 2, 2) [px] of a grey image, ends in the order that keeps the brighter side constant.

    Segments of a line segment detector (von Gioi et al., LSD) that lie on one line are joined, from the longest on.
    """
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(image)[0]
    if found is None:
        return np.zeros((0, 2, 2))
    segments: FloatArray = np.asarray(found, np.float64).reshape(-1, 2, 2)
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    order = np.argsort(-length, kind="stable")
    return _joined(np.ascontiguousarray(segments[order[length[order] >= SHORTEST]]))


def segment_pairs(edges: FloatArray, narrowest: float, widest: float) -> SegmentPairs:
    """Pairs of edges (N, 2, 2) that face each other at a distance from `narrowest` to `widest` [px].

    Light may come from any side: neither edge need be the darker one.
    """
    ends, widths = [], []
    along = edges[:, 1] - edges[:, 0]
    length = np.linalg.norm(along, axis=1)
    along = along / length[:, None]
    for one in range(len(edges)):
        across = np.array([-along[one, 1], along[one, 0]])
        place = (edges - edges[one, 0]) @ along[one]
        off = (edges - edges[one, 0]) @ across
        low = np.maximum(place.min(axis=1), 0.0)
        high = np.minimum(place.max(axis=1), length[one])
        parallel = np.abs(along @ along[one]) > np.cos(TAPER)
        near = (np.abs(off).max(axis=1) < 2.0 * widest) & (high - low > np.maximum(LEAST_SEEN, widest))
        for other in np.flatnonzero(parallel & near & (np.arange(len(edges)) > one)):
            slope = (off[other, 1] - off[other, 0]) / (place[other, 1] - place[other, 0])
            at = np.array([low[other], high[other]])
            width = off[other, 0] + slope * (at - place[other, 0])
            if width[0] * width[1] <= 0 or not (narrowest < np.abs(width)).all() or not (np.abs(width) < widest).all():
                continue
            ends.append(edges[one, 0] + at[:, None] * along[one] + 0.5 * width[:, None] * across)
            widths.append(np.abs(width))
    return SegmentPairs(np.array(ends, np.float64).reshape(-1, 2, 2), np.array(widths, np.float64).reshape(-1, 2))


@njit(cache=True, nogil=True)
def _joined(segments: FloatArray) -> FloatArray:
    """Edges (M, 2, 2) made of the segments (N, 2, 2), longest first, that lie on one line without a long gap."""
    count = len(segments)
    direction = np.empty((count, 2))
    length = np.empty(count)
    for k in range(count):
        x, y = segments[k, 1, 0] - segments[k, 0, 0], segments[k, 1, 1] - segments[k, 0, 1]
        length[k] = np.sqrt(x * x + y * y)
        direction[k] = x / length[k], y / length[k]
    free = np.ones(count, np.bool_)
    edges = np.empty((count, 2, 2))
    made = 0
    for seed in range(count):
        if not free[seed]:
            continue
        free[seed] = False
        ox, oy = (
            0.5 * (segments[seed, 0, 0] + segments[seed, 1, 0]),
            0.5 * (segments[seed, 0, 1] + segments[seed, 1, 1]),
        )
        dx, dy = direction[seed]
        low, high, seen = -0.5 * length[seed], 0.5 * length[seed], length[seed]
        grown = True
        while grown:
            grown = False
            for k in range(count):
                if not free[k] or direction[k, 0] * dx + direction[k, 1] * dy < np.cos(TURNED):
                    continue
                ax, ay = segments[k, 0, 0] - ox, segments[k, 0, 1] - oy
                bx, by = segments[k, 1, 0] - ox, segments[k, 1, 1] - oy
                if max(abs(ay * dx - ax * dy), abs(by * dx - bx * dy)) > OFF_LINE:
                    continue
                first, last = ax * dx + ay * dy, bx * dx + by * dy
                if first > high + GAP or last < low - GAP:
                    continue
                free[k] = False
                grown = True
                seen += length[k]
                # The farthest ends fix the direction: the line turns about its own far end.
                if last > high:
                    px, py = ox + low * dx, oy + low * dy
                    ox, oy = px, py
                    dx, dy = segments[k, 1, 0] - px, segments[k, 1, 1] - py
                    low, high = 0.0, np.sqrt(dx * dx + dy * dy)
                    dx, dy = dx / high, dy / high
                elif first < low:
                    px, py = ox + high * dx, oy + high * dy
                    dx, dy = px - segments[k, 0, 0], py - segments[k, 0, 1]
                    ox, oy = segments[k, 0]
                    low, high = 0.0, np.sqrt(dx * dx + dy * dy)
                    dx, dy = dx / high, dy / high
        if seen >= LEAST_SEEN and seen >= LEAST_SHARE * (high - low):
            edges[made, 0] = ox + low * dx, oy + low * dy
            edges[made, 1] = ox + high * dx, oy + high * dy
            made += 1
    return edges[:made].copy()
