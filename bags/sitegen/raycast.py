# SPDX-License-Identifier: Apache-2.0
"""Rays against primitives: canonical intersections, and a bounding volume hierarchy over them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sitegen.primitives import Primitive

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Ray = tuple[float, float, float, float, float, float]  # origin, unit direction
Hit = tuple[float, float, float, float, float, float, float, int]
PackedTree = tuple[IntArray, FloatArray, FloatArray, IntArray, IntArray]

STACK = 64  # nodes waiting in a traversal; a balanced tree of 1000 leaves is 10 deep
_NEAR = 1e-6  # metres; closer hits are on the surface that a shadow ray starts from
_SURFACE = 2e-6  # metres from a torus at which a marched ray has hit it; a pixel is 1 mm at 1 m
_MARCH_STEPS = 200
_LEAF_SIZE = 2


@dataclass(frozen=True)
class Tree:
    """Primitives in flat arrays, and the hierarchy of their bounding boxes.

    kinds (P,) int64, geometry (P, 16) float64; boxes (N, 6) low and high corner; links (N, 4) int64 with
    (split axis, first child or -1, second child or first entry in `order`, number of entries); order (P,) int64.
    """

    kinds: IntArray
    geometry: FloatArray
    boxes: FloatArray
    links: IntArray
    order: IntArray

    def packed(self) -> PackedTree:
        """The arrays as the compiled code takes them."""
        return self.kinds, self.geometry, self.boxes, self.links, self.order


def build_tree(primitives: Sequence[Primitive]) -> Tree:
    """Hierarchy of the bounding boxes by the surface area heuristic.

    A node is split where the sum of the halves' surfaces times their numbers of primitives is least, which is the
    expected number of intersections; a wall gets a box of its own and does not enlarge others.
    """
    low = np.array([p.bounds[0] for p in primitives])
    high = np.array([p.bounds[1] for p in primitives])
    centre = (low + high) / 2
    boxes: list[FloatArray] = []
    links: list[list[int]] = []
    order: list[int] = []

    def add(members: IntArray) -> int:
        node = len(links)
        boxes.append(np.r_[low[members].min(0), high[members].max(0)])
        links.append([0, -1, len(order), len(members)])
        if len(members) <= _LEAF_SIZE:
            order.extend(int(m) for m in members)
            return node
        best = (math.inf, 0, members, 0)
        for axis in range(3):
            ranked = members[np.argsort(centre[members, axis], kind="stable")]
            below = _areas(low[ranked], high[ranked])
            above = _areas(low[ranked[::-1]], high[ranked[::-1]])[::-1]
            count = np.arange(1, len(ranked))
            cost = count * below[:-1] + (len(ranked) - count) * above[1:]
            half = int(np.argmin(cost))
            best = min(best, (float(cost[half]), axis, ranked, half + 1), key=lambda split: split[0])
        _, axis, ranked, half = best
        first = add(ranked[:half])
        second = add(ranked[half:])
        links[node] = [axis, first, second, 0]
        return node

    add(np.arange(len(primitives)))
    return Tree(
        np.array([int(p.kind) for p in primitives], np.int64),
        np.array([p.row() for p in primitives]),
        np.array(boxes),
        np.array(links, np.int64),
        np.array(order, np.int64),
    )


def _areas(low: FloatArray, high: FloatArray) -> FloatArray:
    """Half the surface of the box round the first, the first two, ... boxes of a row."""
    x, y, z = (np.maximum.accumulate(high) - np.minimum.accumulate(low)).T
    areas: FloatArray = x * y + y * z + z * x
    return areas


@njit(nogil=True)
def _torus_distance(x: float, y: float, z: float, ring: float, tube: float, sine: float, cosine: float) -> float:
    """Signed distance to a torus arc about z, symmetric about local y (capped by spheres, hidden in the pipes)."""
    ax = abs(x)
    along = ax * sine + y * cosine if cosine * ax > sine * y else math.sqrt(ax * ax + y * y)
    return math.sqrt(max(x * x + y * y + z * z + ring * ring - 2.0 * ring * along, 0.0)) - tube


@njit(nogil=True)
def _local(g: FloatArray, ray: Ray) -> Ray:
    """The ray in the primitive's own frame."""
    ox, oy, oz, dx, dy, dz = ray
    qx, qy, qz = ox - g[0], oy - g[1], oz - g[2]
    return (
        g[3] * qx + g[4] * qy + g[5] * qz,
        g[6] * qx + g[7] * qy + g[8] * qz,
        g[9] * qx + g[10] * qy + g[11] * qz,
        g[3] * dx + g[4] * dy + g[5] * dz,
        g[6] * dx + g[7] * dy + g[8] * dz,
        g[9] * dx + g[10] * dy + g[11] * dz,
    )


