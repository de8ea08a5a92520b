# SPDX-License-Identifier: Apache-2.0
"""Which camera a survey goes on with: calibration and read-out as they came, or as its own images tell them."""

from __future__ import annotations

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.config import CalibrationConfig
from pipeprog_sfm.model.self_calibration import RADII, TOLERATED_SHIFT, Priors, Refinement, numbers_of

FIRST_CHECK = 6  # keyframes: fewer tie points seen from three sides do not tell k1 to a third of its prior
CHECK_GROWTH = 2  # ratio of the keyframes at two checks while keyframes come: their cost stays a constant share
FINAL_SHIFT = 0.2  # px: a careful calibration with a board is right to this at the image's edge
MAX_BOARD_GROWTH = 1.1  # of a board's misfit, with a better camera: of 20 circles it is known to a tenth
K2_SHARE = 2.0  # standard deviation of k2 over that of k1: it counts half as much where the image's corner has r = 0.7
# Of a focal length, relative standard deviation from which it is a guess. With a rolling shutter, the velocities of few
# keyframes, off by a tenth, look like a k1 of 0.005: a guess is worse than that, a calibration is not.
GUESS = 0.01
UNKNOWN_READOUT = 0.03  # s, standard deviation of a read-out that is not told: phones have up to 0.035
# Of a read-out, the share by which it is off with the velocities, those of a spline through the keyframes: 0.5 % was
# measured with keyframes every 0.2 s, 2 % where some are a second apart.
VELOCITY_ERROR = 0.02
UNDECIDED_READOUT = 0.003  # s, standard deviation above which a phone's read-out, 5 to 30 ms, is not told from 0
RADIAL_LIMIT = 0.15  # px, mean residual of a ring: systematic errors of features reach 0.03


class CameraInUse:
    """Decides on refinements of the one camera of a survey, and says what was found.

    Args:
        config: standard deviations of what is told.
        readout: that is told, s; None where none is.
    """

    def __init__(self, config: CalibrationConfig, readout: float | None = 0.0) -> None:
        self.config = config
        self._told_readout = readout
        relative = config.readout_sigma if readout is not None else 0.0
        sigmas = [config.focal_sigma, config.distortion_sigma, K2_SHARE * config.distortion_sigma]
        self._sigmas = np.array([*(sigmas if config.focal_sigma > 0 else [0.0] * 3), relative * (readout or 0.0)])
        if readout is None:
            self._sigmas[3] = UNKNOWN_READOUT
        self._told: Camera | None = None
        self._accepted: Refinement | None = None
        self._looked: Refinement | None = None
        self._found_sigmas: FloatArray = np.full(4, np.inf)  # of what was accepted, as of `Refinement`
        self._next_check = FIRST_CHECK

    @property
    def refines(self) -> bool:
        """Whether anything of the camera is to be refined."""
        return bool((self._sigmas > 0).any())

    @property
    def refined(self) -> Camera | None:
        """The refined camera, None while the calibration is used as it came."""
        accepted = self._accepted.camera if self._accepted else None
        return accepted if accepted != self._told else None

    @property
    def readout_sigma(self) -> float:
        """Standard deviation of the read-out in use, s: 0 where it is the one told, NaN where it is not known."""
        if self._accepted and self._accepted.readout != (self._told_readout or 0.0):
            return self._readout_sigma(self._accepted)
        if self._told_readout is not None:
            return 0.0
        return self._looked.readout_sigma if self._looked else np.nan

    def of(self, told: Camera) -> Camera:
        """The camera to use for an image that came with this calibration."""
        return self._accepted.camera if self._accepted and told == self._told else told

    def priors(self, used: Camera, waiting: bool = False) -> Priors:
        """What was told of the camera that is used.

        waiting: with a rolling shutter, for the last keyframe: a calibration stays until then, a guess does not.
        """
        told = self._told if self._told and self._accepted and used == self._accepted.camera else used
        stays = waiting and self.config.focal_sigma < GUESS
        return Priors(told, self._told_readout or 0.0, np.where([stays, stays, stays, False], 0.0, self._sigmas))

    def is_due(self, keyframes: int) -> bool:
        """Whether to look at the camera at this number of registered keyframes; True once per check."""
        due = self.refines and keyframes >= self._next_check
        while keyframes >= self._next_check:
            self._next_check *= CHECK_GROWTH
        return due

    def is_better(self, found: Refinement, final: bool) -> bool:
        """Whether the images say that the camera differs, by enough to matter."""
        self._looked = found
        if final and self.refined and np.isfinite(found.sigmas).any():
            return True  # that it differs has been decided, the last images only say it best
        if found.camera == found.told:  # the read-out alone, which is refined where it matters to the poses
            return bool(found.changes[3]) and (final or found.shift > FINAL_SHIFT)
        return found.is_significant and found.shift > (FINAL_SHIFT if final else TOLERATED_SHIFT)

    def accept(self, found: Refinement) -> None:
        """Goes on with a refined camera."""
        self._told = self.priors(found.told).camera
        self._accepted = found
        self._found_sigmas = np.where(np.isfinite(found.sigmas), found.sigmas, self._found_sigmas)

    def description(self) -> str:
        """What was found, empty where all is used as it came."""
        found = self._accepted
        if found is None or self._told is None:
            return ""
        parts = self._calibration_found(found) if self.refined else []
        if found.readout != (self._told_readout or 0.0):
            told = "not told" if self._told_readout is None else f"told {1e3 * self._told_readout:.4g} ms"
            sigma = 1e3 * self._readout_sigma(found)
            parts.append(f"the read-out is {1e3 * found.readout:.2f} ms (sigma {sigma:.2f} ms; {told})")
        return f"calibration refined by the survey: {', '.join(parts)}" if parts else ""

    def readout_warning(self) -> str:
        """That the images do not tell a read-out that was not told; empty where they do."""
        looked = self._looked
        if self._told_readout is not None or looked is None or looked.readout:
            return ""
        if looked.readout_sigma <= UNDECIDED_READOUT:
            return ""
        return (
            "the images do not tell whether the camera has a rolling shutter (they tell its read-out to "
            f"{1e3 * looked.readout_sigma:.0f} ms): give the read-out (sfm.readout, in seconds; 0 for a global "
            "shutter), or turn the phone by 90 degrees for part of the walk"
        )

    def _calibration_found(self, found: Refinement) -> list[str]:
        """By how much focal length, k1 and k2 differ from what was told."""
        assert self._told is not None
        change, sigmas = numbers_of(found.camera) - numbers_of(self._told), self._found_sigmas
        parts = ["the focal length is not told by the images"]
        if np.isfinite(sigmas[0]):
            parts = [f"the focal length differs by {100 * np.expm1(change[0]):+.2f} % (sigma {100 * sigmas[0]:.2f} %)"]
        return parts + [
            f"{name} by {difference:+.4f} (sigma {sigma:.4f})"
            for name, difference, sigma in zip(("k1", "k2"), change[1:], sigmas[1:3], strict=True)
            if np.isfinite(sigma)
        ]

    def _readout_sigma(self, found: Refinement) -> float:
        return float(np.hypot(found.readout_sigma, VELOCITY_ERROR * found.readout))


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
