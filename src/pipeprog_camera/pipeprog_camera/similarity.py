# SPDX-License-Identifier: Apache-2.0
"""The least-squares similarity between two sets of points."""

from __future__ import annotations

import numpy as np

from pipeprog_camera.arrays import FloatArray


def similarity(source: FloatArray, target: FloatArray, *, scaled: bool = True) -> FloatArray:
    """(4, 4) least-squares target_from_source of (N, 3) points (Umeyama, PAMI 1991); rigid unless `scaled`."""
    mean_source, mean_target = source.mean(0), target.mean(0)
    centred = source - mean_source
    left, values, right = np.linalg.svd((target - mean_target).T @ centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    scale = (values * signs).sum() / (centred**2).sum() if scaled else 1.0
    transform = np.eye(4)
    transform[:3, :3] = (left * signs) @ right * scale
    transform[:3, 3] = mean_target - transform[:3, :3] @ mean_source
    return transform
