# SPDX-License-Identifier: Apache-2.0
"""Geometric least-squares fit of a cylinder at a known noise, blind to the wall behind the pipe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.types import Cylinder

# Residuals beyond this many sigmas have no weight: what lies farther off a pipe is mostly another object.
_CUT = 3.5
# Rounds in which the width falls to its final value, and most rounds in all.
_ANNEALING = 8
_MOST_ROUNDS = 40
# Blocks along the axis for the covariance, lags of Newey and West's window (a quarter of the length), and sectors.
_BLOCKS = 24
_WINDOW = 6
_SECTORS = 36
# Mean slope of Tukey's psi at that cut under Gaussian noise: what a bias of the residual is worth in the equations.
_SLOPE = 0.603
# Noise tensor and cylinder are estimated in turn, three times each.
_TENSOR_ROUNDS = 3


@dataclass(frozen=True)
class CylinderFit:
    """A fitted cylinder.

    covariance (5, 5) of (centre u, centre v, axis u, axis v, radius) in the frame of `basis(axis)` at the middle of
    the axis [m, rad]; rmse [m] of the inliers; inliers (N,) of the given points.
    """

    cylinder: Cylinder
    covariance: FloatArray
    rmse: float
    inliers: NDArray[np.bool_]

    @property
    def radius_sigma(self) -> float:
        """Standard deviation of the radius [m]."""
        return float(np.sqrt(self.covariance[4, 4]))


@njit(cache=True, nogil=True)
def basis(axis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors (3,) that complete the unit vector axis (3,) to a right-handed frame."""
    helper = np.zeros(3)
    helper[np.argmin(np.abs(axis))] = 1.0
    across = np.cross(axis, helper)
    u = across / np.sqrt(across @ across)
    return u, np.cross(axis, u)


def fit_cylinder(
    points: FloatArray,
    initial: Cylinder,
    sigma: float,
    *,
    fixed_radius: float | None = None,
    reach: float = 4.0,
) -> CylinderFit | None:
    """Fit a cylinder to points (N, 3) [m] near `initial`; None where fewer than ten of them agree with one.

    Minimises the geometric distance (faithful 5-parameter form of Lukacs, Marshall and Martin) with Tukey weights at
    the known noise `sigma` [m], annealed from `reach` times the final width: with the scale of the residuals instead,
    a wall behind the pipe would count as noise and pull the radius up. The covariance is the sandwich over blocks
    along the axis and sectors around it, so noise that is alike in neighbouring points is not taken for independent.

    Noise of cameras and scanners lies along the ray, so it moves a point across and along the surface together, and
    the plain geometric radius is too small by several noise variances over the radius. So the noise tensor of the
    section is estimated from the residuals over the angle, distances are taken in its metric (for noise along the
    ray: along the ray), and the outward bias that a bent surface gives them is subtracted.
    """
    if len(points) < 10 or not sigma > 0:
        return None
    middle = initial.middle
    radius = initial.radius if fixed_radius is None else fixed_radius
    free_radius = fixed_radius is None
    tensor = sigma**2 * np.eye(3)
    ok, centre, axis, radius = _iterate(points, middle, initial.axis, radius, tensor, reach, free_radius, False)
    for _ in range(_TENSOR_ROUNDS):
        if not ok or not np.isfinite(centre).all() or radius <= 0:
            return None
        tensor = _noise_tensor(points, centre, axis, radius, tensor, sigma)
        ok, centre, axis, radius = _iterate(points, centre, axis, radius, tensor, 1.0, free_radius, True)
    if not ok or not np.isfinite(centre).all() or radius <= 0:
        return None
    offset = points - centre
    weight, foot, residual, spread = _weights(offset, axis, radius, tensor)
    inliers = np.asarray((weight > 0) & (np.abs(residual) < 3.0 * spread))
    if inliers.sum() < 10:
        return None
    cylinder, rmse = _between_inliers(offset[inliers], centre, axis, radius)
    covariance = _sandwich(offset, axis, foot, residual, weight / spread**2, cylinder.length, fixed_radius is None)
    return CylinderFit(cylinder, covariance, rmse, inliers)


