# SPDX-License-Identifier: Apache-2.0
"""Thin pipes parallel to others: along a known direction each segment pair is a ray in the plane across it.

Where the rays of several views meet, there is an axis. Pieces of a pipe that views show at different places along it
support the same axis, which they cannot while its direction is open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.cloud.cylinder_fit import basis
from pipeprog_detect.silhouette.apparent_contour import in_image
from pipeprog_detect.thin.pair_views import CENTRE_SIGMA, WIDTH_SIGMA, PairView, rays
from pipeprog_detect.types import Cylinder

# Pipes are installed parallel, to a standard deviation of 0.3 deg: at least three within 5 deg of one direction tell it
# (two may be so by chance).
NEARLY_PARALLEL, PARALLEL_SIGMA, LEAST_PARALLEL = np.radians(5.0), np.radians(0.3), 3
# A segment pair agrees with an axis within three standard deviations of its place, its width and its direction.
SURELY = 3.0
# Least number of views that must show an axis, and least share of those in which its middle lies: chance makes the
# pairs of two views agree, not those of four.
MIN_VIEWS, MIN_SHARE = 4, 0.25
# Pieces of one pipe are apart by no more than what hides it from all views is wide [m]; what lies farther than this [m]
# from a piece is another pipe's.
HIDDEN, LONGEST = 0.3, 3.0
# Rounds of least squares, each on what agrees with the last one.
ROUNDS = 4


@dataclass(frozen=True)
class Proposal:
    """A cylinder that may be a thin pipe, and the standard deviation of its distance from the cameras [m]."""

    cylinder: Cylinder
    depth_sigma: float


def parallel_directions(known: Sequence[Cylinder]) -> list[FloatArray]:
    """The directions (3,) that at least `LEAST_PARALLEL` of the cylinders have, those of the longest ones first."""
    groups: list[list[Cylinder]] = []
    for cylinder in sorted(known, key=lambda each: -each.length):
        near = [group for group in groups if abs(group[0].axis @ cylinder.axis) > np.cos(NEARLY_PARALLEL)]
        if near:
            near[0].append(cylinder)
        else:
            groups.append([cylinder])
    directions = []
    for group in groups:
        if len(group) >= LEAST_PARALLEL:
            axes = np.array([each.axis * np.sign(each.axis @ group[0].axis) for each in group])
            middle = np.median(axes, axis=0)
            directions.append(np.asarray(middle / np.linalg.norm(middle), np.float64))
    return directions


def propose_parallel(
    pair_views: Sequence[PairView], directions: Sequence[FloatArray], radii: Sequence[float]
) -> list[Proposal]:
    """The cylinders along the `directions` (3,), of the given radii [m], that several views show; best seen first."""
    found: list[tuple[int, Proposal]] = []
    for direction in directions:
        for radius in radii:
            sights = _Sights.of(pair_views, direction, radius)
            found += _axes(sights, pair_views) if len(sights.view) else []
    return [proposal for _, proposal in sorted(found, key=lambda each: -each[0])]


@dataclass(frozen=True)
class _Sights:
    """N segment pairs that may be images of cylinders of one direction and radius, seen in the plane across it.

    Attributes:
        direction: (3,) of the axes, and `across` (2, 3) unit vectors across it.
        radius: of the cylinders [m].
        view: number (N,) of the view, `focal` (N,) its focal length [px].
        origin: (N, 2) where the view's centre lies in the plane [m], `ray` (N, 2) how far the pair's middle moves there
            for a metre of depth.
        along: (N,) where the view's centre lies along the direction [m], `slope` (N, 2) how far the pair's two ends
            move along it for a metre of depth.
        width: (N,) of the pairs [px].
        depths: (N, 2) the least and the largest depth [m] that width and cloud allow.
    """

    direction: FloatArray
    across: FloatArray
    radius: float
    view: IntArray
    focal: FloatArray
    origin: FloatArray
    ray: FloatArray
    along: FloatArray
    slope: FloatArray
    width: FloatArray
    depths: FloatArray

    @classmethod
    def of(cls, pair_views: Sequence[PairView], direction: FloatArray, radius: float) -> _Sights:
        """The pairs of all views whose centre lines point to where cylinders of the direction vanish."""
        across = np.stack(basis(direction))
        empty = cls(direction, across, radius, np.zeros(0, np.int64), *(np.zeros(shape) for shape in _EMPTY))
        parts = [empty]
        for number, seen in enumerate(pair_views):
            if not len(seen.pairs):
                continue
            ends = rays(seen) @ seen.view.camera_from_map[:3, :3]
            normal = np.cross(ends[:, 0], ends[:, 1])
            turned = np.abs(normal @ direction) / np.linalg.norm(normal, axis=1)
            length = np.linalg.norm(seen.pairs.ends[:, 1] - seen.pairs.ends[:, 0], axis=1)
            width, focal = seen.pairs.width.mean(axis=1), seen.view.camera.fx
            spread = SURELY * WIDTH_SIGMA
            near = np.maximum(2.0 * focal * radius / (width + spread), seen.depth[0])
            far = np.minimum(2.0 * focal * radius / np.maximum(width - spread, 1e-9), seen.depth[1])
            far = np.minimum(far, seen.behind - radius)  # before the pipe that is behind it, or touching it
            kept = (turned < SURELY * np.hypot(np.sqrt(2.0) * CENTRE_SIGMA / length, PARALLEL_SIGMA)) & (near < far)
            count = int(kept.sum())
            parts.append(
                cls(
                    direction,
                    across,
                    radius,
                    np.full(count, number),
                    np.full(count, focal),
                    np.tile(across @ seen.view.centre, (count, 1)),
                    ends[kept].mean(axis=1) @ across.T,
                    np.full(count, direction @ seen.view.centre),
                    ends[kept] @ direction,
                    width[kept],
                    np.stack([near, far], axis=1)[kept],
                )
            )
        columns = [np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS]
        return cls(direction, across, radius, *columns)

    def depth(self, point: FloatArray) -> FloatArray:
        """Depth (N,) [m] at which each pair's ray passes a point (2,) of the plane."""
        return np.asarray(((point - self.origin) * self.ray).sum(axis=1) / (self.ray**2).sum(axis=1), np.float64)

    def aside(self, point: FloatArray) -> FloatArray:
        """Distance (N,) [m] from each pair's ray, signed, of a point (2,) of the plane."""
        offset = point - self.origin
        cross = offset[:, 0] * self.ray[:, 1] - offset[:, 1] * self.ray[:, 0]
        return np.asarray(cross / np.linalg.norm(self.ray, axis=1), np.float64)

    def stretch(self, depth: FloatArray) -> FloatArray:
        """From where to where (N, 2) [m] along the direction each pair reaches at its depth (N,)."""
        return np.sort(self.along[:, None] + depth[:, None] * self.slope, axis=1)


