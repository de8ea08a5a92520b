# SPDX-License-Identifier: Apache-2.0
"""The direction up from planes: floors and ceilings are horizontal, walls and columns vertical."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.metric.map_frame import Vertical

MAX_POINTS = 5000  # whose normals are estimated: bounds the time
NEIGHBOURS = 16  # of a point: enough to measure the spread across their plane
FLATNESS = 0.1  # largest variance across the plane of the neighbours, of the sum of all three
ROUNDNESS = 0.2  # smallest ratio of the two variances in the plane: neighbours on a line have none
ANGLE_GATES = np.radians(
    [25.0, 15.0, 10.0]
)  # of a normal from its direction: first how upright a camera is held, last the noise of normals
MIN_NORMALS = 200  # a share of them is then known to 4 %
MIN_SHARE = 0.5  # of the normals, within 10 degrees of horizontal or vertical; 19 % of random directions are
MIN_STIFFNESS = 0.1  # gap of the two smallest eigenvalues, a share of the normals: with a single wall it is zero


class PlanesError(Exception):
    """The surroundings give no vertical; the text says why."""


def vertical_from_planes(points_in_model: FloatArray, camera_up: FloatArray) -> Vertical:
    """Up in the model, from the normals of the surfaces that its points lie on.

    The sum of (n.u)^2 over vertical and of 1 - (n.u)^2 over horizontal surfaces is least for the eigenvector of the
    smallest eigenvalue of a matrix; which surface is which follows from how the cameras were held, then from the fit.

    Args:
        points_in_model: (N, 3) sparse points.
        camera_up: (3,) unit vector, up as the cameras were held, to 25 degrees.

    Raises:
        PlanesError: too few surfaces, or not horizontal and vertical ones.
    """
    normals = _normals(points_in_model)
    up = camera_up
    share = stiffness = 0.0
    if len(normals) >= MIN_NORMALS:
        for gate in ANGLE_GATES:
            along = np.abs(normals @ up)
            horizontal, vertical = normals[along > np.cos(gate)], normals[along < np.sin(gate)]
            matrix = vertical.T @ vertical - horizontal.T @ horizontal + len(horizontal) * np.eye(3)
            values, vectors = np.linalg.eigh(matrix / len(normals))
            up = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
            share, stiffness = (len(horizontal) + len(vertical)) / len(normals), float(values[1] - values[0])
    if share < MIN_SHARE or stiffness < MIN_STIFFNESS:
        raise PlanesError("the surroundings show no floor, or no walls of two directions, that would tell what is up")
    return Vertical(up, "floor and walls")


def _normals(points: FloatArray) -> FloatArray:
    """(M, 3) unit normals of those points whose neighbours lie on a plane."""
    if len(points) < NEIGHBOURS:
        return np.empty((0, 3))
    chosen = points[:: len(points) // MAX_POINTS + 1]
    _, near = cKDTree(points).query(chosen, NEIGHBOURS)
    groups = points[near] - points[near].mean(1, keepdims=True)
    values, vectors = np.linalg.eigh(groups.transpose(0, 2, 1) @ groups)
    flat = (values[:, 0] < FLATNESS * values.sum(1)) & (values[:, 1] > ROUNDNESS * values[:, 2])
    return vectors[flat, :, 0]
