# SPDX-License-Identifier: Apache-2.0
"""Velocities and accelerations of a walk, by its poses and by what the rows of its views tell, together.

Between two poses the camera's linear and angular snap, the change of its jerk, is white noise: a prior of trajectories
by which the most likely motion follows from equations that tie neighbours in time alone (Barfoot, Tong, Särkkä, RSS
2014). Without rows it is a natural spline of degree 7. The poses hold what is slow, as the way between two of them is
known; velocities that are free bend the scene at no cost (`row_motion`). The rows tell how the velocity changes on that
way. How strong the snap is, and in which direction, the poses tell. A walk is smooth but for its turns: Student's t
leaves the intervals and axes free in which the snap is far above its mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import factorial

import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.model.row_fit import CONVERGED, MAX_STEPS, ViewRows

# Of the snap's noise before poses tell it, rad^2/s^7 and squared depths of the scene per s^7, and as how many intervals
# that counts: a hand that sways by 0.004 rad at 1.7 Hz has a snap of 37 rad/s^4, for 0.3 s each way. White noise of the
# jerk in its place suits turns at 1.4 m/s as well, but a hand's sway less: at 0.75 m/s the path is off by a tenth more.
SNAP, COUNTS = 400.0, 3.0
# Degrees of freedom of Student's t: above two its mean square is finite, with many it is normal. Between 2 and 8 the
# camera path of simulated walks differs by 3 %.
FREEDOM = 4.0
ROUNDS = 6  # of weights by the poses alone: they have settled to a hundredth
UNHEARD_OF = 1000.0  # rad or depths of the scene, per s, s^2, s^3, which no walk has: where few poses tell a line

RATES = 3  # derivatives of a view: velocity, acceleration, jerk, each of them angular and linear
STATE = 6 * RATES
TOLD = 12  # of these, the velocities and accelerations, are told by rows
# What the snap of a second adds to the way and its derivatives is whitened by the root of its information; over t
# seconds these grow by t to the powers POWERS.
WHITEN = np.linalg.cholesky(
    np.linalg.inv([[1 / ((7 - i - j) * factorial(3 - i) * factorial(3 - j)) for j in range(4)] for i in range(4)])
).T
POWERS = 3.5 - np.arange(RATES + 1)


def smoothed(
    times: FloatArray,
    rotations: FloatArray,
    centres: FloatArray,
    motions: Sequence[RowMotion],
    rows: Sequence[ViewRows | None],
) -> tuple[list[RowMotion], FloatArray]:
    """The motions of N views that agree best with their poses and rows; those of a walk without rows stay.

    Also (N, 6) by how many standard deviations the angular and linear velocities that its rows alone tell of a view
    differ from those of `motions`; 0 without rows.

    Args:
        times: (N,) of the views, s, ascending.
        rotations: (N, 3, 3) camera_from_model.
        centres: (N, 3) of the cameras, in the model.
        motions: to start from: what rows tell depends on the motion, and takes steps of Gauss-Newton.
        rows: of each view, None where its pose alone is to count; they go on with its pose.
    """
    told = {number: each for number, each in enumerate(rows) if each is not None and each.are_enough}
    apart = np.zeros((len(times), 6))
    if not told:
        return list(motions), apart
    camera_from_model: FloatArray = np.asarray(np.kron(np.eye(TOLD // 3), -rotations), np.float64)
    found = list(motions)
    state = _state(camera_from_model, found)
    walk = _Walk(times, rotations, centres, state[:, :3], float(np.median([each.depth for each in told.values()])))
    for _ in range(MAX_STEPS):
        information, pull = np.zeros((len(times), TOLD, TOLD)), np.zeros((len(times), TOLD))
        solved = {}  # information, and what the pose loses with each rate, and its own step
        for number, each in told.items():
            sums, towards = each.normal_equations(found[number], bends=True)
            of_pose = np.linalg.solve(sums[:6, :6], np.c_[sums[:6, 6:], towards[:6]])
            of_rates = sums[6:, 6:] - sums[6:, :6] @ of_pose[:, :-1]
            towards_rates = towards[6:] - sums[6:, :6] @ of_pose[:, -1]
            covariance = np.linalg.inv(of_rates[:6, :6] + np.diag(walk.held[:6]))
            alone = (_rates(found[number]) - _rates(motions[number]))[:6] + covariance @ towards_rates[:6]
            apart[number] = np.abs(alone) / np.sqrt(np.diag(covariance))
            turned = camera_from_model[number].T
            information[number] = turned @ of_rates @ turned.T
            pull[number] = turned @ towards_rates + information[number] @ state[number]
            solved[number] = sums, of_pose
        state = walk.solve(information, pull)
        before, found = found, [_motion(*each) for each in zip(motions, camera_from_model, state, strict=True)]
        largest = 0.0
        for number, (sums, of_pose) in solved.items():
            change = _rates(found[number]) - _rates(before[number])
            step = np.concatenate([of_pose[:, -1] - of_pose[:, :-1] @ change, change])
            told[number].move(step[:6])
            largest = max(largest, told[number].step_size(step, sums))
        if largest < CONVERGED:
            break
    return found, apart


class _Walk:
    """Poses of N views, and the snap between them: along axes of its own, each with a variance and weights."""

    def __init__(
        self, times: FloatArray, rotations: FloatArray, centres: FloatArray, turning: FloatArray, depth: float
    ) -> None:
        """turning: (N, 3) about the angular velocities in the model, rad/s; depth: of the scene."""
        gaps = np.diff(times)
        model_from_camera = Rotation.from_matrix(rotations.transpose(0, 2, 1))
        self._gaps = gaps
        self._turns = (model_from_camera[1:] * model_from_camera[:-1].inv()).as_rotvec()
        self._shifts = np.diff(centres, axis=0)
        units = np.array([1.0, depth])  # of angular and of linear numbers
        self.held = np.tile(np.repeat((UNHEARD_OF * units) ** -2, 3), RATES)  # (18,) information on any state
        # What an interval adds to the way and its derivatives beside a steady jerk, from the derivatives at its begin
        # and at its end.
        added = np.zeros((len(gaps), RATES + 1, 2 * RATES))
        for row in range(RATES + 1):
            for column in range(max(row - 1, 0), RATES):
                power = column + 1 - row
                added[:, row, column] = -(gaps**power) / factorial(power)
            if row:
                added[:, row, RATES + row - 1] = 1.0
        self._whitened = WHITEN * gaps[:, None, None] ** -POWERS
        self._added = self._whitened @ added
        self._pairs = self._added.swapaxes(1, 2) @ self._added
        self._turning = turning
        nothing = np.zeros((len(times), TOLD, TOLD)), np.zeros((len(times), TOLD))
        prior = SNAP * units[:, None] ** 2  # variances along the axes
        self._axes = np.tile(np.eye(3), (2, 1, 1))  # as columns
        self._variances = np.repeat(prior, 3, axis=1)
        self._trust = np.ones((len(gaps), 2, 3))
        snap = self._snap(self._most_likely(*nothing))
        self._axes = np.linalg.eigh(np.einsum("nspc,nspd->pcd", snap, snap))[1]
        for _ in range(ROUNDS):
            squares = (self._along_axes(snap) ** 2).sum(axis=1)
            # Poses alone tell one number of an interval, and the ends are free.
            count = COUNTS + max(len(times) - RATES - 1, 0)
            self._variances = (COUNTS * prior + (self._trust * squares).sum(axis=0)) / count
            self._weigh(snap)
            snap = self._snap(self._most_likely(*nothing))

    def solve(self, information: FloatArray, pull: FloatArray) -> FloatArray:
        """(N, 12) velocities and accelerations in the model's frame, by the poses and by what rows tell.

        information (N, 12, 12) of the rows, and (N, 12) its product with what they tell. The weights of the intervals
        follow the outcome.
        """
        state = self._most_likely(information, pull)
        self._weigh(self._snap(state))
        self._turning = state[:, :3]
        return np.asarray(state[:, :TOLD])

    def _ways(self) -> FloatArray:
        """(N - 1, 2, 3) integrals of the angular and of the linear velocity over the intervals.

        A turn is the integral of the angular velocity but for half of the integral of its cross products with itself.
        """
        crossed = np.cross(self._turning[1:], self._turning[:-1])
        return np.stack([self._turns - self._gaps[:, None] ** 2 / 12.0 * crossed, self._shifts], axis=1)

    def _whitened_ways(self) -> FloatArray:
        """(N - 1, 4, 2, 3) what the ways alone make of the snap's integrals."""
        return np.asarray(self._whitened[:, :, 0, None, None] * self._ways()[:, None])

    def _snap(self, state: FloatArray) -> FloatArray:
        """(N - 1, 4, 2, 3) integrals of the snap that states (N, 18) take, whitened but for its covariance."""
        rates = state.reshape(-1, RATES, 2, 3)
        both = np.concatenate([rates[:-1], rates[1:]], axis=1)
        return np.asarray(self._whitened_ways() + np.einsum("nsk,nkpc->nspc", self._added, both))

    def _along_axes(self, snap: FloatArray) -> FloatArray:
        """(N - 1, 4, 2, 3) of the model's frame, along the axes."""
        return np.asarray(np.einsum("nspc,pcd->nspd", snap, self._axes))

    def _weigh(self, snap: FloatArray) -> None:
        squares = (self._along_axes(snap) ** 2).sum(axis=1) / self._variances
        self._trust = (FREEDOM + 1.0) / (FREEDOM + squares)

    def _most_likely(self, information: FloatArray, pull: FloatArray) -> FloatArray:
        """(N, 18) states by the present weights."""
        count = len(pull)
        precision = np.einsum("pcd,npd,ped->npce", self._axes, self._trust / self._variances, self._axes)
        blocks = np.zeros((count - 1, 2 * RATES, 2, 3, 2 * RATES, 2, 3))
        for part in range(2):
            blocks[:, :, part, :, :, part] = np.einsum("nkl,ncd->nkcld", self._pairs, precision[:, part])
        bands = np.zeros((2 * STATE, STATE * count))  # of the lower half: diagonals as rows
        bands[0] = np.tile(self.held, count)
        _add_to_bands(bands, blocks.reshape(-1, 2 * STATE, 2 * STATE))
        _add_to_bands(bands, information)
        towards = np.zeros((count, STATE))
        towards[:, :TOLD] = pull
        of_ways = np.einsum("nsk,nspc,npcd->nkpd", self._added, self._whitened_ways(), precision)
        towards[:-1] -= of_ways[:, :RATES].reshape(-1, STATE)
        towards[1:] -= of_ways[:, RATES:].reshape(-1, STATE)
        return np.asarray(scipy.linalg.solveh_banded(bands, towards.ravel(), lower=True)).reshape(count, STATE)