_COLUMNS = ("view", "focal", "origin", "ray", "along", "slope", "width", "depths")
_EMPTY: tuple[tuple[int, ...], ...] = ((0,), (0, 2), (0, 2), (0,), (0, 2), (0,), (0, 2))


def _axes(sights: _Sights, pair_views: Sequence[PairView]) -> list[tuple[int, Proposal]]:
    """Number of views and proposal of each axis on which enough views agree; each pair makes one axis at the most."""
    depth = np.clip(2.0 * sights.focal * sights.radius / sights.width, *sights.depths.T)
    place = sights.stretch(depth).mean(axis=1)
    error = CENTRE_SIGMA * depth / sights.focal
    count, best = _most_seen(sights.origin, sights.ray, place, error, sights.depths, sights.view)
    used = np.zeros(len(count), bool)
    found = []
    for first in np.argsort(-count, kind="stable"):
        if used[first] or count[first] < MIN_VIEWS:
            continue
        start = sights.origin[first] + best[first] * sights.ray[first]
        settled = _settled(sights, start, float(place[first]), used)
        if settled is None:
            continue
        proposal, members = settled
        used[members] = True
        views = len(np.unique(sights.view[members]))
        shown = sum(bool(in_image(seen.view, proposal.cylinder.middle[None])[0]) for seen in pair_views)
        if views >= max(MIN_VIEWS, MIN_SHARE * shown):
            found.append((views, proposal))
    return found


