# SPDX-License-Identifier: Apache-2.0
"""The field: 58 pipes of six radii in a plant room, with racks, crossings, elbows, clamps and clutter."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sitegen.primitives import Material, bend_tangent, unit
from sitegen.site import (
    BEND,
    CABLE,
    CARDBOARD,
    CONCRETE,
    FIELD_RADII,
    GALVANISED,
    Site,
    drawn_material,
    segment_gap,
)
from sitegen.visibility import shows_every_pipe

FloatArray = NDArray[np.float64]

_WIDTH, _HEIGHT, _DEPTH = 10.0, 3.2, 4.6
_COUNTS = dict(zip(FIELD_RADII, (8, 10, 10, 10, 10, 10), strict=True))
_LAYOUTS = 40  # layouts drawn until one shows every pipe
_PLACINGS = 6000  # attempts to place the pipes of a layout
_RACK_DEPTH = -1.95  # m; further from the wall the path would be below the ceiling rack
_GAP = 0.025  # metres of air between pipes that were not installed side by side


class _Room:
    """A site being filled: the pipes still to be placed, and the boxes that they must not enter."""

    def __init__(self, site: Site, rng: np.random.Generator) -> None:
        self.site = site
        self.rng = rng
        self.pool = [radius for radius, count in _COUNTS.items() for _ in range(count)]
        self.keep_clear: list[tuple[FloatArray, FloatArray]] = []

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def draw(self) -> float:
        """The radius of one of the pipes that are left, which stays in the pool until it is placed."""
        return self.pool[int(self.rng.integers(len(self.pool)))]

    def material(self, radius: float) -> Material:
        return drawn_material(self.rng, radius)

    def block(self, low: ArrayLike, high: ArrayLike, material: Material | None = None, yaw: float = 0.0) -> None:
        """Clutter that pipes keep clear of; without material a space that is to stay empty."""
        a, b = np.asarray(low, float), np.asarray(high, float)
        self.keep_clear.append((a, b))
        if material is not None:
            self.site.box(a, b, material, yaw)

    def is_free(self, start: FloatArray, end: FloatArray, radius: float) -> bool:
        for pipe in self.site.pipes:
            if segment_gap(start, end, pipe.start, pipe.end) < radius + pipe.radius + _GAP:
                return False
        along = np.linspace(0.0, 1.0, max(int(np.linalg.norm(end - start) / 0.03), 2))[:, None]
        points = (1 - along) * start + along * end
        for low, high in self.keep_clear:
            if (np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=1) < radius + 0.01).any():
                return False
        return True

    def place(
        self, start: ArrayLike, end: ArrayLike, radius: float, ends: tuple[str, str], towards: ArrayLike | None
    ) -> None:
        """Puts a pipe in; `towards` is the direction to the wall or ceiling that its two clamps are fixed to."""
        a, b = np.asarray(start, float), np.asarray(end, float)
        index = self.site.pipe(a, b, radius, self.material(radius), ends)
        self.pool.remove(radius)
        if towards is None:
            return
        away = unit(towards)
        for share in (self.uniform(0.10, 0.25), self.uniform(0.75, 0.90)):
            at = (1 - share) * a + share * b
            reach = -at[1] if away[1] > 0.5 else _HEIGHT - at[2]
            self.site.clamp(index, share * float(np.linalg.norm(b - a)), away, float(reach))

    def chain(self, corners: list[list[float]], radius: float, first_end: str) -> bool:
        """Straight pipes along the corners joined by elbows, all of them or none."""
        points = [np.array(c) for c in corners]
        ways = [unit(b - a) for a, b in pairwise(points)]
        trims = [0.0, *(bend_tangent(u, v, BEND * radius) for u, v in pairwise(ways)), 0.0]
        barrels = [(points[k] + trims[k] * w, points[k + 1] - trims[k + 1] * w) for k, w in enumerate(ways)]
        if any((b - a) @ w < 0.35 for (a, b), w in zip(barrels, ways, strict=True)):
            return False
        if not all(self.is_free(points[k], points[k + 1], radius) for k in range(len(ways))):
            return False
        material = self.material(radius)
        for k, (a, b) in enumerate(barrels):
            ends = (first_end if k == 0 else "elbow", "free" if k == len(ways) - 1 else "elbow")
            self.site.pipe(a, b, radius, material, ends)
            self.pool.remove(radius)
        for k in range(1, len(ways)):
            self.site.elbow(points[k], ways[k - 1], ways[k], radius, material)
        return True


def _shell(room: _Room) -> None:
    site = room.site
    site.room(_WIDTH, _HEIGHT, _DEPTH)
    room.block((0.2, -0.32, 2.80), (_WIDTH - 0.3, -0.03, 3.08), GALVANISED)  # duct
    low = 2.36  # cable tray: floor, two flanks, and cables of several layers in it
    room.block((0.2, -0.27, low), (_WIDTH - 0.3, -0.02, low + 0.003), GALVANISED)
    room.block((0.2, -0.273, low), (_WIDTH - 0.3, -0.27, low + 0.06), GALVANISED)
    for k in range(12):
        x = 0.25 + 0.78 * k
        site.box((x, -0.24, low + 0.003), (x + 0.76, -0.05, low + 0.03 + 0.04 * room.uniform(0, 1)), CABLE)
    room.block((3.32, -0.10, 0.10), (3.54, -0.04, low), GALVANISED)  # riser
    room.block((_WIDTH - 0.4, -0.45, 0.0), (_WIDTH, 0.0, _HEIGHT), CONCRETE)  # column
    site.decoy((6.66, -0.22, 0.0), (6.66, -0.22, 2.30), 0.15, CONCRETE)  # round column
    room.keep_clear.append((np.array([6.51, -0.37, 0.0]), np.array([6.81, -0.07, 2.3])))
    for x in (0.62, 9.0):
        centre = np.array([x + room.uniform(-0.1, 0.1), 0.0, 2.09 + room.uniform(-0.02, 0.02)])
        site.board(centre, (0, -1, 0), room.rng.spawn(1)[0])
        # Nothing may stand between a board and the path.
        room.block(centre - np.array([0.34, 1.7, 0.34]), centre + np.array([0.34, 0.0, 0.23]))


def _racks(room: _Room) -> None:
    bottom, y = 2.64 + room.uniform(-0.02, 0.02), -0.42
    for _ in range(9):
        radius = room.draw()
        if y - 2 * radius < _RACK_DEPTH:
            break
        y -= radius
        length = room.uniform(2.6, 7.0)
        x = room.uniform(0.4, _WIDTH - 0.6 - length)
        lift = room.uniform(-0.004, 0.004)
        room.place((x, y, bottom + radius), (x + length, y, bottom + radius + lift), radius, ("free", "free"), None)
        y -= radius * room.uniform(1.6, 2.2) if radius > 0.02 else 0.03
    for x in (1.6, 4.6, 7.6):
        room.block((x - 0.02, y, bottom - 0.045), (x + 0.02, -0.35, bottom - 0.002), GALVANISED)
        for end in (y + 0.01, -0.36):
            room.site.box((x - 0.006, end - 0.006, bottom - 0.04), (x + 0.006, end + 0.006, _HEIGHT), GALVANISED)

    for x, stop, count in ((0.3, 3.25, 10), (6.95, 9.5, 7)):
        for _ in range(count):
            radius = room.draw()
            if x + 2 * radius > stop:
                break
            x += radius
            y = -(radius + room.uniform(0.03, 0.09))
            floor = room.rng.random() < 0.3
            foot = 0.0 if floor else room.uniform(0.10, 0.40)
            top = room.uniform(1.45, 1.72)
            ends = ("floor" if floor else "free", "free")
            room.place((x, y, foot), (x + room.uniform(-0.003, 0.003), y, top), radius, ends, (0, 1, 0))
            # A pitch of 1.3 diameters and more.
            x += radius + max(2 * radius * room.uniform(0.30, 0.75), 0.02)

    z = 0.30
    for _ in range(8):
        radius = room.draw()
        if z + 2 * radius > 2.2:
            break
        z += radius
        length = room.uniform(1.7, 2.6)
        x = room.uniform(3.72, 6.40 - length)
        y = -(radius + room.uniform(0.03, 0.09))
        room.place((x, y, z), (x + length, y, z), radius, ("free", "free"), (0, 1, 0))
        z += radius + max(2 * radius * room.uniform(0.30, 0.75), 0.02)


def _remaining(room: _Room) -> bool:
    """Places chains, crossings, inclined and single pipes until none is left; False where they do not fit."""
    uniform = room.uniform
    for _ in range(_PLACINGS):
        if not room.pool:
            return True
        radius = room.draw()
        left = room.pool.count(radius)
        kind = str(room.rng.choice(["chain", "crossing", "inclined", "wall", "level"]))
        if kind == "chain":
            if left < 2 or radius < 0.02:
                continue
            x, y, z = uniform(0.5, 9.2), -uniform(0.40, 0.95), uniform(1.2, 1.9)
            far = x + float(room.rng.choice([-1.0, 1.0])) * uniform(0.8, 1.6)
            foot = 0.0 if room.rng.random() < 0.5 else z - uniform(0.8, 1.1)
            corners = [[x, y, foot], [x, y, z], [far, y, z]]
            if left > 2:
                corners.append([far, y, z - uniform(0.7, 0.9)])
            if 0.3 < far < 9.3:
                room.chain(corners, radius, "floor" if foot == 0.0 else "free")
            continue
        if kind == "crossing":
            x, y, foot = uniform(3.8, 9.2), -uniform(0.40, 0.60), uniform(0.05, 0.30)
            a, b = np.array([x, y, foot]), np.array([x, y, foot + uniform(1.3, 1.8)])
        elif kind == "inclined":
            middle = np.array([uniform(0.8, 8.8), -uniform(0.40, 0.90), uniform(0.6, 1.8)])
            half = unit([uniform(-1, 1), uniform(-0.3, 0.3), uniform(-1, 1)]) * uniform(0.45, 0.8)
            a, b = middle - half, middle + half
        elif kind == "wall":
            if radius > 0.04:
                continue
            x, y, z = uniform(0.4, 7.8), -(radius + uniform(0.02, 0.06)), uniform(0.15, 2.25)
            a, b = np.array([x, y, z]), np.array([x + uniform(0.9, 1.6), y, z])
        else:
            x, y, z = uniform(0.4, 7.3), -uniform(0.40, 0.75), uniform(0.25, 2.2)
            a, b = np.array([x, y, z]), np.array([x + uniform(1.0, 2.0), y, z])
        low, high = np.minimum(a, b), np.maximum(a, b)
        inside = low[0] > 0.25 and high[0] < 9.45 and low[2] > 0.08 and high[2] < 2.45 and high[1] < -radius - 0.01
        if inside and room.is_free(a, b, radius):
            room.place(a, b, radius, ("free", "free"), (0, 1, 0) if kind == "wall" else None)
    return False


def _clutter(room: _Room) -> None:
    flanges = 6
    for index in room.rng.permutation(len(room.site.pipes)):
        pipe = room.site.pipes[index]
        axis = unit(pipe.end - pipe.start)
        at = pipe.length * room.uniform(0.35, 0.65)
        a, b = pipe.start + (at - 0.02) * axis, pipe.start + (at + 0.02) * axis
        others = [p for k, p in enumerate(room.site.pipes) if k != index]
        free = all(segment_gap(a, b, p.start, p.end) > 1.6 * pipe.radius + p.radius + 0.005 for p in others)
        if flanges and free and pipe.radius > 0.03 and pipe.length > 1.2 and pipe.start[1] < -1.7 * pipe.radius:
            room.site.flange(int(index), at)
            flanges -= 1
    for _ in range(5):
        width, height = room.uniform(0.25, 0.5), room.uniform(0.15, 0.35)
        x, y = room.uniform(0.4, 9.0), -room.uniform(1.1, 1.5)
        yaw = room.uniform(0, math.pi)
        if room.is_free(np.array([x, y, height / 2]), np.array([x + width, y, height / 2]), 0.35):
            room.block((x, y - 0.15, 0.0), (x + width, y + 0.15, height), CARDBOARD, yaw)


def _waypoints(distance: float) -> list[list[float]]:
    """Three passes: to the right at eye height, back low down, and to the right again looking up at the rack."""
    turn = math.radians(9.0)
    y = -distance
    path = [
        [x, y - 0.05 * (k % 2), 1.58 + 0.03 * (k % 2), turn * (-1) ** k, 0.05]
        for k, x in enumerate((0.5, 2.1, 3.6, 5.1, 6.6, 8.1, 9.3))
    ]
    path.append([9.5, y - 0.1, 1.28, 0.0, 0.0])
    path += [
        [x, y - 0.10 - 0.05 * (k % 2), 0.9, turn * (-1) ** k, -0.06]
        for k, x in enumerate((9.3, 8.1, 6.6, 5.1, 3.6, 2.1, 0.5))
    ]
    path += [[0.35, y - 0.30, 1.2, 0.0, 0.12], [0.6, y - 0.5, 1.45, 0.0, 0.32]]
    path += [
        [x, y - 0.70 - 0.05 * (k % 2), 1.55, turn * (-1) ** k, 0.50]
        for k, x in enumerate((1.2, 2.4, 3.6, 5.1, 6.6, 8.1, 9.3))
    ]
    return path


def build_field(
    rng: np.random.Generator, richness: float, wall_period: float, distance: float, board_error: float = 0.0
) -> Site:
    """Back wall y = 0 with everything before it (y < 0), floor z = 0; raises RuntimeError where no layout is seen."""
    for _ in range(_LAYOUTS):
        site = Site(FIELD_RADII, richness, wall_period, board_error)
        room = _Room(site, rng)
        _shell(room)
        _racks(room)
        if not _remaining(room):
            continue
        _clutter(room)
        for x in (1.8, 5.0, 8.2):
            site.tube_lamp((x - 0.5, -2.9, 3.05), (x + 0.5, -2.9, 3.05), 2.4, 1)
        site.ambient = 0.40
        site.gain = 1.0
        site.waypoints = _waypoints(distance)
        if shows_every_pipe(site):
            return site
    raise RuntimeError(f"no layout in {_LAYOUTS} shows every pipe: choose another seed")
