# SPDX-License-Identifier: Apache-2.0
"""The solids a site is built of, each in a local frame of its own, and their materials.

Every primitive is a rigid frame (`origin`, `rotation` whose rows are the local axes in world coordinates) and a few
sizes. The ray caster transforms a ray into that frame and meets a canonical shape there, and the solid texture is
evaluated at the local point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


class Kind(IntEnum):
    """Canonical shapes, in local coordinates."""

    RECTANGLE = 0  # z = 0, |x| <= size[0], |y| <= size[1]
    DISC = 1  # z = 0, x^2 + y^2 <= size[0]^2
    BOX = 2  # |x| <= size[0], |y| <= size[1], |z| <= size[2]
    CYLINDER = 3  # radius size[0], 0 <= z <= size[1], closed at both ends
    ELBOW = 4  # torus arc about z: ring size[0], tube size[1], +-size[2] radians about local y


@dataclass(frozen=True)
class Material:
    """A solid texture and how it takes light; colours are linear, lengths in metres.

    `mottle` and `speckle` are relative changes of the albedo, `cell` the size of the coarsest mottle, `stretch`
    lengthens the texture along the local z axis (brushed or drawn metal). `mirror` is the share of the room's light
    that it mirrors when seen face on, `metal` how much what it mirrors takes its colour (0: dielectric, 1: metal).
    """

    name: str
    colour: tuple[float, float, float]
    mottle: float = 0.5
    cell: float = 0.35
    octaves: int = 7
    persistence: float = 0.75
    speckle: float = 0.45
    speckle_cell: float = 0.035
    stretch: float = 1.0
    specular: float = 0.0
    shininess: float = 20.0
    period: float = 0.0
    mirror: float = 0.0
    metal: float = 0.0

    def row(self) -> list[float]:
        """The material as the renderer's flat row."""
        return [
            *self.colour,
            self.mottle,
            self.cell,
            float(self.octaves),
            self.persistence,
            self.speckle,
            self.speckle_cell,
            self.stretch,
            self.specular,
            self.shininess,
            self.period,
            self.mirror,
            self.metal,
        ]


@dataclass(frozen=True)
class Primitive:
    """One solid: local frame, sizes, material; `pipe` is the index of the true pipe it is the barrel of, or -1."""

    kind: Kind
    origin: FloatArray
    rotation: FloatArray
    size: tuple[float, ...]
    material: Material
    pipe: int = -1
    bounds: tuple[FloatArray, FloatArray] = field(init=False)

    def __post_init__(self) -> None:
        low, high = _local_bounds(self.kind, self.size)
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        world = corners @ self.rotation + self.origin
        # A flat shape needs a box of some thickness for the slab test.
        object.__setattr__(self, "bounds", (world.min(0) - 1e-6, world.max(0) + 1e-6))

    def row(self) -> list[float]:
        """The geometry as the ray caster's flat row: origin, rotation rows, sizes padded to four."""
        return [*self.origin, *self.rotation.ravel(), *self.size, *([0.0] * (4 - len(self.size)))]


def _local_bounds(kind: Kind, size: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    if kind == Kind.RECTANGLE:
        high = np.array([size[0], size[1], 0.0])
        return -high, high
    if kind == Kind.DISC:
        high = np.array([size[0], size[0], 0.0])
        return -high, high
    if kind == Kind.BOX:
        high = np.array(size[:3])
        return -high, high
    if kind == Kind.CYLINDER:
        radius, length = size[:2]
        return np.array([-radius, -radius, 0.0]), np.array([radius, radius, length])
    ring, tube, half = size[:3]
    x = (ring + tube) * (math.sin(half) if half < math.pi / 2 else 1.0)
    bottom = (ring - tube if half < math.pi / 2 else ring + tube) * math.cos(half)
    # The end discs of the arc reach beyond the arc's chord by no more than the tube.
    return np.array([-x - tube, bottom - tube, -tube]), np.array([x + tube, ring + tube, tube])


def unit(vector: ArrayLike) -> FloatArray:
    """The vector scaled to length 1."""
    v = np.asarray(vector, float)
    return v / np.linalg.norm(v)


def frame(z: ArrayLike, hint: ArrayLike = (0.0, 0.0, 1.0)) -> FloatArray:
    """Rotation whose rows are x, y, z with the given z and y as near to `hint` as can be."""
    w = unit(z)
    h = np.asarray(hint, float)
    if abs(unit(h) @ w) > 0.99:
        h = np.array([0.0, 1.0, 0.0]) if abs(w[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    y = unit(h - (h @ w) * w)
    return np.array([np.cross(y, w), y, w])


def rectangle(centre: ArrayLike, normal: ArrayLike, width: float, height: float, material: Material) -> Primitive:
    """Rectangle with `height` along the direction nearest to world z."""
    return Primitive(Kind.RECTANGLE, np.asarray(centre, float), frame(normal), (width / 2, height / 2), material)


def disc(centre: ArrayLike, normal: ArrayLike, radius: float, material: Material) -> Primitive:
    """Flat disc."""
    return Primitive(Kind.DISC, np.asarray(centre, float), frame(normal), (radius,), material)


def box(low: ArrayLike, high: ArrayLike, material: Material, yaw: float = 0.0) -> Primitive:
    """Box spanning two corners, turned by `yaw` about the vertical through its centre."""
    a, b = np.asarray(low, float), np.asarray(high, float)
    c, s = math.cos(yaw), math.sin(yaw)
    rotation = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return Primitive(Kind.BOX, (a + b) / 2, rotation, tuple((b - a) / 2), material)


def cylinder(start: ArrayLike, end: ArrayLike, radius: float, material: Material, pipe: int = -1) -> Primitive:
    """Cylinder with flat ends, open like a pipe's as far as the texture can show it."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    return Primitive(Kind.CYLINDER, a, frame(b - a), (radius, float(np.linalg.norm(b - a))), material, pipe)


def bend_tangent(arriving: ArrayLike, leaving: ArrayLike, bend_radius: float) -> float:
    """Distance from the corner of two axes to where the bend of that radius begins on each."""
    angle = math.acos(float(np.clip(unit(arriving) @ unit(leaving), -1.0, 1.0)))
    return bend_radius * math.tan(angle / 2)


def elbow(
    corner: ArrayLike, arriving: ArrayLike, leaving: ArrayLike, radius: float, bend_radius: float, material: Material
) -> Primitive:
    """Bend of tube `radius` about the corner where an axis arrives along one direction and leaves along another."""
    u, v = unit(arriving), unit(leaving)
    half = math.acos(float(np.clip(u @ v, -1.0, 1.0))) / 2
    inward = unit(v - u)
    centre = np.asarray(corner, float) + inward * bend_radius / math.cos(half)
    rotation = np.array([unit(u + v), -inward, np.cross(unit(u + v), -inward)])
    return Primitive(Kind.ELBOW, centre, rotation, (bend_radius, radius, half), material)
