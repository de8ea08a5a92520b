# SPDX-License-Identifier: Apache-2.0
"""The light of a pipe's surface, spread out by angle and length, in each keyframe that shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeprog_detect.look.colour_view import ColourView
from pipeprog_detect.silhouette.apparent_contour import NEAR_PLANE, project
from pipeprog_detect.silhouette.occlusion import cylinder_rows, hidden_by_cloud, hidden_by_cylinders
from pipeprog_detect.silhouette.scene import frame
from pipeprog_detect.types import Cylinder

# Places on a barrel: every 7.5 degrees around it, and this many along it.
ANGLES, PLACES = 48, 24
# The ends are left out, fittings and caps begin there: a share of the length on either side.
_END = 0.06
# Steeper than this (cosine between the surface and the line of sight) a pixel shows too much of the barrel at once, and
# within this distance of the apparent contour [px] it shows the background, too.
_LEAST_COSINE, _CONTOUR = 0.35, 1.2
# A keyframe counts where it shows this many of the places, and these many keyframes of a pipe are used, the nearest.
_LEAST_SEEN, MOST_VIEWS = 60, 16


@dataclass(frozen=True)
class BarrelLight:
    """What V keyframes show of a barrel.

    Attributes:
        light: (V, ANGLES, PLACES, 3) RGB relative to white, NaN where a place is not seen.
        width: (V,) of the barrel in the images [px].
        by_board: whether a board told what is white.
    """

    light: NDArray[np.float32]
    width: NDArray[np.float64]
    by_board: bool


def barrel_light(cylinder: Cylinder, views: Sequence[ColourView], others: Sequence[Cylinder]) -> BarrelLight | None:
    """The light of a barrel in the views that show it, where none of the `others` hides it; None where none does."""
    along = np.linspace(_END, 1.0 - _END, PLACES) * cylinder.length
    turn = 2.0 * np.pi * np.arange(ANGLES) / ANGLES
    across = frame(cylinder, np.array([0.31, 0.59, 0.74]))
    normals = np.cos(turn)[:, None] * across[0] + np.sin(turn)[:, None] * across[1]
    points = cylinder.start + along[None, :, None] * cylinder.axis + cylinder.radius * normals[:, None]
    points, outward = points.reshape(-1, 3), np.repeat(normals, PLACES, axis=0)
    rows = cylinder_rows(others)
    found = []
    for each in views:
        view = each.view
        sight = view.centre - points
        cosine = (sight * outward).sum(axis=1) / np.linalg.norm(sight, axis=1)
        pixel, depth = project(view, points)
        width = 2.0 * view.camera.fx * cylinder.radius / np.maximum(depth, NEAR_PLANE)
        inside = 0.5 * width * (1.0 - np.sqrt(np.maximum(1.0 - cosine**2, 0.0)))
        shown = view.shown(pixel, depth)
        size = np.array([view.camera.width, view.camera.height])
        seen = (cosine > _LEAST_COSINE) & (inside > _CONTOUR) & (depth > NEAR_PLANE)
        seen &= ((shown > 0) & (shown < size - 1)).all(axis=1)
        if seen.sum() < _LEAST_SEEN:
            continue
        at = np.flatnonzero(seen)
        hidden = hidden_by_cylinders(view, pixel[at], depth[at], rows) | hidden_by_cloud(view, pixel[at], depth[at])
        at = at[~hidden]
        if len(at) < _LEAST_SEEN:
            continue
        light = np.full((ANGLES * PLACES, 3), np.nan, np.float32)
        light[at] = each.relative_light(shown[at])
        found.append((float(np.median(width[at])), light.reshape(ANGLES, PLACES, 3)))
    if not found:
        return None
    found.sort(key=lambda one: -one[0])
    chosen = found[:MOST_VIEWS]
    return BarrelLight(
        np.stack([light for _, light in chosen]), np.array([width for width, _ in chosen]), views[0].by_board
    )
