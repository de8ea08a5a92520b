# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of calibrated views: Levenberg-Marquardt on the Schur complement of the points.

Own code rather than the solver that pycolmap wraps: that one needs one Python object per observation, and its adjuster
of a part of a map (BundleAdjuster.solve, which can keep views fixed) holds the interpreter lock for the whole call
(pycolmap 4.2.1: 16 s for 480 000 observations without another thread running). Here the compiled functions release it.
Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray

# Median length of a 2-D normal error in standard deviations, and the scale of the robust loss: the median. Errors of
# features have long tails, their 90th percentile is 3.4 to 5.3 medians (six recordings; normal errors 1.8, a t
# distribution of two degrees of freedom 3.0, of one 5.7). For two, the loss is the likelihood and its scale the median.
RAYLEIGH_MEDIAN = 1.1774
DIFFERENCE = 1e-3  # px, step of numerical derivatives of residuals: far above rounding (1e-12), below curvature (px)
INITIAL_DAMPING = 1e-4  # of Levenberg-Marquardt, relative to the diagonal: nearly Gauss-Newton, as poses are near
MAX_DAMPINGS = 6  # tenfold increases after which an iteration is given up: a damping of 100 hardly moves anything
LARGE = 1e100  # of a product whose next factor is below 1e30 (1e-9 from a camera): doubles reach to 1e308
HOLD = 1e6  # weight that fixes a coordinate, relative to the largest entry of its pose: 1e-6 of its freedom is left


@dataclass(frozen=True)
class Bundle:
    """Views, points, and the observations of the points in the views, sorted by point.

    Attributes:
        rotation: (C, 3, 3) float64 camera_from_world.
        translation: (C, 3) float64 camera_from_world.
        points: (P, 3) float64 points_in_world.
        start: (P + 1,) int64, the observations of point p are start[p]:start[p + 1].
        view: (K,) int64 view of each observation.
        rays: (K, 2) float64 normalised image coordinates.
        focal: (C, 2) float64 px.
    """

    rotation: FloatArray
    translation: FloatArray
    points: FloatArray
    start: IntArray
    view: IntArray
    rays: FloatArray
    focal: FloatArray

    def arrays(self) -> tuple[NDArray[Any], ...]:
        """All of them in this order, for compiled code."""
        return self.rotation, self.translation, self.points, self.start, self.view, self.rays, self.focal

    def residuals(self) -> FloatArray:
        """(K, 2) reprojection errors, px."""
        return np.asarray(_residuals(*self.arrays()))

    def errors(self) -> FloatArray:
        """(K,) lengths of the reprojection errors, px."""
        return np.asarray(np.linalg.norm(self.residuals(), axis=1))

    def moved(self, index: IntArray, turns_and_shifts: FloatArray, moves: FloatArray) -> Bundle:
        """With other poses, by the (F, 6) rows index[c] of views c (-1: stays), and points shifted by moves (P, 3)."""
        moving = np.flatnonzero(index >= 0)
        rotation, translation = self.rotation.copy(), self.translation.copy()
        if len(moving):
            step = turns_and_shifts[index[moving]]
            rotation[moving] = rotation_from_vector(step[:, :3]) @ self.rotation[moving]
            translation[moving] += step[:, 3:]
        return replace(self, rotation=rotation, translation=translation, points=self.points + moves)


def adjust(
    bundle: Bundle, free: NDArray[np.bool_], *, loss_scale: float, max_iterations: int, tolerance: float
) -> Bundle:
    """Minimises Cauchy-robust reprojection errors over points and free views; returns the adjusted bundle.

    free (C,): views that may move; loss_scale px, of the Cauchy loss. Ends when an iteration reduces the cost by less
    than `tolerance` of it.
    """
    start, view = bundle.start, bundle.view
    index = np.where(free, np.cumsum(free) - 1, -1)
    count = int(free.sum())
    pairs, row, column = pairs_of_views(start, view, index, count)
    cost = _cost(*bundle.arrays(), loss_scale)
    damping = INITIAL_DAMPING
    for _ in range(max_iterations):
        u, gc, v, gp, w = _linearise(*bundle.arrays(), index, count, loss_scale)
        gained = 0.0
        for _ in range(MAX_DAMPINGS):
            blocks, gradient, v_inverse = eliminate_points(
                u, gc, v, gp, w, start, view, index, pairs, len(row), damping
            )
            step = _solve(blocks, row, column, gradient).reshape(-1, 6)
            moves = moves_of_points(step, gp, w, v_inverse, start, view, index)
            candidate = bundle.moved(index, step, moves)
            new_cost = _cost(*candidate.arrays(), loss_scale)
            if new_cost < cost:
                gained = cost - new_cost
                bundle, cost = candidate, new_cost
                damping = max(damping * 0.1, 1e-9)
                break
            damping *= 10
        if gained <= tolerance * cost:
            break
    return bundle