def quick_fit(
    points: FloatArray, initial: Cylinder, sigma: float, reach: float, *, free_radius: bool = True
) -> tuple[Cylinder, float] | None:
    """The cylinder that `fit_cylinder` starts from, with noise of `sigma` [m] all around, and its inliers' rmse [m]."""
    if len(points) < 10 or not sigma > 0:
        return None
    tensor = sigma**2 * np.eye(3)
    ok, centre, axis, radius = _iterate(
        points, initial.middle, initial.axis, initial.radius, tensor, reach, free_radius, False
    )
    if not ok or not np.isfinite(centre).all() or radius <= 0:
        return None
    offset = points - centre
    distance = np.abs(np.linalg.norm(offset - (offset @ axis)[:, None] * axis, axis=1) - radius)
    inliers = distance < 3.0 * sigma
    return _between_inliers(offset[inliers], centre, axis, radius) if inliers.sum() >= 10 else None


def _between_inliers(offset: FloatArray, centre: FloatArray, axis: FloatArray, radius: float) -> tuple[Cylinder, float]:
    """The cylinder as long as its points (N, 3), given from `centre`, and their distances' root mean square [m]."""
    along = offset @ axis
    low, high = float(along.min()), float(along.max())
    distance = np.linalg.norm(offset - along[:, None] * axis, axis=1) - radius
    cylinder = Cylinder(centre + low * axis, centre + high * axis, float(radius))
    return cylinder, float(np.sqrt(np.mean(distance**2)))


