# SPDX-License-Identifier: Apache-2.0
"""Tracks in flat arrays, compiled: extended along matches, triangulated, filtered.

A track is the point that features of several views see; the arrays are those of `SparseModel`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

NONE = -1  # the point of a feature without one


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
def by_point(point_of, chosen):  # type: ignore[no-untyped-def]  # compiled
    """Ids of the chosen points (mask over all) that features see, bounds of the features of each, and all of these."""
    count = np.zeros(len(chosen), np.int64)
    for feature in range(len(point_of)):
        if point_of[feature] != NONE and chosen[point_of[feature]]:
            count[point_of[feature]] += 1
    ids = np.flatnonzero(count)
    end = np.append(0, np.cumsum(count))  # until a point has its features: where the next one goes
    start = np.append(end[ids], end[-1])
    features = np.empty(end[-1], np.int64)
    for feature in range(len(point_of)):
        point = point_of[feature]
        if point != NONE and chosen[point]:
            features[end[point]] = feature
            end[point] += 1
    return ids, start, features


@njit(cache=True, nogil=True)
def digests(point_of, offsets):  # type: ignore[no-untyped-def]  # compiled
    """FNV-1a over the points of each view, a word at a time."""
    hashes = np.full(len(offsets) - 1, 0xCBF29CE484222325, np.uint64)
    for view in range(len(hashes)):
        for feature in range(offsets[view], offsets[view + 1]):
            hashes[view] = (hashes[view] ^ np.uint64(point_of[feature] + 1)) * np.uint64(0x100000001B3)
    return hashes


@njit(cache=True, nogil=True)
def covisible(views, point_of, offsets, points):  # type: ignore[no-untyped-def]  # compiled
    """(N, V) number of features of each view whose points, of which there are `points`, the N views see, too."""
    start = np.zeros(points + 1, np.int64)
    for view in views:
        for feature in range(offsets[view], offsets[view + 1]):
            if point_of[feature] != NONE:
                start[point_of[feature] + 1] += 1
    start = np.cumsum(start)
    end = start[:-1].copy()
    seen_by = np.empty(start[-1], np.int64)  # from start to end of a point: which of the N see it
    for number, view in enumerate(views):
        for feature in range(offsets[view], offsets[view + 1]):
            point = point_of[feature]
            if point != NONE and (end[point] == start[point] or seen_by[end[point] - 1] != number):
                seen_by[end[point]] = number
                end[point] += 1
    shared = np.zeros((len(views), len(offsets) - 1), np.int64)
    for other in range(shared.shape[1]):
        for feature in range(offsets[other], offsets[other + 1]):
            point = point_of[feature]
            if point != NONE:
                for k in range(start[point], end[point]):
                    shared[seen_by[k], other] += 1
    for number, view in enumerate(views):
        shared[number, view] = 0
    return shared


@njit(cache=True, nogil=True)
def _root(alias, point):  # type: ignore[no-untyped-def]  # compiled
    while alias[point] != point:
        point = alias[point]
    return point


@njit(cache=True, nogil=True)
def extend(  # type: ignore[no-untyped-def]  # compiled
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
def _view_rays(track, view_of, rays, rotation, translation):  # type: ignore[no-untyped-def]  # compiled
    """(N, 3) unit directions of a track's features in the model, and (N, 3) centres of their views."""
    directions = np.empty((len(track), 3))
    centres = np.empty((len(track), 3))
    for k in range(len(track)):
        view = view_of[track[k]]
        u, v = rays[track[k], 0], rays[track[k], 1]
        norm = np.sqrt(u * u + v * v + 1)
        for i in range(3):
            r = rotation[view]
            directions[k, i] = (r[0, i] * u + r[1, i] * v + r[2, i]) / norm
            centres[k, i] = -(
                r[0, i] * translation[view, 0] + r[1, i] * translation[view, 1] + r[2, i] * translation[view, 2]
            )
    return directions, centres


@njit(cache=True, nogil=True)
def _widest_pair(directions, among):  # type: ignore[no-untyped-def]  # compiled
    """Cosine between the two directions of `among` (N,) bool farthest apart (2.0: fewer than two), and indices."""
    widest, first, second = 2.0, -1, -1
    for k in range(len(directions)):
        if not among[k]:
            continue
        for m in range(k + 1, len(directions)):
            if not among[m]:
                continue
            cosine = (
                directions[k, 0] * directions[m, 0]
                + directions[k, 1] * directions[m, 1]
                + directions[k, 2] * directions[m, 2]
            )
            if cosine < widest:
                widest, first, second = cosine, k, m
    return widest, first, second


@njit(cache=True, nogil=True)
def _nearest_point(directions, centres, chosen):  # type: ignore[no-untyped-def]  # compiled
    """The point with the least sum of squared distances from the chosen rays."""
    normal = np.zeros((3, 3))
    right = np.zeros(3)
    for k in range(len(directions)):
        if not chosen[k]:
            continue
        for i in range(3):
            for j in range(3):
                projector = (1.0 if i == j else 0.0) - directions[k, i] * directions[k, j]
                normal[i, j] += projector
                right[i] += projector * centres[k, j]
    return np.linalg.solve(normal, right)


@njit(cache=True, nogil=True)
def triangulate(  # type: ignore[no-untyped-def]  # compiled
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
        directions, centres = _view_rays(track, view_of, rays, rotation, translation)
        widest, first, second = _widest_pair(directions, np.ones(size, np.bool_))
        if widest > max_cosine:
            continue
        # The widest pair fixes the point; all that agree with it refine it.
        chosen = np.zeros(size, np.bool_)
        chosen[first] = chosen[second] = True
        point = np.zeros(3)
        for _ in range(2):
            point[:] = _nearest_point(directions, centres, chosen)
            for k in range(size):
                view = view_of[track[k]]
                error = _error(
                    rotation[view], translation[view], focal[view],
                    point[0], point[1], point[2], rays[track[k], 0], rays[track[k], 1],
                )  # fmt: skip
                chosen[k] = error < max_error
            if chosen.sum() < 2:
                break
        if chosen.sum() < 2 or not chosen[0]:
            continue
        free = chosen & (point_of[track] < 0)
        if free.sum() < 2 or _widest_pair(directions, free)[0] > max_cosine:
            continue
        for k in range(size):
            if free[k]:
                point_of[track[k]] = next_point + count
        created[count] = point
        count += 1
    return created[:count].copy()


@njit(cache=True, nogil=True)
def filter_tracks(  # type: ignore[no-untyped-def]  # compiled
    ids, start, features, point_of, view_of, rays, points, rotation, translation, focal, max_error, max_cosine
):
    """Takes from points what disagrees, one of two features of the same view, and what is left of thin points."""
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
