# SPDX-License-Identifier: Apache-2.0
"""The faces of the boards as points: a board hides the pipes behind it, and stereo shows nothing of its plain dark."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from pipeprog_camera.arrays import FloatArray

# Circles of one board are at most this many of their radii apart, centre to centre (7.4 on the boards of this project).
NEIGHBOURS = 10.0
# Distance of the points [m]: two of them in each cell of a view's depths (8 px, `occlusion.LEAST_POINTS`) from 0.5 m
# on, with a focal length of 1000 px.
SPACING = 0.002
# A board lies flat within this share of a radius, and is no larger than this [m].
FLAT, LARGEST = 0.25, 3.0
# Points of a circle's rim by which the face's outline is told.
RIM = 16


def board_faces(centres: FloatArray, radii: FloatArray) -> FloatArray:
    """Points (M, 3) [m] all over the boards, as far as their circles tell: what lies between them is board.

    `centres` (N, 3) and `radii` (N,) [m] of the circles. Those of one board lie in a plane; others are left out.
    """
    if not len(centres):
        return np.empty((0, 3))
    near = cdist(centres, centres) < NEIGHBOURS * np.minimum.outer(radii, radii)
    count, board = connected_components(near, directed=False)
    faces = [_face(centres[board == one], float(radii[board == one].max())) for one in range(count)]
    return np.concatenate(faces)


def _face(centres: FloatArray, radius: float) -> FloatArray:
    """Points (M, 3) within the outline of circles (N, 3); none without three of them in a plane."""
    middle = centres.mean(axis=0)
    if len(centres) < 3:
        return np.empty((0, 3))
    _, spread, directions = np.linalg.svd(centres - middle)
    turn = np.linspace(0.0, 2.0 * np.pi, RIM, endpoint=False)
    rim = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    outline = (((centres - middle) @ directions[:2].T)[:, None] + rim).reshape(-1, 2)
    low, size = outline.min(axis=0), np.ptp(outline, axis=0)
    if spread[2] > FLAT * radius or size.max() > LARGEST:
        return np.empty((0, 3))
    columns, rows = (int(side) + 1 for side in size / SPACING)
    hull = cv2.convexHull(np.round((outline - low) / SPACING).astype(np.int32))
    row, column = np.nonzero(cv2.fillConvexPoly(np.zeros((rows + 1, columns + 1), np.uint8), hull, 1))
    return np.asarray(middle + (low + SPACING * np.stack([column, row], axis=1)) @ directions[:2], np.float64)