def covered_arc(points: FloatArray, cylinder: Cylinder, bins: int = 72) -> float:
    """Widest stretch of the circumference [rad] that points (N, 3) on the cylinder cover, small gaps included.

    A sector is covered from three points and a thirtieth of what a full one holds; gaps up to 30 deg are closed, as
    a neighbour's shadow makes them, so two surfaces that happen to touch one circle do not add up.
    """
    u, v = basis(cylinder.axis)
    offset = points - cylinder.start
    angle = np.arctan2(offset @ v, offset @ u)
    count = np.bincount(((angle + np.pi) * (bins / (2 * np.pi))).astype(int) % bins, minlength=bins)
    seen = np.flatnonzero((count > 2) & (count > 0.03 * np.sort(count)[-bins // 4 :].mean()))
    if not len(seen):
        return 0.0
    steps = np.diff(np.append(seen, seen[0] + bins))
    breaks = np.flatnonzero(steps > 1 + bins // 12)
    if not len(breaks):
        return float(len(seen) * 2 * np.pi / bins)
    turned = np.roll(seen, -(breaks[0] + 1))
    parts = np.split(turned, np.cumsum(np.diff(np.append(breaks, breaks[0] + len(seen))))[:-1])
    return float(max(len(part) for part in parts) * 2 * np.pi / bins)


def _noise_tensor(
    points: FloatArray, centre: FloatArray, axis: FloatArray, radius: float, tensor: FloatArray, sigma: float
) -> FloatArray:
    """Covariance (3, 3) [m2] of the noise in the section: the squared residuals as n . M . n over the normals n."""
    u, v = basis(axis)
    offset = points - centre
    x, y = offset @ u, offset @ v
    plane = np.stack([u, v]) @ tensor @ np.stack([u, v]).T
    cosine, sine, distance = _feet(x, y, radius, plane[0, 0], plane[0, 1], plane[1, 1])
    near = np.abs(distance) < _CUT * sigma
    if near.sum() < 50:
        return sigma**2 * np.eye(3)
    x, y, square = cosine[near], sine[near], distance[near] ** 2
    rows = np.stack([x * x, 2 * x * y, y * y], axis=1)
    # A few dozen points' worth of the cloud's typical noise keeps directions without points sensible.
    prior = 30.0 * np.array([[1.0, 0, 0], [0, 2.0, 0], [0, 0, 1.0]])
    mxx, mxy, myy = np.linalg.solve(rows.T @ rows + prior, rows.T @ square + prior @ [sigma**2, 0.0, sigma**2])
    values, vectors = np.linalg.eigh(np.array([[mxx, mxy], [mxy, myy]]))
    values = np.clip(values, (0.25 * sigma) ** 2, (1.5 * sigma) ** 2)
    plane = vectors @ np.diag(values) @ vectors.T
    frame = np.stack([u, v])
    return np.asarray(frame.T @ plane @ frame + sigma**2 * np.outer(axis, axis))


def _weights(
    offset: FloatArray, axis: FloatArray, radius: float, tensor: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Tukey weights (N,), feet on the unit circle (N, 2), residuals across it [m] and their standard deviation [m]."""
    u, v = basis(axis)
    x, y = offset @ u, offset @ v
    muu, muv, mvv = u @ tensor @ u, u @ tensor @ v, v @ tensor @ v
    cosine, sine, residual = _feet(x, y, radius, muu, muv, mvv)
    spread = np.sqrt(cosine**2 * muu + 2 * cosine * sine * muv + sine**2 * mvv)
    weight = np.clip(1.0 - (residual / (_CUT * spread)) ** 2, 0.0, None) ** 2
    return weight, np.stack([cosine, sine], axis=1), residual, spread


def _sandwich(
    offset: FloatArray,
    axis: FloatArray,
    foot: FloatArray,
    residual: FloatArray,
    weight: FloatArray,
    length: float,
    free_radius: bool,
) -> FloatArray:
    x, y, z = foot[:, 0], foot[:, 1], offset @ axis
    jacobian = np.stack([-x, -y, -z * x, -z * y, -np.ones_like(x)], axis=1)
    used = 5 if free_radius else 4
    jacobian = jacobian[:, :used]
    information = jacobian.T @ (weight[:, None] * jacobian)
    block = np.clip(((z / max(length, 1e-9) + 0.5) * _BLOCKS).astype(int), 0, _BLOCKS - 1)
    gradients = np.stack(
        [np.bincount(block, weights=weight * residual * jacobian[:, k], minlength=_BLOCKS) for k in range(used)], axis=1
    )
    # Blocks near each other are wrong alike: Newey and West's window takes in their products.
    meat: Any = gradients.T @ gradients
    for lag in range(1, _WINDOW):
        product = gradients[lag:].T @ gradients[:-lag]
        meat += (1.0 - lag / _WINDOW) * (product + product.T)
    filled = max(int((np.abs(gradients).sum(axis=1) > 0).sum()), 2)
    meat *= filled / (filled - 1)
    # And what is wrong all along the pipe, a dent of the section, is seen over the sectors.
    sector = ((np.arctan2(y, x) + np.pi) * (_SECTORS / (2 * np.pi))).astype(int) % _SECTORS
    around = np.stack(
        [np.bincount(sector, weights=weight * residual * jacobian[:, k], minlength=_SECTORS) for k in range(used)],
        axis=1,
    )
    filled = int((np.abs(around).sum(axis=1) > 0).sum())
    # The fit has made itself blind to as many patterns over the sectors as it has unknowns.
    meat += around.T @ around * (filled / max(filled - used, 2))
    inverse = np.linalg.pinv(information)
    covariance = np.zeros((5, 5))
    covariance[:used, :used] = inverse @ meat @ inverse
    return covariance


@njit(cache=True, nogil=True)
def _foot(x: float, y: float, radius: float, muu: float, muv: float, mvv: float) -> tuple[float, float, float]:
    """Foot (cos, sin) of the point on the circle in the metric of the tensor, and the residual across it [m]."""
    rho = np.sqrt(x * x + y * y) + 1e-12
    c, s = x / rho, y / rho
    determinant = muu * mvv - muv * muv
    for _ in range(3):
        ex, ey = x - radius * c, y - radius * s
        # The adjoint stands for the inverse: the determinant cancels.
        tx, ty = -mvv * s - muv * c, muv * s + muu * c
        nx, ny = mvv * c - muv * s, -muv * c + muu * s
        slope = tx * ex + ty * ey
        bend = radius * (tx * -s + ty * c) + nx * ex + ny * ey
        if bend < 0.2 * determinant / max(muu, mvv) * radius:
            break
        step = min(max(slope / bend, -0.4), 0.4)
        c, s = c - step * s, s + step * c
        size = np.sqrt(c * c + s * s)
        c, s = c / size, s / size
        if abs(step) < 1e-4:
            break
    return c, s, (x - radius * c) * c + (y - radius * s) * s


@njit(cache=True, nogil=True)
def _feet(
    x: FloatArray, y: FloatArray, radius: float, muu: float, muv: float, mvv: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    cosine, sine, residual = np.empty(len(x)), np.empty(len(x)), np.empty(len(x))
    for i in range(len(x)):
        cosine[i], sine[i], residual[i] = _foot(x[i], y[i], radius, muu, muv, mvv)
    return cosine, sine, residual


@njit(cache=True, nogil=True)
def _normal_equations(
    points: FloatArray,
    centre: FloatArray,
    axis: FloatArray,
    radius: float,
    tensor: FloatArray,
    cut: float,
    lever: float,
    metric: bool,
) -> tuple[FloatArray, FloatArray, float, float]:
    """Matrix (5, 5), upper triangle, and right side (5,) of a step of (centre u, v, axis u, v, radius).

    Residuals beyond `cut` standard deviations have no weight; centre and axis turn about the point `lever` [m] along
    the axis. Also returns the mean position of the weighted points along the axis [m], and their weight.
    """
    u, v = basis(axis)
    muu, muv, mvv = u @ tensor @ u, u @ tensor @ v, v @ tensor @ v
    typical, determinant = 0.5 * (muu + mvv), muu * mvv - muv * muv
    matrix = np.zeros((5, 5))
    right = np.zeros(5)
    row = np.empty(5)
    moment, total = 0.0, 0.0
    for i in range(len(points)):
        ox, oy, oz = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        x = ox * u[0] + oy * u[1] + oz * u[2]
        y = ox * v[0] + oy * v[1] + oz * v[2]
        if metric:
            x, y, d = _foot(x, y, radius, muu, muv, mvv)
        else:
            rho = np.sqrt(x * x + y * y) + 1e-12
            d = rho - radius
            x /= rho
            y /= rho
        variance = x * x * muu + 2.0 * x * y * muv + y * y * mvv
        share = d * d / (variance * cut**2)
        if share >= 1.0:
            continue
        z = ox * axis[0] + oy * axis[1] + oz * axis[2]
        weight = (1.0 - share) ** 2 * typical / variance
        moment += weight * z
        total += weight
        z -= lever
        row[0], row[1], row[2], row[3], row[4] = -x, -y, -z * x, -z * y, -1.0
        for a in range(5):
            right[a] -= weight * d * row[a]
            for b in range(a, 5):
                matrix[a, b] += weight * row[a] * row[b]
        if metric:
            # Isotropic unit noise about a curve of curvature k lies k / 2 outside it; here in the tensor's metric.
            bias = 0.5 * determinant / (radius * variance)
            for a in range(5):
                right[a] += _SLOPE * typical / variance * bias * row[a]
    return matrix, right, moment, total


@njit(cache=True, nogil=True)
def _bounded_step(matrix: FloatArray, right: FloatArray, used: int, radius: float) -> tuple[FloatArray, float, float]:
    """Step (5,) of the first `used` unknowns, kept within 0.3 rad, half a radius and 30 % of it; tilt, shift before."""
    for a in range(used):
        matrix[a, a] = matrix[a, a] * (1.0 + 1e-6) + 1e-9
        for b in range(a):
            matrix[a, b] = matrix[b, a]
    step = np.zeros(5)
    step[:used] = np.linalg.solve(matrix[:used, :used], right[:used])
    tilt = np.sqrt(step[2] ** 2 + step[3] ** 2)
    if tilt > 0.3:
        step[2] *= 0.3 / tilt
        step[3] *= 0.3 / tilt
    shift = np.sqrt(step[0] ** 2 + step[1] ** 2)
    if shift > 0.5 * radius:
        step[0] *= 0.5 * radius / shift
        step[1] *= 0.5 * radius / shift
    step[4] = min(max(step[4], -0.3 * radius), 0.3 * radius)
    return step, tilt, shift


@njit(cache=True, nogil=True)
def _iterate(
    points: FloatArray,
    centre: FloatArray,
    axis: FloatArray,
    radius: float,
    tensor: FloatArray,
    reach: float,
    free_radius: bool,
    metric: bool,
) -> tuple[bool, FloatArray, FloatArray, float]:
    """Gauss-Newton from a start to (whether it found points, centre, axis, radius)."""
    centre, axis = centre.copy(), axis.copy()
    used = 5 if free_radius else 4
    lever = 0.0
    precision = 1e-3 * np.sqrt(tensor[0, 0] + tensor[1, 1] + tensor[2, 2])
    for turn in range(_MOST_ROUNDS):
        wide = max(1.0, reach + (1.0 - reach) * turn / (_ANNEALING - 1.0))
        matrix, right, moment, total = _normal_equations(
            points, centre, axis, radius, tensor, _CUT * wide, lever, metric
        )
        if total < 5.0:
            return False, centre, axis, radius
        step, tilt, shift = _bounded_step(matrix, right, used, radius)
        # Shift and tilt are taken about the mean of the points: elsewhere they are nearly the same unknown.
        u, v = basis(axis)
        centre = centre + lever * axis + step[0] * u + step[1] * v
        lever = moment / total - lever
        axis = axis + step[2] * u + step[3] * v
        axis /= np.sqrt(axis @ axis)
        radius += step[4]
        if wide == 1.0 and shift + abs(step[4]) < precision and tilt < 10.0 * precision:
            break
    return True, centre, axis, radius