@njit(nogil=True)
def intersect(kind: int, g: FloatArray, ray: Ray, limit: float) -> Hit:
    """Nearest hit of a ray with one primitive.

    Returns (t, x, y, z, nx, ny, nz, part): distance along the unit direction (inf when missed or beyond `limit`),
    local hit point, local outward normal, and the face that was hit.
    """
    local = _local(g, ray)
    if kind <= 1:
        return _hit_flat(kind, g, local, limit)
    if kind == 2:
        return _hit_box(g, local, limit)
    if kind == 3:
        return _hit_cylinder(g, local, limit)
    return _hit_torus(g, local, limit)


@njit(nogil=True)
def _miss() -> Hit:
    return (math.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)


@njit(nogil=True)
def _hit_flat(kind: int, g: FloatArray, local: Ray, limit: float) -> Hit:
    """A rectangle (kind 0) or a disc (kind 1) in the plane z = 0."""
    px, py, pz, ex, ey, ez = local
    if ez == 0.0:
        return _miss()
    t = -pz / ez
    if not (_NEAR < t < limit):
        return _miss()
    x, y = px + t * ex, py + t * ey
    inside = abs(x) <= g[12] and abs(y) <= g[13] if kind == 0 else x * x + y * y <= g[12] * g[12]
    if not inside:
        return _miss()
    return (t, x, y, 0.0, 0.0, 0.0, -1.0 if ez > 0 else 1.0, 0)


@njit(nogil=True)
def _hit_box(g: FloatArray, local: Ray, limit: float) -> Hit:
    """A box about the origin with half sides g[12:15]; the part is 1 + the axis of its face."""
    px, py, pz, ex, ey, ez = local
    enter, leave, axis = -math.inf, math.inf, 0
    for k in range(3):
        p = px if k == 0 else (py if k == 1 else pz)
        e = ex if k == 0 else (ey if k == 1 else ez)
        h = g[12 + k]
        if e == 0.0:
            if abs(p) > h:
                return _miss()
            continue
        t0, t1 = (-h - p) / e, (h - p) / e
        if t0 > t1:
            t0, t1 = t1, t0
        if t0 > enter:
            enter, axis = t0, k
        leave = min(leave, t1)
    if enter > leave or not (_NEAR < enter < limit):
        return _miss()
    e = ex if axis == 0 else (ey if axis == 1 else ez)
    s = -1.0 if e > 0 else 1.0
    return (
        enter,
        px + enter * ex,
        py + enter * ey,
        pz + enter * ez,
        s if axis == 0 else 0.0,
        s if axis == 1 else 0.0,
        s if axis == 2 else 0.0,
        1 + axis,
    )


@njit(nogil=True)
def _hit_cylinder(g: FloatArray, local: Ray, limit: float) -> Hit:
    """A cylinder of radius g[12] about z, from 0 to g[13]; part 0 is the barrel, part 1 an end."""
    px, py, pz, ex, ey, ez = local
    radius, length = g[12], g[13]
    a = ex * ex + ey * ey
    b = px * ex + py * ey
    c = px * px + py * py - radius * radius
    disc = b * b - a * c
    if disc <= 0.0 and c > 0.0:
        return _miss()
    if a > 1e-14 and disc > 0.0:
        t = (-b - math.sqrt(disc)) / a
        z = pz + t * ez
        if 0.0 <= z <= length and _NEAR < t < limit:
            x, y = px + t * ex, py + t * ey
            return (t, x, y, z, x / radius, y / radius, 0.0, 0)
    if ez != 0.0:
        z = 0.0 if ez > 0 else length
        t = (z - pz) / ez
        x, y = px + t * ex, py + t * ey
        if _NEAR < t < limit and x * x + y * y <= radius * radius:
            return (t, x, y, z, 0.0, 0.0, -1.0 if ez > 0 else 1.0, 1)
    return _miss()