def _settled(
    sights: _Sights, point: FloatArray, place: float, used: NDArray[np.bool_]
) -> tuple[Proposal, IntArray] | None:
    """The axis by least squares on the pairs that agree with it, and these pairs; None where none does.

    `point` (2,) of the plane and `place` [m] along the direction: where the search found it. `used` (N,): the pairs of
    other axes.
    """
    for _ in range(ROUNDS):
        depth, aside = sights.depth(point), sights.aside(point)
        reach = sights.stretch(depth)
        lever = reach.mean(axis=1) - place
        sigma = np.hypot(CENTRE_SIGMA * depth / sights.focal, PARALLEL_SIGMA * lever)
        wider = 2.0 * sights.focal * sights.radius / np.maximum(depth, 1e-3) - sights.width
        agrees = (np.abs(aside) < SURELY * sigma) & (np.abs(wider) < SURELY * WIDTH_SIGMA)
        allowed = (depth > 0.0) & (depth < sights.depths[:, 1])
        rows = np.flatnonzero(agrees & ~used & allowed & (np.abs(lever) < LONGEST))
        if not len(rows):
            return None
        members = rows[_best_chain(reach[rows], sights.view[rows])]
        ray, deep = sights.ray[members], depth[members]
        far = np.linalg.norm(ray, axis=1)
        sideways = np.stack([ray[:, 1], -ray[:, 0]], axis=1) / (far * sigma[members])[:, None]
        thinner = -2.0 * sights.radius * (sights.focal[members] / (deep * far) ** 2)[:, None] * ray / WIDTH_SIGMA
        normal = sideways.T @ sideways + thinner.T @ thinner
        right = -sideways.T @ (aside[members] / sigma[members]) - thinner.T @ (wider[members] / WIDTH_SIGMA)
        point = point + np.linalg.solve(normal, right)
        low, high = float(reach[members, 0].min()), float(reach[members, 1].max())
        place = 0.5 * (low + high)
    towards = ray.mean(axis=0)
    depth_sigma = float(np.sqrt(towards @ np.linalg.solve(normal, towards)) / np.linalg.norm(towards))
    foot = point @ sights.across
    ends = foot + low * sights.direction, foot + high * sights.direction
    return Proposal(Cylinder(*ends, sights.radius), depth_sigma), members


def _best_chain(reach: FloatArray, view: IntArray) -> IntArray:
    """Those of the stretches (M, 2) [m], without a gap longer than `HIDDEN`, that most of the views (M,) show."""
    order = np.argsort(reach[:, 0], kind="stable")
    end = np.maximum.accumulate(reach[order, 1])
    gaps = np.flatnonzero(reach[order[1:], 0] > end[:-1] + HIDDEN) + 1
    return max(np.split(order, gaps), key=lambda chain: len(np.unique(view[chain])))


@njit(cache=True)
def _within(level: float, slope: float, least: float, most: float, low: float, high: float) -> tuple[float, float]:
    """The part of [low, high] in which level + slope * t lies between least and most; empty where its end is less."""
    if abs(slope) < 1e-12:
        return (low, high) if least <= level <= most else (1.0, 0.0)
    one, other = (least - level) / slope, (most - level) / slope
    return max(low, min(one, other)), min(high, max(one, other))


@njit(cache=True)
def _most_seen(
    origin: FloatArray, ray: FloatArray, place: FloatArray, error: FloatArray, depths: FloatArray, view: IntArray
) -> tuple[IntArray, FloatArray]:
    """The largest number (N,) of views whose pairs agree with each pair at one depth, and that depth (N,) [m].

    Each other pair agrees with a pair along one interval of its depth: the most intervals overlap in the middle of one.

    Args:
        origin, ray: (N, 2) as in `_Sights`.
        place: (N,) of the pairs along the direction [m].
        error: (N,) standard deviation of their rays [m].
        depths: (N, 2) least and largest depth [m].
        view: (N,) number of the view.
    """
    count = len(origin)
    seen, best = np.zeros(count, np.int64), np.zeros(count)
    lows, highs, views = np.empty(count), np.empty(count), np.empty(count, np.int64)
    mark = np.zeros(view.max() + 1, np.int64)
    trial = 0
    for i in range(count):
        kept = 0
        for j in range(count):
            lever = place[j] - place[i]
            if abs(lever) > LONGEST:
                continue
            square = ray[j, 0] ** 2 + ray[j, 1] ** 2
            norm = np.sqrt(square)
            reach = SURELY * np.sqrt(error[i] ** 2 + error[j] ** 2 + (PARALLEL_SIGMA * lever) ** 2)
            x, y = origin[i, 0] - origin[j, 0], origin[i, 1] - origin[j, 1]
            level = (x * ray[j, 1] - y * ray[j, 0]) / norm
            slope = (ray[i, 0] * ray[j, 1] - ray[i, 1] * ray[j, 0]) / norm
            low, high = _within(level, slope, -reach, reach, depths[i, 0], depths[i, 1])
            level = (x * ray[j, 0] + y * ray[j, 1]) / square
            slope = (ray[i, 0] * ray[j, 0] + ray[i, 1] * ray[j, 1]) / square
            low, high = _within(level, slope, depths[j, 0], depths[j, 1], low, high)
            if low <= high:
                lows[kept], highs[kept], views[kept] = low, high, view[j]
                kept += 1
        for k in range(kept):
            depth, number = 0.5 * (lows[k] + highs[k]), 0
            trial += 1
            for j in range(kept):
                if lows[j] <= depth <= highs[j] and mark[views[j]] != trial:
                    mark[views[j]] = trial
                    number += 1
            if number > seen[i]:
                seen[i], best[i] = number, depth
    return seen, best
