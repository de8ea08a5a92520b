# SPDX-License-Identifier: Apache-2.0
"""Velocities and accelerations of a camera by a spline through its poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from pipeprog_camera.arrays import FloatArray

MIN_GAP = 0.02  # s between two knots: poses are known to 0.3 mm, and their difference over it to 0.02 m/s
# A hand sways at up to 1.7 Hz: through poses 0.2 s apart, a cubic one has such a velocity 21 % too low
# (1 - 3 sin(w) / (2 + cos(w)) / w with w = 2 pi 1.7 0.2), one of degree 5 has it 6 % too low.
DEGREE = 5


def spline_rates(stamps: list[int], rotations: FloatArray, centres: FloatArray) -> tuple[FloatArray, ...]:
    """Linear and angular velocities, linear and angular accelerations of the model as its views see it.

    Each (V, 3), in the view's frame, per second; empty where all views lie within MIN_GAP.

    Args:
        stamps: of the V views, ns, ascending.
        rotations: (V, 3, 3) camera_from_model.
        centres: (V, 3) of the cameras, in the model.
    """
    times = (np.array(stamps) - stamps[0]) * 1e-9
    knots = apart(times)
    if len(knots) < 2:
        return (np.empty((0, 3)),) * 4
    turns = _unit_quaternions(rotations.transpose(0, 2, 1))
    degree = DEGREE if len(knots) > 2 else 3  # two poses tell a line
    # A natural spline: one whose ends are free doubles the error of its last velocities.
    ends = [(order, np.zeros(7)) for order in range((degree + 1) // 2, degree)]
    spline = make_interp_spline(times[knots], np.c_[centres, turns][knots], k=degree, bc_type=(ends, ends))
    # R X + s with s = -R c, the centre c and the rotation R of a moment from that of the stamp.
    (linear, angular), (bent, twisted) = (_in_cameras(rotations, turns, spline(times, order)) for order in (1, 2))
    return linear, angular, bent + 2.0 * np.cross(angular, linear), twisted


def _in_cameras(rotations: FloatArray, turns: FloatArray, rates: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(V, 3) of the model beside cameras, linear and angular, from the derivatives (V, 7) of centres and quaternions.

    q' = q w / 2 and, for its part across q, q'' = q w' / 2 with the angular velocity w in the camera's frame; what is
    along q changes its length alone.
    """
    back = Rotation.from_quat(turns).inv().as_matrix()
    own_turn = 2.0 * (back @ _imaginary(turns, rates[:, 3:])[..., None])[..., 0]
    return -np.einsum("vij,vj->vi", rotations, rates[:, :3]), -own_turn


def _unit_quaternions(rotations: FloatArray) -> FloatArray:
    """(V, 4) quaternions x, y, z, w of (V, 3, 3) rotations, each with the sign nearest to the one before."""
    turns = Rotation.from_matrix(rotations).as_quat()
    signs = np.cumprod(np.r_[1.0, np.where((turns[1:] * turns[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)])
    return np.asarray(turns * signs[:, None])


def _imaginary(turns: FloatArray, rates: FloatArray) -> FloatArray:
    """(V, 3) imaginary part of rates times the conjugates of turns, quaternions x, y, z, w (V, 4)."""
    vector, scalar = turns[:, :3], turns[:, 3:]
    return np.asarray(scalar * rates[:, :3] - rates[:, 3:] * vector - np.cross(rates[:, :3], vector))


def apart(times: FloatArray) -> NDArray[np.intp]:
    """Indices of ascending times that are MIN_GAP apart, from the first one."""
    kept: list[int] = []
    for index, time in enumerate(times):
        if not kept or time - times[kept[-1]] >= MIN_GAP:
            kept.append(index)
    return np.array(kept, np.intp)
