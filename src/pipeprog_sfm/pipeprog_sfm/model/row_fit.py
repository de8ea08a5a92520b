# SPDX-License-Identifier: Apache-2.0
"""What the rows of a view with a rolling shutter tell of its motion: features beside known points, each at its time."""

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


@dataclass
class ViewRows:
    """Known points beside the features that show them.

    Attributes:
        inside: (K, 3) points in the camera's frame at the stamp; they move with its pose.
        rays: (K, 2) normalised image coordinates of the features as measured.
        times: (K,) when their rows are exposed, s after the stamp.
        focal: (2,) focal lengths, px.
        noise: of a feature, px.
    """

    inside: FloatArray
    rays: FloatArray
    times: FloatArray
    focal: FloatArray
    noise: float

    @staticmethod
    def of(inside: FloatArray, keyframe: Keyframe, features: IntArray, noise: float, motion: RowMotion) -> ViewRows:
        """Of points (K, 3) in the camera's frame and the features (K,) that show them; those behind it are left out.

        The times of rows are those of the motion's read-out.
        """
        ahead = inside[:, 2] > 0
        camera = keyframe.camera
        measured = keyframe.measured[features[ahead]].astype(np.float64)
        times = motion.row_times(camera.distort_points(measured)[:, 1])
        rays = (measured - [camera.cx, camera.cy]) / keyframe.focal
        return ViewRows(inside[ahead], rays, times, keyframe.focal, noise)

    @property
    def are_enough(self) -> bool:
        """Whether they tell a motion."""
        return len(self.inside) >= MIN_POINTS

    @property
    def depth(self) -> float:
        """Median depth of the points."""
        return float(np.median(self.inside[:, 2]))

    def normal_equations(self, motion: RowMotion, bends: bool) -> tuple[FloatArray, FloatArray]:
        """(U, U) information, and (U,) its product with the step to what fits best, with robust weights.

        Unknowns: turn and shift of the pose, changes of the angular and the linear velocity and, with `bends`, of the
        accelerations. The columns of the velocity are those of the pose times the row's time t, those of the
        acceleration times t^2 / 2.
        """
        blocks = 3 if bends else 2
        return _normal_equations(self.inside, self.rays, self.times, motion.rates, self.focal, self.noise, blocks)

    def move(self, turn_and_shift: FloatArray) -> None:
        """Goes on with another pose, from this one by (6,)."""
        self.inside = self.inside @ rotation_from_vector(turn_and_shift[None, :3])[0].T + turn_and_shift[3:]

    def step_size(self, step: FloatArray, information: FloatArray) -> float:
        """Root mean square over the features, px, of what a step (U,) of all unknowns moves."""
        return float(self.noise * np.sqrt(step @ information @ step / len(self.inside)))


def fit_rows(rows: ViewRows, prior: RowMotion, sigma: float) -> RowMotion:
    """The motion that fits a view's points best, with another one as the prior and the pose as it may be.

    Where the prior is off by much, its rows are too, and count little by their robust weights: one step is not enough.
    With fewer than MIN_POINTS it is the prior.

    Args:
        rows: of the view; they go on with its pose.
        prior: motion expected; its accelerations are kept.
        sigma: standard deviation of its velocities, rad/s, and depths of the scene per second.
    """
    if not rows.are_enough:
        return prior
    held = np.repeat([1.0, 1.0 / rows.depth**2], 3) / sigma**2
    moved = np.zeros(6)
    fitted = prior
    for _ in range(MAX_STEPS):
        information, pull = rows.normal_equations(fitted, bends=False)
        normal = information.copy()
        normal[range(6, 12), range(6, 12)] += held
        pull[6:] -= held * moved
        step: FloatArray = np.asarray(np.linalg.solve(normal, pull), np.float64)
        rows.move(step[:6])
        moved += step[6:]
        fitted = replace(prior, angular=prior.angular + moved[:3], linear=prior.linear + moved[3:])
        if rows.step_size(step, information) < CONVERGED:
            break
    return fitted


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
