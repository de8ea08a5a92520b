# SPDX-License-Identifier: Apache-2.0
"""Depth between the pixels of a depth map."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def depth_at(depth, u, v, agreement):  # type: ignore[no-untyped-def]
    """Bilinear where the four pixels lie on one surface, else the nearest one; NaN outside.

    `agreement`: relative difference of depth up to which they do.
    """
    height, width = depth.shape
    if not (0.0 <= u < width - 1 and 0.0 <= v < height - 1):
        return np.nan
    i, j = int(v), int(u)
    du, dv = u - j, v - i
    a, b, c, d = depth[i, j], depth[i, j + 1], depth[i + 1, j], depth[i + 1, j + 1]
    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    if a + b + c + d > 0.0 and high - low < agreement * low:  # false for NaN
        return (a * (1 - du) + b * du) * (1 - dv) + (c * (1 - du) + d * du) * dv
    return depth[int(v + 0.5), int(u + 0.5)]
