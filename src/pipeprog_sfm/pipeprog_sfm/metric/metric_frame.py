"""What makes a model metric: all sources of scale and of the vertical, gathered over a stream of keyframes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board import BoardObservation
from pipeprog_sfm.boards.board_adjustment import placement_sensitivity
from pipeprog_sfm.boards.board_check import BoardPlacement, contradiction, measure
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.boards.board_triangulation import place_boards
from pipeprog_sfm.boards.ellipses import ImageEllipses
from pipeprog_sfm.boards.placed_board import PlacedBoard
from pipeprog_sfm.boards.scale_bar import ScaleBarError, find_scale_bar
from pipeprog_sfm.config import BoardConfig, OdometryConfig
from pipeprog_sfm.metric.gravity import GravityError, gravity
from pipeprog_sfm.metric.map_frame import Vertical, board_vertical, camera_up, map_from_model, path_vertical
from pipeprog_sfm.metric.odometry import OdometryError, odometry_measurement
from pipeprog_sfm.metric.rig import rig_measurements
from pipeprog_sfm.metric.scale import (
    Measurement,
    NoScaleError,
    PoseCovariance,
    ScaleEstimate,
    board_measurement,
    combine,
    distance_measurement,
)
from pipeprog_sfm.metric.transform_tree import Acceleration, NoPathError, TransformTree
from pipeprog_sfm.metric.vertical_from_planes import PlanesError, vertical_from_planes


@dataclass(frozen=True)
class ScaleEvidence:
    """What was seen of boards and scale bars, and what a robot told of its motion.

    Attributes:
        board_file: what the file says.
        observations: boards seen, by image stamp [ns].
        ellipses: all ellipses of the images, by stamp: boards of which only a circle is in view take part, too.
        transforms: odometry and TF.
        accelerations: of an IMU.
        camera_frame: name of the camera's optical frame.
        frames: the same by stamp [ns], where images are of another camera than that one; it tells no more than where
            it is mounted.
    """

    board_file: BoardFile = BoardFile()  # noqa: RUF009  # frozen
    observations: Mapping[int, Sequence[BoardObservation]] = field(default_factory=dict)
    ellipses: Mapping[int, ImageEllipses] | None = None
    transforms: TransformTree = field(default_factory=TransformTree)
    accelerations: Sequence[Acceleration] = ()
    camera_frame: str = ""
    frames: Mapping[int, str] = field(default_factory=dict)


def estimate_scale(
    evidence: ScaleEvidence,
    poses: Mapping[int, FloatArray],
    camera: Camera,
    config: BoardConfig,
    odometry: OdometryConfig = OdometryConfig(),  # noqa: B008  # frozen
    covariance: PoseCovariance | None = None,
    points: Callable[[], FloatArray] | None = None,
) -> ScaleEstimate:
    """Metric scale and map frame of a model.

    Args:
        evidence: what tells the scale and the vertical.
        poses: (4, 4) camera_from_model by stamp in order of time, model units; images without a pose are left out.
        camera: calibration.
        config: eccentricity, tolerance, upright.
        odometry: how good odometry is.
        covariance: of functions of the poses; None takes these for exact.
        points: gives (N, 3) points of the model, should nothing else tell the vertical.

    Raises:
        NoScaleError: no source of scale was seen, or too little of it, or a board contradicts its file, or nothing
            tells the vertical.
    """
    stamps = list(poses)
    warnings: list[str] = []
    measurements: list[Measurement] = []
    places: list[PlacedBoard] = []
    placements: list[BoardPlacement] = []
    refusal: NoScaleError | None = None
    try:
        places, placements, warnings = _sound_boards(evidence, poses, camera, config)
    except NoScaleError as error:
        refusal = error
    inherited = [placement_sensitivity(place, poses, camera, config) for place in places]
    measurements += [board_measurement(*pair, stamps, config) for pair in zip(places, inherited, strict=True)]
    by_name = {place.board.name: (place, own) for place, own in reversed(list(zip(places, inherited, strict=True)))}
    for distance in evidence.board_file.distances:
        measurement = distance_measurement(distance, by_name, stamps)
        if measurement is None:
            warnings.append(f"the distance {distance.name} tells nothing: its boards were not both measured")
        else:
            measurements.append(measurement)
    for pair in evidence.board_file.scale_bars:
        try:
            ends = find_scale_bar(pair, _loose(evidence, places), poses, camera, config)
        except ScaleBarError as error:
            warnings.append(str(error))
        else:
            placed = {
                name: (place, placement_sensitivity(place, poses, camera, config)) for name, place in ends.items()
            }
            measurements += [one for one in [distance_measurement(pair.distance, placed, stamps)] if one]
    found, texts = rig_measurements(evidence.frames, evidence.transforms, poses, odometry)
    measurements += found
    warnings += texts
    own = {
        stamp: pose
        for stamp, pose in poses.items()
        if evidence.frames.get(stamp, evidence.camera_frame) == evidence.camera_frame
    }
    path = None
    if evidence.transforms:
        try:
            path = evidence.transforms.path(evidence.camera_frame, list(own))
            measurements.append(odometry_measurement(path, poses, odometry))
        except (NoPathError, OdometryError) as error:
            warnings.append(str(error))
    if refusal is not None and (not measurements or evidence.board_file.boards):
        warnings.insert(0, str(refusal))
    if not measurements:
        assert refusal is not None
        raise NoScaleError(refusal.reason, "; ".join(warnings))
    combined = combine(measurements, poses, covariance)
    origin = places[0] if places else None
    verticals: list[Vertical] = []
    if evidence.accelerations:
        try:
            verticals.append(_gravity(evidence, own, combined.scale))
        except (NoPathError, GravityError) as error:
            warnings.append(str(error))
    if origin is not None and config.upright:
        origin, vertical, text = board_vertical(origin, poses)
        verticals.append(vertical)
        warnings += [text] if text else []
    if path is not None and len(path.stamps):
        verticals.append(path_vertical(path, poses))
    if not verticals:
        try:
            verticals.append(vertical_from_planes(points() if points else np.empty((0, 3)), camera_up(poses)))
        except PlanesError as error:
            raise NoScaleError(
                "no_vertical", f"{error}: hang the board upright and set upright to true, or record an IMU or odometry"
            ) from error
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


def _gravity(evidence: ScaleEvidence, poses: Mapping[int, FloatArray], scale: float) -> Vertical:
    frames = {one.frame for one in evidence.accelerations}
    turns = {frame: evidence.transforms.static_transform(evidence.camera_frame, frame) for frame in frames}
    forces = np.stack([turns[one.frame][:3, :3] @ one.force for one in evidence.accelerations])
    return gravity(np.array([one.stamp for one in evidence.accelerations], np.int64), forces, poses, scale)


def _loose(evidence: ScaleEvidence, places: Sequence[PlacedBoard]) -> dict[int, ImageEllipses]:
    """The ellipses that belong to no board."""
    taken = {(view.stamp, *centre) for place in places for view in place.views for centre in view.seen.ellipse_centres}
    loose = {}
    for stamp, seen in (evidence.ellipses or {}).items():
        free = np.array([(stamp, *centre) not in taken for centre in seen.centres], bool)
        loose[stamp] = ImageEllipses(seen.centres[free], seen.shapes[free], seen.rms[free])
    return loose


def _sound_boards(
    evidence: ScaleEvidence, poses: Mapping[int, FloatArray], camera: Camera, config: BoardConfig
) -> tuple[list[PlacedBoard], list[BoardPlacement], list[str]]:
    """Boards that agree with their file, what was measured of them, and why others were refused."""
    if not evidence.board_file.boards:
        raise NoScaleError("no_board", "nothing tells the scale: hang up a board and name its file, or record odometry")
    seen = sum(stamp in poses and len(found) > 0 for stamp, found in evidence.observations.items())
    if not seen:
        names = ", ".join(board.name for board in evidence.board_file.boards)
        raise NoScaleError("no_board", f"no board ({names}) was identified in any of {len(poses)} images with a pose")
    found = place_boards(evidence.observations, poses, camera, evidence.board_file.boards, config, evidence.ellipses)
    if not found:
        raise NoScaleError("too_few_views", f"a board was seen in {seen} images, but from too few sides to be measured")
    measured = [(place, measure(place, poses, camera, config)) for place in found]
    faults = [contradiction(place, result, config) for place, result in measured]
    if all(faults):
        raise NoScaleError("contradiction", "; ".join(faults))
    sound = [one for one, fault in zip(measured, faults, strict=True) if not fault]
    return [place for place, _ in sound], [result for _, result in sound], [fault for fault in faults if fault]
