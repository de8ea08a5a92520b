# SPDX-License-Identifier: Apache-2.0
"""Measurements of the last map, which stand as long as nothing that they depend on has changed."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.rolled_image import RolledImage
from pipeprog_detect.cloud.collinear import near
from pipeprog_detect.cloud.map_change import MapChange
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.silhouette.apparent_contour import ViewArrays
from pipeprog_detect.types import Cylinder, View

# A candidate is the same while its ends move by less than the cloud's own scatter [m] and a share of its radius, and
# its radius changes by less than that share.
_MOVED, _CHANGED = 2e-3, 0.03
# Poses are the same while the images move by less than a tenth of a pixel: metres at 1.4 m, and radians, at a focal
# length of 700 px.
_SHIFTED, _TURNED = 2e-4, 1.5e-4
# Views that have come since, as a share of those measured in: a tenth more of them makes sigma 5 % smaller, and where
# they show more of a pipe, its candidate is longer.
_MORE_VIEWS = 0.1
# Pipes that come nearer than this [m] may hide one another.
_BESIDE = 0.3
# Views that see this part of the axis, in lengths from the start, may see the pipe or what it is extended to.
_AROUND = np.linspace(-0.5, 1.5, 9)


@dataclass(frozen=True)
class Question:
    """What a contour fit depends on.

    Attributes:
        cylinder: where it started.
        follow: whether the ends were sought.
        others: cylinders near enough to hide it.
        poses: camera_from_map (4, 4) by stamp of the views that may see it.
        rolled: how their rolling shutters show it, by stamp.
    """

    cylinder: Cylinder
    follow: bool
    others: list[Cylinder]
    poses: dict[int, FloatArray]
    rolled: dict[int, RolledImage]

    @classmethod
    def of(cls, cylinder: Cylinder, follow: bool, others: Sequence[Cylinder], views: Sequence[View]) -> Question:
        """The question of a fit among all `others` and `views`."""
        beside = [other for other in others if near(other, cylinder, _BESIDE)]
        around = cylinder.at(_AROUND)
        seeing = [views[number] for number in np.flatnonzero(ViewArrays.of(views).showing(around))] if views else []
        poses = {view.stamp: view.camera_from_map for view in seeing}
        rolled = {view.stamp: view.rolled for view in seeing if view.rolled is not None}
        return cls(cylinder, follow, beside, poses, rolled)

    def is_answered_by(self, earlier: Question) -> bool:
        """Whether nothing that the fit depends on has changed since an earlier question, but for a few more views."""
        return (
            earlier.follow == self.follow
            and _unchanged(earlier.cylinder, self.cylinder)
            and earlier.poses.keys() <= self.poses.keys()
            and len(self.poses) <= (1.0 + _MORE_VIEWS) * len(earlier.poses)
            and all(_same_pose(pose, self.poses[stamp]) for stamp, pose in earlier.poses.items())
            and all(_same_rows(rolled, self.rolled.get(stamp)) for stamp, rolled in earlier.rolled.items())
            and len(earlier.others) == len(self.others)
            and all(any(_unchanged(one, other) for other in self.others) for one in earlier.others)
        )


class MeasurementCache:
    """Contour fits of the last map; for one survey, whose keyframes keep their stamps and images.

    `novelty`: what the last map's cloud was like.
    `edges`: straight edges (N, 2, 2) [px] by a keyframe's stamp, the width at which they were sought, and whether in
    colour.
    """

    def __init__(self) -> None:
        self.novelty = MapChange()
        self.edges: dict[tuple[int, int, bool], FloatArray] = {}
        self._last: list[tuple[Question, ContourFit | None]] = []
        self._current: list[tuple[Question, ContourFit | None]] = []

    def next_map(self) -> None:
        """Forgets what only the map before the last one needed."""
        self._last, self._current = self._current, []

    def forget_views(self, stamps: Collection[int]) -> None:
        """Forgets what was measured in single keyframes that no map contains any more."""
        self.edges = {key: found for key, found in self.edges.items() if key[0] not in stamps}

    def recall(self, question: Question) -> tuple[bool, ContourFit | None]:
        """Whether the last map answers the question, and the fit (None: there is none)."""
        for earlier, fit in self._last:
            if question.is_answered_by(earlier):
                self._current.append((earlier, fit))
                return True, fit
        return False, None

    def keep(self, question: Question, fit: ContourFit | None) -> None:
        """Keeps an answer for the next map."""
        self._current.append((question, fit))


def _same_pose(one: FloatArray, other: FloatArray) -> bool:
    turn = float(np.linalg.norm(one[:3, :3] - other[:3, :3]))  # sqrt(2) times the angle
    shift = float(np.linalg.norm(one[:3, :3].T @ one[:3, 3] - other[:3, :3].T @ other[:3, 3]))
    return turn < np.sqrt(2.0) * _TURNED and shift < _SHIFTED


def _same_rows(one: RolledImage, other: RolledImage | None) -> bool:
    """Whether the first and the last row, the farthest from the stamp, have the same poses."""
    if other is None or one.motion.readout != other.motion.readout:
        return False
    farthest = 0.5 * one.motion.readout
    shift, turn, bend, twist = np.subtract(one.numbers[6:], other.numbers[6:]).reshape(4, 3)
    turns, shifts = (
        max(farthest * float(np.linalg.norm(rate + time * half)) for time in (-farthest, farthest))
        for rate, half in ((turn, twist), (shift, bend))
    )
    return turns < _TURNED and shifts < _SHIFTED


def _unchanged(one: Cylinder, other: Cylinder) -> bool:
    moved = max(float(np.linalg.norm(one.start - other.start)), float(np.linalg.norm(one.end - other.end)))
    return moved < _MOVED + _CHANGED * one.radius and abs(one.radius - other.radius) < _CHANGED * one.radius
