# SPDX-License-Identifier: Apache-2.0
"""Pipe runs: which pipes elbows, tees, reducers and couplings connect, and the metres along their centre line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import numpy as np
from scipy.sparse.csgraph import connected_components

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.product import fittings
from pipeprog_detect.types import Cylinder, Pipe, PipeEnd

# A bend of 3 radii (a long-radius elbow) leaves the line of its pipe by s^2 / (2 * 3 r) at s beyond its beginning; less
# than 4 mm (1.5 px at 2.5 m with 1000 px) does not show in the contour, so that the end may lie anywhere along that.
# The legs of an elbow are equal: of two ends that differ by no more the one nearer to the corner lies in the bend.
_ELBOW_RADII, _ELBOW_SHOWS = 3.0, 4e-3


@dataclass(frozen=True)
class Joint:
    """A fitting between the pipes with these ids; angle [rad] of its turn, length [m] along the centre line.

    kind is "elbow", "reducer", "coupling" or "tee"; of a tee the first pipe is the branch, whose centre line reaches
    the other's axis. `miss` is how far the axes pass each other [m], NaN where it is not known; `into_bend` [m] how far
    each pipe was measured on into the bend of an elbow.
    """

    kind: str
    pipes: tuple[str, str]
    angle: float
    length: float
    miss: float = float("nan")
    into_bend: tuple[float, float] = (0.0, 0.0)


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
        barrel = sum(pipe.cylinder.length for pipe in own) - sum(sum(joint.into_bend) for joint in fittings)
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


def with_fittings(pipes: Sequence[Pipe], runs: Sequence[PipeRun]) -> list[Pipe]:
    """The pipes of the runs, with the ends at which fittings begin, and no longer than to there."""
    result = {pipe.id: pipe for pipe in pipes}
    for joint in (joint for run in runs for joint in run.joints):
        for place in (0,) if joint.kind == "tee" else (0, 1):  # the run of a tee goes on
            own, other = joint.pipes[place], joint.pipes[1 - place]
            pipe, beside = result[own], result[other].cylinder
            cylinder, further = pipe.cylinder, joint.into_bend[place]
            at_end = _distance(cylinder.end, beside) < _distance(cylinder.start, beside)
            start, end = pipe.ends
            fitted = _at_fitting(end if at_end else start, joint, cylinder.radius)
            within = (0.0, cylinder.length - further) if at_end else (further, cylinder.length)
            ends = (start, fitted) if at_end else (fitted, end)
            result[own] = replace(pipe, cylinder=cylinder.cut(*within), ends=ends)
    return list(result.values())


def _at_fitting(end: PipeEnd, joint: Joint, radius: float) -> PipeEnd:
    hidden = max(_bend_hides(radius) - sum(joint.into_bend), 0.0) if joint.kind == "elbow" else 0.0
    return PipeEnd(float(np.hypot(end.sigma, hidden / np.sqrt(3.0))), "fitting")


def _bend_hides(radius: float) -> float:
    """How far [m] a barrel may be measured on into a bend."""
    return float(np.sqrt(2.0 * _ELBOW_RADII * radius * _ELBOW_SHOWS))


def _distance(point: FloatArray, cylinder: Cylinder) -> float:
    """Distance [m] of a point (3,) from the axis between the ends."""
    along = float(np.clip((point - cylinder.start) @ cylinder.axis, 0.0, cylinder.length))
    return float(np.linalg.norm(point - cylinder.start - along * cylinder.axis))


def _end(cylinder: Cylinder, which: int) -> tuple[FloatArray, FloatArray]:
    """An end of the axis (3,) and the direction (3,) that leads away from the pipe there."""
    return (cylinder.start, -cylinder.axis) if which == 0 else (cylinder.end, cylinder.axis)


def _between_ends(first: Pipe, second: Pipe, a: int, b: int) -> tuple[float, Joint] | None:
    """The gap between the axes [m], and the elbow, reducer or coupling between two ends."""
    (from_, out), (to, back) = _end(first.cylinder, a), _end(second.cylinder, b)
    turn = float(np.arccos(np.clip(-(out @ back), -1.0, 1.0)))
    thick, thin = (sort(pipe.cylinder.radius for pipe in (first, second)) for sort in (max, min))
    same = fittings.are_of_one_size(first, second)
    ids = (first.id, second.id)
    if turn < fittings.STRAIGHT:
        gap = to - from_
        along = float(gap @ out)
        miss = float(np.linalg.norm(gap - along * out))
        fits = fittings.is_coupling(along, thick) if same else fittings.is_reducer(along, thick, thin)
        if not fits or miss > fittings.miss_allowed(thin) + fittings.MISS_SLOPE * abs(along):
            return None
        return miss, Joint("coupling" if same else "reducer", ids, turn, max(along, 0.0), miss)
    if not same or turn > fittings.SHARPEST:
        return None
    s, t, miss = _meeting(from_, out, to, back)
    if miss > fittings.miss_allowed(thin) or not fittings.is_elbow(s, t, turn, thick):
        return None
    further = (max(t - s, 0.0), max(s - t, 0.0))
    farther_end = second.ends[b] if t > s else first.ends[a]
    if max(further) > _bend_hides(thick) or farther_end.sigma > max(further):
        # The bend begins where the nearer end is; what the other has more is straight socket.
        tangent = max(min(s, t), 0.0)
        return miss, Joint("elbow", ids, turn, tangent * turn / float(np.tan(0.5 * turn)) + abs(s - t), miss)
    return miss, Joint("elbow", ids, turn, max(s, t) * turn / float(np.tan(0.5 * turn)), miss, further)


def _branch(first: Pipe, second: Pipe, a: int) -> tuple[float, Joint] | None:
    """The gap between the axes [m], and the tee by which an end of the first pipe branches off the second's barrel."""
    branch, run = first.cylinder, second.cylinder
    end, out = _end(branch, a)
    turn = float(np.arccos(np.clip(abs(out @ run.axis), 0.0, 1.0)))
    if turn < fittings.STRAIGHT or not (branch.radius < run.radius or fittings.are_of_one_size(first, second)):
        return None
    s, t, miss = _meeting(end, out, run.start, run.axis)
    on_barrel = run.radius < t < run.length - run.radius
    if miss > fittings.miss_allowed(branch.radius) or not on_barrel or not fittings.is_tee(s, turn, run.radius):
        return None
    return miss, Joint("tee", (first.id, second.id), turn, s, miss)


def _meeting(one: FloatArray, out: FloatArray, other: FloatArray, back: FloatArray) -> tuple[float, float, float]:
    """Distances along two lines to where they come nearest [m], and how far apart they are there [m].

    The lines run through `one` and `other` (3,) along the unit directions `out` and `back` (3,), which must differ.
    """
    gap, cosine = other - one, float(out @ back)
    sine = 1.0 - cosine**2
    s = float(gap @ out - cosine * (gap @ back)) / sine
    t = float(cosine * (gap @ out) - gap @ back) / sine
    return s, t, float(np.linalg.norm(one + s * out - other - t * back))
