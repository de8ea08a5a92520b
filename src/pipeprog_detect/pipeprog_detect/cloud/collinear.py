# SPDX-License-Identifier: Apache-2.0
"""How cylinders belong together: pieces of one pipe on one line, elbows between two pipes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.sparse.csgraph import connected_components

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.axial_extent import longest_gap
from pipeprog_detect.types import Cylinder

# Pieces of one pipe: axes within 2 deg, or half a radius over the length of the shorter piece, as well as its direction
# is known; offset by a quarter of the radius and 4 mm of waviness; radii within 12 %: half the step of 25 % between
# standard sizes.
_ANGLE = np.radians(2.0)
_ANGLE_RADII = 0.5
_OFFSET = 0.25
_RATIO = 1.12
_LEAST_OFFSET = 4e-3
# Where the offset is within half of what is allowed, a gap may be as long as the shorter piece, or 15 radii.
_CLOSE = 0.5
_CLOSE_GAP_RADII = 15.0
# The middle of an elbow: at most 6 radii long (the arc of a long-radius elbow, 3 radii times 90 deg, is 4.7), beside a
# pipe at least 1.5 times as long, whose radius is the same to a factor of 1.25, the step between standard sizes.
_ELBOW_RADII = 6.0
_LONGER = 1.5
_THINNER, _THICKER = 0.8, 1.25
# It is at 8 to 75 deg to that pipe (the chord of a bend of 90 deg is at 45 deg; below 8 deg it is the same pipe), and
# their ends are at most 2.5 of its radii apart, since what lies between is bent and belongs to neither.
_ELBOW_LEAST, _ELBOW_MOST = np.radians(8.0), np.radians(75.0)
_TOUCH = 2.5
# Places on an axis at which its distance from another is taken: every eighth of it.
_PLACES = 9


def near(one: Cylinder, other: Cylinder, reach: float) -> bool:
    """Whether the axes of two cylinders come nearer than their radii and `reach` [m]."""
    allowed = one.radius + other.radius + reach
    apart = float(np.linalg.norm(0.5 * (one.start + one.end - other.start - other.end)))
    if apart > 0.5 * (one.length + other.length) + allowed:
        return False
    return _axis_distance(one, other) < allowed


def join(cylinders: Sequence[Cylinder]) -> list[list[int]]:
    """Groups of the cylinders that are pieces of one pipe, in the order of their first members.

    Two pieces are one pipe where axis and radius agree and the gap is one that fittings, clamps and occluders make:
    up to ten radii or 30 cm, or up to the shorter piece's length where the axes agree closely.
    """
    count = len(cylinders)
    one_pipe = np.zeros((count, count), bool)
    for i, j in combinations(range(count), 2):
        one_pipe[i, j] = _one_pipe(cylinders[i], cylinders[j])
    groups, label = connected_components(one_pipe, directed=False)
    return [np.flatnonzero(label == group).tolist() for group in range(groups)]


def spanning(pieces: Sequence[Cylinder], best: int) -> Cylinder:
    """One cylinder from end to end of collinear pieces, with the radius of the best; its axis joins the far ends."""
    if len(pieces) == 1:
        return pieces[0]
    ends = np.array([end for piece in pieces for end in (piece.start, piece.end)])
    along = pieces[best].along(ends)
    return Cylinder(ends[int(np.argmin(along))], ends[int(np.argmax(along))], pieces[best].radius)


def elbows(cylinders: Sequence[Cylinder]) -> set[int]:
    """Which cylinders are the middle of an elbow: short, beside an end of a longer one as thick, at an angle to it."""
    found = set()
    for i, one in enumerate(cylinders):
        if one.length > _ELBOW_RADII * one.radius:
            continue
        for other in cylinders:
            if other.length < _LONGER * one.length or not _THINNER < one.radius / other.radius < _THICKER:
                continue
            cosine = abs(float(one.axis @ other.axis))
            touch = min(float(np.linalg.norm(a - b)) for a in (one.start, one.end) for b in (other.start, other.end))
            if np.cos(_ELBOW_MOST) < cosine < np.cos(_ELBOW_LEAST) and touch < _TOUCH * one.radius:
                found.add(i)
    return found


def _one_pipe(one: Cylinder, other: Cylinder) -> bool:
    if not 1.0 / _RATIO < one.radius / other.radius < _RATIO:
        return False
    shorter, longer = sorted((one, other), key=lambda cylinder: cylinder.length)
    radius = longer.radius
    if abs(float(shorter.axis @ longer.axis)) < np.cos(max(_ANGLE, _ANGLE_RADII * radius / shorter.length)):
        return False
    along = np.array([(end - longer.start) @ longer.axis for end in (shorter.start, shorter.end)])
    gap = max(float(along.min()) - longer.length, -float(along.max()))
    facing = (shorter.start, shorter.end)[int(np.argmin(np.abs(along - 0.5 * longer.length)))]
    aside = facing - longer.start
    offset = float(np.linalg.norm(aside - (aside @ longer.axis) * longer.axis))
    if offset > _OFFSET * radius + _LEAST_OFFSET:
        return False
    close = offset < _CLOSE * _OFFSET * radius + _LEAST_OFFSET
    allowed = longest_gap(radius)
    return gap < (max(allowed, shorter.length, _CLOSE_GAP_RADII * radius) if close else allowed)


def _axis_distance(one: Cylinder, other: Cylinder) -> float:
    """Least distance [m] of points along one axis from the other's segment."""
    share = np.linspace(0.0, 1.0, _PLACES)[:, None]
    best = np.inf
    for a, b in ((one, other), (other, one)):
        points: FloatArray = a.start + share * (a.end - a.start)
        along = np.clip(b.along(points), 0.0, b.length)
        best = min(best, float(np.linalg.norm(points - b.start - along[:, None] * b.axis, axis=1).min()))
    return best
