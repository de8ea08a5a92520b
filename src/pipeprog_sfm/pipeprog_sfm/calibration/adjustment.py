# SPDX-License-Identifier: Apache-2.0
"""The adjustment of a camera, its read-out and the poses of a board in all images.

While a row of a rolling shutter is read, the board is where the polynomial through the poses of the run has it: Oth,
Furgale, Kneip, Siegwart, Rolling Shutter Camera Calibration, CVPR 2013, with a polynomial in the place of a spline.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board import Board
from pipeprog_sfm.calibration.board_images import MIN_RUN, BoardImage, runs_of
from pipeprog_sfm.calibration.calibration import COEFFICIENTS

MAX_ITERATIONS = 60  # of Levenberg-Marquardt: from a focal length that is a guess it takes up to 30
TOLERANCE = 1e-7  # of the cost, at which the iterations end
MAX_DAMPING = 1e6  # at which no step gains any more
STEP = 1e-6  # of numerical derivatives, of numbers of size one


@dataclass(frozen=True)
class Lens:
    """What is sought of a camera: the camera itself, and its read-out, s."""

    camera: Camera
    readout: float = 0.0

    @classmethod
    def starting_at(cls, start: Camera) -> Lens:
        """With all coefficients of the camera's distortion model, those that it lacks zero."""
        count = len(COEFFICIENTS[start.distortion_model])
        return cls(replace(start, distortion=(*start.distortion, *([0.0] * count))[:count]))

    @property
    def names(self) -> tuple[str, ...]:
        """Of its numbers, in the order of `changed`."""
        return ("fx", "fy", "cx", "cy", *COEFFICIENTS[self.camera.distortion_model], "readout")

    def changed(self, change: FloatArray) -> Lens:
        """By (4 + D + 1,): focal lengths and principal point in focal lengths, coefficients, read-out, s."""
        camera = self.camera
        fx, fy, cx, cy = np.array([camera.fx, camera.fy, camera.cx, camera.cy]) + camera.fx * change[:4]
        distortion = tuple((np.array(camera.distortion) + change[4:-1]).tolist())
        changed = replace(camera, fx=float(fx), fy=float(fy), cx=float(cx), cy=float(cy), distortion=distortion)
        return Lens(changed, self.readout + float(change[-1]))


class Adjustment:
    """All circles of all images as rows of equations; poses are (V, 4, 4) camera_from_board, m."""

    def __init__(self, images: Sequence[BoardImage], board: Board) -> None:
        self.view = np.repeat(np.arange(len(images)), [len(image.circles) for image in images])
        self.points = board.centres[np.concatenate([image.circles for image in images])]
        self.pixels = np.concatenate([image.pixels for image in images])
        stamps = [image.stamp for image in images]
        self.run = runs_of(stamps)
        self._by_pose = _derivative_weights(np.array(stamps), self.run)
        # First and second derivative by time of what moves a point x of the board, as matrices times [x, 1] in the
        # camera's frame.
        self._motion = np.zeros((2, len(images), 3, 4))

    def take_motion(self, poses: FloatArray) -> None:
        """Has the board move in each image as the poses of its run say."""
        moving = np.einsum("dij,jkl->dikl", self._by_pose, poses)
        self._motion = (moving @ np.linalg.inv(poses))[:, :, :3]

    def residuals(self, lens: Lens, poses: FloatArray) -> FloatArray:
        """(K, 2) px, in the image as it is."""
        camera = lens.camera
        inside = np.einsum("kij,kj->ki", poses[self.view, :3, :3], self.points) + poses[self.view, :3, 3]
        if lens.readout:
            time = (((self.pixels[:, 1] + 0.5) / camera.height - 0.5) * lens.readout)[:, None]
            first, second = (
                np.einsum("kij,kj->ki", each[self.view, :, :3], inside) + each[self.view, :, 3] for each in self._motion
            )
            inside = inside + time * first + 0.5 * time**2 * second
        rays = inside[:, :2] / np.maximum(inside[:, 2:], 1e-6)
        ideal = rays * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        return camera.distort_points(ideal) - self.pixels

    def adjusted(self, lens: Lens, poses: FloatArray, held: Collection[str]) -> tuple[Lens, FloatArray]:
        """Lens and poses at the minimum of Cauchy's loss; the numbers `held`, by name, stay as they are."""
        cost, damping = self._cost(lens, poses), 1e-3
        for _ in range(MAX_ITERATIONS):
            equations = self._equations(lens, poses, held)
            before = cost
            while damping < MAX_DAMPING:
                change, moves = equations.step(damping)
                trial = lens.changed(change), _moved(poses, moves)
                new_cost = self._cost(*trial)
                if new_cost < cost:
                    (lens, poses), cost, damping = trial, new_cost, max(0.2 * damping, 1e-9)
                    break
                damping *= 5
            if before - cost <= TOLERANCE * cost:
                break
        return lens, poses

    def sigmas(self, lens: Lens, poses: FloatArray, held: Collection[str]) -> dict[str, float]:
        """Standard deviations of the lens's numbers, by name, zero of those `held`; those of one run err together."""
        covariance = self._equations(lens, poses, held).covariance(self.run[self.view])
        unit = np.r_[np.full(4, lens.camera.fx), np.ones(len(lens.names) - 4)]
        return dict(zip(lens.names, (unit * np.sqrt(np.diag(covariance))).tolist(), strict=True))

    def _cost(self, lens: Lens, poses: FloatArray) -> float:
        """Of Cauchy's loss at a scale of one pixel: residuals are long while the camera is a guess."""
        square = (self.residuals(lens, poses) ** 2).sum(axis=1)
        return float(np.log1p(square).sum()) if np.isfinite(square).all() else np.inf

    def _equations(self, lens: Lens, poses: FloatArray, held: Collection[str]) -> _Equations:
        by_lens = _derivatives(lambda step: self.residuals(lens.changed(step), poses), len(lens.names))
        by_lens[..., [name in held for name in lens.names]] = 0.0

        def turned(step: FloatArray) -> FloatArray:
            return self.residuals(lens, _moved(poses, np.tile(step, (len(poses), 1))))

        return _Equations(self.view, self.residuals(lens, poses), by_lens, _derivatives(turned, 6))


