"""Pipe runs: which pipes elbows, tees, reducers and couplings connect, and the metres along their centre line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.types import Cylinder

# Axes that a fitting joins meet within this share of the radius, and what their measurement may be off by [m].
_MISS, _LEAST_MISS = 0.3, 5e-3
# A turn below this is a coupling's, not an elbow's; above the other no fitting turns back so far.
_STRAIGHT, _SHARPEST = np.radians(8.0), np.radians(135.0)
# Bends turn about up to five diameters; their sockets add up to a diameter. Radii of one size agree within a quarter.
_WIDEST_BEND, _SOCKET = 10.0, 2.0
_SAME_SIZE = 1.25
# What a reducer or a coupling is long at most, in radii of the thicker pipe, and at least [m].
_COUPLING, _LEAST_COUPLING = 10.0, 0.3


@dataclass(frozen=True)
class Joint:
    """A fitting between the pipes with these numbers; angle [rad] of its turn, length [m] along the centre line.

    kind is "elbow", "reducer", "coupling" or "tee"; of a tee the first pipe is the branch, whose centre line reaches
    the other's axis.
    """

    kind: str
    pipes: tuple[int, int]
    angle: float
    length: float


@dataclass(frozen=True)
class PipeRun:
    """Connected pipes by number and their joints; lengths [m]: of the straight barrels, and of the centre line."""

    pipes: tuple[int, ...]
    joints: tuple[Joint, ...]
    barrel: float
    centre_line: float


def pipe_runs(cylinders: Sequence[Cylinder]) -> list[PipeRun]:
    """The runs that the cylinders form, each cylinder in one of them, in the order of their first pipes."""
    joints = find_joints(cylinders)
    group = list(range(len(cylinders)))
    for joint in joints:
        old, new = max(group[k] for k in joint.pipes), min(group[k] for k in joint.pipes)
        group = [new if member == old else member for member in group]
    runs = []
    for first in sorted(set(group)):
        pipes = tuple(k for k in range(len(cylinders)) if group[k] == first)
        own = tuple(joint for joint in joints if group[joint.pipes[0]] == first)
        barrel = sum(cylinders[k].length for k in pipes)
        runs.append(PipeRun(pipes, own, barrel, barrel + sum(joint.length for joint in own)))
    return runs


def find_joints(cylinders: Sequence[Cylinder]) -> list[Joint]:
    """The fittings between cylinders; each end has one at most, the one whose axes meet best."""
    found: list[tuple[float, Joint, tuple[tuple[int, int], ...]]] = []
    for i, j in combinations(range(len(cylinders)), 2):
        for a, b in product((0, 1), (0, 1)):
            between = _between_ends(cylinders, i, j, a, b)
            if between is not None:
                found.append((*between, ((i, a), (j, b))))
    for i, j in product(range(len(cylinders)), repeat=2):
        for a in (0, 1):
            branch = _branch(cylinders, i, j, a) if i != j else None
            if branch is not None:
                found.append((*branch, ((i, a),)))
    joints: list[Joint] = []
    used: set[tuple[int, int]] = set()
    for _, joint, ends in sorted(found, key=lambda each: (each[0], each[2])):
        if used.isdisjoint(ends):
            used.update(ends)
            joints.append(joint)
    return sorted(joints, key=lambda joint: joint.pipes)


def _end(cylinder: Cylinder, which: int) -> tuple[FloatArray, FloatArray]:
    """An end of the axis (3,) and the direction (3,) that leads away from the pipe there."""
    return (cylinder.start, -cylinder.axis) if which == 0 else (cylinder.end, cylinder.axis)


def _between_ends(cylinders: Sequence[Cylinder], i: int, j: int, a: int, b: int) -> tuple[float, Joint] | None:
    """How ill the axes meet [m], and the elbow, reducer or coupling between two ends."""
    one, other = cylinders[i], cylinders[j]
    (from_, out), (to, back) = _end(one, a), _end(other, b)
    thick, thin = max(one.radius, other.radius), min(one.radius, other.radius)
    allowed = _MISS * thin + _LEAST_MISS
    turn = float(np.arccos(np.clip(-(out @ back), -1.0, 1.0)))
    if turn < _STRAIGHT:
        gap = to - from_
        along = float(gap @ out)
        miss = float(np.linalg.norm(gap - along * out))
        # Over the gap the directions may be off by what the shorter one's ends are.
        if not -thick < along < max(_COUPLING * thick, _LEAST_COUPLING) or miss > allowed + 0.03 * abs(along):
            return None
        kind = "coupling" if thick < _SAME_SIZE * thin else "reducer"
        return miss, Joint(kind, (i, j), turn, max(along, 0.0))
    if turn > _SHARPEST or thick > _SAME_SIZE * thin:
        return None
    s, t, miss = _meeting(from_, out, to, back)
    longest = _WIDEST_BEND * thick * np.tan(0.5 * turn) + _SOCKET * thick
    if miss > allowed or min(s, t) < -0.5 * thick or max(s, t) > longest or abs(s - t) > 2.0 * _SOCKET * thick:
        return None
    # The bend begins where the nearer end is; what the other has more is straight socket.
    tangent = max(min(s, t), 0.0)
    return miss, Joint("elbow", (i, j), turn, tangent * turn / float(np.tan(0.5 * turn)) + abs(s - t))


def _branch(cylinders: Sequence[Cylinder], i: int, j: int, a: int) -> tuple[float, Joint] | None:
    """How ill the axes meet [m], and the tee by which an end of pipe i branches off the barrel of pipe j."""
    branch, run = cylinders[i], cylinders[j]
    end, out = _end(branch, a)
    turn = float(np.arccos(np.clip(abs(out @ run.axis), 0.0, 1.0)))
    if turn < np.radians(30.0) or branch.radius > _SAME_SIZE * run.radius:
        return None
    s, t, miss = _meeting(end, out, run.start, run.axis)
    reach = run.radius / float(np.sin(turn)) + _SOCKET * run.radius
    if miss > _MISS * run.radius + _LEAST_MISS or not 0.0 < s < reach or not run.radius < t < run.length - run.radius:
        return None
    return miss, Joint("tee", (i, j), turn, s)


def _meeting(one: FloatArray, out: FloatArray, other: FloatArray, back: FloatArray) -> tuple[float, float, float]:
    """Distances along two lines to where they come nearest, and how near that is."""
    gap, cosine = other - one, float(out @ back)
    sine = 1.0 - cosine**2
    s = float(gap @ out - cosine * (gap @ back)) / sine
    t = float(cosine * (gap @ out) - gap @ back) / sine
    return s, t, float(np.linalg.norm(one + s * out - other - t * back))