def function_covariance(gradients: FloatArray, bundle: Bundle, *, loss_scale: float) -> FloatArray:
    """(S, S) covariance of S functions of all adjusted poses which no similarity of the whole model changes.

    gradients (S, C, 6): derivatives by each pose, turned from the left by a vector and shifted; bundle: at the minimum
    that `adjust` finds. This is the sandwich covariance of an M-estimator with the points as clusters (Huber 1967;
    White 1982; Liang and Zeger 1986): it assumes that points are independent, and nothing else. Errors that the
    features of one point have in common, and residuals larger than the noise, are included.
    """
    start, view, count = bundle.start, bundle.view, len(bundle.rotation)
    index = np.append(np.arange(count - 1), -1)  # the last pose fixes the model's position and orientation
    pairs, row, column = pairs_of_views(start, view, index, count - 1)
    u, gc, v, gp, w = _linearise(*bundle.arrays(), index, count - 1, loss_scale)
    blocks, _, v_inverse = eliminate_points(u, gc, v, gp, w, start, view, index, pairs, len(row), 0.0)
    hold_scale(blocks, pairs, index, bundle.rotation, bundle.translation)

    error = bundle.residuals()
    square = (error**2).sum(axis=1)
    weight = 1.0 / (1.0 + square / loss_scale**2)
    scores = np.zeros((len(gradients), len(bundle.points)))
    for number, gradient in enumerate(gradients):
        if not gradient.any():
            continue
        poses = _solve(blocks, row, column, gradient[:-1]).reshape(-1, 6)
        moves = moves_of_points(poses, np.zeros_like(gp), w, v_inverse, start, view, index)
        size = DIFFERENCE / max(float(np.abs(poses).max() * bundle.focal.max()), 1e-300)
        ends = [bundle.moved(index, step * poses, step * moves).residuals() for step in (size, -size)]
        derivative = (ends[0] - ends[1]) / (2 * size)
        score = np.add.reduceat(weight * (error * derivative).sum(axis=1), start[:-1])
        share = np.add.reduceat(weight * (derivative**2).sum(axis=1), start[:-1])
        # A point of high leverage fits itself and hides its error: the jackknife's correction.
        scores[number] = score / (1.0 - share / share.sum())
    # The robust loss has less curvature than its weights imply, and the poses absorb part of the residuals.
    curvature = float((weight - square * weight**2 / loss_scale**2).mean() / weight.mean())
    freedom = 2 * len(view) - 3 * len(bundle.points)
    return scores @ scores.T / curvature**2 * freedom / max(freedom - 6 * count + 7, 1)


def hold_scale(
    blocks: FloatArray, pairs: NDArray[np.int32], index: IntArray, rotation: FloatArray, translation: FloatArray
) -> None:
    """Fixes the scale of a reduced system one of whose views stays: one coordinate of the view farthest from it.

    Args:
        blocks: upper (6, 6) blocks of the system, changed here.
        pairs: number of the block of each pair of free views.
        index: number of each view among the free ones, -1 for the one that stays.
        rotation: (C, 3, 3) camera_from_world.
        translation: (C, 3) camera_from_world.
    """
    centres = -np.einsum("cji,cj->ci", rotation, translation)
    away = centres - centres[index < 0]
    far = int(np.linalg.norm(away, axis=1).argmax())
    axis = 3 + int(np.abs(rotation[far] @ away[far]).argmax())
    block = blocks[pairs[index[far], index[far]]]
    block[axis, axis] += HOLD * np.abs(block).max()


