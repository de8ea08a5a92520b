# SPDX-License-Identifier: Apache-2.0
"""The result of a cylinder's refinement by its apparent contour, with its standard deviations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.refinement.contour_adjustment import MODEL_ERROR, ROBUST, AdjustedCylinder, flatness
from pipeprog_detect.refinement.pipe_ends import End
from pipeprog_detect.types import Cylinder

# Where the contour is not seen, edges of texture take its place, spread evenly within the robust loss [px].
CLUTTER_ERROR = ROBUST / np.sqrt(3.0)
# Flatness is 0 for a cylinder and 1 for a strip: one that is beyond the middle by two standard deviations is surely so.
FLAT, SURELY = 0.5, 2.0


@dataclass(frozen=True)
class ContourFit:
    """A cylinder measured by its apparent contour.

    Attributes:
        cylinder: the cylinder.
        across: (2, 3) unit vectors across the axis, sideways as the views see it and away from them.
        covariance: (5, 5) of the axis' offset at its middle (2) [m], its direction (2) [rad] and the radius [m], both
            along `across`.
        radius_sigma: standard deviation of the radius [m].
        support: share (0 to 1) of the visible contour with an edge in three views or more.
        log_odds: logarithm of how much more probable its edges are on a pipe there than on texture.
        views: number of views used.
        rims: evidence for an end rim at the start and at the end (`pipe_ends.End.odds`).
        flatness: 0 for a cylinder, whose contour keeps its distance from the axis from all sides; 1 for a painted strip
            or a joint, whose edges stay where they are.
        flatness_sigma: its standard deviation.
        blur: of the images there [px].
    """

    cylinder: Cylinder
    across: FloatArray
    covariance: FloatArray
    radius_sigma: float
    support: float
    log_odds: float
    views: int
    rims: tuple[float, float]
    flatness: float
    flatness_sigma: float
    blur: float = float("nan")

    @property
    def is_flat(self) -> bool:
        """Whether the views surely show a flat strip."""
        return self.flatness - FLAT > SURELY * self.flatness_sigma

    @property
    def is_round(self) -> bool:
        """Whether the views surely show no flat strip: they see it from sides that differ enough."""
        return FLAT - self.flatness > SURELY * self.flatness_sigma

    def on(self, piece: Cylinder) -> ContourFit:
        """The fit of another piece of the same axis: away from the middle of its own the axis is known less."""
        shift = float((piece.middle - self.cylinder.middle) @ self.cylinder.axis)
        moved = np.eye(5)
        moved[0:2, 2:4] = shift * np.eye(2)
        return replace(self, cylinder=piece, covariance=moved @ self.covariance @ moved.T)


def contour_fit(found: AdjustedCylinder, ends: tuple[End | None, End | None]) -> ContourFit:
    """The adjusted cylinder between its `ends` (None: as it is), with what is known of its errors."""
    cylinder = found.cylinder
    length, axis = cylinder.length, cylinder.axis
    start, end = ends
    measured = Cylinder(
        cylinder.start - (start.position if start else 0.0) * axis,
        cylinder.end + (end.position if end else 0.0) * axis,
        cylinder.radius,
    )
    middle = float(cylinder.along(measured.middle[None])[0]) / length  # share of the way from start to end
    from_ends = np.zeros((5, 5))
    from_ends[0:2, 0:2], from_ends[0:2, 2:4] = (1.0 - middle) * np.eye(2), middle * np.eye(2)
    from_ends[2:4, 0:2] = -np.eye(2) / length
    from_ends[2:4, 2:4] = np.eye(2) / length
    from_ends[4, 4] = 1.0
    systematic = np.hypot(MODEL_ERROR, CLUTTER_ERROR * (1.0 - found.share)) / float(np.median(found.samples.gain))
    covariance = from_ends @ (found.covariance + systematic**2 * np.eye(5)) @ from_ends.T
    return ContourFit(
        measured,
        found.scene.basis,
        covariance,
        float(np.sqrt(covariance[4, 4])),
        found.share,
        found.log_odds,
        len(np.unique(found.samples.view[found.used])),
        (start.odds if start else 0.0, end.odds if end else 0.0),
        *flatness(found),
        found.scene.blur,
    )
