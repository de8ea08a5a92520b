"""Pipes of a rack that show one outline, the other behind their neighbour: what the cloud knows takes its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import Stations, stations, visible
from pipeprog_detect.types import Cylinder, View

# An edge of texture agrees with an outline by chance in two views.
MIN_VIEWS = 3
# Places of one outline so few beside those of the other are gaps in what hides it.
GAPS = 0.1


@dataclass(frozen=True)
class SeenArc:
    """What a cloud shows of a cylinder: `arc` [rad] of its circumference, its surface known to `sigma` [m].

    Stereo errs alike on all of an arc, so that `sigma` is no smaller for the number of points.
    """

    arc: float
    sigma: float


def lone_limb(
    cylinder: Cylinder, views: Sequence[View], others: Sequence[Cylinder], basis: FloatArray, spacing: float
) -> float | None:
    """Where the only outline lies that the views show beside the `others`: -1 or 1 along `basis[0]`; else None."""
    at = stations(cylinder, views, basis, spacing)
    at = at.select(visible(cylinder, others, views, at))
    if shows_both(at) or len(np.unique(at.view)) < MIN_VIEWS:
        return None
    return float(np.sign(at.jacobian[:, 0].sum()))


def shows_both(at: Stations) -> bool:
    """Whether visible stations lie on both outlines, more of them than gaps in what hides one let through."""
    count = np.bincount(at.side, minlength=2)
    return bool(count.min() > GAPS * count.max())


def precision(seen: SeenArc, limb: float) -> FloatArray:
    """(5, 5) precision [1/m^2] that an arc from the `limb` (-1 or 1) towards the viewer gives `outline.moved`'s step.

    Where the surface is seen it is known to sigma; with half of the arc as a, the radius follows from its sagitta, to
    sigma / (1 - cos a), and where the axis lies across its middle from its ends, to sigma / sin a.
    """
    half = 0.5 * min(seen.arc, np.pi)
    middle = np.array([limb * np.cos(half), -np.sin(half)])  # of the arc, from the axis; the viewer is at -basis[1]
    across = np.array([-middle[1], middle[0]])
    rows = np.zeros((5, 5))
    for number, end in enumerate((slice(0, 2), slice(2, 4))):
        rows[2 * number, end], rows[2 * number, 4] = middle, 1.0
        rows[2 * number + 1, end] = np.sin(half) * across
    rows[4, 4] = 1.0 - np.cos(half)
    rows /= seen.sigma
    return rows.T @ rows
