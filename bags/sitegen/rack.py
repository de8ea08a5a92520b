# SPDX-License-Identifier: Apache-2.0
"""The rack: pipes of two radii side by side, of which a bill tells several materials, under light that changes."""

from __future__ import annotations

import numpy as np

from sitegen.pipe_materials import KINDS, pipe_material
from sitegen.primitives import Material, unit
from sitegen.render import Colour, Lamp
from sitegen.site import CONCRETE, FIELD_RADII, PLASTER, SCREED, Site

_WIDTH, _HEIGHT, _DEPTH = 5.0, 3.0, 4.5
_KINDS_OF_A_RADIUS = 4
# Light of lamps and of the sky, red and blue over green: halogen to overcast.
_WARM, _COLD = np.array([1.45, 1.0, 0.55]), np.array([0.85, 1.0, 1.25])


def build_rack(
    rng: np.random.Generator, richness: float, wall_period: float, distance: float, board_error: float = 0.0
) -> Site:
    """Wall y = 0 with standing pipes before it (y < 0), floor z = 0; seen from about y = -distance."""
    radii = tuple(sorted(float(radius) for radius in rng.choice(FIELD_RADII, 2, replace=False)))
    site = Site(radii, richness, wall_period, board_error, tells_materials=True)
    for centre, normal, width, height in (
        ((_WIDTH / 2, 0.0, _HEIGHT / 2), (0, -1, 0), _WIDTH, _HEIGHT),
        ((0.0, -_DEPTH / 2, _HEIGHT / 2), (1, 0, 0), _DEPTH, _HEIGHT),
        ((_WIDTH / 2, -_DEPTH / 2, 0.0), (0, 0, 1), _WIDTH, _DEPTH),
    ):
        site.wall(centre, normal, width, height, _surface(rng))
    kinds = {radius: [str(kind) for kind in rng.choice(KINDS, _KINDS_OF_A_RADIUS, replace=False)] for radius in radii}
    left = _standing(site, rng, [(radius, kind) for radius in radii for kind in kinds[radius]])
    site.board((min(0.5 * left, 2.2), 0.0, rng.uniform(2.2, 2.35)), (0, -1, 0), rng.spawn(1)[0])
    _light(site, rng)
    z = rng.uniform(1.2, 1.5)
    site.waypoints = [
        [0.35, -distance, z, -0.1, 0.05],
        [0.5 * left, -distance - 0.2, z + 0.25, 0.0, -0.05],
        [left, -distance, z - 0.1, 0.15, 0.0],
        [0.6 * left, -distance + 0.25, z - 0.3, 0.05, 0.08],
    ]
    site.closed_walk = True
    return site


def _surface(rng: np.random.Generator) -> Material:
    """A wall or a floor: concrete, plaster or screed, of another colour each time."""
    material = (CONCRETE, PLASTER, SCREED)[int(rng.integers(3))]
    level, warm = rng.uniform(0.6, 1.6), rng.uniform(-0.05, 0.12)
    red, green, blue = (level * part for part in material.colour)
    return Material(
        material.name,
        (min(red * (1.0 + warm), 0.9), min(green, 0.9), min(blue * (1.0 - warm), 0.9)),
        material.mottle,
        material.cell,
        speckle=material.speckle,
        speckle_cell=material.speckle_cell,
    )


def _standing(site: Site, rng: np.random.Generator, wanted: list[tuple[float, str]]) -> float:
    """Vertical pipes in a random order, most of them before the wall; returns the x that they leave free, m."""
    x = rng.uniform(0.15, 0.3)
    for number in rng.permutation(len(wanted)):
        radius, kind = wanted[int(number)]
        x += radius
        y = -(radius + rng.uniform(0.02, 0.12))
        bottom, top = rng.uniform(0.2, 0.5), rng.uniform(1.75, 2.05)
        lean = rng.uniform(-0.012, 0.012)
        pipe = site.pipe((x, y, bottom), (x + lean, y, top), radius, pipe_material(kind, rng), ("free", "free"))
        for share in (rng.uniform(0.12, 0.25), rng.uniform(0.75, 0.88)):
            site.clamp(pipe, share * (top - bottom), unit((0, 1, 0)), -y)
        x += radius + rng.uniform(0.08, 0.22)
    return float(x)


def _light(site: Site, rng: np.random.Generator) -> None:
    """One to four lamps and the sky, each bright and coloured at random about a cast that all share."""
    cast = rng.uniform(0.0, 1.0)

    def colour() -> Colour:
        share = float(np.clip(cast + 0.15 * rng.standard_normal(), 0.0, 1.0))
        red, green, blue = (_WARM ** (1.0 - share) * _COLD**share).tolist()
        return red, green, blue

    for _ in range(int(rng.integers(1, 5))):
        place = (float(rng.uniform(0.2, 4.5)), float(rng.uniform(-3.8, -1.2)), float(rng.uniform(1.6, 2.9)))
        site.lamps.append(Lamp(place, float(np.exp(rng.uniform(np.log(0.5), np.log(3.0)))), colour()))
    site.ambient, site.ambient_colour = float(np.exp(rng.uniform(np.log(0.12), np.log(0.7)))), colour()
    light = site.ambient + sum(lamp.power / (1.0 + (lamp.position[1]) ** 2) for lamp in site.lamps)
    site.gain = float(np.exp(rng.uniform(np.log(0.6), np.log(1.5)))) / light
    # The camera balances white, more or less.
    cast_rgb = np.asarray(site.ambient_colour) ** rng.uniform(0.4, 1.3)
    red, green, blue = (cast_rgb[1] / cast_rgb * np.exp(0.06 * rng.standard_normal(3))).tolist()
    site.balance = (red, green, blue)
