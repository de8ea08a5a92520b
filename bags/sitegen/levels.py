# SPDX-License-Identifier: Apache-2.0
"""The levels: pipes in line at eight heights on a wall, and risers and a pillar before them.

What is in line has a size, a distance from the wall and a height of its own, which may be nearly those of its
neighbour: whether two pipes are one is what this site asks.
"""

from __future__ import annotations

import math

import numpy as np

from sitegen.site import CARDBOARD, CONCRETE, FIELD_RADII, GALVANISED, Site, drawn_material
from sitegen.visibility import shows_every_pipe

_WIDTH, _HEIGHT, _DEPTH = 10.0, 3.6, 5.5
_LAYOUTS = 40  # layouts drawn until one shows every pipe
# Heights of the axes [m]: two of the thickest pipes side by side have 7 cm of air between them.
_LOWEST, _STEP, _LEVELS, _JITTER = 0.42, 0.36, 8, 0.02
_FIRST, _LAST = 0.95, 9.3  # m along the wall, between which pipes lie
_RISERS = 18
_BEFORE = 0.46  # m from the wall, behind which no riser is: the pipes on the wall, their clamps and air
_BOARDS = ((0.5, 0.0, 1.55), (8.55, -0.66, 1.30))  # on the wall, and on a stand before the pipes
_STAND = 0.45  # m to both sides of a board's middle that risers keep free


def build_levels(
    rng: np.random.Generator, richness: float, wall_period: float, distance: float, board_error: float = 0.0
) -> Site:
    """Wall y = 0 with everything before it (y < 0), floor z = 0; raises RuntimeError where no layout is seen."""
    for _ in range(_LAYOUTS):
        site = Site(FIELD_RADII, richness, wall_period, board_error)
        site.room(_WIDTH, _HEIGHT, _DEPTH)
        for level in range(_LEVELS):
            _in_line(site, rng, _LOWEST + level * _STEP)
        _before_them(site, rng)
        for board in _BOARDS:
            site.board(board, (0, -1, 0), rng.spawn(1)[0])
        for x in (1.8, 5.0, 8.2):
            site.tube_lamp((x - 0.5, -2.9, 3.45), (x + 0.5, -2.9, 3.45), 2.6, 1)
        site.ambient = 0.40
        site.waypoints = _waypoints(distance)
        if shows_every_pipe(site):
            return site
    raise RuntimeError(f"no layout in {_LAYOUTS} shows every pipe: choose another seed")


def _in_line(site: Site, rng: np.random.Generator, height: float) -> None:
    """Pipes along the wall at one height, with a gap between each two."""
    x = _FIRST + rng.uniform(0.0, 0.2)
    while x < _LAST - 0.7:
        radius = float(rng.choice(FIELD_RADII))
        end = min(x + rng.uniform(0.8, 2.3), _LAST)
        y, z = -(radius + rng.uniform(0.03, 0.14)), height + rng.uniform(-_JITTER, _JITTER)
        pipe = site.pipe((x, y, z), (end, y, z), radius, drawn_material(rng, radius), ("free", "free"))
        for share in (rng.uniform(0.12, 0.3), rng.uniform(0.7, 0.88)):
            site.clamp(pipe, share * (end - x), (0, 1, 0), -y)
        x = end + rng.uniform(0.12, 0.45)


def _before_them(site: Site, rng: np.random.Generator) -> None:
    """Risers that end in the open, a pillar and crates."""
    taken = [(_BOARDS[1][0], _STAND)]

    def place(half: float) -> float | None:
        for _ in range(50):
            x = float(rng.uniform(_FIRST, _LAST))
            if all(abs(x - other) > half + reach + 0.05 for other, reach in taken):
                taken.append((x, half))
                return x
        return None

    pillar = place(0.2)
    if pillar is not None:
        site.decoy((pillar, -0.85, 0.0), (pillar, -0.85, _HEIGHT), 0.2, CONCRETE)
    for _ in range(_RISERS):
        radius = float(rng.choice(FIELD_RADII))
        x = place(radius)
        if x is None:
            continue
        foot, y = rng.uniform(0.4, 1.5), -(_BEFORE + radius + rng.uniform(0.0, 0.1))
        top = min(foot + rng.uniform(0.8, 1.6), 3.1)
        pipe = site.pipe((x, y, foot), (x, y, top), radius, drawn_material(rng, radius), ("free", "free"))
        site.clamp(pipe, rng.uniform(0.2, 0.8) * (top - foot), (0, 1, 0), -y)
    for _ in range(3):
        x, width, height = rng.uniform(1.5, 8.0), rng.uniform(0.25, 0.5), rng.uniform(0.15, 0.3)
        site.box((x, -1.35, 0.0), (x + width, -1.05, height), CARDBOARD, rng.uniform(0.0, math.pi))
    site.box((0.2, -0.60, 3.30), (_WIDTH - 0.3, -0.35, 3.303), GALVANISED)  # cable tray
    site.box((0.2, -0.603, 3.30), (_WIDTH - 0.3, -0.60, 3.36), GALVANISED)


def _waypoints(distance: float) -> list[list[float]]:
    """Three passes along the wall: at eye height, back low down, and with the camera held up."""
    turn, y = math.radians(7.0), -distance - 0.1
    places = (0.4, 2.0, 3.6, 5.1, 6.6, 8.1, 9.4)
    passes = ((places, 1.65, 0.0), (places[::-1], 0.90, 0.03), (places, 2.45, 0.0))
    return [
        [x, y - 0.06 * (k % 2), height, turn * (-1) ** k, pitch]
        for along, height, pitch in passes
        for k, x in enumerate(along)
    ]
