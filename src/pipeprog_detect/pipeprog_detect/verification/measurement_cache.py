"""What is known from the last map, so that neither cloud nor keyframes are asked again while nothing has changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.collinear import near
from pipeprog_detect.cloud.map_change import MapChange
from pipeprog_detect.silhouette.apparent_contour import inside
from pipeprog_detect.silhouette.contour_refinement import ContourFit
from pipeprog_detect.types import Cylinder, View

# A candidate is the same while it moves by less than the cloud's own scatter [m] and a share of its radius.
_MOVED, _CHANGED = 2e-3, 0.03
# Poses are the same while the images move by less than a tenth of a pixel: metres, and radians at 700 px focal length.
_SHIFTED, _TURNED = 2e-4, 1.5e-4
# Pipes that come so near [m] may hide one another.
_BESIDE = 0.3


@dataclass(frozen=True)
class _Answer:
    """A question about a cylinder, what it depended on, and the answer."""

    cylinder: Cylinder
    follow: bool
    others: list[Cylinder]
    poses: dict[int, FloatArray]
    fit: ContourFit | None


class Memory:
    """Fits of the last map by candidate; for one survey, whose keyframes keep their stamps and images.

    `novelty`: what the last map's cloud was like.
    `edges`: straight edges (N, 2, 2) [px] by a keyframe's stamp and the width at which they were sought.
    """

    def __init__(self) -> None:
        self.novelty = MapChange()
        self.edges: dict[tuple[int, int], FloatArray] = {}
        self._last: list[_Answer] = []
        self._current: list[_Answer] = []

    def next_map(self) -> None:
        """Forgets what the map before the last one needed."""
        self._last, self._current = self._current, []

    def recall(
        self, cylinder: Cylinder, follow: bool, others: Sequence[Cylinder], views: Sequence[View]
    ) -> tuple[bool, ContourFit | None]:
        """Whether the answer is known, and the fit (None: there is none)."""
        poses = _poses(cylinder, views)
        beside = _beside(cylinder, others)
        for answer in self._last:
            if (
                answer.follow == follow
                and _alike(answer.cylinder, cylinder)
                and _unmoved(answer.poses, poses)
                and len(answer.others) == len(beside)
                and all(any(_alike(one, other) for other in beside) for one in answer.others)
            ):
                self._current.append(answer)
                return True, answer.fit
        return False, None

    def keep(
        self,
        cylinder: Cylinder,
        follow: bool,
        others: Sequence[Cylinder],
        views: Sequence[View],
        fit: ContourFit | None,
    ) -> None:
        """Remembers an answer for the next map."""
        self._current.append(_Answer(cylinder, follow, _beside(cylinder, others), _poses(cylinder, views), fit))


def _beside(cylinder: Cylinder, others: Sequence[Cylinder]) -> list[Cylinder]:
    return [other for other in others if near(other, cylinder, _BESIDE)]


def _poses(cylinder: Cylinder, views: Sequence[View]) -> dict[int, FloatArray]:
    """camera_from_map (4, 4) by stamp of the views that may see the cylinder or what it grows to."""
    share = np.linspace(-0.5, 1.5, 9)[:, None]
    points = cylinder.start + share * (cylinder.end - cylinder.start)
    return {view.stamp: view.camera_from_map for view in views if inside(view, points).any()}


def _unmoved(one: dict[int, FloatArray], other: dict[int, FloatArray]) -> bool:
    return one.keys() == other.keys() and all(_same_pose(pose, other[stamp]) for stamp, pose in one.items())


def _same_pose(one: FloatArray, other: FloatArray) -> bool:
    turn = float(np.linalg.norm(one[:3, :3] - other[:3, :3]))  # sqrt(2) times the angle
    shift = float(np.linalg.norm(one[:3, :3].T @ one[:3, 3] - other[:3, :3].T @ other[:3, 3]))
    return turn < np.sqrt(2.0) * _TURNED and shift < _SHIFTED


def _alike(one: Cylinder, other: Cylinder) -> bool:
    moved = max(float(np.linalg.norm(one.start - other.start)), float(np.linalg.norm(one.end - other.end)))
    return moved < _MOVED + _CHANGED * one.radius and abs(one.radius - other.radius) < _CHANGED * one.radius
