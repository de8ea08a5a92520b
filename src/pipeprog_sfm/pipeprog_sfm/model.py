"""A sparse model: views, points, and which feature sees which point, in flat arrays.

Flat arrays instead of pycolmap's graph, observation manager and triangulator: these accept no match between images that
they already know (a loop found late, a frame tried again), and every look at them costs one Python object per feature.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_sfm.adjustment import adjust, function_covariance

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MAX_ERROR = 3.0  # px: the noise of SIFT is below 1 px, wrong matches are uniform in the search range
NOISE_RANGE = (0.1, 1.0)  # px, of a coordinate: what image noise and SIFT's localisation allow
CAUCHY = 2.385  # scale of the loss in standard deviations for 95 % efficiency under normal noise (Holland, Welsch 1977)
RAYLEIGH_MEDIAN = 1.1774  # of an error's length, in standard deviations of a coordinate
MIN_ANGLE = np.radians(1.5)  # between the rays of a point: depth is known to a few per cent at 0.5 px
NONE = -1


class SparseModel:
    """Views (index, in order of registration) and points of one connected piece of map.

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
        self.noise = NOISE_RANGE[1]
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

    def pose(self, view: int) -> FloatArray:
        """camera_from_model (4, 4)."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.rotation[view], self.translation[view]
        return pose

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
        _continue(
            features, others, self.point_of, self.view_of, self.rays, self.points, alias,
            self.rotation, self.translation, self.focal, MAX_ERROR,
        )  # fmt: skip
        has = self.point_of >= 0
        self.point_of[has] = alias[self.point_of[has]]
        new = (self.point_of[features] < 0) & (self.point_of[others] < 0)
        created = _create(
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

    def epipolar_errors(self, view: int, other: int, matches: NDArray[np.int32]) -> FloatArray:
        """Distances in px of the features of `other` from the epipolar lines of those of `view`; matches (M, 2)."""
        rotation = self.rotation[other] @ self.rotation[view].T
        tx, ty, tz = self.translation[other] - rotation @ self.translation[view]
        essential = np.array([[0, -tz, ty], [tz, 0, -tx], [-ty, tx, 0]]) @ rotation
        own = self.rays[self.offsets[view] + matches[:, 0]]
        theirs = self.rays[self.offsets[other] + matches[:, 1]]
        line = np.c_[own, np.ones(len(own))] @ essential.T
        residual = (line * np.c_[theirs, np.ones(len(theirs))]).sum(axis=1)
        return np.abs(residual) / np.maximum(np.hypot(*(line[:, :2] / self.focal[other]).T), 1e-12)

    def observations(self, points: NDArray[np.bool_]) -> tuple[IntArray, IntArray, IntArray]:
        """Features that see the chosen points (mask over the points), sorted by point.

        Returns the ids of the points that are seen (P,), the bounds (P + 1,) and the flat features (K,).
        """
        flags = np.append(points, False)  # NONE indexes the last one
        features = np.flatnonzero(flags[self.point_of])
        owner = self.point_of[features]
        order = np.argsort(owner, kind="stable")
        features, owner = features[order], owner[order]
        ids, start = np.unique(owner, return_index=True)
        return ids, np.append(start, len(features)), features

    def digests(self) -> NDArray[np.uint64]:
        """(V,) hash of each view's points: another number when they have changed."""
        return _digests(self.point_of, np.array(self.offsets))

    def covisible(self, view: int) -> IntArray:
        """(V,) number of points that each view shares with this one."""
        mine = self.point_of[self.features(view)]
        flags = np.zeros(len(self.points) + 1, bool)
        flags[mine[mine >= 0]] = True
        shared = np.bincount(self.view_of[flags[self.point_of]], minlength=len(self))
        shared[view] = 0
        return shared

    def adjust(self, views: IntArray | None, max_iterations: int, tolerance: float) -> None:
        """Bundle adjustment of all views (None; the first stays fixed), or of some and the points that these see."""
        free = np.zeros(len(self), bool)
        chosen = np.ones(len(self.points), bool)
        if views is None:
            free[1:] = True
        else:
            free[views] = True
            free[0] = False
            seen = np.concatenate([self.point_of[self.features(view)] for view in views])
            chosen[:] = False
            chosen[seen[seen >= 0]] = True
        ids, start, features = self.observations(chosen)
        if not len(ids):
            return
        used, view = np.unique(self.view_of[features], return_inverse=True)
        result = adjust(
            self.rotation[used], self.translation[used], free[used], self.points[ids], start, view.astype(np.int64),
            self.rays[features], self.focal[used], loss_scale=CAUCHY * self.noise,
            max_iterations=max_iterations, tolerance=tolerance,
        )  # fmt: skip
        self.rotation[used], self.translation[used] = result.rotation, result.translation
        self.points[ids] = result.points
        if views is None:
            error = float(np.median(self.errors(features))) / RAYLEIGH_MEDIAN
            self.noise = min(max(error, NOISE_RANGE[0]), NOISE_RANGE[1])
        self.filter(ids, start, features)
        if views is None:
            self._forget_unseen()

    def _forget_unseen(self) -> None:
        """Numbers the points anew, without those that no view sees."""
        alive = np.zeros(len(self.points), bool)
        alive[self.point_of[self.point_of >= 0]] = True
        number = np.append(np.cumsum(alive) - 1, NONE)  # NONE indexes the last one
        self.point_of[:] = number[self.point_of]
        self.points = self.points[alive]

    def covariance(self, gradients: FloatArray) -> FloatArray:
        """(S, S) covariance of functions of the poses whose derivatives are (S, V, 6): see `function_covariance`."""
        ids, start, features = self.observations(np.ones(len(self.points), bool))
        view = self.view_of[features].astype(np.int64)
        return function_covariance(
            gradients, self.rotation, self.translation, self.points[ids], start, view,
            self.rays[features], self.focal, loss_scale=CAUCHY * self.noise,
        )  # fmt: skip

    def filter(self, ids: IntArray, start: IntArray, features: IntArray) -> None:
        """Drops observations with a large error or behind the camera, second ones of a view, and thin points."""
        _filter(
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


@njit(cache=True, nogil=True, inline="always")
def _error(rotation, translation, focal, x, y, z, u, v):  # type: ignore[no-untyped-def]  # compiled
    """Reprojection error in px, infinite behind the camera."""
    depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
    if depth <= 1e-9:
        return np.inf
    du = (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]) / depth - u
    dv = (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]) / depth - v
    return np.sqrt((focal[0] * du) ** 2 + (focal[1] * dv) ** 2)


