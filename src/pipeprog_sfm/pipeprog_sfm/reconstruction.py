# SPDX-License-Identifier: Apache-2.0
"""Keyframes in, a metric map out: the stages of the reconstruction, wired together."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_camera.rolled_image import RowVelocities
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.alignment.alignment import Alignment, align
from pipeprog_sfm.alignment.placing import NotAlignedError
from pipeprog_sfm.alignment.survey_map import MappedBoard, SurveyMap, sparse_part, thinned
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.camera_in_use import CameraInUse, board_agrees, radial_warning
from pipeprog_sfm.config import NOT_TOLD, SfmConfig
from pipeprog_sfm.deblur import Deblurrer
from pipeprog_sfm.dense.dense_mapper import DenseMapper, Registered, centre
from pipeprog_sfm.dense.depth_fusion import FusedCloud
from pipeprog_sfm.features.images_ahead import ImagesAhead
from pipeprog_sfm.metric.metric_tracker import MetricTracker
from pipeprog_sfm.metric.scale import DISAGREEMENT, NoScaleError, ScaleEstimate
from pipeprog_sfm.metric.scale_sources import SOURCES, ScaleSource
from pipeprog_sfm.metric.transform_tree import RobotMotion
from pipeprog_sfm.metric.unrolled_ellipses import RollingViews
from pipeprog_sfm.model.row_motion import LONG_TRAJECTORY
from pipeprog_sfm.model.sparse_model import SparseModel
from pipeprog_sfm.sparse.colmap import ModelView, write_model
from pipeprog_sfm.sparse.mapper import GROWTH, KeyframeReport, Mapper
from pipeprog_sfm.sparse.overlap import OverlapReport
from pipeprog_sfm.types import EncodedImage

# Of read-out and poses in turns: poses and velocities follow what the read-out is off by, so that a turn leaves up to a
# half of it (20 ms told as 24 ms: 20.2, 19.95).
READOUT_ROUNDS = 6
EARLY_ROUNDS = 2  # of these while keyframes come: the next ones tell more than further rounds


class NotMetricError(Exception):
    """There is no metric map; the text says why and what to do."""


@dataclass(frozen=True)
class Status:
    """Health of the reconstruction; fields as in pipeprog_msgs/SfmStatus."""

    seen: int = 0
    registered: int = 0
    waiting: int = 0
    models: int = 0
    reprojection_error: float = 0.0
    scale: ScaleEstimate | None = None
    message: str = ""
    calibration: str = ""
    readout: float = 0.0
    readout_sigma: float = 0.0


@dataclass(frozen=True)
class Trajectory:
    """Poses in metres, z up: stamps (M,) int64 and map_from_camera (M, 4, 4) float64, in order of time.

    Velocities are given with a rolling shutter only.
    """

    stamps: NDArray[np.int64]
    map_from_camera: FloatArray
    velocities: RowVelocities | None = None

    def correction(self, earlier: Trajectory | None) -> float:
        """How far the keyframe is moved that has moved farthest since an earlier trajectory, m."""
        if earlier is None:
            return 0.0
        _, own, theirs = np.intersect1d(self.stamps, earlier.stamps, return_indices=True)
        moved = self.map_from_camera[own, :3, 3] - earlier.map_from_camera[theirs, :3, 3]
        return float(np.linalg.norm(moved, axis=1).max(initial=0.0))


@dataclass(frozen=True)
class MetricMap:
    """The map in metres: the poses, the cloud that goes with them, the scale of both, and the camera if refined."""

    scale: ScaleEstimate
    trajectory: Trajectory
    cloud: FusedCloud
    refined_camera: Camera | None = None


class Reconstruction:
    """Sparse poses, scale, depth maps and fusion over a stream of keyframes.

    Args:
        config: settings.
        board_file: boards, scale bars and known distances that may be seen.
        sources: what measures the scale; `(*SOURCES, own)` adds a source of one's own (examples/own_scale_source.py).
        reference: map of an earlier survey, in whose frame the final map is to lie.
    """

    def __init__(
        self,
        config: SfmConfig,
        board_file: BoardFile,
        sources: Sequence[ScaleSource] = SOURCES,
        reference: SurveyMap | None = None,
    ) -> None:
        told = None if config.readout == NOT_TOLD else config.readout
        self._mapper = Mapper(config.mapper, config.seed, readout=told or 0.0)
        self._map = self._mapper.map
        self._config = config
        self._ahead = ImagesAhead(config.mapper)
        self._deblurrer = Deblurrer(config)
        self._metric_tracker = MetricTracker(board_file, config.board, config.odometry, sources)
        self._camera = CameraInUse(config.calibration, told)
        self._images: dict[int, EncodedImage] = {}
        self._dense = DenseMapper(config.stereo, config.fusion)
        self._pending: tuple[ScaleEstimate, Trajectory, Future[FusedCloud]] | None = None
        self._scale: ScaleEstimate | None = None
        self._scaled = -1  # revision of the map that the scale was estimated in
        self._sightings = 0  # keyframes that show a board
        self._due = 0.0  # sightings at which the scale is estimated again
        self._reason = "no keyframe has been registered yet"
        self._problem = ""
        self._camera_warning = ""
        self._reference = reference
        self._alignment: Alignment | None = None
        self._not_aligned = ""

    def expect(self, stamp: int, encoded: bytes, camera: Camera) -> None:
        """Has the image of a keyframe that will be added prepared beside what is done till then; from any thread."""
        self._ahead.expect(stamp, encoded, self._camera.of(camera))

    def add(self, stamp: int, encoded: bytes, camera: Camera, frame: str = "") -> KeyframeReport:
        """Takes a keyframe (JPEG or PNG bytes, stamp in ns, the camera's frame); InputError when it cannot be used."""
        if stamp in self._map.keyframes:
            self._ahead.forget(stamp)
            raise InputError("a keyframe of this stamp has been taken already: it is left out")
        told, camera = camera, self._camera.of(camera)
        image = self._ahead.take(stamp, encoded, told, camera)
        self._images[stamp] = EncodedImage(encoded, camera)
        self._alignment = None  # it is of the last final map
        # Features and boards are measured in the image as it is: their points are undistorted, not resampled.
        self._sightings += bool(self._metric_tracker.add(stamp, image.gray, camera, frame))
        report = self._mapper.add(stamp, image.gray, camera, frame, image.features)
        poses = self._map.camera_from_model()
        for other, features in self._deblurrer.deblurred(stamp, self._images[stamp], poses, self._map.points_seen):
            self._mapper.replace_features(other, features)
        if self._camera.is_due(len(self._map.published)):
            self._settle_camera(final=False)
        return report

    def update_dense(self) -> None:
        """Starts the depth maps that can be made by now; they are worked off in a thread of their own."""
        # With a rolling shutter, once rows correct the velocities: before, these are off by up to 6 %, which moves
        # points at the border of an image by 0.4 px (30 ms, 0.75 m/s).
        if not self._map.readout or self._map.published.adjusted_at >= LONG_TRAJECTORY:
            self._dense.update(self._registered(), complete=False)

    def move(self, motion: RobotMotion) -> None:
        """Takes what odometry, TF and IMU have told since the last call."""
        self._metric_tracker.move(motion)

    def skip(self, stamp: int, problem: str) -> None:
        """Notes a keyframe that could not be used."""
        self._problem = f"keyframe {stamp}: {problem}"

    def retire(self, stamps: Collection[int]) -> None:
        """Takes keyframes out of the map: pose, observations and depth map; unknown stamps are ignored.

        What they have added to the cloud stays until the cloud is made anew, at the latest for the final map.
        """
        self._mapper.retire(stamps)
        self._deblurrer.retire(stamps)
        self._metric_tracker.retire(stamps)
        self._dense.retire(stamps)
        for stamp in stamps:
            self._images.pop(stamp, None)

    def finish(self) -> MetricMap:
        """Registers what still can be, adjusts everything, and makes the final map; raises NotMetricError."""
        self._mapper.finish()
        if self._camera.refines:
            self._settle_camera(final=True)
        warnings = radial_warning(self._map.radial_residuals()), self._camera.readout_warning()
        self._camera_warning = "; ".join(filter(None, warnings))
        self._scaled = -1
        if self._reference is not None:
            self._align(self._reference)
        self._request(settled=True, final=True)
        return self._take()

    def close(self) -> None:
        """Gives up what has not been begun; nothing more can be asked for."""
        self._dense.close()

    def write_colmap(self, folder: Path) -> None:
        """The sparse model in `map` for COLMAP, binary and as text; images are named by their stamps [ns]."""
        scale, trajectory = self._metric()
        points, seen = self._map.observations()
        poses = dict(zip(trajectory.stamps.tolist(), np.linalg.inv(trajectory.map_from_camera), strict=True))
        views = [
            ModelView(f"{stamp}.jpg", self._images[stamp].camera, poses[stamp], pixels, rows)
            for stamp, (rows, pixels) in seen.items()
        ]
        write_model(folder, views, points @ scale.map_from_model[:3, :3].T + scale.map_from_model[:3, 3])

    def survey_map(self, cloud: FusedCloud) -> SurveyMap:
        """What the next survey of this site is aligned with; `cloud`: of the final map."""
        scale, _ = self._metric()
        survey = sparse_part(self._map.published, self._map.keyframes, scale.map_from_model, scale.scale)
        points, normals = thinned(cloud.points, cloud.normals)
        linear, shift = scale.map_from_model[:3, :3], scale.map_from_model[:3, 3]
        boards = tuple(MappedBoard(b.board.name, b.circles_in_model @ linear.T + shift) for b in scale.boards)
        survey = replace(survey, scale_sigma=scale.sigma, boards=boards, cloud=points, normals=normals)
        if self._alignment is None or self._reference is None:
            return survey
        return replace(
            survey,
            frame=self._reference.frame,
            aligned_by=self._alignment.by,
            alignment_covariance=self._alignment.covariance,
        )

    def overlap_reports(self) -> list[OverlapReport]:
        """Overlap of the keyframes that changed since the last call (Eq. 1)."""
        return self._map.overlap_reports()

    def status(self) -> Status:
        """Health so far."""
        warnings = (self._not_aligned, *self._scale.warnings, self._camera_warning) if self._scale else ()
        message = self._problem or ("; ".join(filter(None, warnings)) if self._scale else self._reason)
        if len(self._map.models) > 1:
            elsewhere = len(self._map.keyframes) - len(self._map.waiting) - len(self._map.published)
            message = "; ".join(
                [message] * bool(message)
                + [f"{elsewhere} keyframes are not connected with the map: film what lies between once more"]
            )
        return Status(
            len(self._map.keyframes),
            len(self._map.published),
            len(self._map.waiting),
            len(self._map.models),
            self._map.reprojection_error(),
            self._scale,
            message,
            self._camera.description(),
            self._map.readout,
            self._camera.readout_sigma,
        )

    def trajectory(self) -> Trajectory:
        """The poses as they stand; raises NotMetricError while there are no poses or no scale."""
        return self._metric()[1]

    def request_map(self, settled: bool) -> None:
        """Starts to make a map; raises NotMetricError.

        settled: no keyframe is expected soon, so that the map waits for all depth maps that can be made by now; else it
            is of those that are there. The last keyframes get theirs with later neighbours, or in the final map: it
            must not depend on when the stream of keyframes paused.
        """
        self._request(settled, final=False)

    @property
    def is_mapping(self) -> bool:
        """Whether a map has been requested and not been taken."""
        return self._pending is not None

    def finished_map(self) -> MetricMap | None:
        """The map that was requested, once it is there; raises NotMetricError when there is no surface in it yet."""
        return self._take() if self._pending is not None and self._pending[2].done() else None

    def _registered(self) -> Registered:
        motions = self._map.motions(self._map.published)
        return Registered(self._map.camera_from_model(), self._images, self._map.points_seen, motions)

    def _request(self, settled: bool, final: bool) -> None:
        if final:
            self._dense.update(self._registered(), complete=True)
        scale, trajectory = self._metric()
        camera_from_map = dict(zip(trajectory.stamps.tolist(), np.linalg.inv(trajectory.map_from_camera), strict=True))
        cloud = self._dense.fuse(camera_from_map, self._map.camera_from_model(), scale.scale, settled, anew=final)
        self._pending = scale, trajectory, cloud

    def _take(self) -> MetricMap:
        assert self._pending is not None
        scale, trajectory, cloud = self._pending
        self._pending = None
        points = cloud.result()
        if not len(points.points):
            self._reason = (
                f"no surface is seen by {self._config.fusion.min_views} of {len(self._map.published)} keyframes alike: "
                "walk past it, sideways, or have more keyframes chosen (frames.overlap_min)"
            )
            raise NotMetricError(self._reason)
        return MetricMap(scale, trajectory, points, self._camera.refined)

    def _settle_camera(self, final: bool) -> None:
        """Refines the camera, with a rolling shutter in turns with the poses until the read-out stays."""
        for _ in range(READOUT_ROUNDS if final else EARLY_ROUNDS):
            before = self._map.readout
            if not self._refine_camera(final):
                return
            if final:
                self._mapper.finish()
            if self._map.readout == before:
                return

    def _refine_camera(self, final: bool) -> bool:
        """Goes on with the camera that the map says, where the boards agree; whether it does."""
        poses = self._map.camera_from_model()
        if not poses:
            return False
        used = self._images[next(iter(poses))].camera
        waiting = bool(self._map.readout) and not final
        found = self._mapper.self_calibration(self._camera.priors(used, waiting), final)
        if found is None or not self._camera.is_better(found, final):
            return False
        images = {stamp: image for stamp, image in self._images.items() if image.camera == found.told}
        if len(images) < len(self._images):  # the detector is told one camera for all keyframes
            return False
        measured = self._metric_tracker
        if found.camera != found.told:
            measured = measured.remeasured(((stamp, image.gray()) for stamp, image in images.items()), found.camera)
        if not self._mapper.keeps_map(found):  # boards do not tell so little
            model = self._map.published
            rolling, other = (
                _rolling(model, self._map.spline_motions(model, each)) for each in (self._map.readout, found.readout)
            )
            before = self._metric_tracker.board_misfit(poses, rolling)
            if not board_agrees(before, measured.board_misfit(found.poses, other)):
                return False
        self._camera.accept(found)
        if found.camera != found.told:
            self._metric_tracker = measured
            for stamp, image in images.items():
                self._images[stamp] = EncodedImage(image.data, found.camera)
            self._deblurrer.replace_camera(found.camera)
        self._mapper.take_camera(found, final)
        self._dense.change_camera(found.shift)
        return True

    def _metric(self) -> tuple[ScaleEstimate, Trajectory]:
        """The scale, estimated again when the map has moved or more of the boards was seen, and the metric poses."""
        # Its cost grows with the map: a pose must not wait for it at every keyframe in sight of a board.
        moved = self._scaled != self._map.revision
        if self._scale is None or moved or self._sightings >= self._due:
            self._estimate_scale()
            self._scaled, self._due = self._map.revision, GROWTH * (self._sightings + 1)
        if self._scale is None:
            raise NotMetricError(self._reason)
        poses = {
            stamp: _metric_pose(pose, self._scale.map_from_model)
            for stamp, pose in self._map.camera_from_model().items()
        }
        map_from_camera = np.stack([np.linalg.inv(pose) for pose in poses.values()])
        stamps = np.array(list(poses), np.int64)
        return self._scale, Trajectory(stamps, map_from_camera, self._velocities(stamps, self._scale.scale))

    def _velocities(self, stamps: NDArray[np.int64], scale: float) -> RowVelocities | None:
        """Of the published model's keyframes, zero where unknown; None without a rolling shutter."""
        if not self._map.readout:
            return None
        motions = self._map.motions(self._map.published)
        known = np.array([stamp in motions for stamp in stamps.tolist()])
        rates = np.zeros((4, len(stamps), 3))
        for row in np.flatnonzero(known):
            motion = motions[int(stamps[row])]
            rates[:2, row] = scale * motion.linear, motion.angular
            rates[2:, row] = scale * motion.linear_acceleration, motion.angular_acceleration
        return RowVelocities(self._map.readout, *rates)

    def _align(self, reference: SurveyMap) -> None:
        """Puts the model that is published into the frame of the reference, or notes why not."""
        self._alignment, self._not_aligned = None, ""
        self._estimate_scale()
        model = self._map.published
        boards = self._scale.boards if self._scale else ()
        try:
            if not len(model):
                raise NotAlignedError("nothing was reconstructed")
            self._alignment = align(model, self._map.keyframes, boards, reference, self._config.seed)
        except NotAlignedError as error:
            self._not_aligned = f"not aligned with the reference, so the map is in a frame of its own: {error}"
            self._reason = f"{self._reason}; {self._not_aligned}"

    def _estimate_scale(self) -> None:
        """The scale of its own, or that of the reference where the survey is aligned with one."""
        self._estimate_own_scale()
        if self._alignment is not None and self._reference is not None:
            self._scale = in_frame_of(self._reference, self._alignment, self._scale)

    def _estimate_own_scale(self) -> None:
        """Publishes the largest model that has a scale; the reason is that of the largest one."""
        self._scale = None
        models = sorted(self._map.models, key=len, reverse=True)
        if not models:
            self._reason = (
                f"none of {len(self._map.keyframes)} keyframes could be placed: "
                "film textured surroundings while moving sideways, and check the calibration"
            )
        for number, model in enumerate(models):
            poses = model.poses()
            first = next(iter(poses))
            try:
                self._scale = self._metric_tracker.estimate(
                    poses,
                    partial(self._map.covariance, first),
                    partial(self._map.points, first),
                    _rolling(model, self._map.motions(model)),
                )
            except NoScaleError as error:
                if number == 0:
                    self._reason = str(error)
                continue
            self._map.publish(first)
            return


def in_frame_of(reference: SurveyMap, alignment: Alignment, own: ScaleEstimate | None) -> ScaleEstimate:
    """The scale and frame of a reference for a survey that was aligned with it; `own`: what it measured itself."""
    sigma = float(np.hypot(reference.scale_sigma, alignment.scale_sigma))
    frame = f"that of the reference, found again by its {alignment.by}"
    if own is None:
        pose = alignment.reference_from_model
        return ScaleEstimate(alignment.scale, sigma, "reference", (), pose, frame, (), (), ())
    gap, spread = np.log(own.scale / alignment.scale), np.hypot(sigma, own.sigma)
    warnings = own.warnings
    if abs(gap) > DISAGREEMENT * spread:
        warnings += (
            f"this survey's own scale ({own.source}) is {100 * np.expm1(gap):+.2f} % off that of the reference, more "
            f"than three times their uncertainty ({100 * spread:.2f} %): is the board the one that its file describes?",
        )
    return replace(
        own,
        scale=alignment.scale,
        sigma=sigma,
        source="+".join(dict.fromkeys(("reference", *own.source.split("+")))),
        map_from_model=alignment.reference_from_model,
        frame=frame,
        warnings=warnings,
    )


def _rolling(model: SparseModel, motions: dict[int, RowMotion]) -> RollingViews | None:
    """What unrolls the pixels of a model's views; None with a global shutter."""

    def points_seen(stamp: int) -> FloatArray:
        return np.asarray(model.points[model.seen(model.stamps.index(stamp))])

    return RollingViews(motions, points_seen) if motions else None


def _metric_pose(camera_from_model: FloatArray, map_from_model: FloatArray) -> FloatArray:
    """camera_from_map (4, 4), rigid, from a pose in the model and the similarity map_from_model."""
    scale = np.cbrt(np.linalg.det(map_from_model[:3, :3]))
    rotation = camera_from_model[:3, :3] @ map_from_model[:3, :3].T / scale
    place = map_from_model[:3, :3] @ centre(camera_from_model) + map_from_model[:3, 3]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ place
    return pose
