# SPDX-License-Identifier: Apache-2.0
"""Focal length, radial distortion and read-out from the map itself, with what was told as a prior.

The camera is a small dense block beside the poses of a bundle adjustment: residuals are those of the image as it is,
so that a camera which shrinks the image gains nothing. Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000.

The read-out of a rolling shutter is one more number: the rows' times shift each feature along its own velocity, which
the trajectory tells. It is told by what changes along a walk, such as sway and turns; a walk at one velocity shears the
map and leaves no residual, so that its standard deviation, which is part of the result, decides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.model.bundle_adjustment import (
    RAYLEIGH_MEDIAN,
    eliminate_points,
    factorised,
    hold_scale,
    moves_of_points,
    pairs_of_views,
    rotation_from_vector,
)
from pipeprog_sfm.model.row_motion import readout_rates
from pipeprog_sfm.model.sparse_model import SparseModel

MAX_POINTS = 4000  # points used, evenly thinned: three numbers need no more, and the cost does not grow with the map
# Points used while keyframes come: what matters then moves a corner of the image by 1 px, as a k1 that is off by 0.002
# does (720p), and 24 views of 1000 points tell k1 to 0.0003. With a rolling shutter in the end as well.
EARLY_POINTS = 1000
MIN_TRACK = 3  # views of a point: two views of it say nothing on the camera that its depth does not take up
DETERMINED = 1 / 3  # of the prior's standard deviation that may be left: with more, the prior has decided
SIGNIFICANT = 5.0  # standard deviations of a change: features share errors that the covariance knows in part only
# Standard deviations by which one step contradicts a read-out that was told: poses and velocities have followed it, so
# that a step finds a half of what is off (three labs: a read-out that was right was contradicted by up to 1.3).
CONTRADICTED = 3.0
MAX_ITERATIONS = 15  # of Levenberg-Marquardt; 3 to 6 for a calibration, up to 12 for a guess, are needed
CONVERGED = 0.1  # of its standard deviation, change of each number at which the iterations end
STEP = 1e-6  # of numerical derivatives by rays, k1 and k2: a forward difference errs by 1e-6, its rounding by 1e-7 px
HELD = 1e-9  # standard deviation of a number that stays as it is
# s, below which all rows count as exposed at once: 0.3 px at walking pace, and the fastest rolling shutters take 2 ms.
LEAST_READOUT = 0.001
# px, root mean square of the moves of features by a change of the read-out in use, below which it does not matter: at
# 20 ms and 1.4 m/s, 0.05 px (1 %) put a path off by 0.13 mm, and a fifth of it is less than the features' noise does.
LEAST_MOVE = 0.01
# px, by which another camera moves a point of the image: below, every match passes the geometric checks, so that a
# calibration can wait for the end, and a map stays with another read-out.
TOLERATED_SHIFT = 1.0
RADII = 8  # equal areas of the image, as rings, in which residuals are averaged
MIN_IN_RING = 100  # residuals of a ring: their mean is known to a twentieth of a pixel


@dataclass(frozen=True)
class Priors:
    """What was told of a camera.

    Attributes:
        camera: its calibration.
        readout: s.
        sigmas: (4,) standard deviations of the logarithm of its focal length, of k1, of k2 and of the read-out [s]; 0
            for what is not to be refined.
    """

    camera: Camera
    readout: float
    sigmas: FloatArray


@dataclass(frozen=True)
class Refinement:
    """A camera that the map agrees with better.

    Attributes:
        told: the camera that the map was made with.
        camera: the refined one.
        readout: s.
        readout_sigma: its standard deviation, also where it stays as it was [s]; 0: it was not looked at.
        changes: (4,) of the logarithm of the focal length, of k1, of k2 and of the read-out [s].
        sigmas: (4,) their standard deviations; infinite for what the data do not determine, which stays as it was.
        shift: the most by which camera or read-out moves a point of the image, px.
        poses: (4, 4) camera_from_model of the views with it, by stamp.
    """

    told: Camera
    camera: Camera
    readout: float
    readout_sigma: float
    changes: FloatArray
    sigmas: FloatArray
    shift: float
    poses: Mapping[int, FloatArray]

    @property
    def is_significant(self) -> bool:
        """Whether a number differs by more than its own error and the prior's explain."""
        return bool((np.abs(self.changes) > SIGNIFICANT * self.sigmas).any())


