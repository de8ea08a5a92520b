# SPDX-License-Identifier: Apache-2.0
"""Which camera a survey goes on with: the calibration as it came, or what its own images have made of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.config import CalibrationConfig
from pipeprog_sfm.sparse.self_calibration import RADII, Refinement, numbers_of

FIRST_CHECK = 6  # keyframes: fewer tie points seen from three sides do not tell k1 to a third of its prior
CHECK_GROWTH = 2  # ratio of the keyframes at two checks while keyframes come: their cost stays a constant share
EARLY_SHIFT = 1.0  # px, of a point of the image: below, every match passes the geometric checks, and the end will do
FINAL_SHIFT = 0.2  # px: a careful calibration with a board is right to this at the image's edge
MAX_BOARD_GROWTH = 1.1  # of a board's misfit, with a better camera: of 20 circles it is known to a tenth
RADIAL_LIMIT = 0.15  # px, mean residual of a ring: systematic errors of features reach 0.03


@dataclass(frozen=True)
class _Accepted:
    """A refined camera and the standard deviations (3,) of its log focal length, k1 and k2."""

    camera: Camera
    sigmas: FloatArray


class CameraInUse:
    """Decides on refinements of the one camera of a survey, and says what was found."""

    def __init__(self, config: CalibrationConfig) -> None:
        self.config = config
        self._told: Camera | None = None
        self._accepted: _Accepted | None = None
        self._next_check = FIRST_CHECK

    @property
    def refined(self) -> Camera | None:
        """The refined camera, None while the calibration is used as it came."""
        return self._accepted.camera if self._accepted else None

    def of(self, told: Camera) -> Camera:
        """The camera to use for an image that came with this calibration."""
        return self._accepted.camera if self._accepted and told == self._told else told

    def told(self, used: Camera) -> Camera:
        """The calibration that came with images for which this camera is used."""
        return self._told if self._told and self._accepted and used == self._accepted.camera else used

    def is_due(self, keyframes: int) -> bool:
        """Whether to check the calibration at this number of registered keyframes; True once per check."""
        due = self.config.focal_sigma > 0 and keyframes >= self._next_check
        while keyframes >= self._next_check:
            self._next_check *= CHECK_GROWTH
        return due

    def is_better(self, found: Refinement, final: bool) -> bool:
        """Whether the images say that the camera differs, by enough to matter."""
        if final and self._accepted:  # that it differs has been decided, the last images only say it best
            return True
        return found.is_significant and found.shift > (FINAL_SHIFT if final else EARLY_SHIFT)

    def accept(self, found: Refinement) -> None:
        """Goes on with a refined camera."""
        self._told = self.told(found.told)
        self._accepted = _Accepted(found.camera, found.sigmas)

    def description(self) -> str:
        """What was found, empty where the calibration is used as it came."""
        if self._accepted is None or self._told is None:
            return ""
        change = numbers_of(self._accepted.camera) - numbers_of(self._told)
        sigmas = self._accepted.sigmas
        parts = [f"the focal length differs by {100 * np.expm1(change[0]):+.2f} % (sigma {100 * sigmas[0]:.2f} %)"]
        parts += [
            f"{name} by {difference:+.4f} (sigma {sigma:.4f})"
            for name, difference, sigma in zip(("k1", "k2"), change[1:], sigmas[1:], strict=True)
            if np.isfinite(sigma)
        ]
        if not np.isfinite(sigmas[0]):
            parts[0] = "the focal length is not told by the images"
        return f"calibration refined by the survey: {', '.join(parts)}"


def board_agrees(before: float | None, after: float | None) -> bool:
    """Whether a board's misfit, px (None: no board is placed), lets a refined camera pass."""
    return before is None or (after is not None and after < MAX_BOARD_GROWTH * before)


def radial_warning(residuals: FloatArray) -> str:
    """What residuals that grow with the radius mean, (RADII,) px as of `radial_residuals`; empty where they do not."""
    known = residuals[np.isfinite(residuals)]
    if len(known) < RADII // 2 or np.abs(known).max() < RADIAL_LIMIT:
        return ""
    return (
        f"residuals grow with the distance from the image's centre, to {np.abs(known).max():.2f} px: the lens "
        "distortion differs from its calibration; calibrate the camera again (docs/calibration.md)"
    )
