# SPDX-License-Identifier: Apache-2.0
"""How a view with a rolling shutter moves by its own rows: the velocity that fits its features beside known points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.model.bundle_adjustment import RAYLEIGH_MEDIAN, rotation_from_vector

MAX_STEPS = 10  # of Gauss-Newton: it converges in three to six
CONVERGED = 0.01  # px, root mean square of a step over the points, a thirtieth of their noise
MIN_POINTS = 50  # of a view, from which its own rows tell its velocity: twelve unknowns, and some wrong points


@dataclass(frozen=True)
class RowFit:
    """The motion that fits a view's rows best, with another one as the prior.

    Attributes:
        prior: motion expected.
        moved: (6,) by how much the one that fits differs, angular (rad/s) and linear (units of the model per second).
        information: (6, 6) of the rows on these.
        precision: (6,) of the prior, for a standard deviation of one.
        sigma: the prior's standard deviation, rad/s, and depths of the scene per second.
    """

    prior: RowMotion
    moved: FloatArray
    information: FloatArray
    precision: FloatArray
    sigma: float

    @property
    def motion(self) -> RowMotion:
        """The one that fits."""
        return _changed(self.prior, self.moved)

    @property
    def sigmas(self) -> FloatArray:
        """(6,) standard deviations of its velocities if there were no prior; infinite where too few rows tell them."""
        if not self.information.any():
            return np.full(6, np.inf)
        return np.sqrt(np.diag(np.linalg.pinv(self.information)))

    def held_to(self, sigma: float) -> RowMotion:
        """The one that fits best with another standard deviation of the prior."""
        wide, narrow = (self.information + np.diag(self.precision / each**2) for each in (self.sigma, sigma))
        return _changed(self.prior, np.asarray(np.linalg.solve(narrow, wide @ self.moved), np.float64))


def fit_rows(
    inside: FloatArray, keyframe: Keyframe, features: IntArray, noise: float, prior: RowMotion, sigma: float
) -> RowFit:
    """The motion that fits a view's points best, with another one as the prior and the pose as it may be.

    Gauss-Newton steps for pose and velocity, twelve unknowns: the columns of the velocity are those of the pose times
    the row's time. Where the prior is off by much, its rows are too, and count little by their robust weights: one step
    is not enough. With fewer than MIN_POINTS it is the prior.

    Args:
        inside: (K, 3) points in the camera's frame.
        keyframe: of the view.
        features: (K,) its features that show them.
        noise: of a feature, px.
        prior: motion expected.
        sigma: standard deviation of its velocities, rad/s, and depths of the scene per second.
    """
    ahead = inside[:, 2] > 0
    features, inside = features[ahead], inside[ahead]
    if len(features) < MIN_POINTS:
        return RowFit(prior, np.zeros(6), np.zeros((6, 6)), np.ones(6), sigma)
    camera = keyframe.camera
    measured = keyframe.measured[features].astype(np.float64)
    times = prior.row_times(camera.distort_points(measured)[:, 1])[:, None, None]
    precision = np.repeat([1.0, 1.0 / float(np.median(inside[:, 2])) ** 2], 3)
    moved = np.zeros(6)
    fitted = prior
    for _ in range(MAX_STEPS):
        x, y, z = inside.T
        shown = np.c_[camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy]
        error = fitted.unrolled_pixels(measured, z, camera) - shown
        by_point = np.zeros((len(z), 2, 3))
        by_point[:, 0, 0], by_point[:, 1, 1] = camera.fx / z, camera.fy / z
        by_point[:, 0, 2], by_point[:, 1, 2] = -camera.fx * x / z**2, -camera.fy * y / z**2
        by_pose = np.concatenate([np.cross(inside[:, None], by_point), by_point], axis=2)
        rows = np.concatenate([by_pose, times * by_pose], axis=2).reshape(-1, 12)
        weights = 1.0 / (1.0 + (error**2).sum(axis=1) / (RAYLEIGH_MEDIAN * noise) ** 2) / noise**2
        weighted = (np.repeat(weights, 2)[:, None] * rows).T
        information = weighted @ rows
        normal = information.copy()
        normal[np.arange(6, 12), np.arange(6, 12)] += precision / sigma**2
        pull = weighted @ error.ravel()
        pull[6:] -= precision / sigma**2 * moved
        change = np.linalg.solve(normal, pull)
        inside = inside @ rotation_from_vector(change[None, :3])[0].T + change[3:6]
        moved += change[6:]
        fitted = _changed(prior, moved)
        if np.sqrt(2.0 * ((rows @ change) ** 2).mean()) < CONVERGED:
            break
    of_pose, both, of_velocity = information[:6, :6], information[:6, 6:], information[6:, 6:]
    return RowFit(prior, moved, of_velocity - both.T @ np.linalg.solve(of_pose, both), precision, sigma)


def _changed(motion: RowMotion, by: FloatArray) -> RowMotion:
    return replace(motion, angular=motion.angular + by[:3], linear=motion.linear + by[3:])
