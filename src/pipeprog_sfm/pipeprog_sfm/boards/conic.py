# SPDX-License-Identifier: Apache-2.0
"""Images of circles: conics, their centres, and the circles that they may be images of.

A conic is a symmetric (3, 3) matrix C with x^T C x = 0 for image points x = (u, v, 1), its dual is C* ~ C^-1. An
ellipse is described by its centre and its shape matrix M (2, 2), whose eigenvalues are the squared semi-axes: the
ellipse is (x - centre)^T M^-1 (x - centre) = 1. Everything here works on stacks: leading dimensions are kept.
"""

from __future__ import annotations

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera


def pixel_change(camera: Camera, own: Camera) -> tuple[FloatArray, FloatArray]:
    """(2,) factors and (2,) shifts from the pixels of the ideal camera `own` to those of `camera` at its place."""
    stretch = np.array([camera.fx / own.fx, camera.fy / own.fy])
    return stretch, np.array([camera.cx, camera.cy]) - stretch * [own.cx, own.cy]


def conic_from_ellipse(centres: FloatArray, shapes: FloatArray) -> FloatArray:
    """(..., 2) centres and (..., 2, 2) shape matrices -> (..., 3, 3) conics of unit Frobenius norm."""
    inverse = np.linalg.inv(shapes)
    linear = -np.einsum("...ij,...j->...i", inverse, centres)
    conics = np.empty((*centres.shape[:-1], 3, 3))
    conics[..., :2, :2] = inverse
    conics[..., :2, 2] = linear
    conics[..., 2, :2] = linear
    conics[..., 2, 2] = -np.einsum("...i,...i->...", linear, centres) - 1.0
    return conics / np.linalg.norm(conics, axis=(-2, -1), keepdims=True)