def rotation_from_vector(vectors: FloatArray) -> FloatArray:
    """(N, 3) rotation vectors in radians -> (N, 3, 3) matrices (Rodrigues).

    SciPy's Rotation.from_rotvec differs by 2e-16, and by 9e-10 in the poses of a whole recording, so that the bytes of
    its results would change for nothing: kept until something else changes them.
    """
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    half = np.sinc(angle / (2 * np.pi))
    return np.eye(3) + np.sinc(angle / np.pi) * skew + 0.5 * half * half * (skew @ skew)


def _solve(blocks: FloatArray, row: IntArray, column: IntArray, gradient: FloatArray) -> FloatArray:
    """Solves the symmetric system given by its upper (6, 6) blocks."""
    return factorised(blocks, row, column, len(gradient)).solve(gradient.ravel()) if len(gradient) else np.zeros(0)


def factorised(blocks: FloatArray, row: IntArray, column: IntArray, count: int) -> scipy.sparse.linalg.SuperLU:
    """What solves the symmetric system of `count` views given by its upper (6, 6) blocks.

    A sparse solver also for small, full systems: a dense solver's threads cost more than they gain, and the result's
    last bits would depend on their number. SuperLU holds the interpreter lock for a quarter of its factorisation.
    """
    off = row != column
    data = np.concatenate([blocks, blocks[off].transpose(0, 2, 1)])
    rows, columns = np.concatenate([row, column[off]]), np.concatenate([column, row[off]])
    six = np.arange(6)
    i = np.broadcast_to(6 * rows[:, None, None] + six[None, :, None], data.shape).ravel()
    j = np.broadcast_to(6 * columns[:, None, None] + six[None, None, :], data.shape).ravel()
    sparse = scipy.sparse.csc_matrix((data.ravel(), (i, j)), shape=(6 * count, 6 * count))
    return scipy.sparse.linalg.splu(
        sparse, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


@njit(cache=True, nogil=True)
def pairs_of_views(start, view, index, count):  # type: ignore[no-untyped-def]  # compiled
    """Number of each pair of free views that see a common point, and the pairs in order."""
    pairs = np.full((count, count), -1, np.int32)
    for c in range(count):
        pairs[c, c] = 0
    for p in range(len(start) - 1):
        for k in range(start[p], start[p + 1]):
            a = index[view[k]]
            if a < 0:
                continue
            for m in range(k + 1, start[p + 1]):
                b = index[view[m]]
                if b >= 0:
                    pairs[min(a, b), max(a, b)] = 0
    total = 0
    for a in range(count):
        for b in range(a, count):
            if pairs[a, b] == 0:
                pairs[a, b] = total
                total += 1
    row = np.empty(total, np.int64)
    column = np.empty(total, np.int64)
    for a in range(count):
        for b in range(a, count):
            if pairs[a, b] >= 0:
                row[pairs[a, b]] = a
                column[pairs[a, b]] = b
    return pairs, row, column


@njit(cache=True, nogil=True)
def _residuals(rotation, translation, points, start, view, rays, focal):  # type: ignore[no-untyped-def]  # compiled
    """(K, 2) px. The sums are in the order in which `np.einsum` takes them, so that results keep their last bits."""
    residuals = np.empty((len(view), 2))
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        for k in range(start[p], start[p + 1]):
            c = view[k]
            r = rotation[c]
            a = (r[0, 0] * x + r[0, 2] * z) + r[0, 1] * y + translation[c, 0]
            b = (r[1, 0] * x + r[1, 2] * z) + r[1, 1] * y + translation[c, 1]
            depth = (r[2, 0] * x + r[2, 2] * z) + r[2, 1] * y + translation[c, 2]
            residuals[k, 0] = (a / depth - rays[k, 0]) * focal[c, 0]
            residuals[k, 1] = (b / depth - rays[k, 1]) * focal[c, 1]
    return residuals


@njit(cache=True, nogil=True)
def _cost(rotation, translation, points, start, view, rays, focal, loss_scale):  # type: ignore[no-untyped-def]  # compiled
    """The sum of the logarithms of the robust loss, by those of products: a logarithm takes as long as the rest."""
    total, product = 0.0, 1.0
    scale = loss_scale * loss_scale
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        for k in range(start[p], start[p + 1]):
            c = view[k]
            r = rotation[c]
            depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + translation[c, 2]
            if depth <= 1e-9:
                total += 20.0  # a point behind a camera costs as much as a gross error
                continue
            eu = focal[c, 0] * ((r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + translation[c, 0]) / depth - rays[k, 0])
            ev = focal[c, 1] * ((r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + translation[c, 1]) / depth - rays[k, 1])
            product *= 1.0 + (eu * eu + ev * ev) / scale
            if product > LARGE:
                total += np.log(product)
                product = 1.0
    return 0.5 * scale * (total + np.log(product))


@njit(cache=True, nogil=True)
def _linearise(rotation, translation, points, start, view, rays, focal, index, count, loss_scale):  # type: ignore[no-untyped-def]  # compiled
    """Blocks of the weighted normal equations; gradients are those of the descent direction."""
    u = np.zeros((count, 6, 6))
    gc = np.zeros((count, 6))
    v = np.zeros((len(points), 3, 3))
    gp = np.zeros((len(points), 3))
    w = np.zeros((len(view), 6, 3))
    jc = np.empty((2, 6))
    jp = np.empty((2, 3))
    residual = np.empty(2)
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        for k in range(start[p], start[p + 1]):
            c = view[k]
            r = rotation[c]
            rx = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z
            ry = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z
            rz = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z
            depth = rz + translation[c, 2]
            if depth <= 1e-9:
                continue
            inverse = 1.0 / depth
            a = (rx + translation[c, 0]) * inverse
            b = (ry + translation[c, 1]) * inverse
            residual[0] = focal[c, 0] * (a - rays[k, 0])
            residual[1] = focal[c, 1] * (b - rays[k, 1])
            square = residual[0] * residual[0] + residual[1] * residual[1]
            weight = 1.0 / (1.0 + square / (loss_scale * loss_scale))
            fu, fv = focal[c, 0] * inverse, focal[c, 1] * inverse
            for i in range(3):
                jp[0, i] = fu * (r[0, i] - a * r[2, i])
                jp[1, i] = fv * (r[1, i] - b * r[2, i])
            for i in range(3):
                for j in range(3):
                    v[p, i, j] += weight * (jp[0, i] * jp[0, j] + jp[1, i] * jp[1, j])
                gp[p, i] -= weight * (jp[0, i] * residual[0] + jp[1, i] * residual[1])
            n = index[c]
            if n < 0:
                continue
            # d(R X)/d(rotation) = -[R X]x, d/d(translation) = I
            jc[0, 0], jc[0, 1], jc[0, 2] = fu * (-a * ry), fu * (rz + a * rx), fu * (-ry)
            jc[1, 0], jc[1, 1], jc[1, 2] = fv * (-rz - b * ry), fv * (b * rx), fv * rx
            jc[0, 3], jc[0, 4], jc[0, 5] = fu, 0.0, -fu * a
            jc[1, 3], jc[1, 4], jc[1, 5] = 0.0, fv, -fv * b
            for i in range(6):
                for j in range(6):
                    u[n, i, j] += weight * (jc[0, i] * jc[0, j] + jc[1, i] * jc[1, j])
                for j in range(3):
                    w[k, i, j] = weight * (jc[0, i] * jp[0, j] + jc[1, i] * jp[1, j])
                gc[n, i] -= weight * (jc[0, i] * residual[0] + jc[1, i] * residual[1])
    return u, gc, v, gp, w


@njit(cache=True, nogil=True)
def eliminate_points(u, gc, v, gp, w, start, view, index, pairs, total, damping):  # type: ignore[no-untyped-def]  # compiled
    """Upper blocks (total, 6, 6) and gradient of the poses' system, inverses (P, 3, 3) of the points' blocks.

    Nearly all of its time goes into the products of pairs of views. Each is a loop over the 36 numbers of its block,
    row by row, with both factors laid out like that, which the compiler turns into SIMD instructions.
    """
    blocks = np.zeros((total, 36))
    gradient = gc.copy()
    v_inverse = np.zeros_like(v)
    longest = 0
    for p in range(len(v)):
        longest = max(longest, start[p + 1] - start[p])
    seeing = np.empty(longest, np.int64)  # the free views of a point
    rows = np.empty((3, 36))  # the product of one view's (6, 3) block and the inverse, each number six times
    columns = np.empty((longest, 3, 36))  # the (6, 3) block of each view, its columns six times
    for c in range(len(u)):
        block = blocks[pairs[c, c]]
        for i in range(6):
            for j in range(6):
                block[6 * i + j] = u[c, i, j]
            block[7 * i] += damping * u[c, i, i] + 1e-9
    for p in range(len(v)):
        a00 = v[p, 0, 0] * (1 + damping) + 1e-12
        a11 = v[p, 1, 1] * (1 + damping) + 1e-12
        a22 = v[p, 2, 2] * (1 + damping) + 1e-12
        a01, a02, a12 = v[p, 0, 1], v[p, 0, 2], v[p, 1, 2]
        c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
        determinant = a00 * c00 + a01 * c01 + a02 * c02
        if determinant <= 0:
            continue
        s = 1.0 / determinant
        inverse = v_inverse[p]
        inverse[0, 0], inverse[0, 1], inverse[0, 2] = c00 * s, c01 * s, c02 * s
        inverse[1, 1], inverse[1, 2] = (a00 * a22 - a02 * a02) * s, (a01 * a02 - a00 * a12) * s
        inverse[2, 2] = (a00 * a11 - a01 * a01) * s
        inverse[1, 0], inverse[2, 0], inverse[2, 1] = inverse[0, 1], inverse[0, 2], inverse[1, 2]
        count = 0
        for k in range(start[p], start[p + 1]):
            if index[view[k]] < 0:
                continue
            seeing[count] = index[view[k]]
            for n in range(3):
                for i in range(6):
                    for j in range(6):
                        columns[count, n, 6 * i + j] = w[k, j, n]
            count += 1
        for k in range(count):
            a = seeing[k]
            for i in range(6):
                w0, w1, w2 = columns[k, 0, i], columns[k, 1, i], columns[k, 2, i]
                y0 = w0 * inverse[0, 0] + w1 * inverse[1, 0] + w2 * inverse[2, 0]
                y1 = w0 * inverse[0, 1] + w1 * inverse[1, 1] + w2 * inverse[2, 1]
                y2 = w0 * inverse[0, 2] + w1 * inverse[1, 2] + w2 * inverse[2, 2]
                for j in range(6):
                    rows[0, 6 * i + j], rows[1, 6 * i + j], rows[2, 6 * i + j] = y0, y1, y2
                gradient[a, i] -= y0 * gp[p, 0] + y1 * gp[p, 1] + y2 * gp[p, 2]
            for m in range(count):
                if seeing[m] < a:
                    continue
                block, other = blocks[pairs[a, seeing[m]]], columns[m]
                for n in range(36):
                    block[n] -= rows[0, n] * other[0, n] + rows[1, n] * other[1, n] + rows[2, n] * other[2, n]
    return blocks.reshape(-1, 6, 6), gradient, v_inverse


@njit(cache=True, nogil=True)
def moves_of_points(step, gp, w, v_inverse, start, view, index):  # type: ignore[no-untyped-def]  # compiled
    """(P, 3) moves of the points that go with a step of the poses."""
    moves = np.empty_like(gp)
    g = np.empty(3)
    for p in range(len(gp)):
        for j in range(3):
            g[j] = gp[p, j]
        for k in range(start[p], start[p + 1]):
            a = index[view[k]]
            if a < 0:
                continue
            for i in range(6):
                for j in range(3):
                    g[j] -= w[k, i, j] * step[a, i]
        for i in range(3):
            moves[p, i] = v_inverse[p, i, 0] * g[0] + v_inverse[p, i, 1] * g[1] + v_inverse[p, i, 2] * g[2]
    return moves