@njit(cache=True, nogil=True)
def _digests(point_of, offsets):  # type: ignore[no-untyped-def]  # compiled
    """FNV-1a over the points of each view, a word at a time."""
    digests = np.full(len(offsets) - 1, 0xCBF29CE484222325, np.uint64)
    for view in range(len(digests)):
        for feature in range(offsets[view], offsets[view + 1]):
            digests[view] = (digests[view] ^ np.uint64(point_of[feature] + 1)) * np.uint64(0x100000001B3)
    return digests


@njit(cache=True, nogil=True)
def _root(alias, point):  # type: ignore[no-untyped-def]  # compiled
    while alias[point] != point:
        point = alias[point]
    return point


@njit(cache=True, nogil=True)
def _continue(  # type: ignore[no-untyped-def]  # compiled
    features, others, point_of, view_of, rays, points, alias, rotation, translation, focal, max_error
):
    """Extends tracks along matches, and notes in `alias` which points are one."""
    for m in range(len(features)):
        a, b = features[m], others[m]
        p, q = point_of[a], point_of[b]
        if p < 0 and q < 0:
            continue
        if p >= 0:
            p = _root(alias, p)
        if q >= 0:
            q = _root(alias, q)
        if p == q:
            continue
        if p < 0 or q < 0:
            source, feature = (q, a) if p < 0 else (p, b)
            view = view_of[feature]
            error = _error(
                rotation[view], translation[view], focal[view],
                points[source, 0], points[source, 1], points[source, 2], rays[feature, 0], rays[feature, 1],
            )  # fmt: skip
            if error < max_error:
                point_of[feature] = source
            continue
        agree = True
        for feature in (a, b):
            for point in (p, q):
                view = view_of[feature]
                error = _error(
                    rotation[view], translation[view], focal[view],
                    points[point, 0], points[point, 1], points[point, 2], rays[feature, 0], rays[feature, 1],
                )  # fmt: skip
                agree = agree and error < max_error
        if agree:
            alias[max(p, q)] = min(p, q)
    for p in range(len(alias)):
        alias[p] = _root(alias, p)


