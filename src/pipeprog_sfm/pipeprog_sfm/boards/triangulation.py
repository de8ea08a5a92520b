"""Geometry of points and rays: where two rays meet, the similarity between two sets of points."""

from __future__ import annotations

import numpy as np

from pipeprog_camera.arrays import FloatArray

MIN_SINE = np.sin(np.deg2rad(1.0))  # of the angle between two rays that give a point


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


def similarity(source: FloatArray, target: FloatArray) -> FloatArray:
    """(4, 4) least-squares similarity target_from_source of (N, 3) points (Umeyama, 1991)."""
    mean_source, mean_target = source.mean(0), target.mean(0)
    centred = source - mean_source
    left, values, right = np.linalg.svd((target - mean_target).T @ centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    linear = (left * signs) @ right * ((values * signs).sum() / (centred**2).sum())
    transform = np.eye(4)
    transform[:3, :3] = linear
    transform[:3, 3] = mean_target - linear @ mean_source
    return transform


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """(N, 3, 3) matrices whose product with b is the cross product of (N, 3) vectors with b."""
    matrices = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    matrices[:, 0, 1], matrices[:, 0, 2], matrices[:, 1, 2] = -z, y, -x
    matrices[:, 1, 0], matrices[:, 2, 0], matrices[:, 2, 1] = z, -y, x
    return matrices
