# SPDX-License-Identifier: Apache-2.0
"""The errors of a board's images: of each circle by itself, and common to all circles of one image, by its pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray

PRIOR_CENTRE = 0.03  # px, of a circle's centre: edges known to 0.15 px at 64 points
PRIOR_POSE = 0.1  # px at the board, of a pose: hundreds of tie points of 0.3 px that share slow errors
PRIOR_WEIGHT = 4.0  # residuals that these priors count for; more than 2, for the mean of the posterior to exist
CAUCHY = 2.385  # scale of Cauchy's loss, in sigma: 95 % efficiency for normal errors (Holland, Welsch 1977)
CAUCHY_SQUARE = 0.630  # mean of weight times squared residual over mean squared residual, normal errors in 2 dimensions


@dataclass(frozen=True)
class Noise:
    """Covariance of M rows of G images: images are independent, centre^2 I + pose^2 B B^T each.

    Attributes:
        groups: (M,) index of the image.
        directions: (M, 2, 3) left singular vectors U of B, by rows.
        shares: (G, 3) part of the variance along each direction that is due to the pose.
        centre: standard deviation of a centre, px.
        pose: standard deviation that the pose adds, px at the board.
    """

    groups: NDArray[np.intp]
    directions: FloatArray
    shares: FloatArray
    centre: float
    pose: float

    def along(self, values: FloatArray) -> FloatArray:
        """(G, 3, P) components of (M, 2, P) values along the directions."""
        products = np.einsum("mik,mip->mkp", self.directions, values)
        sums = np.zeros((len(self.shares), *products.shape[1:]))
        np.add.at(sums, self.groups, products)
        return sums

    def whitened(self, values: FloatArray) -> FloatArray:
        """(M, 2, P) rows times the inverse root of the covariance."""
        shrink = self.along(values) * (np.sqrt(1.0 - self.shares) - 1.0)[..., None]
        return (values + np.einsum("mik,mkp->mip", self.directions, shrink[self.groups])) / self.centre


def image_noise(by_place: FloatArray, groups: NDArray[np.intp], centre: float, pose: float) -> Noise:
    """Noise of rows whose derivatives by the camera's place (up to sign) are (M, 2, 3)."""
    count = np.bincount(groups)
    products = np.zeros((len(count), 3, 3))
    np.add.at(products, groups, by_place.transpose(0, 2, 1) @ by_place)
    values, vectors = np.linalg.eigh(products)
    # Unit of the camera's place: what shifts all circles by 1 px, in the direction of the largest effect.
    values = np.maximum(values, 1e-12 * values[:, 2:])
    directions = by_place @ (vectors / np.sqrt(values)[:, None, :])[groups]
    variances = pose**2 * values * (count / values[:, 2])[:, None]
    # A single circle has two residuals: its third direction is zero and has no variance.
    shares = np.where(values > 1e-9 * values[:, 2:], variances / (variances + centre**2), 0.0)
    return Noise(groups, directions * (shares > 0)[groups][:, None, :], shares, centre, pose)


def cauchy_weights(residuals: FloatArray) -> FloatArray:
    """(M,) weights of whitened rows (M, 2)."""
    return 1.0 / (1.0 + (residuals**2).sum(-1) / CAUCHY**2)


def variance_components(noise: Noise, residuals: FloatArray, jacobian: FloatArray) -> tuple[float, float]:
    """Standard deviations of a centre and of a pose, px, by whitened, weighted residuals (2M,) and derivatives (2M, 7).

    One step of restricted maximum likelihood: each residual counts for a component by the component's share of the
    variance, less the degrees of freedom that the seven parameters take; mean of the posterior under the priors.
    """
    covariance = np.linalg.pinv(jacobian.T @ jacobian)
    parts = noise.along(jacobian.reshape(-1, 2, 7))
    absorbed = np.einsum("gki,ij,gkj->gk", parts, covariance, parts)
    squares = noise.along(residuals.reshape(-1, 2, 1))[..., 0] ** 2
    by_pose = float((noise.shares * squares).sum())
    pose_freedom = max(float((noise.shares * (1.0 - absorbed)).sum()), 0.0)
    by_centre = float(residuals @ residuals) - by_pose
    centre_freedom = max(len(residuals) - 7 - pose_freedom, 0.0)
    found = []
    for prior, sigma, squared, freedom in (
        (PRIOR_CENTRE, noise.centre, by_centre, centre_freedom),
        (PRIOR_POSE, noise.pose, by_pose, pose_freedom),
    ):
        found.append(
            np.sqrt((PRIOR_WEIGHT * prior**2 + sigma**2 * squared / CAUCHY_SQUARE) / (PRIOR_WEIGHT - 2.0 + freedom))
        )
    return float(found[0]), float(found[1])
