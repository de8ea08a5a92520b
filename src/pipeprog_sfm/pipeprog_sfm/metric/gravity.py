# SPDX-License-Identifier: Apache-2.0
"""The direction up, from an accelerometer beside the camera."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.metric.map_frame import Vertical

STANDARD_GRAVITY = 9.80665  # m/s^2
MAX_DEVIATION = 0.5  # m/s^2: gravity varies by 0.05 over the Earth, the bias of cheap accelerometers by 0.3
MIN_SECONDS = 2.0  # s; three steps of a walk, over which its accelerations average out
MIN_SAMPLES = 10
MAX_GAP = 0.2  # of the whole time, without any sample


class GravityError(Exception):
    """The accelerations give no vertical; the text says why."""


def gravity(
    stamps: NDArray[np.int64], forces_in_camera: FloatArray, poses: Mapping[int, FloatArray], scale: float
) -> Vertical:
    """Up in the model, from the weighted mean of specific forces along the way, less the camera's own acceleration.

    With weights t (T - t) the mean of the camera's accelerations follows from its positions, which the model has: it
    is 12 / T^2 times the midpoint of the first and last position less the mean position (integration by parts, twice).

    Args:
        stamps: (K,) of the accelerations [ns].
        forces_in_camera: (K, 3) specific forces along the axes of the camera's optical frame, m/s^2.
        poses: (4, 4) camera_from_model by stamp, in order of time.
        scale: metres per model unit.

    Raises:
        GravityError: too few accelerations, or of a wrong unit.
    """
    times = np.array(list(poses), np.int64)
    seconds = (times - times[0]) * 1e-9
    inside = (stamps >= times[0]) & (stamps <= times[-1])
    at, forces = (stamps[inside] - times[0]) * 1e-9, forces_in_camera[inside]
    whole = float(seconds[-1])
    if whole < MIN_SECONDS or len(at) < MIN_SAMPLES or np.diff(np.r_[0.0, np.sort(at), whole]).max() > MAX_GAP * whole:
        raise GravityError("the accelerations of the IMU do not cover the keyframes: record them all the way")
    if not (np.diff(seconds) > 0).all():
        raise GravityError(f"keyframes are {whole:.0f} s apart, and others at one moment: check the camera's clock")
    stack = np.stack(list(poses.values()))
    model_from_camera = Slerp(seconds, Rotation.from_matrix(stack[:, :3, :3].transpose(0, 2, 1)))
    order = np.argsort(at, kind="stable")
    at, forces = at[order], model_from_camera(at[order]).apply(forces[order])
    # Samples may come in bursts: each is weighted by the time around it.
    edges = np.r_[0.0, 0.5 * (at[1:] + at[:-1]), whole]
    weight = at * (whole - at) * np.diff(edges)
    felt = weight @ forces / weight.sum()
    centres = -scale * np.einsum("nji,nj->ni", stack[:, :3, :3], stack[:, :3, 3])
    mean_place = (0.5 * (centres[1:] + centres[:-1]) * np.diff(seconds)[:, None]).sum(0) / whole
    up = felt - 12.0 / whole**2 * (0.5 * (centres[0] + centres[-1]) - mean_place)
    size = float(np.linalg.norm(up))
    if not abs(size - STANDARD_GRAVITY) <= MAX_DEVIATION:
        raise GravityError(
            f"the IMU feels {size:.2f} m/s^2 on average, not {STANDARD_GRAVITY:.2f}: check its unit and its transform"
        )
    return Vertical(up / size, "IMU")
