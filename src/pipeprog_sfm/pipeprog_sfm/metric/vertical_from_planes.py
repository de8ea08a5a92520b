"""The direction up, from what was built: floors and ceilings are level, walls and columns are plumb."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.metric.map_frame import Vertical

MAX_POINTS = 5000  # whose normals are estimated
NEIGHBOURS = 16
FLATNESS = 0.1  # largest share of the spread of a point's neighbours that is across their plane
ROUNDNESS = 0.2  # smallest of the two along it: neighbours on a line have no plane
ANGLE_GATES = np.radians([25.0, 15.0, 10.0])  # from how a camera is held to how well normals of sparse points are known
MIN_NORMALS = 200
MIN_SHARE = 0.5  # of the normals that are level or plumb, where a third would be by chance
MIN_STIFFNESS = 0.1  # share of the normals that resist a tilt: one wall alone leaves one free


class PlanesError(Exception):
    """The surroundings tell no vertical; the text says why."""


def vertical_from_planes(points_in_model: FloatArray, camera_up: FloatArray) -> Vertical:
    """Up in the model, from the normals of the surfaces that its points lie on.

    The sum of squares of n.u over plumb and of 1 - (n.u)^2 over level surfaces is least for the smallest eigenvector
    of a matrix; which are which follows from how the cameras were held, then from the result.

    Args:
        points_in_model: (N, 3) sparse points.
        camera_up: (3,) unit vector, up as the cameras were held, to 25 degrees.

    Raises:
        StructureError: too few surfaces, or not plumb and level ones.
    """
    normals = _normals(points_in_model)
    up = camera_up
    share = stiffness = 0.0
    if len(normals) >= MIN_NORMALS:
        for gate in ANGLE_GATES:
            along = np.abs(normals @ up)
            level, plumb = normals[along > np.cos(gate)], normals[along < np.sin(gate)]
            matrix = plumb.T @ plumb - level.T @ level + len(level) * np.eye(3)
            values, vectors = np.linalg.eigh(matrix / len(normals))
            up = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
            share, stiffness = (len(level) + len(plumb)) / len(normals), float(values[1] - values[0])
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
