# SPDX-License-Identifier: Apache-2.0
"""Geometry of points and rays: where two rays meet, cross products as matrices."""

from __future__ import annotations

import numpy as np

from pipeprog_camera.arrays import FloatArray

MIN_SINE = np.sin(np.deg2rad(1.0))  # of the angle between two rays; at less, depth errs by over 60 times as much


def midpoints(
    origins_a: FloatArray, rays_a: FloatArray, origins_b: FloatArray, rays_b: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points (..., 3) halfway between rays from two places, with their depths (2, ...) and the rays' sine (...).

    Args:
        origins_a: (..., 3) places of the first camera.
        rays_a: (..., 3) unit directions.
        origins_b: (..., 3) places of the second camera.
        rays_b: (..., 3) unit directions.
    """
    cosine = (rays_a * rays_b).sum(-1)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    gap = origins_b - origins_a
    along_a, along_b = (rays_a * gap).sum(-1), (rays_b * gap).sum(-1)
    depths = np.stack([(along_a - cosine * along_b) / sine2, (cosine * along_a - along_b) / sine2])
    points = 0.5 * (origins_a + depths[0][..., None] * rays_a + origins_b + depths[1][..., None] * rays_b)
    return points, depths, np.sqrt(sine2)


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """(N, 3, 3) matrices whose product with b is the cross product of (N, 3) vectors with b."""
    matrices = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    matrices[:, 0, 1], matrices[:, 0, 2], matrices[:, 1, 2] = -z, y, -x
    matrices[:, 1, 0], matrices[:, 2, 0], matrices[:, 2, 1] = z, -y, x
    return matrices
