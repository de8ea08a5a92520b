"""Geometric least-squares fit of a cylinder at a known noise, blind to the wall behind the pipe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_detect.pipe import Cylinder, FloatArray

# Residuals beyond this many sigmas have no weight: Tukey's biweight at 85 % efficiency would take 4.7, but what lies
# four sigmas off a pipe is mostly another object.
_CUT = 4.0
_ANNEALING = 8
_MOST_ROUNDS = 40
_BLOCKS = 16
# Mean slope of Tukey's psi at that cut under Gaussian noise: what a bias of the residual is worth in the equations.
_SLOPE = 0.684
_TENSOR_ROUNDS = 3


@dataclass(frozen=True)
class CylinderFit:
    """A fitted cylinder.

    covariance (5, 5) of (centre u, centre v, axis u, axis v, radius) in the frame of `basis(axis)` at the middle of
    the axis [m, rad]; rmse [m] of the inliers; inliers (N,) of the given points; arc [rad] that they cover.
    """

    cylinder: Cylinder
    covariance: FloatArray
    rmse: float
    inliers: NDArray[np.bool_]
    arc: float

    @property
    def radius_sigma(self) -> float:
        """Standard deviation of the radius [m]."""
        return float(np.sqrt(self.covariance[4, 4]))


def basis(axis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors (3,) that complete the unit vector axis (3,) to a right-handed frame."""
    least = np.zeros(3)
    least[int(np.argmin(np.abs(axis)))] = 1.0
    u = np.cross(axis, least)
    u /= np.linalg.norm(u)
    return u, np.cross(axis, u)


def fit_cylinder(
    points: FloatArray,
    normals: FloatArray | None,
    initial: Cylinder,
    sigma: float,
    *,
    signed: bool = False,
    fixed_radius: float | None = None,
    reach: float = 4.0,
) -> CylinderFit | None:
    """Fit a cylinder to points (N, 3) [m] near `initial`; None where they hold none.

    Minimises the geometric distance (faithful 5-parameter form of Lukacs, Marshall and Martin) with Tukey weights at
    the known noise `sigma` [m], annealed from `reach` times the final width: with the scale of the residuals instead,
    a wall behind the pipe would count as noise and pull the radius up. Where normals (N, 3) are given, a point counts
    only as far as its normal is radial: outward where `signed` (normals towards the sensor), either way otherwise;
    zero normals are not judged. The covariance is the sandwich over blocks along the axis, so noise that is alike in
    neighbouring points is not taken for independent.

    Noise of cameras and scanners lies along the ray, so it differs around the section and shifts a point across and
    along the surface together; the plain least-squares radius is then too small by several noise variances over the
    radius. So the noise tensor of the section is estimated from the residuals over the angle, its standard deviation
    in each direction scales the residuals, and its expected share is taken out of the normal equations.
    """
    if len(points) < 10 or not sigma > 0:
        return None
    given = normals if normals is not None else np.zeros((0, 3))
    middle = 0.5 * (initial.start + initial.end)
    radius = initial.radius if fixed_radius is None else fixed_radius
    free_radius = fixed_radius is None
    tensor = sigma**2 * np.eye(3)
    ok, centre, axis, radius = _iterate(
        points, given, signed, middle, initial.axis, radius, tensor, reach, free_radius, False
    )
    for _ in range(_TENSOR_ROUNDS):
        if not ok or not np.isfinite(centre).all() or radius <= 0:
            return None
        tensor = _noise_tensor(points, given, signed, centre, axis, radius, sigma)
        ok, centre, axis, radius = _iterate(points, given, signed, centre, axis, radius, tensor, 1.0, free_radius, True)
    if not ok or not np.isfinite(centre).all() or radius <= 0:
        return None
    offset = points - centre
    along = offset @ axis
    radial = offset - along[:, None] * axis
    distance = np.linalg.norm(radial, axis=1) - radius
    spread = _spread_across(radial, tensor)
    weight = np.clip(1.0 - (distance / (_CUT * spread)) ** 2, 0.0, None) ** 2 * (sigma / spread) ** 2
    if normals is not None:
        weight *= _gate(radial, normals, signed)
    inliers = np.asarray((weight > 0) & (np.abs(distance) < 3.0 * spread))
    if inliers.sum() < 10:
        return None
    low, high = np.quantile(along[inliers], [0.0, 1.0])
    centre = centre + 0.5 * (low + high) * axis
    half = 0.5 * (high - low) * axis
    cylinder = Cylinder(centre - half, centre + half, float(radius))
    covariance = _sandwich(points, centre, axis, radius, distance, weight, float(high - low), fixed_radius is None)
    rmse = float(np.sqrt(np.mean(distance[inliers] ** 2)))
    return CylinderFit(cylinder, covariance, rmse, inliers, covered_arc(points[inliers], cylinder))