@dataclass(frozen=True)
class _State:
    """What is adjusted: `numbers` (4,) change the camera's log focal length, k1, k2 and its read-out [s]."""

    rotation: FloatArray
    translation: FloatArray
    points: FloatArray
    numbers: FloatArray


@dataclass(frozen=True)
class _Rows:
    """Residuals (K, 2), weighted, and their derivatives by pose (K, 2, 6), number (K, 2, 4) and point (K, 2, 3)."""

    residuals: FloatArray
    by_pose: FloatArray
    by_number: FloatArray
    by_point: FloatArray


class _Problem:
    """Observations of one camera in the image as it is, in units of their noise; `rolling`: a read-out is in use."""

    def __init__(
        self,
        model: SparseModel,
        camera: Camera,
        chosen: tuple[IntArray, IntArray, IntArray],
        rates: FloatArray,
        prior: FloatArray,
        rolling: bool,
    ) -> None:
        self.ids, self.start, features = chosen
        self.camera, self.rates, self.prior, self.rolling = camera, rates, prior, rolling
        self.view = model.view_of[features].astype(np.int64)
        self.owner = np.repeat(np.arange(len(self.ids)), np.diff(self.start))
        ideal = model.rays[features] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        self.pixels = camera.distort_points(ideal)
        self.noise = model.noise

    def projected(self, state: _State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(K, 2) pixels, (K, 3) points in the cameras' frames turned only, (K, 2) rays."""
        turned = np.einsum("kij,kj->ki", state.rotation[self.view], state.points[self.owner])
        inside = turned + state.translation[self.view]
        rays = inside[:, :2] / np.maximum(inside[:, 2:], 1e-9)
        return pixels_of(changed(self.camera, state.numbers), rays), turned, rays

    def errors(self, state: _State, pixels: FloatArray) -> FloatArray:
        """(K, 2) of projected pixels, in units of the noise."""
        return (pixels - self.pixels - state.numbers[3] * self.rates) / self.noise

    def cost(self, state: _State, told: FloatArray) -> float:
        """Half of the sum of Cauchy losses, and of the prior's squares."""
        error = self.errors(state, self.projected(state)[0])
        robust = RAYLEIGH_MEDIAN**2 * np.log1p((error**2).sum(axis=1) / RAYLEIGH_MEDIAN**2).sum()
        return 0.5 * float(robust + (((state.numbers - told) / self.prior) ** 2).sum())

    def linearised(self, state: _State) -> _Rows:
        """Rows at a state, with the square roots of the robust weights."""
        pixels, turned, rays = self.projected(state)
        error, camera = self.errors(state, pixels), changed(self.camera, state.numbers)
        root = np.sqrt(1.0 / (1.0 + (error**2).sum(axis=1) / RAYLEIGH_MEDIAN**2)) / self.noise
        by_ray = _derivatives(lambda step: pixels_of(camera, rays + step), pixels, 2)
        by_focal = pixels - [camera.cx, camera.cy]  # its logarithm scales the image
        by_lens = _derivatives(lambda step: pixels_of(changed(camera, np.append(0.0, step)), rays), pixels, 2)
        by_number = np.concatenate([by_focal[:, :, None], by_lens, -self.rates[:, :, None]], axis=-1)
        depth = turned[:, 2] + state.translation[self.view, 2]
        slope = np.zeros((len(rays), 2, 3))
        slope[:, 0, 0] = slope[:, 1, 1] = 1.0
        slope[:, :, 2] = -rays
        by_shift = by_ray @ slope * (root / np.maximum(depth, 1e-9))[:, None, None]
        by_turn = np.cross(turned[:, None, :], by_shift)
        by_point = by_shift @ state.rotation[self.view]
        by_pose = np.concatenate([by_turn, by_shift], axis=-1)
        return _Rows(error * self.noise * root[:, None], by_pose, by_number * root[:, None, None], by_point)


class _Reduced:
    """Normal equations without the points: those of the poses, factorised, with the camera's numbers as a border.

    The first view stays, and so does the scale.
    """

    def __init__(self, problem: _Problem, state: _State, rows: _Rows, damping: float) -> None:
        self.problem, self.index = problem, np.arange(len(state.rotation)) - 1
        count = len(state.rotation) - 1
        u, gradient, v, self.by_points, w, own, self.pull, border, coupling = _normal_equations(
            rows.by_pose, rows.by_number, rows.by_point, rows.residuals, problem.start, problem.view, count
        )
        pairs, row, column = pairs_of_views(problem.start, problem.view, self.index, count)
        blocks, self.gradient, self.inverse = eliminate_points(
            u, gradient, v, self.by_points, w, problem.start, problem.view, self.index, pairs, len(row), damping
        )
        hold_scale(blocks, pairs, self.index, state.rotation, state.translation)
        self.poses = factorised(blocks, row, column, count)
        self.by_pose, self.coupling = w, coupling
        lifted = self.inverse @ coupling.transpose(0, 2, 1)  # (P, 3, 4), by point and number
        free = problem.view > 0
        np.subtract.at(border, problem.view[free] - 1, (w @ lifted[problem.owner])[free])
        self.border = border.reshape(-1, 4)
        self.solved = self.poses.solve(self.border)
        own[range(4), range(4)] += damping * np.diag(own) + 1e-9 + 1.0 / problem.prior**2
        own -= np.einsum("pij,pjk->ik", coupling, lifted)
        self.corner = np.linalg.inv(own - self.border.T @ self.solved)
        self.pull -= np.einsum("pji,pj->i", lifted, self.by_points)

    def step(self, prior: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Steps of the poses (V - 1, 6), the numbers (4,) and the points (P, 3); prior (4,): its gradient."""
        numbers = self.corner @ (self.pull + prior - self.solved.T @ self.gradient.ravel())
        poses = self.poses.solve(self.gradient.ravel()) - self.solved @ numbers
        return poses.reshape(-1, 6), numbers, self.moves(self.by_points, poses, numbers)

    def moves(self, by_points: FloatArray, poses: FloatArray, numbers: FloatArray) -> FloatArray:
        """(P, 3) moves of the points that go with those of the poses (6 (V - 1),) and the numbers (4,)."""
        rest = by_points - np.einsum("pji,j->pi", self.coupling, numbers)
        start, view = self.problem.start, self.problem.view
        return moves_of_points(poses.reshape(-1, 6), rest, self.by_pose, self.inverse, start, view, self.index)


def refine(
    model: SparseModel,
    keyframes: Mapping[int, Keyframe],
    told: Priors,
    motions: Mapping[int, RowMotion],
    points: int = MAX_POINTS,
) -> Refinement | None:
    """The camera refined on a model's observations; None where there are too few.

    The read-out changes only where the images contradict the one told, and takes the camera with it only where that is
    contradicted, too: each explains a part of what the other does.

    Args:
        model: adjusted views of one camera.
        keyframes: at least those of the model's views, by stamp; all have the camera in use.
        told: what was told of the camera.
        motions: of the views while their rows are read out with the read-out in use, by stamp; a view without one tells
            nothing of the read-out, nor may one whose velocity is told by its rows: they tell velocity times read-out.
        points: used at the most.
    """
    camera = keyframes[model.stamps[0]].camera
    chosen = _sample(model, points)
    if chosen is None:
        return None
    rates = readout_rates(model, keyframes, motions, chosen[2])
    readout = next((motion.readout for motion in motions.values()), told.readout)
    offset = np.append(numbers_of(told.camera) - numbers_of(camera), told.readout - readout)  # the priors' centre
    free = told.sigmas > 0
    readout_sigma = 0.0
    if free[3]:
        problem = _Problem(model, camera, chosen, rates, np.where(free, told.sigmas, HELD), readout > 0)
        change, readout_sigma = _readout_change(problem, model, np.where(free, offset, 0.0))
        moved = abs(change) * float(np.sqrt((rates**2).sum(axis=1).mean()))  # px
        matters = moved > LEAST_MOVE if readout else abs(change) > LEAST_READOUT
        least = 1.0 if readout != told.readout else CONTRADICTED if readout else SIGNIFICANT
        free[3] = readout + change > 0 and matters and abs(change) > least * readout_sigma
        if free[3] and not readout:  # what a rolling shutter bends looks like distortion: the camera's turn comes next
            free[:3] = False
    state, sigmas = _State(model.rotation, model.translation, model.points, np.zeros(4)), told.sigmas
    while free.any():
        problem = _Problem(model, camera, chosen, rates, np.where(free, told.sigmas, HELD), readout > 0)
        state, sigmas = _adjusted(problem, model, np.where(free, offset, 0.0))
        determined = free & (sigmas < DETERMINED * told.sigmas)
        if determined[3] and not (np.abs(state.numbers) > SIGNIFICANT * sigmas)[:3].any():
            determined[:3] = False
        if (determined == free).all():
            break
        free = determined
    found = changed(camera, state.numbers) if free[:3].any() else camera
    poses = np.tile(np.eye(4), (len(model), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = state.rotation, state.translation
    numbers = np.where(free, state.numbers, 0.0)
    rolled = abs(numbers[3]) * float(np.linalg.norm(rates, axis=1).max(initial=0.0))
    return Refinement(
        told=camera,
        camera=found,
        readout=max(readout + float(numbers[3]), 0.0),
        readout_sigma=float(sigmas[3]) if free[3] else readout_sigma,
        changes=numbers,
        sigmas=np.where(free, sigmas, np.inf),
        shift=max(largest_shift(camera, found), rolled),
        poses=dict(zip(model.stamps, poses, strict=True)),
    )


def numbers_of(camera: Camera) -> FloatArray:
    """(3,) logarithm of the focal length, k1 and k2."""
    k1, k2 = (*camera.distortion, 0.0, 0.0)[:2]
    return np.array([0.5 * np.log(camera.fx * camera.fy), k1, k2])


def changed(camera: Camera, numbers: FloatArray) -> Camera:
    """The camera with its log focal length, k1 and k2 changed by the first three numbers."""
    known = camera.distortion or (0.0, 0.0, 0.0, 0.0)
    factor = float(np.exp(numbers[0]))
    coefficients = (known[0] + float(numbers[1]), known[1] + float(numbers[2]), *known[2:])
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor, distortion=coefficients)


def pixels_of(camera: Camera, rays: FloatArray) -> FloatArray:
    """(K, 2) pixels of the image as it is where the camera shows (K, 2) normalised image coordinates."""
    return camera.distort_points(rays * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def largest_shift(camera: Camera, other: Camera) -> float:
    """The most by which another calibration moves a point of the image, px, over a grid of 9 x 9 points."""
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 9))
    grid = np.c_[x.ravel(), y.ravel()]
    rays = (camera.undistort_points(grid) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    shift = np.linalg.norm(pixels_of(other, rays) - grid, axis=1)
    return float(np.max(shift, initial=0.0, where=np.isfinite(shift)))


def radial_residuals(model: SparseModel, camera: Camera) -> FloatArray:
    """(RADII,) mean residual away from the principal point, px, in rings of equal area; NaN where too few are seen.

    Zero throughout where focal length and distortion are right.
    """
    features = np.flatnonzero(model.point_of >= 0)
    view = model.view_of[features]
    inside = np.einsum("kij,kj->ki", model.rotation[view], model.points[model.point_of[features]])
    inside += model.translation[view]
    rays = model.rays[features]
    radius = np.linalg.norm(rays, axis=1)
    outward = rays / np.maximum(radius, 1e-9)[:, None]
    error = ((inside[:, :2] / inside[:, 2:] - rays) * model.focal[view] * outward).sum(axis=1)
    corner = 0.5 * np.hypot(camera.width / camera.fx, camera.height / camera.fy)
    ring = np.minimum((RADII * (radius / corner) ** 2).astype(int), RADII - 1)
    count = np.bincount(ring, minlength=RADII)
    mean = np.bincount(ring, -error, minlength=RADII) / np.maximum(count, 1)
    return np.where(count >= MIN_IN_RING, mean, np.nan)


def _sample(model: SparseModel, points: int) -> tuple[IntArray, IntArray, IntArray] | None:
    """Observations of at most `points` points with tracks of MIN_TRACK views, as `SparseModel.observations`."""
    count = np.bincount(model.point_of[model.point_of >= 0], minlength=len(model.points))
    long = np.flatnonzero(count >= MIN_TRACK)
    if len(long) < MAX_POINTS // 20:
        return None
    wanted = np.zeros(len(model.points), bool)
    wanted[long[np.unique(np.linspace(0, len(long) - 1, points).astype(int))]] = True
    return model.observations(wanted)


def _adjusted(problem: _Problem, model: SparseModel, told: FloatArray) -> tuple[_State, FloatArray]:
    """The adjusted state, and the (4,) standard deviations of its numbers with the prior.

    told (4,): the prior's centre, as a change of the camera in use.
    """
    state = _State(model.rotation.copy(), model.translation.copy(), model.points[problem.ids], np.zeros(4))
    cost, damping = problem.cost(state, told), 1e-4
    rows = problem.linearised(state)
    for _ in range(MAX_ITERATIONS):
        before = state.numbers
        while damping < 1e3:
            step = _Reduced(problem, state, rows, damping).step((told - state.numbers) / problem.prior**2)
            trial = _moved(state, *step)
            new_cost = problem.cost(trial, told)
            if new_cost < cost:
                state, cost, damping = trial, new_cost, max(damping * 0.1, 1e-9)
                break
            damping *= 10
        else:
            break
        rows = problem.linearised(state)
        change = np.abs(state.numbers - before)
        if (change <= CONVERGED * problem.prior).all():  # the data only make the standard deviations smaller
            sigmas = _sigmas(_Reduced(problem, state, rows, 0.0), rows)
            if (change <= CONVERGED * sigmas).all():
                return state, sigmas
    return state, _sigmas(_Reduced(problem, state, rows, 0.0), rows)


def _readout_change(problem: _Problem, model: SparseModel, told: FloatArray) -> tuple[float, float]:
    """What one Gauss-Newton step of all numbers makes of the read-out, s, and its standard deviation; told as above."""
    state = _State(model.rotation, model.translation, model.points[problem.ids], np.zeros(4))
    rows = problem.linearised(state)
    reduced = _Reduced(problem, state, rows, 0.0)
    numbers = reduced.step(told / problem.prior**2)[1]
    return float(numbers[3]), float(_sigmas(reduced, rows)[3])


def _moved(state: _State, poses: FloatArray, numbers: FloatArray, moves: FloatArray) -> _State:
    rotation, translation = state.rotation.copy(), state.translation.copy()
    rotation[1:] = rotation_from_vector(poses[:, :3]) @ rotation[1:]
    translation[1:] += poses[:, 3:]
    return _State(rotation, translation, state.points + moves, state.numbers + numbers)


def _sigmas(reduced: _Reduced, rows: _Rows) -> FloatArray:
    """(4,) standard deviations of the numbers, with the prior.

    A sandwich covariance as `function_covariance` of the bundle adjustment, of errors that the views of a point share;
    with a rolling shutter, where velocities are off, also of those that the features of a view share (clusters of two
    kinds: Cameron, Gelbach, Miller, Robust Inference with Multiway Clustering, 2011).
    """
    problem = reduced.problem
    poses = -reduced.solved @ reduced.corner
    none = np.zeros((len(problem.ids), 3))
    moves = np.stack([reduced.moves(none, *each) for each in zip(poses.T, reduced.corner, strict=True)], axis=-1)
    turned = np.concatenate([np.zeros((1, 6, 4)), poses.reshape(-1, 6, 4)])  # the first view stays
    lines = rows.by_pose @ turned[problem.view] + rows.by_number @ reduced.corner + rows.by_point @ moves[problem.owner]
    scores = np.einsum("kin,ki->kn", lines, rows.residuals)
    spread = (np.add.reduceat(scores, problem.start[:-1], axis=0) ** 2).sum(axis=0)
    if problem.rolling:
        of_views = np.zeros((len(turned), 4))
        np.add.at(of_views, problem.view, scores)
        spread += np.maximum((of_views**2).sum(axis=0) - (scores**2).sum(axis=0), 0.0)
    observed, unknown = 2 * len(problem.view), 3 * len(problem.ids) + 6 * len(turned) + 4 - 6
    spread *= observed / max(observed - unknown, 1)
    by_prior = (reduced.corner / problem.prior[:, None]) ** 2
    return np.sqrt(spread + by_prior.sum(axis=0))


@njit(cache=True, nogil=True)
def _normal_equations(by_pose, by_number, by_point, residuals, start, view, count):  # type: ignore[no-untyped-def]  # compiled
    """Blocks of the normal equations, and the descent gradients, of poses, points and camera, and what couples them.

    In the order of `eliminate_points`: poses (count, 6, 6), (count, 6), points (P, 3, 3), (P, 3), pose with point
    (K, 6, 3); then camera (4, 4), (4,), pose with camera (count, 6, 4), camera with point (P, 4, 3).
    """
    points = len(start) - 1
    u, gu = np.zeros((count, 6, 6)), np.zeros((count, 6))
    v, gv = np.zeros((points, 3, 3)), np.zeros((points, 3))
    w = np.zeros((len(view), 6, 3))
    c, gc = np.zeros((4, 4)), np.zeros(4)
    uc, cv = np.zeros((count, 6, 4)), np.zeros((points, 4, 3))
    for p in range(points):
        for k in range(start[p], start[p + 1]):
            n = view[k] - 1
            for r in range(2):
                error = residuals[k, r]
                pose, number, point = by_pose[k, r], by_number[k, r], by_point[k, r]
                for i in range(3):
                    gv[p, i] -= point[i] * error
                    for j in range(3):
                        v[p, i, j] += point[i] * point[j]
                for i in range(4):
                    gc[i] -= number[i] * error
                    for j in range(4):
                        c[i, j] += number[i] * number[j]
                    for j in range(3):
                        cv[p, i, j] += number[i] * point[j]
                if n < 0:
                    continue
                for i in range(6):
                    gu[n, i] -= pose[i] * error
                    for j in range(6):
                        u[n, i, j] += pose[i] * pose[j]
                    for j in range(3):
                        w[k, i, j] += pose[i] * point[j]
                    for j in range(4):
                        uc[n, i, j] += pose[i] * number[j]
    return u, gu, v, gv, w, c, gc, uc, cv


def _derivatives(function: Callable[[FloatArray], FloatArray], values: FloatArray, count: int) -> FloatArray:
    """(K, 2, N) differences of a function from its (K, 2) values at zero, by `count` numbers."""
    return np.stack([(function(step) - values) / STEP for step in STEP * np.eye(count)], axis=-1)
