# SPDX-License-Identifier: Apache-2.0
"""Solid procedural textures: seeded lattice noise, faded out where a pixel can no longer resolve it."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

_MASK = 0xFFFFFFFF


@njit(nogil=True)
def _lattice(x: int, y: int, z: int, seed: int) -> float:
    """A lattice point's value in [-1, 1] (integer mixing in 32 bits)."""
    h = (x * 0x8DA6B343 + y * 0xD8163841 + z * 0xCB1AB31F + seed * 0x9E3779B1) & _MASK
    h = ((h ^ (h >> 15)) * 0x2C1B3C6D) & _MASK
    h = ((h ^ (h >> 12)) * 0x297A2D39) & _MASK
    h = h ^ (h >> 15)
    return h * (2.0 / 4294967295.0) - 1.0


@njit(nogil=True)
def value_noise(x: float, y: float, z: float, period: int, seed: int) -> float:
    """Smooth noise in [-1, 1] on a unit lattice; with `period` > 0 it repeats after that many cells in x and y."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - fx, y - fy, z - fz
    i0, j0, k0 = int(fx), int(fy), int(fz)
    i1, j1, k1 = i0 + 1, j0 + 1, k0 + 1
    if period > 0:
        i0, i1, j0, j1 = i0 % period, i1 % period, j0 % period, j1 % period
    u, v, w = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v), w * w * (3.0 - 2.0 * w)
    a = _lattice(i0, j0, k0, seed) * (1 - u) + _lattice(i1, j0, k0, seed) * u
    b = _lattice(i0, j1, k0, seed) * (1 - u) + _lattice(i1, j1, k0, seed) * u
    c = _lattice(i0, j0, k1, seed) * (1 - u) + _lattice(i1, j0, k1, seed) * u
    d = _lattice(i0, j1, k1, seed) * (1 - u) + _lattice(i1, j1, k1, seed) * u
    return (a * (1 - v) + b * v) * (1 - w) + (c * (1 - v) + d * v) * w


@njit(nogil=True)
def _turned_noise(x: float, y: float, z: float, period: int, seed: int) -> float:
    """Noise on a lattice askew to the surface, so that its cells show no grid; a repeating one has to stay aligned."""
    if period > 0:
        return value_noise(x, y, z, period, seed)
    return value_noise(0.36 * x + 0.48 * y - 0.80 * z, -0.80 * x + 0.60 * y, 0.48 * x + 0.64 * y + 0.60 * z, 0, seed)


@njit(nogil=True)
def _resolved(cell: float, footprint: float) -> float:
    """Weight of detail of a size: 1 where a pixel resolves it, 0 where it would alias."""
    s = (1.2 - footprint / cell) / 0.7
    s = min(max(s, 0.0), 1.0)
    return s * s * (3.0 - 2.0 * s)


@njit(nogil=True)
def albedo_factor(material: NDArray[np.float64], x: float, y: float, z: float, footprint: float, seed: int) -> float:
    """Factor on the albedo at a local point; `footprint` is a pixel's size on the surface in metres.

    Mottle is a sum of octaves; speckle are spots where a noise exceeds a threshold, in two sizes and in dark and
    light, their rims as wide as a pixel.
    """
    mottle, cell, octaves, persistence = material[3], material[4], int(material[5]), material[6]
    speckle, spot, stretch, period = material[7], material[8], material[9], material[12]
    z /= stretch
    value, weight, amplitude = 0.0, 0.0, 1.0
    size = cell if period == 0.0 else period / max(round(period / cell), 1.0)
    for k in range(octaves):
        shown = _resolved(size, footprint)
        if shown > 0.0:
            cells = 0 if period == 0.0 else round(period / size)
            value += amplitude * shown * _turned_noise(x / size, y / size, z / size, cells, seed + k)
        weight += amplitude * amplitude
        amplitude *= persistence
        size *= 0.5
    factor = math.exp(1.8 * mottle * value / math.sqrt(weight))
    if speckle > 0.0:
        for k in range(2):
            size = spot * (1.0 if k == 0 else 0.4)
            size = size if period == 0.0 else period / max(round(period / size), 1.0)
            shown = _resolved(size, footprint)
            if shown > 0.0:
                cells = 0 if period == 0.0 else round(period / size)
                n = _turned_noise(x / size, y / size, z / size, cells, seed + 101 + k)
                rim = 0.04 + 0.7 * footprint / size
                dark = min(max((n - 0.48 + rim) / (2.0 * rim), 0.0), 1.0)
                light = min(max((-n - 0.60 + rim) / (2.0 * rim), 0.0), 1.0)
                factor *= 1.0 + shown * speckle * (light - dark)
    return factor