@njit(cache=True, nogil=True)
def _create(  # type: ignore[no-untyped-def]  # compiled
    features, others, point_of, view_of, rays, next_point, rotation, translation, focal, max_error, max_cosine
):
    """Triangulates each feature with all its matches; keeps the matches that agree."""
    created = np.empty((len(features), 3))
    count = 0
    begin = 0
    while begin < len(features):
        end = begin
        while end < len(features) and features[end] == features[begin]:
            end += 1
        size = end - begin + 1
        track = np.empty(size, np.int64)
        track[0] = features[begin]
        track[1:] = others[begin:end]
        begin = end
        directions = np.empty((size, 3))
        centres = np.empty((size, 3))
        for k in range(size):
            view = view_of[track[k]]
            u, v = rays[track[k], 0], rays[track[k], 1]
            norm = np.sqrt(u * u + v * v + 1)
            for i in range(3):
                r = rotation[view]
                directions[k, i] = (r[0, i] * u + r[1, i] * v + r[2, i]) / norm
                centres[k, i] = -(
                    r[0, i] * translation[view, 0] + r[1, i] * translation[view, 1] + r[2, i] * translation[view, 2]
                )
        # The widest pair fixes the point; all that agree with it refine it.
        widest, first, second = 2.0, -1, -1
        for k in range(size):
            for m in range(k + 1, size):
                cosine = (
                    directions[k, 0] * directions[m, 0]
                    + directions[k, 1] * directions[m, 1]
                    + directions[k, 2] * directions[m, 2]
                )
                if cosine < widest:
                    widest, first, second = cosine, k, m
        if widest > max_cosine:
            continue
        chosen = np.zeros(size, np.bool_)
        chosen[first] = chosen[second] = True
        point = np.zeros(3)
        agreeing = 0
        for _ in range(2):
            normal = np.zeros((3, 3))
            right = np.zeros(3)
            for k in range(size):
                if not chosen[k]:
                    continue
                for i in range(3):
                    for j in range(3):
                        projector = (1.0 if i == j else 0.0) - directions[k, i] * directions[k, j]
                        normal[i, j] += projector
                        right[i] += projector * centres[k, j]
            point[:] = np.linalg.solve(normal, right)
            agreeing = 0
            for k in range(size):
                view = view_of[track[k]]
                chosen[k] = (
                    _error(
                        rotation[view], translation[view], focal[view],
                        point[0], point[1], point[2], rays[track[k], 0], rays[track[k], 1],
                    )
                    < max_error
                )  # fmt: skip
                agreeing += chosen[k]
            if agreeing < 2:
                break
        if agreeing < 2 or not chosen[0]:
            continue
        free = 0
        narrow = 2.0
        for k in range(size):
            if chosen[k] and point_of[track[k]] < 0:
                free += 1
                for m in range(k):
                    if chosen[m] and point_of[track[m]] < 0:
                        narrow = min(
                            narrow,
                            directions[k, 0] * directions[m, 0]
                            + directions[k, 1] * directions[m, 1]
                            + directions[k, 2] * directions[m, 2],
                        )
        if free < 2 or narrow > max_cosine:
            continue
        for k in range(size):
            if chosen[k] and point_of[track[k]] < 0:
                point_of[track[k]] = next_point + count
        created[count] = point
        count += 1
    return created[:count].copy()


@njit(cache=True, nogil=True)
def _filter(  # type: ignore[no-untyped-def]  # compiled
    ids, start, features, point_of, view_of, rays, points, rotation, translation, focal, max_error, max_cosine
):
    for n in range(len(ids)):
        p = ids[n]
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        size = start[n + 1] - start[n]
        error = np.empty(size)
        for k in range(size):
            feature = features[start[n] + k]
            view = view_of[feature]
            error[k] = _error(
                rotation[view], translation[view], focal[view], x, y, z, rays[feature, 0], rays[feature, 1]
            )
        direction = np.empty((size, 3))
        kept = 0
        widest = 2.0
        for k in range(size):
            feature = features[start[n] + k]
            view = view_of[feature]
            good = error[k] < max_error
            for m in range(size):
                if good and m != k and view_of[features[start[n] + m]] == view:
                    good = error[k] < error[m] or (error[k] == error[m] and k < m)
            if not good:
                point_of[feature] = NONE
                continue
            r = rotation[view]
            for i in range(3):
                direction[kept, i] = points[p, i] + (
                    r[0, i] * translation[view, 0] + r[1, i] * translation[view, 1] + r[2, i] * translation[view, 2]
                )
            norm = np.sqrt(direction[kept, 0] ** 2 + direction[kept, 1] ** 2 + direction[kept, 2] ** 2)
            for i in range(3):
                direction[kept, i] /= norm
            for m in range(kept):
                widest = min(
                    widest,
                    direction[kept, 0] * direction[m, 0]
                    + direction[kept, 1] * direction[m, 1]
                    + direction[kept, 2] * direction[m, 2],
                )
            kept += 1
        if kept < 2 or widest > max_cosine:
            for k in range(size):
                point_of[features[start[n] + k]] = NONE