def covered_arc(points: FloatArray, cylinder: Cylinder, bins: int = 72) -> float:
    """Angle [rad] around the axis that points (N, 3) on the cylinder cover: sectors above a tenth of a full one."""
    u, v = basis(cylinder.axis)
    offset = points - cylinder.start
    angle = np.arctan2(offset @ v, offset @ u)
    count = np.bincount(((angle + np.pi) * (bins / (2 * np.pi))).astype(int) % bins, minlength=bins)
    full = np.sort(count)[-bins // 4 :].mean()
    return float((count > 0.1 * full).sum() * 2 * np.pi / bins)


def _gate(radial: FloatArray, normals: FloatArray, signed: bool) -> FloatArray:
    cosine = np.einsum("ij,ij->i", radial, normals) / np.maximum(np.linalg.norm(radial, axis=1), 1e-12)
    gate = np.clip(((cosine if signed else np.abs(cosine)) - 0.6) / 0.3, 0.0, 1.0)
    return np.where((normals == 0).all(axis=1), 1.0, gate)


def _spread_across(radial: FloatArray, tensor: FloatArray) -> FloatArray:
    """Standard deviation [m] of the noise along each of the vectors (N, 3)."""
    unit = radial / np.maximum(np.linalg.norm(radial, axis=1), 1e-12)[:, None]
    return np.asarray(np.sqrt(np.einsum("ij,jk,ik->i", unit, tensor, unit)))


def _noise_tensor(
    points: FloatArray,
    normals: FloatArray,
    signed: bool,
    centre: FloatArray,
    axis: FloatArray,
    radius: float,
    sigma: float,
) -> FloatArray:
    """Covariance (3, 3) [m2] of the noise in the section: the squared residuals as n . M . n over the normals n."""
    u, v = basis(axis)
    offset = points - centre
    x, y = offset @ u, offset @ v
    rho = np.hypot(x, y) + 1e-12
    distance = rho - radius
    near = np.abs(distance) < _CUT * sigma
    if len(normals):
        near &= _gate(offset - (offset @ axis)[:, None] * axis, normals, signed) > 0
    if near.sum() < 50:
        return sigma**2 * np.eye(3)
    x, y, square = x[near] / rho[near], y[near] / rho[near], distance[near] ** 2
    rows = np.stack([x * x, 2 * x * y, y * y], axis=1)
    # A few dozen points' worth of the cloud's typical noise keeps directions without points sensible.
    prior = 30.0 * np.array([[1.0, 0, 0], [0, 2.0, 0], [0, 0, 1.0]])
    mxx, mxy, myy = np.linalg.solve(rows.T @ rows + prior, rows.T @ square + prior @ [sigma**2, 0.0, sigma**2])
    values, vectors = np.linalg.eigh(np.array([[mxx, mxy], [mxy, myy]]))
    values = np.clip(values, (0.25 * sigma) ** 2, (1.5 * sigma) ** 2)
    plane = vectors @ np.diag(values) @ vectors.T
    frame = np.stack([u, v])
    return np.asarray(frame.T @ plane @ frame + sigma**2 * np.outer(axis, axis))


def _sandwich(
    points: FloatArray,
    centre: FloatArray,
    axis: FloatArray,
    radius: float,
    distance: FloatArray,
    weight: FloatArray,
    length: float,
    free_radius: bool,
) -> FloatArray:
    u, v = basis(axis)
    offset = points - centre
    x, y, z = offset @ u, offset @ v, offset @ axis
    rho = np.hypot(x, y) + 1e-12
    jacobian = np.stack([-x / rho, -y / rho, -z * x / rho, -z * y / rho, -np.ones_like(x)], axis=1)
    used = 5 if free_radius else 4
    jacobian = jacobian[:, :used]
    information = jacobian.T @ (weight[:, None] * jacobian)
    block = np.clip(((z / max(length, 1e-9) + 0.5) * _BLOCKS).astype(int), 0, _BLOCKS - 1)
    gradients = np.stack(
        [np.bincount(block, weights=weight * distance * jacobian[:, k], minlength=_BLOCKS) for k in range(used)], axis=1
    )
    inverse = np.linalg.pinv(information)
    covariance = np.zeros((5, 5))
    filled = max(int((np.abs(gradients).sum(axis=1) > 0).sum()), 2)
    covariance[:used, :used] = inverse @ (gradients.T @ gradients) @ inverse * (filled / (filled - 1))
    return covariance


@njit(cache=True)
def _iterate(
    points: FloatArray,
    normals: FloatArray,
    signed: bool,
    centre: FloatArray,
    axis: FloatArray,
    radius: float,
    tensor: FloatArray,
    reach: float,
    free_radius: bool,
    corrected: bool,
) -> tuple[bool, FloatArray, FloatArray, float]:
    centre, axis = centre.copy(), axis.copy()
    gated = len(normals) > 0
    count = len(points)
    used = 5 if free_radius else 4
    for turn in range(_MOST_ROUNDS):
        wide = max(1.0, reach + (1.0 - reach) * turn / (_ANNEALING - 1.0))
        # A frame normal to the axis.
        least = 0
        for k in range(1, 3):
            if abs(axis[k]) < abs(axis[least]):
                least = k
        helper = np.zeros(3)
        helper[least] = 1.0
        u = np.cross(axis, helper)
        u /= np.sqrt(u @ u)
        v = np.cross(axis, u)
        muu, muv, mvv = u @ tensor @ u, u @ tensor @ v, v @ tensor @ v
        typical = 0.5 * (muu + mvv)
        # Levers are taken about the mean of the weighted points, else shift and tilt are nearly the same unknown.
        lever, total = 0.0, 0.0
        matrix = np.zeros((5, 5))
        right = np.zeros(5)
        row = np.empty(5)
        turned = np.empty(5)
        for sweep in range(2):
            for i in range(count):
                ox, oy, oz = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
                x = ox * u[0] + oy * u[1] + oz * u[2]
                y = ox * v[0] + oy * v[1] + oz * v[2]
                rho = np.sqrt(x * x + y * y) + 1e-12
                d = rho - radius
                x /= rho
                y /= rho
                variance = x * x * muu + 2.0 * x * y * muv + y * y * mvv
                share = d * d / (variance * (_CUT * wide) ** 2)
                if share >= 1.0:
                    continue
                z = ox * axis[0] + oy * axis[1] + oz * axis[2]
                weight = (1.0 - share) ** 2 * typical / variance
                gate = 1.0
                if gated:
                    nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
                    if nx != 0.0 or ny != 0.0 or nz != 0.0:
                        cosine = x * (nx * u[0] + ny * u[1] + nz * u[2]) + y * (nx * v[0] + ny * v[1] + nz * v[2])
                        if not signed:
                            cosine = abs(cosine)
                        gate = min(max((cosine - 0.6) / 0.3, 0.0), 1.0)
                        weight *= gate
                if sweep == 0:
                    lever += weight * z
                    total += weight
                    continue
                z -= lever
                row[0], row[1], row[2], row[3], row[4] = -x, -y, -z * x, -z * y, -1.0
                # Second order in the noise: its sideways part turns the normal and lies off the tangent.
                turned[0], turned[1], turned[2], turned[3], turned[4] = y, -x, z * y, -z * x, 0.0
                across = (x * x - y * y) * muv + x * y * (mvv - muu)
                sideways = y * y * muu - 2.0 * x * y * muv + x * x * mvv
                expected = gate * _SLOPE * typical / (variance * radius)
                for a in range(used):
                    right[a] -= weight * d * row[a]
                    if corrected:
                        right[a] += expected * (across * turned[a] + 0.5 * sideways * row[a])
                    for b in range(a, used):
                        matrix[a, b] += weight * row[a] * row[b]
            if sweep == 0:
                if total < 5.0:
                    return False, centre, axis, radius
                lever /= total
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
        centre = centre + lever * axis + step[0] * u + step[1] * v
        axis = axis + step[2] * u + step[3] * v
        axis /= np.sqrt(axis @ axis)
        radius += step[4]
        if turn > _ANNEALING and shift + abs(step[4]) < 1e-8 and tilt < 1e-8:
            break
    return True, centre, axis, radius