def ellipse_from_dual(duals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(..., 3, 3) dual conics -> (..., 2) centres and (..., 2, 2) shape matrices."""
    scaled = duals / duals[..., 2:, 2:]
    centres = scaled[..., :2, 2]
    return centres, centres[..., :, None] * centres[..., None, :] - scaled[..., :2, :2]


def axes_and_angle(shapes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(..., 2, 2) shape matrices -> (..., 2) semi-axes, larger first, and the larger one's angle [rad, 0..pi)."""
    values, vectors = np.linalg.eigh(shapes)
    axes = np.sqrt(np.maximum(values[..., ::-1], 0.0))
    return axes, np.arctan2(vectors[..., 1, 1], vectors[..., 0, 1]) % np.pi


def project_circles(
    camera_matrix: FloatArray, camera_from_board: FloatArray, centres: FloatArray, radius: float
) -> tuple[FloatArray, FloatArray]:
    """Images of circles that lie in the plane z = 0 of a board.

    Args:
        camera_matrix: (3, 3) matrix K of the pinhole camera.
        camera_from_board: (4, 4) pose; its translation in the unit of `centres` and `radius`.
        centres: (N, 3) circle centres in the board's frame, z = 0.
        radius: radius of every circle.

    Returns:
        Centres (N, 2) and shape matrices (N, 2, 2) of the ellipses. The centre of an ellipse is not the image of
        the circle's centre: the dual conic of a circle is H diag(1, 1, -1/r^2) H^T with H = K [e1 e2 E].
    """
    rotation, translation = camera_from_board[:3, :3], camera_from_board[:3, 3]
    homographies = np.empty((len(centres), 3, 3))
    homographies[:, :, :2] = rotation[:, :2]
    homographies[:, :, 2] = centres @ rotation.T + translation
    images = camera_matrix @ homographies
    return ellipse_from_dual((images * np.array([1.0, 1.0, -1.0 / radius**2])) @ images.transpose(0, 2, 1))


def circle_centre_images(conics: FloatArray, camera_matrix: FloatArray, normals: FloatArray) -> FloatArray:
    """Images (..., 2) of the centres of circles whose images are `conics` and whose planes have `normals`.

    The centre is the pole of the plane's vanishing line, c ~ C^-1 K^-T n: exact, whatever the circle's size.

    Args:
        conics: (..., 3, 3) conics in pixels.
        camera_matrix: (3, 3) matrix K.
        normals: (..., 3) or (3,) normals of the circles' planes in the camera's frame.
    """
    lines = normals @ np.linalg.inv(camera_matrix)
    poles = np.linalg.solve(conics, np.broadcast_to(lines, (*conics.shape[:-2], 3))[..., None])[..., 0]
    return poles[..., :2] / poles[..., 2:]


def circles_from_conics(conics: FloatArray, camera_matrix: FloatArray, radius: float) -> tuple[FloatArray, FloatArray]:
    """The two circles of given radius that each conic may be the image of (single calibrated view).

    With the eigenvalues l1 >= l2 > 0 > l3 of A = K^T C K the planes that cut the cone in circles have the normals
    sqrt((l1-l2)/(l1-l3)) v1 +- sqrt((l2-l3)/(l1-l3)) v3.

    Args:
        conics: (N, 3, 3) conics of ellipses, in pixels.
        camera_matrix: (3, 3) matrix K.
        radius: radius of the circles, which sets the unit of the result.

    Returns:
        Centres (N, 2, 3) and unit normals (N, 2, 3) in the camera's frame; normals point towards the camera. NaN for
        what is no ellipse.
    """
    cones = camera_matrix.T @ conics @ camera_matrix
    cones /= np.linalg.norm(cones, axis=(-2, -1), keepdims=True)
    # Eigenvalues of what is not finite do not converge, and a pair of lines has no pole of a line: their circles are
    # unknown, as are those of the cone that takes their place, which has no real point.
    cones[~np.isfinite(cones).all((1, 2)) | (np.linalg.det(cones) == 0.0)] = np.eye(3)
    values, vectors = np.linalg.eigh(cones)
    flip = values[:, 1] < 0
    cones[flip] *= -1
    values[flip] = -values[flip, ::-1]
    vectors[flip] = vectors[flip][:, :, ::-1]
    low, middle, high = values.T
    span = high - low
    along_high = np.sqrt(np.maximum(high - middle, 0.0) / span)[:, None] * vectors[:, :, 2]
    along_low = np.sqrt(np.maximum(middle - low, 0.0) / span)[:, None] * vectors[:, :, 0]
    normals = np.stack([along_low + along_high, along_low - along_high], axis=1)
    directions = np.linalg.solve(cones[:, None], normals[..., None])[..., 0]
    directions *= np.sign(directions[..., 2:])
    quadratic = np.einsum("nki,nij,nkj->nk", directions, cones, directions)
    depth = radius * np.sqrt(np.maximum(-middle[:, None] / quadratic, 0.0))
    centres = depth[..., None] * directions
    facing = -np.sign(np.einsum("nki,nki->nk", normals, centres))
    return centres, normals * facing[..., None]


def conic_score(
    conics_a: FloatArray, conics_b: FloatArray, projection_a: FloatArray, projection_b: FloatArray, origins: FloatArray
) -> FloatArray:
    """How far two ellipses in two views are from being images of one plane conic: 0 for a true match.

    With the cones Q = P^T C P, det(Qa + l Qb) = l (I2 l^2 + I3 l + I4); the pencil of two cones over one plane conic
    holds a pair of planes, so that the quadratic has a double root (Quan, 1996). The score is
    |I3^2 - 4 I2 I4| / I3^2; below 0.1 for true matches at centres known to 0.1 px and poses to 0.5 mm.

    Args:
        conics_a: (..., 3, 3) conics in the first view, pixels.
        conics_b: (..., 3, 3) conics in the second view, pixels.
        projection_a: (3, 4) projection matrix K [R t] of the first view.
        projection_b: (3, 4) projection matrix of the second view.
        origins: (..., 3) points near the discs, such as their triangulated centres; the origin is moved there, which
            conditions the determinants.

    Returns:
        (...) scores.
    """
    shifts = np.tile(np.eye(4), (*origins.shape[:-1], 1, 1))
    shifts[..., :3, 3] = origins
    cones = []
    for conics, projection in ((conics_a, projection_a), (conics_b, projection_b)):
        moved = projection @ shifts
        cones.append(_unit(moved.swapaxes(-1, -2) @ conics @ moved))
    # Rescale the unit of length so that the rotation and translation parts of the cones weigh alike.
    size = np.sqrt(np.abs(cones[0][..., 3, 3]) / np.linalg.norm(cones[0][..., :3, :3], axis=(-2, -1))) + 1e-12
    unit = np.stack([size, size, size, np.ones_like(size)], axis=-1)
    first, second = (_unit(unit[..., :, None] * cone * unit[..., None, :]) for cone in cones)
    roots = np.array([-2.0, -1.0, 1.0, 2.0])
    values = np.stack([np.linalg.det(first + root * second) for root in roots], axis=-1)
    i2, i3, i4 = np.moveaxis(values @ np.linalg.pinv(np.stack([roots**3, roots**2, roots], axis=1)).T, -1, 0)
    return np.asarray(np.abs(i3**2 - 4.0 * i2 * i4) / np.maximum(i3**2, 1e-300))


def _unit(matrices: FloatArray) -> FloatArray:
    return np.asarray(matrices / np.linalg.norm(matrices, axis=(-2, -1), keepdims=True))
