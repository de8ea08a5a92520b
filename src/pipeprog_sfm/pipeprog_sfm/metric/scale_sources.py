# SPDX-License-Identifier: Apache-2.0
"""The sources of scale: boards, known distances, scale bars, camera rigs, odometry; each measures it on its own.

A source is a function of the evidence. SOURCES lists those of pipeprog; a further one is added by handing
`(*SOURCES, own_source)` to `estimate_scale` or MetricTracker:

    def laser_tracker(posed: PosedEvidence) -> Sequence[Measurement | ScaleWarning]:
        return [Measurement.of_trajectory("laser", "the laser tracker", metres_per_unit, relative_sigma, posed.poses)]
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from pipeprog_sfm.boards.board_adjustment import PlacementSensitivity, placement_sensitivity
from pipeprog_sfm.boards.board_file import KnownDistance
from pipeprog_sfm.boards.ellipses import ImageEllipses
from pipeprog_sfm.boards.placed_board import PlacedBoard
from pipeprog_sfm.boards.rays import cross_matrices
from pipeprog_sfm.boards.scale_bar import ScaleBarError, find_scale_bar
from pipeprog_sfm.metric.odometry import OdometryError, odometry_measurement
from pipeprog_sfm.metric.rig import rig_measurements
from pipeprog_sfm.metric.scale import Measurement, ScaleWarning
from pipeprog_sfm.metric.scale_evidence import PosedEvidence
from pipeprog_sfm.metric.transform_tree import NoPathError

PlacedWithSensitivity = tuple[PlacedBoard, PlacementSensitivity]


class ScaleSource(Protocol):
    """A source of scale.

    It returns its measurements, none where it saw nothing, and warnings that a person should read: why it cannot
    measure although it should, or what looks wrong. It does not raise.
    """

    def __call__(self, posed: PosedEvidence, /) -> Sequence[Measurement | ScaleWarning]:
        """Measurements of the scale at the poses of `posed`, and warnings."""


def boards(posed: PosedEvidence) -> list[Measurement | ScaleWarning]:
    """The scale by each placed board: from the scatter of its images and the tolerance of its circles."""
    found: list[Measurement | ScaleWarning] = []
    for place, sensitivity in zip(posed.boards.sound, posed.boards.sensitivities, strict=True):
        sigma = float(np.hypot(place.sigma, posed.board_config.tolerance / place.board.spread))
        gradient = np.zeros((len(posed.poses), 6))
        row = {stamp: number for number, stamp in enumerate(posed.poses)}
        for stamp, derivative in sensitivity.derivatives.items():
            gradient[row[stamp]] = -derivative[6]
        found.append(Measurement("board", f"board {place.board.name}", float(np.log(place.scale)), sigma, gradient))
    found += [ScaleWarning(text, posed.boards.reason) for text in posed.boards.refused]
    return found + [ScaleWarning(text) for text in posed.boards.missed]


def known_distances(posed: PosedEvidence) -> list[Measurement | ScaleWarning]:
    """The scale by each measured distance between circles of two boards."""
    checked = posed.boards
    pairs = list(zip(checked.sound, checked.sensitivities, strict=True))
    by_name = {pair[0].board.name: pair for pair in reversed(pairs)}  # the place where a board was seen first
    found: list[Measurement | ScaleWarning] = []
    for distance in posed.seen.board_file.distances:
        if all(board in by_name for board, _ in distance.ends):
            found.append(_distance_measurement(distance, by_name, list(posed.poses)))
        else:
            found.append(ScaleWarning(f"the distance {distance.name} tells nothing: its boards were not both measured"))
    return found


def scale_bars(posed: PosedEvidence) -> list[Measurement | ScaleWarning]:
    """The scale by each pair of discs that were put up a measured distance apart."""
    found: list[Measurement | ScaleWarning] = []
    for bar in posed.seen.board_file.scale_bars:
        try:
            discs = find_scale_bar(bar, _free_ellipses(posed), posed.posed_camera)
        except ScaleBarError as error:
            found.append(ScaleWarning(str(error)))
        else:
            placed = {disc.board.name: (disc, placement_sensitivity(disc, posed.posed_camera)) for disc in discs}
            found.append(_distance_measurement(bar.distance, placed, list(posed.poses)))
    return found


def scale_bar_discs(posed: PosedEvidence) -> list[PlacedBoard]:
    """The discs of all scale bars that are found."""
    found: list[PlacedBoard] = []
    for bar in posed.seen.board_file.scale_bars:
        with contextlib.suppress(ScaleBarError):
            found += find_scale_bar(bar, _free_ellipses(posed), posed.posed_camera)
    return found


def camera_rig(posed: PosedEvidence) -> list[Measurement | ScaleWarning]:
    """The scale by each two cameras of one body, from where they are mounted."""
    return rig_measurements(posed.seen.frames, posed.seen.transforms, posed.poses, posed.odometry_config)


def odometry(posed: PosedEvidence) -> list[Measurement | ScaleWarning]:
    """The scale by odometry."""
    try:
        path = posed.path
        return [] if path is None else [odometry_measurement(path, posed.poses, posed.odometry_config)]
    except (NoPathError, OdometryError) as error:
        return [ScaleWarning(str(error))]


SOURCES: tuple[ScaleSource, ...] = (boards, known_distances, scale_bars, camera_rig, odometry)


def _free_ellipses(posed: PosedEvidence) -> dict[int, ImageEllipses]:
    """The ellipses that belong to no board, by stamp."""
    views = [view for place in posed.boards.sound for view in place.views]
    taken = {(view.stamp, *centre) for view in views for centre in view.seen.ellipse_centres}
    free = {}
    for stamp, seen in (posed.seen.ellipses or {}).items():
        rows = np.array([(stamp, *centre) not in taken for centre in seen.centres], bool)
        free[stamp] = ImageEllipses(seen.centres[rows], seen.shapes[rows], seen.rms[rows])
    return free


def _distance_measurement(
    distance: KnownDistance, places: Mapping[str, PlacedWithSensitivity], stamps: Sequence[int]
) -> Measurement:
    """The scale by a measured distance between two circles of placed boards."""
    points, by_placement = [], []
    for board, circle in distance.ends:
        place, _ = places[board]
        arm = place.model_from_board[:3, :3] @ (place.board.centres[circle] - place.board.centres.mean(0))
        points.append(place.circles_in_model[circle])
        by_placement.append(np.c_[-cross_matrices(arm[None])[0], np.eye(3), arm])
    gap = points[1] - points[0]
    length = float(np.linalg.norm(gap))
    variance = (distance.sigma / distance.length) ** 2
    gradient = np.zeros((len(stamps), 6))
    for (board, _), derivative, sign in zip(distance.ends, by_placement, (-1.0, 1.0), strict=True):
        row = sign * gap @ derivative / length**2
        _, sensitivity = places[board]
        variance += float(row @ sensitivity.covariance @ row)
        for stamp, by_pose in sensitivity.derivatives.items():
            gradient[stamps.index(stamp)] -= row @ by_pose
    log_scale = float(np.log(distance.length / length))
    return Measurement("known_distance", f"the distance {distance.name}", log_scale, float(np.sqrt(variance)), gradient)
