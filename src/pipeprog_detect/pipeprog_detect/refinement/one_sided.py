# SPDX-License-Identifier: Apache-2.0
"""Pipes of a rack of which one side is hidden by a neighbour: what the cloud knows takes the place of that side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder

# An edge of texture agrees with a contour by chance in two views.
MIN_VIEWS = 3


@dataclass(frozen=True)
class SeenArc:
    """What a cloud shows of a cylinder: `arc` [rad] of its circumference, its surface known to `sigma` [m].

    The error of stereo is common to all of an arc, so that `sigma` does not fall with the number of points.
    """

    arc: float
    sigma: float

    @property
    def half(self) -> float:
        """Half of the arc that is towards the viewer [rad]."""
        return 0.5 * min(self.arc, float(np.pi))

    def middle(self, side: float) -> FloatArray:
        """Unit vector (2,) along a scene's basis, from the axis to the arc's middle; the viewer is at -basis[1]."""
        return np.array([side * np.cos(self.half), -np.sin(self.half)])


def only_visible_side(scene: Scene) -> float | None:
    """-1 or 1, along the scene's `basis[0]`: the side of the only visible contour line; None where there are two."""
    samples = scene.samples()
    if samples.shows_both_sides() or len(np.unique(samples.view)) < MIN_VIEWS:
        return None
    return float(np.sign(samples.jacobian[:, 0].sum()))


def with_radius(scene: Scene, seen: SeenArc, radius: float) -> Cylinder:
    """The scene's cylinder with another radius [m]: where only one side is visible, its surface stays where it is."""
    cylinder, side = scene.cylinder, only_visible_side(scene)
    offset = np.zeros(3) if side is None else (cylinder.radius - radius) * seen.middle(side) @ scene.basis
    return Cylinder(cylinder.start + offset, cylinder.end + offset, radius)


def arc_precision(seen: SeenArc, side: float) -> FloatArray:
    """(5, 5) precision [1/m^2] that an arc from `side` (-1 or 1) towards the viewer gives the step of `Scene.moved`.

    Where the surface is seen it is known to sigma; with half of the arc as a, the radius follows from its sagitta, to
    sigma / (1 - cos a), and where the axis lies across its middle from its ends, to sigma / sin a.
    """
    half, middle = seen.half, seen.middle(side)
    across = np.array([-middle[1], middle[0]])
    rows = np.zeros((5, 5))
    for number, end in enumerate((slice(0, 2), slice(2, 4))):
        rows[2 * number, end], rows[2 * number, 4] = middle, 1.0
        rows[2 * number + 1, end] = np.sin(half) * across
    rows[4, 4] = 1.0 - np.cos(half)
    rows /= seen.sigma
    return rows.T @ rows
