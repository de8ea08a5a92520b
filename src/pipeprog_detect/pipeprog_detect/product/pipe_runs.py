# SPDX-License-Identifier: Apache-2.0
"""Pipe runs: which pipes elbows, tees, reducers and couplings connect, and the metres along their centre line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, permutations, product

import numpy as np
from scipy.sparse.csgraph import connected_components

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.types import Cylinder, Pipe

# Axes that a fitting joins meet within 0.3 radii, and 5 mm by which their measurement may be off; over the gap of a
# coupling also 3 % of its length, as directions of short pipes are off by up to 1.7 deg.
_MISS, _LEAST_MISS = 0.3, 5e-3
_MISS_SLOPE = 0.03
# A turn [rad] below 8 deg is a coupling's, not an elbow's; no fitting turns by more than 135 deg. A branch leaves its
# run at 45 deg or more; 30 deg leaves room for what its axis may be off by.
_STRAIGHT, _SHARPEST = np.radians(8.0), np.radians(135.0)
_LEAST_BRANCHING = np.radians(30.0)
# Bends turn about up to five diameters (10 radii); their sockets add up to a diameter (2 radii). Radii of one size
# agree within 25 %, the step between standard sizes.
_WIDEST_BEND, _SOCKET = 10.0, 2.0
_SAME_SIZE = 1.25
# Ends measured too long overlap: in a coupling by a radius at most, in an elbow up to half a radius beyond the corner.
_OVERLAP, _CORNER_OVERLAP = 1.0, 0.5
# A reducer or a coupling hides at most 10 radii of the thicker pipe, or 0.3 m.
_COUPLING, _LEAST_COUPLING = 10.0, 0.3


@dataclass(frozen=True)
class Joint:
    """A fitting between the pipes with these ids; angle [rad] of its turn, length [m] along the centre line.

    kind is "elbow", "reducer", "coupling" or "tee"; of a tee the first pipe is the branch, whose centre line reaches
    the other's axis.
    """

    kind: str
    pipes: tuple[str, str]
    angle: float
    length: float


@dataclass(frozen=True)
class PipeRun:
    """Connected pipes by id and their joints; lengths [m]: of the straight barrels, and of the centre line."""

    id: str
    pipes: tuple[str, ...]
    joints: tuple[Joint, ...]
    barrel: float
    centre_line: float


def pipe_runs(pipes: Sequence[Pipe]) -> list[PipeRun]:
    """The runs r01, r02, ... that the pipes form, each pipe in one of them, in the order of their first pipes."""
    joints = find_joints(pipes)
    number = {pipe.id: k for k, pipe in enumerate(pipes)}
    connected = np.zeros((len(pipes), len(pipes)), bool)
    for joint in joints:
        connected[number[joint.pipes[0]], number[joint.pipes[1]]] = True
    count, label = connected_components(connected, directed=False)
    runs = []
    for run in range(count):
        own = [pipe for pipe, its in zip(pipes, label, strict=True) if its == run]
        fittings = tuple(joint for joint in joints if label[number[joint.pipes[0]]] == run)
        barrel = sum(pipe.cylinder.length for pipe in own)
        centre_line = barrel + sum(joint.length for joint in fittings)
        runs.append(PipeRun(f"r{run + 1:02d}", tuple(pipe.id for pipe in own), fittings, barrel, centre_line))
    return runs


def find_joints(pipes: Sequence[Pipe]) -> list[Joint]:
    """The fittings between pipes; each end of a pipe has one at most, the one whose axes meet best.

    They are sorted by the places of their pipes in the list.
    """
    found: list[tuple[float, tuple[tuple[int, int], ...], tuple[int, int], Joint]] = []
    for i, j in combinations(range(len(pipes)), 2):
        for a, b in product((0, 1), (0, 1)):
            between = _between_ends(pipes[i], pipes[j], a, b)
            if between is not None:
                miss, joint = between
                found.append((miss, ((i, a), (j, b)), (i, j), joint))
    for i, j in permutations(range(len(pipes)), 2):
        for a in (0, 1):
            branch = _branch(pipes[i], pipes[j], a)
            if branch is not None:
                miss, joint = branch
                found.append((miss, ((i, a),), (i, j), joint))
    joints: list[tuple[tuple[int, int], Joint]] = []
    used: set[tuple[int, int]] = set()
    for _, ends, places, joint in sorted(found, key=lambda each: each[:2]):
        if used.isdisjoint(ends):
            used.update(ends)
            joints.append((places, joint))
    return [joint for _, joint in sorted(joints, key=lambda each: each[0])]


def _end(cylinder: Cylinder, which: int) -> tuple[FloatArray, FloatArray]:
    """An end of the axis (3,) and the direction (3,) that leads away from the pipe there."""
    return (cylinder.start, -cylinder.axis) if which == 0 else (cylinder.end, cylinder.axis)


def _between_ends(first: Pipe, second: Pipe, a: int, b: int) -> tuple[float, Joint] | None:
    """The gap between the axes [m], and the elbow, reducer or coupling between two ends."""
    one, other = first.cylinder, second.cylinder
    ids = (first.id, second.id)
    (from_, out), (to, back) = _end(one, a), _end(other, b)
    thick, thin = max(one.radius, other.radius), min(one.radius, other.radius)
    allowed = _MISS * thin + _LEAST_MISS
    turn = float(np.arccos(np.clip(-(out @ back), -1.0, 1.0)))
    if turn < _STRAIGHT:
        gap = to - from_
        along = float(gap @ out)
        miss = float(np.linalg.norm(gap - along * out))
        longest = max(_COUPLING * thick, _LEAST_COUPLING)
        if not -_OVERLAP * thick < along < longest or miss > allowed + _MISS_SLOPE * abs(along):
            return None
        kind = "coupling" if thick < _SAME_SIZE * thin else "reducer"
        return miss, Joint(kind, ids, turn, max(along, 0.0))
    if turn > _SHARPEST or thick > _SAME_SIZE * thin:
        return None
    s, t, miss = _meeting(from_, out, to, back)
    longest = _WIDEST_BEND * thick * np.tan(0.5 * turn) + _SOCKET * thick
    if (
        miss > allowed
        or min(s, t) < -_CORNER_OVERLAP * thick
        or max(s, t) > longest
        or abs(s - t) > 2.0 * _SOCKET * thick
    ):
        return None
    # The bend begins where the nearer end is; what the other has more is straight socket.
    tangent = max(min(s, t), 0.0)
    return miss, Joint("elbow", ids, turn, tangent * turn / float(np.tan(0.5 * turn)) + abs(s - t))


def _branch(first: Pipe, second: Pipe, a: int) -> tuple[float, Joint] | None:
    """The gap between the axes [m], and the tee by which an end of the first pipe branches off the second's barrel."""
    branch, run = first.cylinder, second.cylinder
    end, out = _end(branch, a)
    turn = float(np.arccos(np.clip(abs(out @ run.axis), 0.0, 1.0)))
    if turn < _LEAST_BRANCHING or branch.radius > _SAME_SIZE * run.radius:
        return None
    s, t, miss = _meeting(end, out, run.start, run.axis)
    reach = run.radius / float(np.sin(turn)) + _SOCKET * run.radius
    if miss > _MISS * run.radius + _LEAST_MISS or not 0.0 < s < reach or not run.radius < t < run.length - run.radius:
        return None
    return miss, Joint("tee", (first.id, second.id), turn, s)


def _meeting(one: FloatArray, out: FloatArray, other: FloatArray, back: FloatArray) -> tuple[float, float, float]:
    """Distances along two lines to where they come nearest [m], and how far apart they are there [m].

    The lines run through `one` and `other` (3,) along the unit directions `out` and `back` (3,), which must differ.
    """
    gap, cosine = other - one, float(out @ back)
    sine = 1.0 - cosine**2
    s = float(gap @ out - cosine * (gap @ back)) / sine
    t = float(cosine * (gap @ out) - gap @ back) / sine
    return s, t, float(np.linalg.norm(one + s * out - other - t * back))
