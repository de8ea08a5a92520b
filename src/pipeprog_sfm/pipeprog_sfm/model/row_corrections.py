# SPDX-License-Identifier: Apache-2.0
"""How the rows of many views together correct the velocities of a spline: in what changes from view to view alone.

Each view's rows tell its velocity to some 0.01 m/s, but errors that change slowly along the walk bend the scene at no
cost to any image (Albl, Sugimoto, Pajdla, ECCV 2016). A spline is right there: the way between two poses is known, and
so is the mean velocity on it. What it does not know is how the velocity changes from one pose to the next.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_sfm.model.row_fit import RowFit

# Weights of the mean that is slow: of a velocity that alternates from view to view nothing is left (cos^4 of pi times
# the frequency, in cycles per view).
WINDOW = np.array([1.0, 4.0, 6.0, 4.0, 1.0])
# rad/s and depths of the scene per second, of that mean of the spline's error, by the poses of generated walks every
# 0.2 s: 0.0001 at 0.75 m/s, at 1.4 m/s with turns of 0.4 m radius 0.0005, where poses known to 0.2 mm leave 0.0003.
SLOW_SIGMA = 5e-4
# rad/s and depths of the scene per second, by which the spline is off at least from view to view: 6 % of the velocity
# of a hand that sways by 0.004 rad at 1.7 Hz, between poses 0.2 s apart.
SPLINE_SIGMA = 0.003
# Degrees of freedom of Student's t, the distribution of the spline's errors: a walk is smooth but for its turns. At
# 1.4 m/s their mean square is five times that of normal errors with their median; above two freedoms it is finite.
# After four rounds of weights the errors of the unit tests have settled to 1e-5.
FREEDOM, ROUNDS = 2.0, 4
# Standard deviations, as the median of all has it, by which what rows tell differs from the spline where that is wrong:
# with six numbers of each of 100 views, by chance in one trajectory of 25.
CONTRADICTED = 4.0
NORMAL_SPREAD = 1.4826  # standard deviations of a normal distribution in its median absolute deviation


def corrections(fits: Sequence[RowFit], times: FloatArray, rotations: FloatArray, off: FloatArray) -> FloatArray:
    """(N, 6) changes of the spline's velocities in N >= 5 views: what rows tell, with means over WINDOW held to zero.

    Where rows contradict that for a window, as at a jerk, which is to one side alone, they decide.

    Args:
        fits: of views in order of time, with the spline's motion as the prior.
        times: (N,) of the views, s.
        rotations: (N, 3, 3) camera_from_model.
        off: (N,) by how much the spline is off besides, also on average, rad/s and depths of the scene per second.
    """
    units = np.sqrt([fit.precision for fit in fits])
    moved = np.array([fit.moved for fit in fits])
    spread = NORMAL_SPREAD * np.median(units * np.abs(moved), axis=0)
    noise = np.median([fit.precision * np.diag(np.linalg.inv(fit.posterior)) for fit in fits], axis=0)
    sigmas = np.hypot(np.sqrt(np.maximum(spread**2 - noise, SPLINE_SIGMA**2)), off[:, None])

    # Each view stands for the time half way to its neighbours.
    windows = sliding_window_view(np.arange(len(fits)), len(WINDOW))
    weights = WINDOW * np.gradient(times)[windows]
    weights /= weights.sum(axis=1, keepdims=True)
    slow_sigmas = np.hypot(SLOW_SIGMA, (weights * off[windows]).sum(axis=1))
    means = _means(windows, weights, units, rotations)
    noise_of_means = noise * (weights**2).sum(axis=1, keepdims=True)
    apart = np.abs(means @ moved.ravel()).reshape(-1, 6) / np.sqrt(slow_sigmas[:, None] ** 2 + noise_of_means)
    slow = scipy.sparse.diags(np.repeat(~contradicted(apart) / slow_sigmas, 6)) @ means

    rows = scipy.sparse.block_diag([fit.information for fit in fits]) + slow.T @ slow
    told = np.concatenate([fit.posterior @ fit.moved for fit in fits])
    trust = np.ones((len(fits), 1))
    changes = np.zeros((len(fits), 6))
    for _ in range(ROUNDS):
        spline = scipy.sparse.diags((trust * (units / sigmas) ** 2).ravel())
        changes = scipy.sparse.linalg.spsolve((rows + spline).tocsc(), told).reshape(-1, 6)
        trust = (FREEDOM + 6.0) / (FREEDOM + ((changes * units / sigmas) ** 2).sum(axis=1, keepdims=True))
    return changes


def contradicted(apart: FloatArray) -> NDArray[np.bool_]:
    """(N,) whether any of (N, 6) differences [standard deviations, not negative] is beyond most others of its kind."""
    return np.asarray((apart > CONTRADICTED * NORMAL_SPREAD * np.median(apart, axis=0)).any(axis=1))


def _means(windows: IntArray, weights: FloatArray, units: FloatArray, rotations: FloatArray) -> scipy.sparse.coo_matrix:
    """(6 W, 6 N) from velocities of N views to their means over windows (W, 5), in the frame of the middle view."""
    middle = windows[:, len(WINDOW) // 2]
    turns = rotations[middle, None] @ rotations[windows].swapaxes(2, 3)
    of_parts = weights[..., None] * units[middle][:, None, [0, 3]]  # angular and linear
    blocks = of_parts[..., None, None] * turns[:, :, None]
    part, row, column = np.ogrid[:2, :3, :3]
    rows = 6 * np.arange(len(windows))[:, None, None, None, None] + 3 * part + row
    columns = 6 * windows[..., None, None, None] + 3 * part + column
    places = (np.broadcast_to(place, blocks.shape).ravel() for place in (rows, columns))
    return scipy.sparse.coo_matrix((blocks.ravel(), tuple(places)), shape=(6 * len(windows), 6 * len(units)))
