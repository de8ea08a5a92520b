# SPDX-License-Identifier: Apache-2.0
"""The scale of a model: measurements of it, and their weighted mean.

Every source measures the scale by itself, with its own standard deviation, at the poses as they are. The errors of
the poses come on top, with the covariance of the bundle adjustment: a board tells the size of the model where the
board hangs, while the rest of the model is larger or smaller by the drift of the poses. The scale is therefore defined
for the size of the whole trajectory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.boards.placed_board import PlacedBoard
from pipeprog_sfm.boards.rays import cross_matrices

# Covariance (S, S) of S functions of the poses, given their (S, N, 6) derivatives, poses in order of time.
PoseCovariance = Callable[[FloatArray], FloatArray]

MAX_SIGMA = 0.05  # relative; a less certain scale is not published: neighbouring pipe sizes differ by 14 % or more
DISAGREEMENT = 3.0  # standard deviations of the difference of two measurements from which a person is warned


class NoScaleError(Exception):
    """There is no scale; `reason` is one word with underscores, the text says more."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


@dataclass(frozen=True)
class Measurement:
    """The scale by one source.

    Attributes:
        source: kind, as in pipeprog_msgs/SfmStatus.
        name: for people.
        log_scale: logarithm of metres per model unit.
        sigma: standard deviation of `log_scale` at the given poses.
        gradient: (N, 6) derivatives of `log_scale` by the poses in order of time, turned and shifted from the left.
    """

    source: str
    name: str
    log_scale: float
    sigma: float
    gradient: FloatArray

    @classmethod
    def of_trajectory(
        cls, source: str, name: str, scale: float, sigma: float, poses: Mapping[int, FloatArray]
    ) -> Measurement:
        """A measurement of the size of the whole trajectory, to which errors of the poses add nothing.

        Args:
            source: kind.
            name: for people.
            scale: metres per model unit.
            sigma: relative standard deviation of `scale`.
            poses: (4, 4) camera_from_model by stamp, in order of time.
        """
        return cls(source, name, float(np.log(scale)), sigma, -trajectory_gradient(poses))


@dataclass(frozen=True)
class ScaleWarning:
    """What a person should check, in full sentences.

    Attributes:
        text: the sentences.
        reason: where it is why a source gives no scale: one word with underscores, for NoScaleError; else empty.
    """

    text: str
    reason: str = ""


@dataclass(frozen=True)
class ScaleEstimate:
    """The metric scale of a model and the frame `map`.

    Attributes:
        scale: metres per model unit.
        sigma: relative standard deviation of `scale`, with respect to the size of the whole trajectory.
        source: kinds of the sources, joined by "+".
        views: stamps of the images in which boards were measured [ns].
        map_from_model: (4, 4) similarity, linear part scale * R.
        frame: where the map's origin is and what tells its z axis, for people.
        boards: every board at every place where it was seen, in that order.
        measurements: those that the scale is the mean of.
        warnings: what a person should check, in full sentences.
    """

    scale: float
    sigma: float
    source: str
    views: tuple[int, ...]
    map_from_model: FloatArray
    frame: str
    boards: tuple[PlacedBoard, ...]
    measurements: tuple[Measurement, ...]
    warnings: tuple[str, ...]

    @property
    def board_circles(self) -> FloatArray:
        """Centres in the map and radii (N, 4) of the boards' circles [m]."""
        rotation, shift = self.map_from_model[:3, :3], self.map_from_model[:3, 3]
        rows = [
            np.c_[
                place.circles_in_model @ rotation.T + shift,
                np.full(len(place.board.centres), place.board.circle_radius),
            ]
            for place in self.boards
        ]
        return np.concatenate([np.empty((0, 4)), *rows])


@dataclass(frozen=True)
class Combined:
    """The weighted mean of the measurements' log_scale, its standard deviation, and which measurements disagree."""

    log_scale: float
    sigma: float
    warnings: tuple[str, ...]

    @property
    def scale(self) -> float:
        """Metres per model unit."""
        return float(np.exp(self.log_scale))


def combine(
    measurements: Sequence[Measurement], poses: Mapping[int, FloatArray], covariance: PoseCovariance | None
) -> Combined:
    """The mean of all, weighted by their inverse variances, with its standard deviation.

    Errors of measurements at the same poses are correlated. The standard deviation accounts for that; the weights do
    not, so that none is negative. Where chi-square per degree of freedom exceeds 1, sigma is multiplied by its root
    (Birge, 1932).

    Args:
        measurements: one or more.
        poses: (4, 4) camera_from_model by stamp, in order of time.
        covariance: of functions of these poses; None takes them for exact.

    Raises:
        NoScaleError: the scale is less certain than MAX_SIGMA.
    """
    logs = np.array([one.log_scale for one in measurements])
    joint = np.diag([one.sigma**2 for one in measurements])
    if covariance is not None:
        size = trajectory_gradient(poses)
        joint = joint + covariance(np.stack([one.gradient + size for one in measurements]))
    weights = 1.0 / np.diag(joint)
    weights /= weights.sum()
    log_scale = float(weights @ logs)
    sigma = float(np.sqrt(weights @ joint @ weights))
    if not sigma <= MAX_SIGMA:
        raise NoScaleError(
            "too_uncertain",
            f"the scale is known to {100 * sigma:.1f} % only: film the board from more sides, or measure a distance",
        )
    warnings = []
    if len(logs) > 1:
        excess = (logs - log_scale) @ np.linalg.pinv(joint) @ (logs - log_scale) / (len(logs) - 1)
        sigma *= max(1.0, float(excess)) ** 0.5
        first = int(weights.argmax())
        for index, one in enumerate(measurements):
            spread = np.sqrt(joint[index, index] + joint[first, first] - 2 * joint[index, first])
            gap = logs[index] - logs[first]
            if abs(gap) > DISAGREEMENT * spread:
                warnings.append(
                    f"{one.name} gives a scale {100 * np.expm1(gap):+.3f} % off that of {measurements[first].name}, "
                    f"more than three times their uncertainty ({100 * spread:.3f} %): one of them is not what it is "
                    "said to be, or the map drifts"
                )
    return Combined(log_scale, sigma, tuple(warnings))


def trajectory_gradient(poses: Mapping[int, FloatArray]) -> FloatArray:
    """(N, 6) derivatives of the logarithm of the trajectory's size by the poses, turned and shifted from the left.

    The size is the root of the summed squared distances of the camera centres from their mean.
    """
    stack = np.array(list(poses.values()))
    rotation, translation = stack[:, :3, :3], stack[:, :3, 3]
    centres = -np.einsum("nji,nj->ni", rotation, translation)
    arms = centres - centres.mean(0)
    rows = -np.einsum("nij,nj->ni", rotation, arms) / (arms**2).sum()  # by the shift of each pose
    by_turn = np.einsum("ni,nij->nj", rows, cross_matrices(translation))
    return np.concatenate([by_turn, rows], axis=1)
