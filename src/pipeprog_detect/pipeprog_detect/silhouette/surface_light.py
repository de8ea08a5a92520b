# SPDX-License-Identifier: Apache-2.0
"""The light of points of a surface in a view, where nothing hides them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import NEAR_PLANE, project
from pipeprog_detect.silhouette.light_sampling import light_at
from pipeprog_detect.silhouette.occlusion import hidden_by_cloud, hidden_by_cylinders
from pipeprog_detect.types import View


def light_on(points: FloatArray, view: View, others: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Light (N,), 0 to 255, of points (N, 3) [m] of the map in a view, 0 where it is not seen, and where it is (N,).

    `others` (K, 8): rows of the cylinders that may hide them (`cylinder_rows`); the cloud may, too.
    """
    pixel, depth = project(view, points)
    camera, shown = view.camera, view.shown(pixel, depth)
    seen = (
        (depth > NEAR_PLANE)
        & (shown > 2).all(axis=1)
        & (shown[:, 0] < camera.width - 3)
        & (shown[:, 1] < camera.height - 3)
    )
    there, deep = pixel[seen], depth[seen]
    seen[seen] = ~(hidden_by_cylinders(view, there, deep, others) | hidden_by_cloud(view, there, deep))
    light = np.zeros(len(pixel))
    light[seen] = light_at(view.image, shown[seen])
    return light, seen
