# SPDX-License-Identifier: Apache-2.0
"""What surrounds a cylinder: a pipe is seen from outside, is not the rounding of a corner, and lies in no wall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.cloud.candidate import Candidate
from pipeprog_detect.cloud.octree import Octree
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.silhouette.scene import frame
from pipeprog_detect.types import Cylinder

# Mean cosine between the normals of a pipe and those of its points: noise turns a thin pipe's by less than 60 deg.
_OUTWARD = 0.5
# A plane goes along a cylinder within this angle (sine), and is tangent to it at its radius but for this share and the
# noise.
ALONG = float(np.sin(np.radians(6.0)))
_TANGENT = 0.15
# Planes that meet at less than 30 deg (cosine) make no corner.
CORNER = float(np.cos(np.radians(30.0)))
# Walls are looked at in steps [m] of a cylinder's length, up to this far beside its surface: in radii, at least in
# metres.
_STEP, _BESIDE, _LEAST_BESIDE = 0.05, 3.0, 0.03
# They are looked at before and behind it up to this many times as far (walls aslant to the view). The median of three
# points tells where a wall is, one of them being astray.
_ASLANT, _LEAST_POINTS = 3.0, 3
# Share of a cylinder beside seen walls that tells whether all of it is in one: it is straight. Less than a quarter may
# be where a pipe comes out of a wall.
_TOLD = 0.25
# A cylinder whose axis lies behind the wall, or before it by less than this share of the radius, is in it.
_IN_WALL = 0.5
# Where two planes meet in a cylinder they are looked for this far beside it [m]: stereo leaves out the foot of a wall,
# in the shade and at the border of the images.
_FOOT = 0.2
# Share of a cylinder within or before which a wall may be seen: it may have been continued into one. Walls farther than
# this many radii from the axis are before the cylinder for some views and beside it for others.
_COVERED, _CLOSE = 0.25, 2.0
# The floor, the ceiling and the walls of a room have more area than this [m2]: boards and boxes have less. What is
# farther than this [m] behind them is no point of theirs. Less than this share of all points are there, astray: on
# rendered sites one in ten thousand at the most, and one in a hundred behind the underside of a duct.
_BOUNDARY, _BEHIND, _STRAY = 0.5, 0.05, 1e-3
# Walls deviate from a plane by this much [m] over that width.
_WAVINESS = 1e-3


@dataclass(frozen=True)
class SceneContext:
    """What surrounds the candidates.

    Attributes:
        tree: the points beside large planes.
        outward: their normals (N, 3) towards the sensor; None where they are not known.
        planes: large planes: walls, floors, ceilings.
        walls: points on these planes.
        sigma: standard deviation of the cloud's noise [m].
    """

    tree: Octree
    outward: FloatArray | None
    planes: Sequence[Plane]
    walls: Octree
    sigma: float

    def outwardness(self, candidate: Candidate) -> float | None:
        """Mean cosine between the normals of the points on a cylinder and its own, None where they are not known.

        Near 1 on a pipe seen from outside, near -1 in a corner and on a pipe seen from inside.
        """
        if self.outward is None:
            return None
        rows, radial = self._surface(candidate)
        return float(np.einsum("ij,ij->i", radial, self.outward[rows]).mean()) if len(rows) else 0.0

    def rejects(self, candidate: Candidate) -> bool:
        """Whether a candidate is no pipe: it is hollow, or the rounding of the edge or corner of two planes.

        Such a rounding is tangent to both planes, which are seen beside it, and lies where they would meet; a pipe in a
        corner shows its other side.
        """
        outwardness = self.outwardness(candidate)
        if outwardness is not None and outwardness < _OUTWARD:
            return True
        cylinder = candidate.cylinder
        allowed = _TANGENT * cylinder.radius + 3.0 * candidate.band
        tangent = []
        for plane in self.planes:
            away = plane.offset - float(plane.normal @ cylinder.middle)
            if abs(plane.normal @ cylinder.axis) < ALONG and abs(abs(away) - cylinder.radius) < allowed:
                tangent.append((plane, np.sign(away) * plane.normal))
        corners = [
            (one, other, towards_one + towards_other)
            for (one, towards_one), (other, towards_other) in combinations(tangent, 2)
            if abs(float(towards_one @ towards_other)) < CORNER
        ]
        if not corners:
            return False
        front = self._surface(candidate)[1].mean(axis=0)
        beside = self.walls.points[self.walls.near_segment(cylinder.start, cylinder.end, _reach_beside(cylinder))]
        return any(
            float(front @ corner) > 0.7 * np.linalg.norm(front) * np.linalg.norm(corner)
            and self._run_beside(cylinder, beside, one, other)
            for one, other, corner in corners
        )

    def _run_beside(self, cylinder: Cylinder, points: FloatArray, one: Plane, other: Plane) -> bool:
        """Whether each of two planes has points (N, 3) of its own beside more than half of the cylinder.

        A plane is known by its normal and offset: what was seen of it may be far away.
        """
        on_one, on_other = (np.abs(points @ each.normal - each.offset) < self.clearance for each in (one, other))
        return all(_are_along(0.5, cylinder, points[own]) for own in (on_one & ~on_other, on_other & ~on_one))

    def is_embedded(self, cylinder: Cylinder, radius_sigma: float, towards: FloatArray) -> bool:
        """Whether the cylinder, looked at along `towards` (3,), would lie within walls where these are seen beside it.

        That is so along more than half of what is beside seen walls, which must be `_TOLD` of it at least.

        The contour is where the line of sight touches the cylinder, beside its axis and hardly nearer: a wall whose
        own face is nearer than the axis on both sides would hide both lines. The depth that the views tell may be
        wrong by a share of the radius, and the axis of a pipe on a wall is a whole radius before it. What counts is the
        wall next to the lines: beside a pipe that is looked at aslant it comes nearer farther away.
        """
        sideways, depth = frame(cylinder, towards)
        reach = _reach_beside(cylinder)
        rows = self.walls.near_segment(cylinder.start, cylinder.end, _ASLANT * reach)
        offset = self.walls.points[rows] - cylinder.start
        aside, behind = offset @ sideways, offset @ depth
        bins = max(int(cylinder.length / _STEP), 4)
        place = np.clip((offset @ cylinder.axis / cylinder.length * bins).astype(np.int64), 0, bins - 1)
        surface = _IN_WALL * cylinder.radius - self._clear(radius_sigma)
        told = buried = 0
        for step in range(bins):
            beside = (place == step) & (np.abs(aside) > cylinder.radius) & (np.abs(aside) < reach)
            flanks = [beside & (side * aside > 0) for side in (-1.0, 1.0)]
            if all(flank.sum() >= _LEAST_POINTS for flank in flanks):
                told += 1
                buried += all(np.median(_next_to(np.abs(aside[flank]), behind[flank])) < surface for flank in flanks)
        return told >= _TOLD * bins and buried > 0.5 * told

    def is_covered(self, cylinder: Cylinder, radius_sigma: float, towards: FloatArray) -> bool:
        """Whether a wall is seen within the cylinder or close before it, looked at along `towards` (3,).

        That is so along more than `_COVERED` of it. The surface of a pipe would hide a wall within it, and one before
        it would hide the pipe: edges of ducts and boards were taken for its contour.
        """
        sideways, depth = frame(cylinder, towards)
        radius = cylinder.radius
        clear = self._clear(radius_sigma)
        points = self.walls.points[self.walls.near_segment(cylinder.start, cylinder.end, _CLOSE * radius)]
        offset = cylinder.from_axis(points)
        aside, behind = offset @ sideways, offset @ depth
        within = np.hypot(aside, behind) < radius - clear
        before = (np.abs(aside) < radius - clear) & (behind < -np.sqrt(np.maximum(radius**2 - aside**2, 0.0)) - clear)
        return _are_along(_COVERED, cylinder, points[within | before])

    def touches_wall(self, cylinder: Cylinder) -> bool:
        """Whether a wall is as near to the axis as the radius, along more than half of the cylinder.

        Lines on a wall, such as shadows, joints and its corner with the next one, look like a thin pipe on it. In a
        corner stereo shows neither wall: a wall that ends beside the cylinder goes on to it, also from farther away
        where another one crosses it there.
        """
        nearest = cylinder.radius + self.clearance
        along = [plane for plane in self.planes if abs(plane.normal @ cylinder.axis) < ALONG]
        through = [each.normal for each in along if abs(each.normal @ cylinder.middle - each.offset) < nearest]
        two_meet = any(abs(one @ other) < CORNER for one, other in combinations(through, 2))
        reach = nearest + (_FOOT if two_meet else _LEAST_BESIDE)
        walls, rest = (
            tree.points[tree.near_segment(cylinder.start, cylinder.end, reach)] for tree in (self.walls, self.tree)
        )
        # A strip of a wall between two pipes is too narrow to be found as a plane, or a part of one.
        on_wall = [np.abs(rest @ plane.normal - plane.offset) < self.clearance for plane in along]
        points = np.concatenate([walls, rest[np.any(on_wall, axis=0)]]) if along else walls
        foot = cylinder.at(cylinder.along(points) / cylinder.length)
        touching = np.linalg.norm(points - foot, axis=1) < nearest
        for plane in along:
            from_points, from_axis = (np.abs(each @ plane.normal - plane.offset) for each in (points, foot))
            touching |= (from_points < self.clearance) & (from_axis < nearest)
        return _are_along(0.5, cylinder, points[touching])

    def bounds_room(self, plane: Plane, direction: FloatArray) -> bool:
        """Whether next to nothing is seen behind a plane, looked at along `direction` (3,).

        Then it is the floor, the ceiling or a wall of the room.
        """
        return any(
            plane is wide and (behind if plane.normal @ direction > 0.0 else before) < _STRAY
            for wide, before, behind in self._off_wide_planes
        )

    @cached_property
    def _off_wide_planes(self) -> list[tuple[Plane, float, float]]:
        """Planes as wide as those of a room, and the shares of all points off them, against and along the normal."""
        shares = []
        for plane in self.planes:
            if plane.area > _BOUNDARY:
                away = [tree.points @ plane.normal - plane.offset for tree in (self.tree, self.walls)]
                count = sum(len(each) for each in away)
                before, behind = (sum(int((sign * each > _BEHIND).sum()) for each in away) for sign in (-1.0, 1.0))
                shares.append((plane, before / count, behind / count))
        return shares

    @property
    def clearance(self) -> float:
        """By how much [m] a wall may seem to be nearer than it is: three standard deviations, and its waviness."""
        return self._clear(0.0)

    def _clear(self, radius_sigma: float) -> float:
        """By how much [m] a wall may seem to be nearer than it is: three standard deviations, and its waviness."""
        return 3.0 * float(np.hypot(self.sigma, radius_sigma)) + _WAVINESS

    def _surface(self, candidate: Candidate) -> tuple[IntArray, FloatArray]:
        """Rows of the points on the cylinder's surface and the unit vectors (K, 3) from its axis to them."""
        cylinder = candidate.cylinder
        rows = self.tree.near_segment(cylinder.start, cylinder.end, cylinder.radius + 3.0 * candidate.band)
        radial = cylinder.from_axis(self.tree.points[rows])
        distance = np.linalg.norm(radial, axis=1)
        near = np.abs(distance - cylinder.radius) < 3.0 * candidate.band
        return rows[near], radial[near] / (distance[near] + 1e-12)[:, None]


def _next_to(aside: FloatArray, behind: FloatArray) -> FloatArray:
    """Of N >= `_LEAST_POINTS` points those (K,) `behind` within a step of the least distance `aside` [m] of a few."""
    least = np.partition(aside, _LEAST_POINTS - 1)[_LEAST_POINTS - 1]
    return behind[aside <= least + _STEP]


def _reach_beside(cylinder: Cylinder) -> float:
    """How far from the axis [m] of a cylinder walls are looked at beside it."""
    return float(cylinder.radius + max(_BESIDE * cylinder.radius, _LEAST_BESIDE))


def _are_along(share: float, cylinder: Cylinder, points: FloatArray) -> bool:
    """Whether points (N, 3) lie along more than a share of a cylinder."""
    along = cylinder.along(points)
    within = along[(along > 0.0) & (along < cylinder.length)]
    steps = max(int(cylinder.length / _STEP), 4)
    return len(np.unique((within / cylinder.length * steps).astype(np.int64))) > share * steps