def _add_to_bands(bands: FloatArray, blocks: FloatArray) -> None:
    """Adds symmetric blocks (B, S, S), each a view further along the diagonal, to diagonals as rows."""
    rows, columns = np.tril_indices(blocks.shape[1])
    first = STATE * np.arange(len(blocks))
    np.add.at(bands, (rows - columns, first[:, None] + columns), blocks[:, rows, columns])


def _rates(motion: RowMotion) -> FloatArray:
    """(12,) velocities and accelerations, each angular and linear, as the model moves in the camera's frame."""
    return np.concatenate(
        [motion.angular, motion.linear, motion.angular_acceleration, motion.linear_acceleration], dtype=np.float64
    )


def _state(camera_from_model: FloatArray, motions: Sequence[RowMotion]) -> FloatArray:
    """(N, 12) of the cameras in the model's frame: of a camera that turns, the model's way is bent besides."""
    straight = np.array([_rates(motion) for motion in motions])
    straight[:, 9:] -= 2.0 * np.cross(straight[:, :3], straight[:, 3:6])
    return np.asarray((straight[:, None] @ camera_from_model)[:, 0])


def _motion(motion: RowMotion, camera_from_model: FloatArray, state: FloatArray) -> RowMotion:
    """A motion with the rates of a state (12,), the inverse of `_state`."""
    angular, linear, twist, bend = (camera_from_model @ state).reshape(4, 3)
    bend = bend + 2.0 * np.cross(angular, linear)
    return replace(motion, angular=angular, linear=linear, angular_acceleration=twist, linear_acceleration=bend)
