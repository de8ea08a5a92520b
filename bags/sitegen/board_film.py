# SPDX-License-Identifier: Apache-2.0
"""A hand-held film of a board, as one makes it to calibrate a camera: a flat scene, which needs no ray tracing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from sitegen.render import FloatImage, Lens, pixel_directions
from sitegen.sensor import Sensor
from sitegen.site import BLACK, BOARD_CENTRES, BOARD_CIRCLE_RADIUS, BOARD_HALF, WHITE
from sitegen.walk import look

FloatArray = NDArray[np.float64]

# The camera's way round the board: slow turns that show it tilted and in all parts of the image, and the wave of a
# hand that is asked to move; Hz each, with phases of the seed.
_SLOW_HZ = (0.097, 0.131, 0.071, 0.167, 0.113)  # the place sideways and up, its distance, the aim sideways and up
_WAVE_HZ, _WAVE = (0.83, 1.07, 0.61), (0.05, 0.04, 0.03)  # m sideways, up and away: 0.3 m/s
_TILT, _NEAR, _FAR = 0.75, 0.55, 1.05  # rad, m
_AIM, _ROLL, _ROLL_HZ = (0.30, 0.20), 0.35, 0.19  # rad
_WHITE, _BLACK = WHITE.colour[0], BLACK.colour[0]
_WALL, _MOTTLE, _CELL = 0.32, 0.2, 0.07  # albedo, its relative change, m
# Eight rays a pixel, each in an eighth of the pixel's width and height and at an eighth of the exposure: the light of
# an edge is right to a sixteenth, and the lens blur takes the mean of ten pixels.
_RAYS = np.array([[0, 3], [1, 6], [2, 1], [3, 4], [4, 7], [5, 2], [6, 5], [7, 0]]) / 8 + 1 / 16 - 0.5
_INSTANTS = np.array([0, 5, 2, 7, 4, 1, 6, 3]) / 8 + 1 / 16 - 0.5


class HandBeforeBoard:
    """Where a hand holds the camera before a board in the plane y = 0, its front to -y, its middle at the origin."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._phase = rng.uniform(0.0, 2.0 * np.pi, 9)

    def poses(self, seconds: ArrayLike) -> FloatArray:
        """(N, 4, 4) world_from_camera (optical frame: x right, y down, z forward) at (N,) times, s."""
        t = np.atleast_1d(np.asarray(seconds, float))[:, None]
        slow = np.sin(2.0 * np.pi * t * np.array(_SLOW_HZ) + self._phase[:5])
        wave = np.array(_WAVE) * np.sin(2.0 * np.pi * t * np.array(_WAVE_HZ) + self._phase[5:8])
        side, rise = _TILT * slow[:, 0], 0.8 * _TILT * slow[:, 1]
        distance = 0.5 * (_NEAR + _FAR) + 0.5 * (_FAR - _NEAR) * slow[:, 2]
        from_board = np.stack([np.sin(side) * np.cos(rise), -np.cos(side) * np.cos(rise), np.sin(rise)], axis=1)
        place = distance[:, None] * from_board + wave[:, [0, 2, 1]]
        roll = _ROLL * np.sin(2.0 * np.pi * _ROLL_HZ * t[:, 0] + self._phase[8])
        return look(place, side + _AIM[0] * slow[:, 3], -rise + _AIM[1] * slow[:, 4], roll)


@dataclass(frozen=True)
class BoardFilm:
    """The camera, its shutter and the hand that holds it."""

    lens: Lens
    sensor: Sensor
    hand: HandBeforeBoard

    @cached_property
    def _directions(self) -> FloatArray:
        return pixel_directions(self.lens, _RAYS)

    def frame(self, time: float) -> FloatImage:
        """Linear image (H, W, 3) of the frame whose middle row is at the middle of its exposure at `time`, s."""
        rows = ((np.arange(self.lens.height) + 0.5) / self.lens.height - 0.5) * self.sensor.readout
        instants = time + rows[None] + self.sensor.exposure * _INSTANTS[:, None]
        poses = self.hand.poses(instants.ravel()).reshape(*instants.shape, 4, 4)
        light = np.empty((self.lens.height, self.lens.width), np.float32)
        _film(poses[:, :, :3], self._directions, np.array(BOARD_CENTRES), light)
        return np.repeat(light[:, :, None], 3, axis=2)


@njit(nogil=True)
def _albedo(x: float, z: float, centres: FloatArray) -> float:
    """Of the wall and the board at a point of the plane, m."""
    if abs(x) > BOARD_HALF[0] or abs(z) > BOARD_HALF[1]:
        return _WALL * (1.0 + _MOTTLE * np.sin(x / _CELL) * np.sin(z / _CELL + 0.7 * np.sin(2.3 * x / _CELL)))
    for k in range(len(centres)):
        if (x - centres[k, 0]) ** 2 + (z - centres[k, 1]) ** 2 < BOARD_CIRCLE_RADIUS**2:
            return _WHITE
    return _BLACK


@njit(nogil=True)
def _film(poses: FloatArray, directions: FloatArray, centres: FloatArray, light: FloatImage) -> None:
    """Fill `light` (H, W); poses (8, H, 3, 4), directions (8, H, W, 2) of the rays of each pixel at z = 1."""
    height, width = light.shape
    for r in range(height):
        for c in range(width):
            total = 0.0
            for k in range(len(poses)):
                p = poses[k, r]
                a, b = directions[k, r, c, 0], directions[k, r, c, 1]
                ahead = p[1, 0] * a + p[1, 1] * b + p[1, 2]
                if ahead <= 0.0:  # away from the wall
                    continue
                t = -p[1, 3] / ahead
                x = p[0, 3] + t * (p[0, 0] * a + p[0, 1] * b + p[0, 2])
                z = p[2, 3] + t * (p[2, 0] * a + p[2, 1] * b + p[2, 2])
                total += _albedo(x, z, centres)
            light[r, c] = total / len(poses)
