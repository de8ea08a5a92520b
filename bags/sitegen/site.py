# SPDX-License-Identifier: Apache-2.0
"""A site under construction: primitives with what is true of them, and the builders that layouts use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sitegen import primitives as shapes
from sitegen.primitives import Material, Primitive, unit
from sitegen.render import NEUTRAL, Colour, Lamp

FloatArray = NDArray[np.float64]

# The planned classes: outer radius (m) -> name and colour of the markers (Figure 11 of the paper).
CLASSES = {
    0.0086: ("copper 17", "magenta"),
    0.0365: ("DN65", "blue"),
    0.0575: ("DN100", "cyan"),
    0.0841: ("DN150", "green"),
    0.1095: ("DN200", "red"),
    0.1223: ("DN225", "yellow"),
}
LAB_RADII = tuple(CLASSES)[:5]
FIELD_RADII = tuple(CLASSES)

BOARD_CIRCLE_RADIUS = 0.040
BOARD_CENTRES = ((-0.240, 0.150), (0.240, 0.150), (0.0, 0.0), (-0.240, -0.150), (0.240, -0.150))
BOARD_HALF = (0.300, 0.210)
_BOARD_THICKNESS = 0.012
_PAINT_THICKNESS = 2e-5  # the circles lie this far before the board, so that rays meet them first
BEND = 2.2  # bend radius over pipe radius, as sold for steel elbows of tight bend

CONCRETE = Material("concrete", (0.42, 0.41, 0.39), mottle=0.50, speckle=0.5)
PLASTER = Material("plaster", (0.55, 0.53, 0.49), mottle=0.35, cell=0.5, speckle=0.35, speckle_cell=0.045)
SCREED = Material("screed", (0.33, 0.32, 0.31), mottle=0.5, cell=0.25, speckle=0.5, speckle_cell=0.03)
GALVANISED = Material(
    "galvanised", (0.50, 0.51, 0.53), mottle=0.30, cell=0.06, octaves=5, speckle=0.25, specular=0.15, shininess=18.0
)
CABLE = Material("cable", (0.10, 0.10, 0.11), mottle=0.4, cell=0.05, octaves=5, speckle=0.4)
CARDBOARD = Material("cardboard", (0.42, 0.30, 0.18), mottle=0.35, cell=0.1, octaves=6, speckle=0.4)
BLACK = Material("board", (0.025, 0.025, 0.027), mottle=0.05, speckle=0.0)
WHITE = Material("circle", (0.75, 0.75, 0.74), mottle=0.01, speckle=0.0)
# Pipes come smoother than walls: what clings to them is dust, scratches and drops of mortar.
_PAINT = Material(
    "paint", (0.10, 0.34, 0.16), 0.22, 0.10, 6, speckle=0.32, speckle_cell=0.025, specular=0.06, shininess=40.0
)
_PVC = Material("pvc", (0.66, 0.66, 0.63), 0.12, 0.12, 6, speckle=0.28, speckle_cell=0.02, specular=0.05)
PIPE_MATERIALS = (
    Material("steel", (0.20, 0.19, 0.19), 0.40, 0.08, 6, speckle=0.25, stretch=3.0, specular=0.20, shininess=30.0),
    _PAINT,
    replace(_PAINT, colour=(0.06, 0.17, 0.40)),
    replace(_PAINT, colour=(0.45, 0.09, 0.06)),
    _PVC,
    replace(_PVC, colour=(0.55, 0.28, 0.08)),
)
COPPER = Material(
    "copper", (0.46, 0.20, 0.10), mottle=0.45, cell=0.04, octaves=5, stretch=4.0, specular=0.25, shininess=35.0
)


def drawn_material(rng: np.random.Generator, radius: float) -> Material:
    """What a pipe of this radius [m] is made of: the thinnest ones are copper."""
    return COPPER if radius < 0.02 else PIPE_MATERIALS[int(rng.integers(len(PIPE_MATERIALS)))]


@dataclass(frozen=True)
class Pipe:
    """A true straight barrel; `ends` says what each end is: free, elbow, floor or wall."""

    start: FloatArray
    end: FloatArray
    radius: float
    material: str
    ends: tuple[str, str]

    @property
    def length(self) -> float:
        """Metres from end to end."""
        return float(np.linalg.norm(self.end - self.start))


@dataclass
class Site:
    """What is built so far, and what is true of it."""

    planned_radii: tuple[float, ...]
    richness: float = 1.0
    wall_period: float = 0.0
    board_error: float = 0.0  # m, standard deviation of a printed circle's place, along and across
    primitives: list[Primitive] = field(default_factory=list)
    pipes: list[Pipe] = field(default_factory=list)
    removed: list[Pipe] = field(default_factory=list)  # of an earlier night, and planned as they were
    ignored: list[tuple[FloatArray, FloatArray, float]] = field(default_factory=list)
    boards: list[FloatArray] = field(default_factory=list)
    lamps: list[Lamp] = field(default_factory=list)
    ambient: float = 0.25
    ambient_colour: Colour = NEUTRAL
    gain: float = 1.0
    balance: Colour = NEUTRAL  # factors on the camera's red, green and blue
    waypoints: list[list[float]] = field(default_factory=list)
    closed_walk: bool = False
    tells_materials: bool = False  # its bill names materials, pipes of one radius have several

    def dressed(self, material: Material, wall: bool = False) -> Material:
        """The material with as much texture as this site has, repeating on walls where asked."""
        return replace(
            material,
            mottle=material.mottle * self.richness,
            speckle=material.speckle * self.richness,
            period=self.wall_period if wall else 0.0,
        )

    def add(self, primitive: Primitive) -> None:
        """Put a primitive in."""
        self.primitives.append(primitive)

    def wall(self, centre: ArrayLike, normal: ArrayLike, width: float, height: float, material: Material) -> None:
        """A wall, floor or ceiling, its texture tiled where the site asks for that."""
        self.add(shapes.rectangle(centre, normal, width, height, self.dressed(material, wall=True)))

    def room(self, width: float, height: float, depth: float) -> None:
        """A room from the back wall y = 0 towards -y, from x = 0 on, with its floor at z = 0."""
        half, middle = width / 2, -depth / 2
        self.wall((half, 0.0, height / 2), (0, -1, 0), width, height, CONCRETE)
        self.wall((half, -depth, height / 2), (0, 1, 0), width, height, PLASTER)
        self.wall((0.0, middle, height / 2), (1, 0, 0), depth, height, PLASTER)
        self.wall((width, middle, height / 2), (-1, 0, 0), depth, height, PLASTER)
        self.wall((half, middle, 0.0), (0, 0, 1), width, depth, SCREED)
        self.wall((half, middle, height), (0, 0, -1), width, depth, CONCRETE)

    def box(self, low: ArrayLike, high: ArrayLike, material: Material, yaw: float = 0.0) -> None:
        """A box between two corners."""
        self.add(shapes.box(low, high, self.dressed(material), yaw))

    def pipe(self, start: ArrayLike, end: ArrayLike, radius: float, material: Material, ends: tuple[str, str]) -> int:
        """A pipe that is to be found; returns its index."""
        a, b = np.asarray(start, float), np.asarray(end, float)
        self.add(shapes.cylinder(a, b, radius, self.dressed(material), len(self.pipes)))
        self.pipes.append(Pipe(a, b, radius, material.name, ends))
        return len(self.pipes) - 1

    def decoy(self, start: ArrayLike, end: ArrayLike, radius: float, material: Material) -> None:
        """A cylinder that counts neither way: a stub, a flange, a column."""
        a, b = np.asarray(start, float), np.asarray(end, float)
        self.add(shapes.cylinder(a, b, radius, self.dressed(material)))
        self.ignored.append((a, b, radius))

    def elbow(self, corner: ArrayLike, arriving: ArrayLike, leaving: ArrayLike, radius: float, m: Material) -> None:
        """A bend about the corner of two axes."""
        self.add(shapes.elbow(corner, arriving, leaving, radius, BEND * radius, self.dressed(m)))

    def clamp(self, pipe: int, at: float, towards: ArrayLike, reach: float) -> None:
        """A clamp round a pipe at `at` metres from its start, with a rod of `reach` from the axis to what holds it."""
        p = self.pipes[pipe]
        axis = unit(p.end - p.start)
        centre = p.start + at * axis
        half = 0.014
        band = 0.004 + 0.03 * p.radius
        self.add(shapes.cylinder(centre - half * axis, centre + half * axis, p.radius + band, self.dressed(GALVANISED)))
        away = unit(towards)
        self.add(shapes.cylinder(centre + away * p.radius, centre + away * reach, 0.006, self.dressed(GALVANISED)))

    def flange(self, pipe: int, at: float) -> None:
        """A pair of flanges on a pipe; it counts neither way."""
        p = self.pipes[pipe]
        axis = unit(p.end - p.start)
        centre = p.start + at * axis
        self.decoy(centre - 0.02 * axis, centre + 0.02 * axis, 1.6 * p.radius, GALVANISED)

    def board(self, centre: ArrayLike, normal: ArrayLike, printing: np.random.Generator) -> None:
        """A board of five white circles, its back at `centre` on a surface with that (horizontal) normal.

        It is printed as well as the site's boards are; what is kept as true is what was printed.
        """
        n = unit(normal)
        rotation = shapes.frame(n)
        right, up = rotation[0], rotation[1]
        back = np.asarray(centre, float)
        middle = back + n * _BOARD_THICKNESS / 2
        self.add(Primitive(shapes.Kind.BOX, middle, rotation, (*BOARD_HALF, _BOARD_THICKNESS / 2), self.dressed(BLACK)))
        face = back + n * (_BOARD_THICKNESS + _PAINT_THICKNESS)
        printed = np.array(BOARD_CENTRES) + self.board_error * printing.standard_normal((len(BOARD_CENTRES), 2))
        circles = np.array([face + x * right + y * up for x, y in printed])
        for circle in circles:
            self.add(shapes.disc(circle, n, BOARD_CIRCLE_RADIUS, self.dressed(WHITE)))
        self.boards.append(circles)

    def tube_lamp(self, start: ArrayLike, end: ArrayLike, power: float, points: int) -> None:
        """A fluorescent tube as a row of point lights that share its power."""
        for s in (np.arange(points) + 0.5) / points:
            p = (1 - s) * np.asarray(start, float) + s * np.asarray(end, float)
            self.lamps.append(Lamp((float(p[0]), float(p[1]), float(p[2])), power / points))

    def planned_lengths(self) -> dict[tuple[float, str], float]:
        """(radius, material) -> planned metres: a quarter more than is installed, to the decimetre.

        The material is empty where the bill does not tell it.
        """
        keys = [(radius, material) for radius in self.planned_radii for material in self._materials(radius)]
        return {key: round(1.25 * sum(p.length for p in self._all if self._line(p) == key), 1) for key in keys}

    @property
    def _all(self) -> list[Pipe]:
        return [*self.pipes, *self.removed]

    def _materials(self, radius: float) -> list[str]:
        own = (self._line(pipe)[1] for pipe in self._all if pipe.radius == radius)
        return list(dict.fromkeys(own)) or [""]

    def _line(self, pipe: Pipe) -> tuple[float, str]:
        return pipe.radius, pipe.material if self.tells_materials else ""


def segment_gap(a0: FloatArray, a1: FloatArray, b0: FloatArray, b1: FloatArray) -> float:
    """Least distance between two segments (closest points, clamped to the ends)."""
    u, v, w = a1 - a0, b1 - b0, a0 - b0
    uu, uv, vv, uw, vw = u @ u, u @ v, v @ v, u @ w, v @ w
    determinant = uu * vv - uv * uv
    candidates: Sequence[float] = (0.0, 1.0)
    if determinant > 1e-12 * uu * vv:
        candidates = (float(np.clip((uv * vw - vv * uw) / determinant, 0.0, 1.0)), 0.0, 1.0)
    least = np.inf
    for s in candidates:
        t = float(np.clip((uv * s + vw) / vv, 0.0, 1.0))
        s = float(np.clip((uv * t - uw) / uu, 0.0, 1.0))
        least = min(least, float(np.linalg.norm(w + s * u - t * v)))
    return least