class _Equations:
    """Normal equations whose poses are eliminated: those of different images do not touch one another."""

    def __init__(self, view: NDArray[np.intp], error: FloatArray, by_lens: FloatArray, by_pose: FloatArray) -> None:
        root = np.sqrt(1.0 / (1.0 + (error**2).sum(axis=1)))[:, None]
        self.view, self.views = view, int(view.max()) + 1
        self.error, self.by_lens, self.by_pose = error * root, by_lens * root[..., None], by_pose * root[..., None]
        self.own = _sums(np.einsum("kia,kib->kab", self.by_pose, self.by_pose), view)
        self.mixed = _sums(np.einsum("kia,kib->kab", self.by_pose, self.by_lens), view)
        self.lens = np.einsum("kia,kib->ab", self.by_lens, self.by_lens)

    def step(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Change of the lens's numbers (N,) and of the poses (V, 6)."""
        own = self.own + damping * self.own * np.eye(6)
        lens = self.lens + np.diag(damping * np.diag(self.lens) + 1e-12)
        goal_lens = -np.einsum("kia,ki->a", self.by_lens, self.error)
        goal_pose = -_sums(np.einsum("kia,ki->ka", self.by_pose, self.error), self.view)
        lifted = np.linalg.solve(own, self.mixed)
        reduced = lens - np.einsum("vpa,vpb->ab", self.mixed, lifted)
        change = np.linalg.lstsq(reduced, goal_lens - np.einsum("vpa,vp->a", lifted, goal_pose), rcond=None)[0]
        right = goal_pose - self.mixed @ change
        return change, np.linalg.solve(own, right[..., None])[..., 0]

    def covariance(self, group: NDArray[np.intp]) -> FloatArray:
        """(N, N) of the lens's numbers, zero for one without derivatives; (K,) groups are independent (sandwich)."""
        lifted = np.linalg.solve(self.own, self.mixed)
        free = self.by_lens - self.by_pose @ lifted[self.view]
        inverse = np.linalg.pinv(np.einsum("kia,kib->ab", free, free), hermitian=True)
        scores = _sums(np.einsum("kia,ki->ka", free, self.error), group)
        rows = 2 * len(self.view)
        freedom = rows / max(rows - 6 * self.views - len(inverse), 1)
        return np.asarray(freedom * inverse @ (scores.T @ scores) @ inverse)


def _sums(values: FloatArray, group: NDArray[np.intp]) -> FloatArray:
    """Sums (G, ...) over the rows (K, ...) of each group."""
    sums = np.zeros((int(group.max()) + 1, *values.shape[1:]))
    np.add.at(sums, group, values)
    return sums


def _derivative_weights(stamps: NDArray[np.int64], run: NDArray[np.intp]) -> FloatArray:
    """(2, V, V) first and second derivatives by time, 1/s and 1/s^2, of the polynomial through what a run has."""
    weights = np.zeros((2, len(stamps), len(stamps)))
    for number in range(int(run.max(initial=-1)) + 1):
        rows = np.flatnonzero(run == number)
        if len(rows) < MIN_RUN:
            continue
        seconds = 1e-9 * (stamps[rows] - stamps[rows[0]])
        coefficients = np.linalg.inv(np.vander(seconds, increasing=True))  # polynomial from values
        power = np.arange(len(rows))
        first = power * seconds[:, None] ** np.maximum(power - 1, 0)
        second = power * (power - 1) * seconds[:, None] ** np.maximum(power - 2, 0)
        weights[0][np.ix_(rows, rows)] = first @ coefficients
        weights[1][np.ix_(rows, rows)] = second @ coefficients
    return weights


def _moved(poses: FloatArray, moves: FloatArray) -> FloatArray:
    """(V, 4, 4) poses turned about the board's origin and shifted by (V, 6)."""
    moved = poses.copy()
    moved[:, :3, :3] = Rotation.from_rotvec(moves[:, :3]).as_matrix() @ poses[:, :3, :3]
    moved[:, :3, 3] += moves[:, 3:]
    return moved


def _derivatives(function: Callable[[FloatArray], FloatArray], count: int) -> FloatArray:
    """(K, 2, N) central differences of (K, 2) values by `count` numbers, at zero."""
    steps = STEP * np.eye(count)
    return np.stack([(function(step) - function(-step)) / (2 * STEP) for step in steps], axis=-1)
