# SPDX-License-Identifier: Apache-2.0
"""The lab: a room corner with six pipes of five radii, an elbow, clamps, a duct and one board."""

from __future__ import annotations

import math

import numpy as np

from sitegen.primitives import Material, bend_tangent, unit
from sitegen.site import (
    BEND,
    CONCRETE,
    COPPER,
    GALVANISED,
    LAB_RADII,
    PIPE_MATERIALS,
    PLASTER,
    SCREED,
    Site,
)

_ELBOW_RADIUS = 0.0365  # the class that comes twice, once with an elbow
_WIDTH, _HEIGHT, _DEPTH = 5.0, 3.0, 4.5


def _material(radius: float, rng: np.random.Generator) -> Material:
    return COPPER if radius < 0.02 else PIPE_MATERIALS[int(rng.integers(len(PIPE_MATERIALS)))]


def build_lab(
    rng: np.random.Generator, richness: float, wall_period: float, distance: float, board_error: float = 0.0
) -> Site:
    """Wall y = 0 with the pipes before it (y < 0), side wall x = 0, floor z = 0; seen from about y = -distance."""
    site = Site(LAB_RADII, richness, wall_period, board_error)
    site.wall((_WIDTH / 2, 0.0, _HEIGHT / 2), (0, -1, 0), _WIDTH, _HEIGHT, CONCRETE)
    site.wall((0.0, -_DEPTH / 2, _HEIGHT / 2), (1, 0, 0), _DEPTH, _HEIGHT, PLASTER)
    site.wall((_WIDTH / 2, -_DEPTH / 2, 0.0), (0, 0, 1), _WIDTH, _DEPTH, SCREED)

    radii = [float(radius) for radius in rng.permutation(LAB_RADII)]
    left = _standing_pipes(site, rng, radii[:3]) + rng.uniform(0.02, 0.10)
    _lying_pipes(site, rng, [*radii[3:], _ELBOW_RADIUS], left)

    centre = left + rng.uniform(0.4, 1.0)
    site.board((centre, 0.0, rng.uniform(2.07, 2.15)), (0, -1, 0), rng.spawn(1)[0])
    site.box((left - 0.1, -0.24, 2.50), (_WIDTH - 0.2, -0.03, 2.72), GALVANISED)

    lamp = rng.uniform(-0.4, 0.4)
    site.tube_lamp((1.0 + lamp, -1.9, 2.85), (2.4 + lamp, -1.9, 2.85), 3.2, 3)
    site.tube_lamp((3.9, -3.2, 2.3), (3.9, -3.2, 2.3), 2.6, 1)
    site.ambient = 0.35
    site.gain = 0.75
    site.waypoints = _waypoints(-distance, max(left + 1.1, 2.4))
    site.closed_walk = True
    return site


def _standing_pipes(site: Site, rng: np.random.Generator, radii: list[float]) -> float:
    """Vertical pipes from the side wall on, clamped to the wall; returns the x that they leave free, m."""
    x = rng.uniform(0.12, 0.25)
    for radius in radii:
        x += radius
        y = -(radius + rng.uniform(0.025, 0.075))
        on_floor = rng.random() < 0.4
        bottom = 0.0 if on_floor else rng.uniform(0.15, 0.40)
        top = rng.uniform(1.75, 2.10)
        lean = np.tan(np.radians(rng.uniform(-0.7, 0.7))) * (top - bottom)
        ends = ("floor" if on_floor else "free", "free")
        pipe = site.pipe((x, y, bottom), (x + lean, y, top), radius, _material(radius, rng), ends)
        for share in (rng.uniform(0.12, 0.25), rng.uniform(0.75, 0.88)):
            site.clamp(pipe, share * (top - bottom), (0, 1, 0), -y)
        x += radius + rng.uniform(0.14, 0.28)
    return float(x)


def _lying_pipes(site: Site, rng: np.random.Generator, radii: list[float], left: float) -> None:
    """Horizontal pipes from x = left on, clamped to the wall, the last of them with an elbow and a stub."""
    heights = rng.permutation(np.linspace(0.55, 1.72, 3) + rng.uniform(-0.08, 0.08, 3))
    for k, (radius, z) in enumerate(zip(radii, heights, strict=True)):
        start = left + rng.uniform(0.0, 0.15)
        end = start + rng.uniform(1.20, 1.55)
        y = -(radius + rng.uniform(0.025, 0.075))
        slope = math.tan(math.radians(rng.uniform(-1.0, 1.0))) * (end - start)
        m = _material(radius, rng)
        a, b = np.array([start, y, z]), np.array([end, y, z + slope])
        ends = ("free", "free")
        if k == len(radii) - 1:
            axis, down = unit(b - a), np.array([0.0, 0.0, -1.0])
            tangent = bend_tangent(axis, down, BEND * radius)
            site.elbow(b, axis, down, radius, m)
            site.decoy(b + tangent * down, b + (tangent + 0.12) * down, radius, m)
            b = b - tangent * axis
            ends = ("free", "elbow")
        pipe = site.pipe(a, b, radius, m, ends)
        length = float(np.linalg.norm(b - a))
        for share in (rng.uniform(0.12, 0.25), rng.uniform(0.70, 0.85)):
            site.clamp(pipe, share * length, (0, 1, 0), -y)


def _waypoints(y: float, right: float) -> list[list[float]]:
    """Two laps along the wall, at eye height to x = right and back low down; x, y, z, yaw, pitch (m, rad)."""
    high, low = 1.60, 0.86
    turn = math.radians(9.0)
    lap = [
        [0.45, y, high, 0.0, 0.03],
        [1.1, y - 0.06, high + 0.03, -turn, 0.05],
        [1.8, y, high, 0.0, 0.06],
        [right, y - 0.04, high - 0.02, turn, 0.03],
        [right + 0.25, y, (high + low) / 2, turn, 0.0],
        [right - 0.05, y + 0.04, low, turn, -0.05],
        [1.7, y - 0.06, low - 0.03, -turn / 2, -0.06],
        [0.95, y, low, -turn, -0.05],
        [0.35, y - 0.05, (high + low) / 2, -turn, 0.0],
    ]
    # The second lap takes another line, as a person would.
    return [*lap, *([x + 0.15, y - 0.12, z + 0.07, yaw, pitch] for x, y, z, yaw, pitch in lap)]
