# SPDX-License-Identifier: Apache-2.0
"""How a view with a rolling shutter moves by its own rows: what fits its features beside known points best."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_camera.rolling_shutter import RowMotion, unrolled_ray
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.model.bundle_adjustment import RAYLEIGH_MEDIAN, rotation_from_vector

MAX_STEPS = 10  # of Gauss-Newton: it converges in three to six
# px, root mean square of a step over the points, a hundredth of their noise: what the rows hold poorly, a speed towards
# the scene beside a turn, then moves by 0.3 % of itself.
CONVERGED = 0.003
MIN_POINTS = 50  # of a view, from which its own rows tell its motion: up to eighteen unknowns, and some wrong points


@dataclass(frozen=True)
class RowFit:
    """The motion that fits a view's rows best, with another one as the prior.

    Attributes:
        motion: the one that fits.
        moved: (6,) by how much its velocities differ from the prior's, angular (rad/s) and linear (units of the model
            per second).
        information: (6, 6) of the rows on these.
        precision: (6,) of the prior, for a standard deviation of one.
        sigma: the prior's standard deviation, rad/s, and depths of the scene per second.
    """

    motion: RowMotion
    moved: FloatArray
    information: FloatArray
    precision: FloatArray
    sigma: float

    @property
    def sigmas(self) -> FloatArray:
        """(6,) standard deviations of its velocities if there were no prior; infinite where too few rows tell them."""
        if not self.information.any():
            return np.full(6, np.inf)
        return np.sqrt(np.diag(np.linalg.pinv(self.information)))

    @property
    def posterior(self) -> FloatArray:
        """(6, 6) information of rows and prior on the velocities."""
        return self.information + np.diag(self.precision / self.sigma**2)

    def changed(self, by: FloatArray) -> RowMotion:
        """The motion with velocities that differ by (6,) from those of the prior."""
        change = by - self.moved
        return replace(self.motion, angular=self.motion.angular + change[:3], linear=self.motion.linear + change[3:])


def fit_rows(
    inside: FloatArray,
    keyframe: Keyframe,
    features: IntArray,
    noise: float,
    prior: RowMotion,
    sigma: float,
    bend_sigmas: FloatArray | None = None,
) -> RowFit:
    """The motion that fits a view's points best, with another one as the prior and the pose as it may be.

    Gauss-Newton steps for pose, velocity and, with `bend_sigmas`, acceleration: the columns of the velocity are those
    of the pose times the row's time t, those of the acceleration times t^2 / 2. Where the prior is off by much, its
    rows are too, and count little by their robust weights: one step is not enough. With fewer than MIN_POINTS it is
    the prior.

    Args:
        inside: (K, 3) points in the camera's frame.
        keyframe: of the view.
        features: (K,) its features that show them.
        noise: of a feature, px.
        prior: motion expected.
        sigma: standard deviation of its velocities, rad/s, and depths of the scene per second.
        bend_sigmas: (2,) of its angular and its linear accelerations, rad/s^2 and units of the model per s^2, where
            they are sought, too.
    """
    ahead = inside[:, 2] > 0
    features, inside = features[ahead], inside[ahead]
    if len(features) < MIN_POINTS:
        return RowFit(prior, np.zeros(6), np.zeros((6, 6)), np.ones(6), sigma)
    camera = keyframe.camera
    measured = keyframe.measured[features].astype(np.float64)
    times = prior.row_times(camera.distort_points(measured)[:, 1])
    rays = (measured - [camera.cx, camera.cy]) / keyframe.focal
    precision = np.repeat([1.0, 1.0 / float(np.median(inside[:, 2])) ** 2], 3)
    held = precision / sigma**2
    if bend_sigmas is not None and bend_sigmas.all():  # two poses tell no acceleration
        held = np.concatenate([held, np.repeat(1.0 / bend_sigmas**2, 3)])
    moved = np.zeros(len(held))
    fitted = prior
    for _ in range(MAX_STEPS):
        sums, pull = _normal_equations(inside, rays, times, fitted.rates, keyframe.focal, noise, 1 + len(held) // 6)
        information = sums.copy()
        information[range(12, 6 + len(held)), range(12, 6 + len(held))] += held[6:]
        normal = information.copy()
        normal[range(6, 12), range(6, 12)] += held[:6]
        pull[6:] -= held * moved
        change = np.linalg.solve(normal, pull)
        inside = inside @ rotation_from_vector(change[None, :3])[0].T + change[3:6]
        moved += change[6:]
        fitted = _changed(prior, moved)
        if noise * np.sqrt(change @ sums @ change / len(inside)) < CONVERGED:
            break
    own = np.r_[6:12]
    other = np.setdiff1d(np.arange(len(information)), own)
    both = information[np.ix_(other, own)]
    of_velocity = information[np.ix_(own, own)] - both.T @ np.linalg.solve(information[np.ix_(other, other)], both)
    return RowFit(fitted, moved[:6], of_velocity, precision, sigma)


def _changed(motion: RowMotion, by: FloatArray) -> RowMotion:
    """With other velocities and, where (12,) are given, accelerations."""
    turn, shift, twist, bend = np.concatenate([by, np.zeros(12 - len(by))]).reshape(4, 3)
    return replace(
        motion,
        angular=motion.angular + turn,
        linear=motion.linear + shift,
        angular_acceleration=motion.angular_acceleration + twist,
        linear_acceleration=motion.linear_acceleration + bend,
    )


@njit(cache=True, nogil=True)
def _normal_equations(inside, rays, times, rates, focal, noise, blocks):  # type: ignore[no-untyped-def]  # compiled
    """(6 blocks, 6 blocks) sums of the weighted rows' products, and (6 blocks,) of these with the residuals.

    A row is that of a pixel of a point (K, 3), by pose, velocity and acceleration (turn and shift each). The columns
    are those of the pose times 1, t and t^2 / 2, and so sums of the pose's alone, times powers of t, tell all.
    """
    products = np.zeros((2 * blocks - 1, 36))  # of the pose's columns, times t to the power of 0, 1, ...
    pulls = np.zeros((blocks, 6))
    across, down, product = np.empty(6), np.empty(6), np.empty(36)
    for k in range(len(inside)):
        x, y, z = inside[k]
        u, v, time = x / z, y / z, times[k]
        ray_x, ray_y = unrolled_ray(rays[k, 0], rays[k, 1], time, z, rates)
        right, below = (ray_x - u) * focal[0], (ray_y - v) * focal[1]
        weight = 1.0 / (1.0 + (right * right + below * below) / (RAYLEIGH_MEDIAN * noise) ** 2) / noise**2
        fx, fy = focal[0] / z, focal[1] / z
        across[0], across[1], across[2] = -fx * u * y, fx * (z + u * x), -fx * y
        across[3], across[4], across[5] = fx, 0.0, -fx * u
        down[0], down[1], down[2] = -fy * (z + v * y), fy * v * x, fy * x
        down[3], down[4], down[5] = 0.0, fy, -fy * v
        for i in range(6):
            for j in range(6):
                product[6 * i + j] = weight * (across[i] * across[j] + down[i] * down[j])
        power = 1.0
        for n in range(2 * blocks - 1):
            for i in range(36):
                products[n, i] += power * product[i]
            if n < blocks:
                for i in range(6):
                    pulls[n, i] += power * weight * (across[i] * right + down[i] * below)
            power *= time
    sums, pull = np.empty((6 * blocks, 6 * blocks)), np.empty(6 * blocks)
    for first in range(blocks):
        scale = 0.5 if first == 2 else 1.0
        pull[6 * first : 6 * first + 6] = scale * pulls[first]
        for second in range(blocks):
            both = 0.5 * scale if second == 2 else scale
            block = both * products[first + second].reshape(6, 6)
            sums[6 * first : 6 * first + 6, 6 * second : 6 * second + 6] = block
    return sums, pull