@njit(nogil=True)
def _hit_torus(g: FloatArray, local: Ray, limit: float) -> Hit:
    """A torus arc about z: ring radius g[12], tube radius g[13], half angle g[14] to both sides of local y."""
    px, py, pz, ex, ey, ez = local
    ring, tube, half = g[12], g[13], g[14]
    reach = ring + tube
    b = px * ex + py * ey + pz * ez
    disc = b * b - (px * px + py * py + pz * pz - reach * reach)
    if disc <= 0.0:
        return _miss()
    sine, cosine = math.sin(half), math.cos(half)
    t = max(-b - math.sqrt(disc), _NEAR)
    stop = min(-b + math.sqrt(disc), limit)
    for _ in range(_MARCH_STEPS):
        if t >= stop:
            return _miss()
        x, y, z = px + t * ex, py + t * ey, pz + t * ez
        d = _torus_distance(x, y, z, ring, tube, sine, cosine)
        if d < _SURFACE:
            ax = abs(x)
            if cosine * ax > sine * y:
                cx, cy = (ring * sine if x > 0 else -ring * sine), ring * cosine
            else:
                rho = math.sqrt(x * x + y * y)
                cx, cy = ring * x / rho, ring * y / rho
            nx, ny, nz = x - cx, y - cy, z
            n = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
            if nx * ex + ny * ey + nz * ez > 0.0:  # leaving: a shadow ray that started on this surface
                t += 1e-4
                continue
            return (t, x, y, z, nx * n, ny * n, nz * n, 0)
        t += d
    return _miss()


@njit(nogil=True)
def _enters(boxes: FloatArray, node: int, start: Ray, limit: float) -> bool:
    """Whether a ray, given as origin and inverse direction, passes through a box before `limit`."""
    ox, oy, oz, ix, iy, iz = start
    a, b = (boxes[node, 0] - ox) * ix, (boxes[node, 3] - ox) * ix
    enter, leave = min(a, b), max(a, b)
    a, b = (boxes[node, 1] - oy) * iy, (boxes[node, 4] - oy) * iy
    enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    a, b = (boxes[node, 2] - oz) * iz, (boxes[node, 5] - oz) * iz
    enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    return leave >= max(enter, 0.0) and enter < limit


@njit(nogil=True)
def _inverse(d: float) -> float:
    return 1.0 / d if abs(d) > 1e-12 else math.copysign(1e12, d)


@njit(nogil=True)
def _inverted(ray: Ray) -> Ray:
    """Origin and inverse direction of a ray."""
    return ray[0], ray[1], ray[2], _inverse(ray[3]), _inverse(ray[4]), _inverse(ray[5])


@njit(nogil=True)
def nearest(tree: PackedTree, stack: IntArray, ray: Ray) -> tuple[int, Hit]:
    """Nearest primitive that a ray hits: (index or -1, the hit as `intersect` returns it)."""
    kinds, geometry, boxes, links, order = tree
    start = _inverted(ray)
    best = -1
    hit = _miss()
    stack[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if not _enters(boxes, node, start, hit[0]):
            continue
        axis, first, second, count = links[node, 0], links[node, 1], links[node, 2], links[node, 3]
        if first < 0:
            for k in range(second, second + count):
                p = order[k]
                found = intersect(kinds[p], geometry[p], ray, hit[0])
                if found[0] < hit[0]:
                    hit, best = found, p
            continue
        d = ray[3] if axis == 0 else (ray[4] if axis == 1 else ray[5])
        stack[depth] = second if d > 0 else first
        stack[depth + 1] = first if d > 0 else second
        depth += 2
    return best, hit


@njit(nogil=True)
def blocked(tree: PackedTree, stack: IntArray, ray: Ray, limit: float) -> bool:
    """Whether anything lies on a ray before `limit`."""
    kinds, geometry, boxes, links, order = tree
    start = _inverted(ray)
    stack[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if not _enters(boxes, node, start, limit):
            continue
        first, second, count = links[node, 1], links[node, 2], links[node, 3]
        if first < 0:
            for k in range(second, second + count):
                p = order[k]
                if intersect(kinds[p], geometry[p], ray, limit)[0] < limit:
                    return True
            continue
        stack[depth] = first
        stack[depth + 1] = second
        depth += 2
    return False
