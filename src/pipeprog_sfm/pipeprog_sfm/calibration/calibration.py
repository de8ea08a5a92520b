# SPDX-License-Identifier: Apache-2.0
"""What a calibration has found, how well, and what to film so that it gets better."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera

COEFFICIENTS = {"plumb_bob": ("k1", "k2", "p1", "p2", "k3"), "equidistant": ("k1", "k2", "k3", "k4")}
GRID = (8, 6)  # cells of the image, of which the share with a circle is the coverage
RINGS = 4  # equal areas of the circle around the image in which residuals are told: the last has its corners alone
GOOD_COVERAGE = 0.7  # of the cells: circles that reach to half a cell from all edges
GOOD_FOCAL = 0.001  # relative standard deviation: what makes 0.1 % of a radius
MIN_GROWTH, GROWTH = 0.05, 2.0  # px, and factor between rings, from which residuals are those of another lens


@dataclass(frozen=True)
class Calibration:
    """A camera that was calibrated.

    Attributes:
        camera: the camera.
        sigmas: standard deviation of fx, fy, cx, cy [px], each distortion coefficient and the read-out [s], by name.
        readout: from the first row to the last, s; 0 where that of a rolling shutter is excluded, None where the
            images do not tell it.
        rms: root mean square length of a residual, px.
        coverage: share of the GRID's cells that a circle was seen in.
        by_radius: (RINGS,) rms of the residuals in rings of equal area around the middle; NaN where none is seen.
        views: images used.
    """

    camera: Camera
    sigmas: dict[str, float]
    readout: float | None
    rms: float
    coverage: float
    by_radius: FloatArray
    views: int

    @property
    def values(self) -> dict[str, float]:
        """The numbers of the camera by the names of `sigmas`; the read-out only where it is told."""
        camera = self.camera
        names = COEFFICIENTS[camera.distortion_model]
        known = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
        known |= dict(zip(names, camera.distortion, strict=True))
        return known if self.readout is None else known | {"readout": self.readout}

    def advice(self) -> list[str]:
        """What to film so that the calibration gets better, in full sentences."""
        found = []
        if self.coverage < GOOD_COVERAGE or np.isnan(self.by_radius[-1]):
            found.append(f"circles were seen in {self.coverage:.0%} of the image: film the corners as well")
        if self.sigmas["fx"] > GOOD_FOCAL * self.camera.fx:
            found.append(
                f"the focal length is known to {self.sigmas['fx'] / self.camera.fx:.2%} only: film the board from "
                "nearer, tilted by up to 45 degrees to all sides"
            )
        outer = self.by_radius[-1]
        if np.isfinite(outer) and outer > GROWTH * max(float(np.nanmin(self.by_radius)), MIN_GROWTH):
            found.append("residuals grow towards the corners: calibrate with the other lens model (--model)")
        if self.readout is None:
            found.append("the images do not tell the read-out: film at 15 images a second or more, in brisk waves")
        return found


def coverage(pixels: FloatArray, camera: Camera) -> float:
    """Share of the GRID's cells that hold one of the (K, 2) pixels."""
    cells = pixels / [camera.width, camera.height] * GRID
    return len(np.unique(np.clip(cells, 0, np.array(GRID) - 1).astype(int), axis=0)) / (GRID[0] * GRID[1])


def rms_by_radius(pixels: FloatArray, lengths: NDArray[np.float64], camera: Camera) -> FloatArray:
    """(RINGS,) root mean square of (K,) lengths in rings of equal area around the middle; NaN without any."""
    size = np.array([camera.width, camera.height])
    share = (np.linalg.norm(pixels - 0.5 * size, axis=1) / (0.5 * np.linalg.norm(size))) ** 2
    ring = np.minimum((RINGS * share).astype(int), RINGS - 1)
    count, squares = np.bincount(ring, minlength=RINGS), np.bincount(ring, lengths**2, minlength=RINGS)
    return np.where(count > 0, np.sqrt(squares / np.maximum(count, 1)), np.nan)
