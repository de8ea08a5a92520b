"""Metres: what boards, known distances and odometry say about the scale of the model, and what they say together.

Every source measures the scale on its own, with a standard deviation of its own, at the poses as they are. What the
poses' errors do to it comes on top, with the covariance of the bundle adjustment: a board tells the size of the model
where the board is, and the rest of the model is as much larger or smaller as the poses have drifted. The scale is
therefore understood with respect to the whole trajectory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.boards.board_adjustment import PlacementSensitivity
from pipeprog_sfm.boards.board_check import BoardPlacement
from pipeprog_sfm.boards.board_file import KnownDistance
from pipeprog_sfm.boards.placed_board import PlacedBoard
from pipeprog_sfm.boards.triangulation import cross_matrices
from pipeprog_sfm.config import BoardConfig

# Of functions of the poses: (S, N, 6) derivatives, poses in order of time, -> (S, S).
PoseCovariance = Callable[[FloatArray], FloatArray]

MAX_SIGMA = 0.05  # relative; a scale known worse than that is not published


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
        placements: every board at every place it was seen, in that order.
        measurements: what the scale is made of.
        warnings: what a person should look at, in full sentences.
    """

    scale: float
    sigma: float
    source: str
    views: tuple[int, ...]
    map_from_model: FloatArray
    frame: str
    placements: tuple[BoardPlacement, ...]
    measurements: tuple[Measurement, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Combined:
    """One logarithm of the scale of many, its standard deviation, and who disagrees."""

    log_scale: float
    sigma: float
    warnings: tuple[str, ...]

    @property
    def scale(self) -> float:
        """Metres per model unit."""
        return float(np.exp(self.log_scale))


def board_measurement(
    place: PlacedBoard, inherited: PlacementSensitivity, stamps: Sequence[int], config: BoardConfig
) -> Measurement:
    """The scale by one board: from the scatter of its images and the tolerance of its circles."""
    sigma = float(np.hypot(place.sigma, config.tolerance / place.board.spread))
    gradient = np.zeros((len(stamps), 6))
    for stamp, derivative in inherited.derivatives.items():
        gradient[stamps.index(stamp)] = -derivative[6]
    return Measurement("board", f"board {place.board.name}", float(np.log(place.scale)), sigma, gradient)


def distance_measurement(
    distance: KnownDistance, places: Mapping[str, tuple[PlacedBoard, PlacementSensitivity]], stamps: Sequence[int]
) -> Measurement | None:
    """The scale by a measured distance between two circles, or None where their boards have no place."""
    if not all(board in places for board, _ in distance.ends):
        return None
    points, by_placement = [], []
    for board, circle in distance.ends:
        place, _ = places[board]
        arm = place.model_from_board[:3, :3] @ (place.board.centres[circle] - place.board.centres.mean(0))
        points.append(place.model_from_board[:3, :3] @ place.board.centres[circle] + place.model_from_board[:3, 3])
        by_placement.append(np.c_[-cross_matrices(arm[None])[0], np.eye(3), arm])
    gap = points[1] - points[0]
    length = float(np.linalg.norm(gap))
    variance = (distance.sigma / distance.length) ** 2
    gradient = np.zeros((len(stamps), 6))
    for (board, _), derivative, sign in zip(distance.ends, by_placement, (-1.0, 1.0), strict=True):
        row = sign * gap @ derivative / length**2
        variance += float(row @ places[board][1].covariance @ row)
        for stamp, by_pose in places[board][1].derivatives.items():
            gradient[stamps.index(stamp)] -= row @ by_pose
    log_scale = float(np.log(distance.length / length))
    return Measurement("known_distance", f"the distance {distance.name}", log_scale, float(np.sqrt(variance)), gradient)


def combine(
    measurements: Sequence[Measurement], poses: Mapping[int, FloatArray], covariance: PoseCovariance | None
) -> Combined:
    """The mean of all, weighted by their variances, with its standard deviation.

    Sources that lean on the same poses err together, which the standard deviation counts; the weights do not, so that
    none becomes negative. Where the sources disagree by more than they should, they are all trusted less (Birge 1932).

    Args:
        measurements: one or more.
        poses: (4, 4) camera_from_model by stamp, in order of time.
        covariance: of functions of these poses; None takes them for exact.
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
            if abs(gap) > 3 * spread:
                warnings.append(
                    f"{one.name} gives a scale {100 * np.expm1(gap):+.3f} % off that of {measurements[first].name}, "
                    f"more than three times their uncertainty ({100 * spread:.3f} %): one of them is not what it is "
                    "said to be, or the map drifts"
                )
    return Combined(log_scale, sigma, tuple(warnings))


def trajectory_gradient(poses: Mapping[int, FloatArray]) -> FloatArray:
    """(N, 6) derivatives of the logarithm of the trajectory's size (root of its summed squares about the mean)."""
    stack = np.array(list(poses.values()))
    rotation, translation = stack[:, :3, :3], stack[:, :3, 3]
    centres = -np.einsum("nji,nj->ni", rotation, translation)
    arms = centres - centres.mean(0)
    rows = -np.einsum("nij,nj->ni", rotation, arms) / (arms**2).sum()  # of each centre, by the pose's shift
    by_turn = np.einsum("ni,nij->nj", rows, cross_matrices(translation))
    return np.concatenate([by_turn, rows], axis=1)
