# SPDX-License-Identifier: Apache-2.0
"""A sparse model: views, points, and which feature sees which point, in flat arrays.

Flat arrays instead of pycolmap's graph, observation manager and triangulator: these accept no match between images that
they already know (a loop found late, a frame tried again), and reading them costs one Python object per feature.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_sfm.model.tracks import NONE, by_point, covisible, digests, extend, filter_tracks, triangulate

MAX_ERROR = 3.0  # px: the noise of SIFT is below 1 px, wrong matches are uniform in the search range
INITIAL_NOISE = 1.0  # px, of a coordinate, before it can be estimated: more than SIFT has
MIN_ANGLE = np.radians(1.5)  # between the rays of a point: depth is known to a few per cent at 0.5 px


class SparseModel:
    """Views (index, in order of registration) and points of one connected part of the map.

    `point_of` holds the point of each feature of all views in a row (NONE: no point); the features of view v are
    offsets[v]:offsets[v + 1].
    """

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.offsets: list[int] = [0]
        self.rotation: FloatArray = np.empty((0, 3, 3))
        self.translation: FloatArray = np.empty((0, 3))
        self.focal: FloatArray = np.empty((0, 2))
        self.points: FloatArray = np.empty((0, 3))
        self.noise = INITIAL_NOISE
        self.adjusted_at = 2  # views at the last global adjustment
        self._rays: FloatArray = np.empty((0, 2))
        self._view_of: NDArray[np.int32] = np.empty(0, np.int32)
        self._point_of: IntArray = np.empty(0, np.int64)

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def rays(self) -> FloatArray:
        """(K, 2) normalised image coordinates of all features."""
        return self._rays[: self.offsets[-1]]

    @property
    def view_of(self) -> NDArray[np.int32]:
        """(K,) view of each feature."""
        return self._view_of[: self.offsets[-1]]

    @property
    def point_of(self) -> IntArray:
        """(K,) point of each feature, NONE without."""
        return self._point_of[: self.offsets[-1]]

    def features(self, view: int) -> slice:
        """The view's features in the flat arrays."""
        return slice(self.offsets[view], self.offsets[view + 1])

    def seen(self, view: int) -> IntArray:
        """(K,) points that the view sees, in the order of its features."""
        own = self.point_of[self.features(view)]
        return own[own >= 0]

    def seen_by_any(self) -> IntArray:
        """(P,) points that a view sees, ascending."""
        return np.unique(self.point_of[self.point_of >= 0])

    def pose(self, view: int) -> FloatArray:
        """camera_from_model (4, 4)."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.rotation[view], self.translation[view]
        return pose

    def poses(self) -> dict[int, FloatArray]:
        """camera_from_model (4, 4) by stamp, in order of time."""
        poses = np.tile(np.eye(4), (len(self), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = self.rotation, self.translation
        order = np.argsort(self.stamps, kind="stable")
        return dict(zip(np.array(self.stamps)[order].tolist(), poses[order], strict=True))

    def centres(self) -> FloatArray:
        """(V, 3) projection centres."""
        return -np.einsum("vji,vj->vi", self.rotation, self.translation)

    def centre(self, view: int) -> FloatArray:
        """(3,) projection centre of one view."""
        return -self.rotation[view].T @ self.translation[view]

    def add_view(self, stamp: int, rays: FloatArray, focal: FloatArray, camera_from_model: FloatArray) -> int:
        """Adds a registered view and returns its index."""
        begin, end = self.offsets[-1], self.offsets[-1] + len(rays)
        if end > len(self._rays):
            capacity = max(2 * len(self._rays), end)
            self._rays = _grown(self._rays, capacity)
            self._view_of = _grown(self._view_of, capacity)
            self._point_of = _grown(self._point_of, capacity)
        view = len(self.stamps)
        self._rays[begin:end], self._view_of[begin:end], self._point_of[begin:end] = rays, view, NONE
        self.stamps.append(stamp)
        self.offsets.append(end)
        self.rotation = np.concatenate([self.rotation, camera_from_model[None, :3, :3]])
        self.translation = np.concatenate([self.translation, camera_from_model[None, :3, 3]])
        self.focal = np.concatenate([self.focal, focal[None]])
        return view

    def link(self, features: IntArray, others: IntArray) -> None:
        """Turns matches of one view's features with features of other views (flat indices) into tracks.

        A feature joins the point of its match when the point reprojects onto it; two points seen as one are merged;
        matches without a point are triangulated. `features` must be sorted.
        """
        alias = np.arange(len(self.points))
        extend(
            features, others, self.point_of, self.view_of, self.rays, self.points, alias,
            self.rotation, self.translation, self.focal, MAX_ERROR,
        )  # fmt: skip
        has = self.point_of >= 0
        self.point_of[has] = alias[self.point_of[has]]
        new = (self.point_of[features] < 0) & (self.point_of[others] < 0)
        created = triangulate(
            features[new], others[new], self.point_of, self.view_of, self.rays, len(self.points),
            self.rotation, self.translation, self.focal, MAX_ERROR, np.cos(MIN_ANGLE),
        )  # fmt: skip
        self.points = np.concatenate([self.points, created])

    def drop(self, view: int) -> None:
        """Takes a view out; later views move up by one."""
        own = self.features(view)
        size = own.stop - own.start
        for array in (self._rays, self._view_of, self._point_of):
            array[own.start : self.offsets[-1] - size] = array[own.stop : self.offsets[-1]].copy()
        self._view_of[own.start : self.offsets[-1] - size] -= 1
        del self.stamps[view]
        self.offsets = self.offsets[: view + 1] + [offset - size for offset in self.offsets[view + 2 :]]
        self.rotation = np.delete(self.rotation, view, axis=0)
        self.translation = np.delete(self.translation, view, axis=0)
        self.focal = np.delete(self.focal, view, axis=0)

    def absorb(self, other: SparseModel, scale: float, self_from_other: FloatArray) -> None:
        """Takes over the views and points of another model; self_from_other (4, 4) rigid, applied after the scale."""
        first_point = len(self.points)
        rotation, translation = self_from_other[:3, :3], self_from_other[:3, 3]
        self.points = np.concatenate([self.points, scale * other.points @ rotation.T + translation])
        for view, stamp in enumerate(other.stamps):
            pose = other.pose(view)
            pose[:3, 3] *= scale
            own = other.features(view)
            new = self.add_view(stamp, other.rays[own], other.focal[view], pose @ np.linalg.inv(self_from_other))
            point = other.point_of[own]
            self.point_of[self.features(new)] = np.where(point >= 0, point + first_point, NONE)

    def observations(self, points: NDArray[np.bool_]) -> tuple[IntArray, IntArray, IntArray]:
        """Features that see the chosen points (mask over the points), sorted by point.

        Returns the ids of the points that are seen (P,), the bounds (P + 1,) and the flat features (K,).
        """
        ids, start, features = by_point(self.point_of, points)
        return ids, start, features

    def digests(self) -> NDArray[np.uint64]:
        """(V,) hash of each view's points: another number when they have changed."""
        return digests(self.point_of, np.array(self.offsets))

    def covisible(self, views: IntArray) -> IntArray:
        """(N, V) number of points that each view shares with these (N,); 0 for itself."""
        return np.asarray(covisible(views, self.point_of, np.array(self.offsets), len(self.points)))

    def forget_unseen(self) -> None:
        """Removes the points that no view sees, and numbers the others anew."""
        alive = np.zeros(len(self.points), bool)
        alive[self.point_of[self.point_of >= 0]] = True
        number = np.append(np.cumsum(alive) - 1, NONE)  # NONE indexes the last one
        self.point_of[:] = number[self.point_of]
        self.points = self.points[alive]

    def filter(self, ids: IntArray, start: IntArray, features: IntArray) -> None:
        """Drops observations with a large error or behind the camera, second ones of a view, and thin points."""
        filter_tracks(
            ids, start, features, self.point_of, self.view_of, self.rays, self.points,
            self.rotation, self.translation, self.focal, MAX_ERROR, np.cos(MIN_ANGLE),
        )  # fmt: skip

    def errors(self, features: IntArray) -> FloatArray:
        """Reprojection errors in px of flat features that have a point."""
        view = self.view_of[features]
        inside = np.einsum("kij,kj->ki", self.rotation[view], self.points[self.point_of[features]])
        inside += self.translation[view]
        difference = inside[:, :2] / inside[:, 2:] - self.rays[features]
        return np.linalg.norm(difference * self.focal[view], axis=1)


def _grown(array: NDArray[Any], capacity: int) -> NDArray[Any]:
    grown = np.empty((capacity, *array.shape[1:]), array.dtype)
    grown[: len(array)] = array
    return grown
