"""What makes a model metric: all sources of scale and of the vertical, gathered over a stream of keyframes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from pipeprog_camera.camera import Camera
from pipeprog_sfm.board import Board, BoardObservation, Distance
from pipeprog_sfm.config import BoardConfig
from pipeprog_sfm.conic import FloatArray
from pipeprog_sfm.ellipse import TargetEllipses
from pipeprog_sfm.map_frame import Vertical, board_vertical, map_from_model
from pipeprog_sfm.placement import BoardPlacement, PlacedBoard, contradiction, measure, place_boards, sensitivity
from pipeprog_sfm.scale import (
    Measurement,
    NoScaleError,
    PoseCovariance,
    ScaleEstimate,
    board_measurement,
    combine,
    distance_measurement,
)


@dataclass(frozen=True)
class Evidence:
    """What was seen of targets.

    Attributes:
        boards: the boards of the file.
        distances: measured distances between their circles.
        observations: boards seen, by image stamp [ns].
        ellipses: all ellipses of the images, by stamp: boards of which only a circle is in view take part, too.
    """

    boards: Sequence[Board] = ()
    distances: Sequence[Distance] = ()
    observations: Mapping[int, Sequence[BoardObservation]] = field(default_factory=dict)
    ellipses: Mapping[int, TargetEllipses] | None = None


def estimate_scale(
    evidence: Evidence,
    poses: Mapping[int, FloatArray],
    camera: Camera,
    config: BoardConfig,
    covariance: PoseCovariance | None = None,
) -> ScaleEstimate:
    """Metric scale and map frame of a model.

    Args:
        evidence: what tells the scale.
        poses: (4, 4) camera_from_model by stamp in order of time, model units; images without a pose are left out.
        camera: calibration.
        config: eccentricity, tolerance, upright.
        covariance: of functions of the poses; None takes these for exact.

    Raises:
        NoScaleError: no board was seen, too few images saw it, or it contradicts its file.
    """
    stamps = list(poses)
    places, placements, warnings = _sound_boards(evidence, poses, camera, config)
    inherited = [sensitivity(place, poses, camera, config) for place in places]
    by_name = {place.board.name: (place, own) for place, own in reversed(list(zip(places, inherited, strict=True)))}
    measurements: list[Measurement] = [
        board_measurement(place, own, stamps, config) for place, own in zip(places, inherited, strict=True)
    ]
    for distance in evidence.distances:
        measurement = distance_measurement(distance, by_name, stamps)
        if measurement is None:
            warnings.append(f"the distance {distance.name} tells nothing: its boards were not both measured")
        else:
            measurements.append(measurement)
    combined = combine(measurements, poses, covariance)
    verticals: list[Vertical] = []
    origin = places[0]
    if config.upright:
        origin, vertical, text = board_vertical(origin, poses)
        verticals.append(vertical)
        warnings += [text] if text else []
    frame, description, disagreements = map_from_model(combined.scale, origin, verticals, poses)
    return ScaleEstimate(
        combined.scale,
        combined.sigma,
        "+".join(dict.fromkeys(one.source for one in measurements)),
        tuple(sorted({view.stamp for place in places for view in place.views})),
        frame,
        description,
        tuple(placements),
        tuple(measurements),
        (*warnings, *combined.warnings, *disagreements),
    )


def _sound_boards(
    evidence: Evidence, poses: Mapping[int, FloatArray], camera: Camera, config: BoardConfig
) -> tuple[list[PlacedBoard], list[BoardPlacement], list[str]]:
    """Boards that agree with their file, what was measured of them, and why others were refused."""
    if not evidence.boards:
        raise NoScaleError("no_board", "no board file was given: hang up a board and name its file, for metres")
    seen = sum(stamp in poses and len(found) > 0 for stamp, found in evidence.observations.items())
    if not seen:
        names = ", ".join(board.name for board in evidence.boards)
        raise NoScaleError("no_board", f"no board ({names}) was identified in any of {len(poses)} images with a pose")
    found = place_boards(evidence.observations, poses, camera, evidence.boards, config, evidence.ellipses)
    if not found:
        raise NoScaleError("too_few_views", f"a board was seen in {seen} images, but from too few sides to be measured")
    measured = [(place, measure(place, poses, camera, config)) for place in found]
    faults = [contradiction(place, result, config) for place, result in measured]
    if all(faults):
        raise NoScaleError("contradiction", "; ".join(faults))
    sound = [one for one, fault in zip(measured, faults, strict=True) if not fault]
    return [place for place, _ in sound], [result for _, result in sound], [fault for fault in faults if fault]
