# SPDX-License-Identifier: Apache-2.0
"""The camera's path: a smooth curve through waypoints at constant speed, and the sway of a hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

FloatArray = NDArray[np.float64]

# A hand: slow sway, gait and tremor; Hz, m, rad. The amplitudes are those of a careful person (option --wobble).
_WOBBLE_HZ = (0.31, 0.83, 1.73)
_WOBBLE_POSITION = (0.020, 0.010, 0.004)
_WOBBLE_ANGLE = (0.030, 0.012, 0.004)


class Walk:
    """Poses along waypoints (x, y, z, yaw, pitch): metres, radians; yaw 0 looks along +y, pitch up is positive.

    With `closed` the walk repeats, else it ends at the last waypoint.
    """

    def __init__(
        self, waypoints: Sequence[Sequence[float]], speed: float, rng: np.random.Generator, closed: bool, wobble: float
    ) -> None:
        points = np.asarray(waypoints, float)
        if closed:
            points = np.vstack([points, points[:1]])
        chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points[:, :3], axis=0), axis=1))])
        self._curve = CubicSpline(chord, points, bc_type="periodic" if closed else "natural")
        dense = np.linspace(0.0, chord[-1], 200 * len(points))
        steps = np.linalg.norm(np.diff(self._curve(dense)[:, :3], axis=0), axis=1)
        self._parameter = dense
        self._travelled = np.concatenate([[0.0], np.cumsum(steps)])
        self._speed = speed
        self._closed = closed
        self._wobble = wobble
        self._phase = rng.uniform(0.0, 2.0 * np.pi, (len(_WOBBLE_HZ), 6))

    @property
    def duration(self) -> float:
        """Seconds from the first waypoint to the last (or round to the first)."""
        return float(self._travelled[-1] / self._speed)

    def poses(self, seconds: ArrayLike) -> FloatArray:
        """(N, 4, 4) world_from_camera (optical frame: x right, y down, z forward) at (N,) times."""
        t = np.atleast_1d(np.asarray(seconds, float))
        distance = t * self._speed
        distance = distance % self._travelled[-1] if self._closed else np.clip(distance, 0.0, self._travelled[-1])
        state = self._curve(np.interp(distance, self._travelled, self._parameter))
        sway = np.sin(2.0 * np.pi * t[:, None, None] * np.array(_WOBBLE_HZ)[:, None] + self._phase)
        amplitude = np.repeat(np.c_[_WOBBLE_POSITION, _WOBBLE_ANGLE], 3, axis=1)
        sway = self._wobble * (sway * amplitude).sum(1)
        position = state[:, :3] + sway[:, :3]
        yaw, pitch = state[:, 3] + sway[:, 3], state[:, 4] + sway[:, 4]
        return look(position, yaw, pitch, sway[:, 5])


def look(position: ArrayLike, yaw: ArrayLike, pitch: ArrayLike, roll: ArrayLike) -> FloatArray:
    """(N, 4, 4) world_from_camera at positions (N, 3) with angles (N,) in radians; yaw turns left from +y."""
    p = np.atleast_2d(np.asarray(position, float))
    yaw, pitch, roll = (np.broadcast_to(np.asarray(a, float), len(p)) for a in (yaw, pitch, roll))
    forward = np.stack([-np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)], 1)
    right = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(len(p))], 1)
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    poses = np.tile(np.eye(4), (len(p), 1, 1))
    poses[:, :3, 0] = c * right + s * down
    poses[:, :3, 1] = c * down - s * right
    poses[:, :3, 2] = forward
    poses[:, :3, 3] = p
    return poses
