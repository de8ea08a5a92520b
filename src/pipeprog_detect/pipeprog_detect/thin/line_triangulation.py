# SPDX-License-Identifier: Apache-2.0
"""Thin pipes by triangulation: segment pairs in the keyframes that agree, over the views, on one cylinder in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import in_image, project
from pipeprog_detect.thin.depth_from_cloud import DEPTH_REACH, at_cloud_depth, covers, extended_to
from pipeprog_detect.thin.pair_views import CENTRE_SIGMA, WIDTH_SIGMA, PairView, centre_lines, rays
from pipeprog_detect.types import Cylinder

# Largest accepted sum of the squares of a segment pair's distance and width, over their standard deviations: chi
# square of two degrees of freedom, exceeded once in a thousand times.
WORST = 13.8
# Following views in which a segment pair is triangulated, least number of views that must show a pipe, and least share
# of those in which its middle lies.
PARTNERS, MIN_VIEWS, MIN_SHARE = 3, 4, 0.25
# Least common length of two segment pairs of one pipe, as a share of the shorter one.
OVERLAP = 0.3
# Standard deviation of a hypothesis's depth, in radii of the pipe.
DEPTH_SIGMA = 1.0
# Lines that pass each other at less than this many radii are the same: highlights and shadows lie a radius off a side.
SAME_LINE = 0.5
# Hypotheses that are followed into all views (a computing budget), and rounds of least squares on what matches.
MOST_HYPOTHESES, ROUNDS = 4000, 2


@dataclass(frozen=True)
class _Axes:
    """H hypotheses: ends (H, 2, 3) of an axis, its radius (H,) and the standard deviation of its depth (H,) [m]."""

    ends: FloatArray
    radius: FloatArray
    sigma: FloatArray

    def select(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> _Axes:
        """Those that a mask or an index array names."""
        return _Axes(self.ends[keep], self.radius[keep], self.sigma[keep])


_NO_AXES = _Axes(np.zeros((0, 2, 3)), np.zeros(0), np.zeros(0))


def propose(
    pair_views: Sequence[PairView], points: NDArray[np.float32], radii: Sequence[float], limit: int
) -> list[Cylinder]:
    """Up to `limit` cylinders of the given radii [m] that the lines of several views agree on, best seen first.

    A segment pair of a view and a radius make a cylinder: its depth follows from the pair's width, and from the centre
    line of another view's pair where the camera has moved across the pipe. One side of a pipe with a shadow's edge or a
    highlight beside it makes a rival of the pipe: both are proposed.

    Args:
        pair_views: the keyframes with their segment pairs.
        points: of the cloud (N, 3); they tell the depth.
        radii: of thin pipes [m].
        limit: largest number of cylinders.
    """
    axes = _hypotheses(pair_views, radii)
    for _ in range(ROUNDS):
        axes = _adjusted(axes, pair_views)
    found, centres = _best_seen(axes, pair_views, limit)
    if not found:
        return []
    found = [
        at_cloud_depth(cylinder, points, centre) or cylinder for cylinder, centre in zip(found, centres, strict=True)
    ]
    radius = np.array([one.radius for one in found])
    axes = _adjusted(_Axes(np.stack([[one.start, one.end] for one in found]), radius, DEPTH_SIGMA * radius), pair_views)
    return [Cylinder(ends[0], ends[1], float(radius)) for ends, radius in zip(axes.ends, axes.radius, strict=True)]


def _hypotheses(pair_views: Sequence[PairView], radii: Sequence[float]) -> _Axes:
    """Axes from the cloud's depth at single segment pairs, and from pairs of pairs; evenly thinned."""
    parts = [_NO_AXES]
    parts += [_at_cloud_depth(pair_view, radius) for pair_view in pair_views for radius in radii]
    parts += [
        _triangulated(pair_view, other, radius)
        for number, pair_view in enumerate(pair_views)
        for other in pair_views[number + 1 : number + 1 + PARTNERS]
        for radius in radii
    ]
    columns = zip(*([one.ends, one.radius, one.sigma] for one in parts), strict=True)
    axes = _Axes(*(np.concatenate(column) for column in columns))
    return axes.select(np.arange(0, len(axes.radius), max(-(-len(axes.radius) // MOST_HYPOTHESES), 1)))


def _best_seen(axes: _Axes, pair_views: Sequence[PairView], limit: int) -> tuple[list[Cylinder], list[FloatArray]]:
    """Up to `limit` cylinders that most views show, the same line once, and the mean centres (3,) of these views."""
    found: list[Cylinder] = []
    centres: list[FloatArray] = []
    if not len(axes.radius):
        return found, centres
    sees = np.stack([_in_view(axes, pair_view) for pair_view in pair_views])
    seen = sees.sum(axis=0)
    count = np.sum([_matches(axes, pair_view) >= 0 for pair_view in pair_views], axis=0)
    for best in np.argsort(-count, kind="stable"):
        if count[best] < max(MIN_VIEWS, MIN_SHARE * seen[best]):
            break
        cylinder = Cylinder(axes.ends[best, 0], axes.ends[best, 1], float(axes.radius[best]))
        covering = [k for k in range(len(found)) if covers(found[k], cylinder, centres[k], SAME_LINE)]
        if covering:
            found[covering[0]] = extended_to(found[covering[0]], cylinder, centres[covering[0]])
        elif len(found) < limit:
            found.append(cylinder)
            centres.append(np.mean([pair_views[k].view.centre for k in np.flatnonzero(sees[:, best])], axis=0))
    return found, centres


def _at_cloud_depth(pair_view: PairView, radius: float) -> _Axes:
    """Axes of segment pairs that stand out from the cloud and are as wide as a pipe of `radius` [m] would be there."""
    depth = pair_view.before + 0.5 * radius
    width = 2.0 * pair_view.view.camera.fx * radius / depth
    fits = np.isfinite(depth).all(axis=1) & (np.abs(width - pair_view.pairs.width).max(axis=1) < 2.5 * WIDTH_SIGMA)
    in_camera = rays(pair_view)[fits] * depth[fits][..., None]
    pose = np.linalg.inv(pair_view.view.camera_from_map)
    count = len(in_camera)
    return _Axes(in_camera @ pose[:3, :3].T + pose[:3, 3], np.full(count, radius), np.full(count, DEPTH_SIGMA * radius))


def _without_depth(pair_view: PairView) -> PairView:
    """The view with those segment pairs alone that the cloud does not show."""
    return replace(pair_view, pairs=pair_view.pairs.select(np.asarray(np.isnan(pair_view.before).any(axis=1), bool)))


def _triangulated(pair_view: PairView, other: PairView, radius: float) -> _Axes:
    """Axes that a segment pair of one view and one of another make with a radius [m].

    The inverse depth of each end of the first follows by linear least squares from both widths and from the distance
    of the projected end from the other centre line.
    """
    if not len(pair_view.pairs) or not len(other.pairs):
        return _NO_AXES
    pair_view, other = _without_depth(pair_view), _without_depth(other)  # what the cloud shows needs no second view
    if not len(pair_view.pairs) or not len(other.pairs):
        return _NO_AXES
    focal, sights = pair_view.view.camera.fx, rays(pair_view)
    other_from_first = other.view.camera_from_map @ np.linalg.inv(pair_view.view.camera_from_map)
    matrix = other.view.camera.matrix
    still = sights @ (matrix @ other_from_first[:3, :3]).T
    shift = matrix @ other_from_first[:3, 3]
    width = pair_view.pairs.width
    first = width / (2.0 * focal * radius)
    depth = still[..., 2] + first * shift[2]
    if not (depth > 0.1).any():
        return _NO_AXES
    depth = np.maximum(depth, 0.1)
    line = centre_lines(other.pairs)
    slope = (line @ shift)[None, None] / (depth[..., None] * CENTRE_SIGMA)
    level = -np.einsum("pek,qk->peq", still, line) / (depth[..., None] * CENTRE_SIGMA)
    gauge = 2.0 * focal * radius / WIDTH_SIGMA
    own = width / WIDTH_SIGMA
    gauge_there = (gauge / depth)[..., None]
    there = other.pairs.width.mean(axis=1) / WIDTH_SIGMA
    inverse = (slope * level + (gauge * own)[..., None] + gauge_there * there) / (slope**2 + gauge**2 + gauge_there**2)
    left = (
        (slope * inverse - level) ** 2 + (gauge * inverse - own[..., None]) ** 2 + (gauge_there * inverse - there) ** 2
    )
    near, far = pair_view.depth
    good = ((left < WORST) & (inverse > 1.0 / far) & (inverse < 1.0 / near)).all(axis=1)
    one, two = np.nonzero(good)
    if not len(one):
        return _NO_AXES
    in_camera = sights[one] / inverse[one, :, two][..., None]
    pose = np.linalg.inv(pair_view.view.camera_from_map)
    axes = _Axes(in_camera @ pose[:3, :3].T + pose[:3, 3], np.full(len(one), radius), np.full(len(one), DEPTH_REACH))
    ends, _ = _projected(axes, other)
    return axes.select(_overlap(ends, other.pairs.ends[two]) > OVERLAP)


def _projected(axes: _Axes, pair_view: PairView) -> tuple[FloatArray, FloatArray]:
    """Pixels (H, 2, 2) and depths (H, 2) of the axes' ends."""
    pixel, depth = project(pair_view.view, axes.ends.reshape(-1, 3))
    return pixel.reshape(-1, 2, 2), depth.reshape(-1, 2)


def _overlap(ends: FloatArray, others: FloatArray) -> FloatArray:
    """Common stretch of segments (..., 2, 2) with others, projected on the first, as a share of the shorter one."""
    along = ends[..., 1, :] - ends[..., 0, :]
    length = np.linalg.norm(along, axis=-1) + 1e-9
    along = along / length[..., None]
    place = np.einsum("...ek,...k->...e", others - ends[..., :1, :], along)
    low, high = np.maximum(place.min(axis=-1), 0.0), np.minimum(place.max(axis=-1), length)
    shorter = np.minimum(length, place.max(axis=-1) - place.min(axis=-1))
    return np.asarray((high - low) / (shorter + 1e-9))


def _in_view(axes: _Axes, pair_view: PairView) -> NDArray[np.bool_]:
    """Which axes (H,) have their middle inside the view."""
    return in_image(pair_view.view, axes.ends.mean(axis=1))


def _matches(axes: _Axes, pair_view: PairView) -> NDArray[np.int64]:
    """Index (H,) of the segment pair of the view that fits each axis best, -1 where none does."""
    none = np.full(len(axes.radius), -1)
    if not len(pair_view.pairs):
        return none
    ends, depth = _projected(axes, pair_view)
    front = (depth > 0.05).all(axis=1)
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1) + 1e-9
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / length[:, None]
    offset = pair_view.pairs.ends[None] - ends[:, None, :1]
    aside = np.einsum("hqek,hk->hqe", offset, normal)
    place = np.einsum("hqek,hk->hqe", offset, along) / (length**2)[:, None, None]
    inverse = 1.0 / depth[:, 0, None, None] + np.clip(place, 0.0, 1.0) * np.diff(1.0 / depth, axis=1)[:, None]
    width = 2.0 * pair_view.view.camera.fx * axes.radius[:, None, None] * inverse
    left = (aside / (2.0 * CENTRE_SIGMA)) ** 2 + ((width - pair_view.pairs.width[None]) / WIDTH_SIGMA) ** 2
    worst: FloatArray = left.max(axis=2)
    common = _overlap(np.broadcast_to(ends[:, None], offset.shape), np.broadcast_to(pair_view.pairs.ends, offset.shape))
    worst = np.where(np.asarray(front)[:, None] & (common > OVERLAP), worst, np.inf)
    best = np.argmin(worst, axis=1)
    return np.where(worst[np.arange(len(best)), best] < WORST, best, none)


def _adjusted(axes: _Axes, pair_views: Sequence[PairView]) -> _Axes:
    """The axes after a least-squares step on the segment pairs that match, and as long as what these show.

    Each end moves across the axis by (2,); the pairs' centre lines and widths, at both of their ends, are the
    observations; the depth that a hypothesis came with is the prior.
    """
    count = len(axes.radius)
    if not count:
        return axes
    basis = _basis(axes, pair_views)
    equations = _NormalEquations(np.eye(4) / axes.sigma[:, None, None] ** 2, np.zeros((count, 4)))
    low: FloatArray = np.full(count, np.inf)
    high: FloatArray = np.full(count, -np.inf)
    for pair_view in pair_views:
        pair = _matches(axes, pair_view)
        rows = np.flatnonzero(pair >= 0)
        if len(rows):
            pairs = pair_view.pairs.select(pair[rows])
            for share in _observe(axes.select(rows), basis[rows], replace(pair_view, pairs=pairs), equations, rows):
                low[rows] = np.minimum(low[rows], share)
                high[rows] = np.maximum(high[rows], share)
    step = np.linalg.solve(equations.normal, equations.right[..., None])[..., 0].reshape(count, 2, 2)
    shown = low < high
    low, high = np.where(shown, low, 0.0).astype(float), np.where(shown, high, 1.0).astype(float)
    ends = axes.ends + np.einsum("hej,hjk->hek", step, basis)
    along = ends[:, 1] - ends[:, 0]
    ends = np.stack([ends[:, 0] + low[:, None] * along, ends[:, 0] + high[:, None] * along], axis=1)
    return replace(axes, ends=ends)


def _basis(axes: _Axes, pair_views: Sequence[PairView]) -> FloatArray:
    """Two unit vectors (H, 2, 3) across each axis: sideways as the views that show it see it, and away from them."""
    along = axes.ends[:, 1] - axes.ends[:, 0]
    along = along / np.linalg.norm(along, axis=1)[:, None]
    weight = np.stack([_in_view(axes, pair_view) for pair_view in pair_views]).astype(float) + 1e-6
    centres = np.stack([pair_view.view.centre for pair_view in pair_views])
    towards = axes.ends.mean(axis=1) - weight.T @ centres / weight.sum(axis=0)[:, None]
    depth = towards - along * np.einsum("ij,ij->i", along, towards)[:, None]
    depth = depth / (np.linalg.norm(depth, axis=1)[:, None] + 1e-12)
    return np.stack([np.cross(along, depth), depth], axis=1)


def _observe(
    axes: _Axes, basis: FloatArray, seen: PairView, equations: _NormalEquations, rows: NDArray[np.int64]
) -> list[FloatArray]:
    """Adds what a view's pairs, one for each of the axes, tell of these to the equations `rows`.

    Returns where, as a share of each axis' length, its pair's two ends lie.
    """
    length = np.linalg.norm(axes.ends[:, 1] - axes.ends[:, 0], axis=1)
    along = (axes.ends[:, 1] - axes.ends[:, 0]) / length[:, None]
    line, camera, rotation = centre_lines(seen.pairs), seen.view.camera, seen.view.camera_from_map[:3, :3]
    pixel, far = _projected(axes, seen)
    image_along = pixel[:, 1] - pixel[:, 0]
    square = (image_along**2).sum(axis=1)
    shares = []
    for end in (0, 1):
        # Where the pair's end falls on the axis: perspective makes the share of the length of that in the image.
        share = np.einsum("ij,ij->i", seen.pairs.ends[:, end] - pixel[:, 0], image_along) / square
        share = share * far[:, 0] / (far[:, 1] + share * (far[:, 0] - far[:, 1]))
        share = np.clip(share, -0.5, 1.5)
        at, distance = project(seen.view, axes.ends[:, 0] + (share * length)[:, None] * along)
        sideways = line[:, :2] @ np.diag([camera.fx, camera.fy])
        ray = np.stack([(at[:, 0] - camera.cx) / camera.fx, (at[:, 1] - camera.cy) / camera.fy], axis=1)
        gradient = np.concatenate([sideways, -(sideways * ray).sum(axis=1)[:, None]], axis=1) / distance[:, None]
        moves = np.einsum("ik,kl,ijl->ij", gradient, rotation, basis) / CENTRE_SIGMA
        residual = -(np.einsum("ij,ij->i", line[:, :2], at) + line[:, 2]) / CENTRE_SIGMA
        equations.add(rows, share, moves, residual)
        width = 2.0 * camera.fx * axes.radius / distance
        moves = -(width / distance)[:, None] * np.einsum("l,ijl->ij", rotation[2], basis) / WIDTH_SIGMA
        equations.add(rows, share, moves, (seen.pairs.width[:, end] - width) / WIDTH_SIGMA)
        shares.append(share)
    return shares


@dataclass(frozen=True)
class _NormalEquations:
    """Normal equations of H axes: `normal` (H, 4, 4) and `right` (H, 4), for the moves of both ends across the axis."""

    normal: FloatArray
    right: FloatArray

    def add(self, rows: NDArray[np.int64], share: FloatArray, moves: FloatArray, residual: FloatArray) -> None:
        """Adds an observation of the point at `share` (K,) of each axis in `rows` (K,).

        `moves` (K, 2): derivative by a move of the point across the axis, and `residual` (K,), both over sigma.
        """
        gradient = np.concatenate([(1.0 - share)[:, None] * moves, share[:, None] * moves], axis=1)
        self.normal[rows] += gradient[:, :, None] * gradient[:, None]
        self.right[rows] += gradient * residual[:, None]
