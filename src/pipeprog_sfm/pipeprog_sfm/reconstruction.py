"""Keyframes in, a metric map out: the stages of the reconstruction, wired together."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_sfm.board import Board
from pipeprog_sfm.board_tracker import BoardTracker
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.fusion import FusedCloud, Fusion
from pipeprog_sfm.mapper import FrameTie, KeyframeReport, Mapper
from pipeprog_sfm.scale import NoScaleError, ScaleEstimate
from pipeprog_sfm.stereo import DepthMap, StereoImage, choose_pairs, depth_map

FloatArray = NDArray[np.float64]

LOOKAHEAD = 2  # later keyframes that a depth map waits for, so that it has neighbours on both sides
STEREO_BACKLOG = 4  # depth maps under way, each holding its images
IMAGE_CACHE = 8  # decoded keyframes: a depth map's neighbours are mostly the last few


class NotMetricError(Exception):
    """There is no metric map; the text says why and what to do."""


@dataclass(frozen=True)
class Status:
    """Health of the reconstruction; fields as in pipeprog_msgs/SfmStatus."""

    seen: int
    registered: int
    waiting: int
    models: int
    reprojection_error: float
    scale: ScaleEstimate | None
    message: str


@dataclass(frozen=True)
class MetricMap:
    """The map in metres, z up: stamps (M,) int64, map_from_camera (M, 4, 4) float64 in order of time, and the cloud."""

    scale: ScaleEstimate
    stamps: NDArray[np.int64]
    map_from_camera: FloatArray
    cloud: FusedCloud


@dataclass(frozen=True)
class _Depth:
    map: DepthMap
    baselines: dict[int, float]  # to the neighbours that it was made with, in model units of that time


class Reconstruction:
    """Sparse poses, board scale, depth maps and fusion over a stream of keyframes."""

    def __init__(self, config: SfmConfig, boards: Sequence[Board]) -> None:
        self._config = config
        self._mapper = Mapper(config.mapper, config.seed)
        self._targets = BoardTracker(boards, config.board)
        self._encoded: dict[int, tuple[bytes, Camera]] = {}
        self._raw = lru_cache(maxsize=1)(self._decode)
        self._image = lru_cache(maxsize=IMAGE_CACHE)(self._undistort)
        self._depths: dict[int, Future[_Depth]] = {}
        # One thread beside the mapper's: matching releases Python's lock, and one keeps the order of results fixed.
        self._stereo = ThreadPoolExecutor(max_workers=1)
        self._fusion = Fusion(config.fusion)
        self._fused: dict[int, FloatArray] = {}
        self._scale: ScaleEstimate | None = None
        self._reason = "no keyframe has been registered yet"
        self._problem = ""

    def add(self, stamp: int, encoded: bytes, camera: Camera) -> KeyframeReport:
        """Takes a keyframe (JPEG or PNG bytes, stamp in ns); raises InputError when it cannot be decoded."""
        self._encoded[stamp] = (encoded, camera)
        try:
            gray = cv2.cvtColor(self._raw(stamp), cv2.COLOR_BGR2GRAY)
        except InputError:
            del self._encoded[stamp]
            raise
        # Features and targets are measured in the image as it is: their points are undistorted, not resampled.
        report = self._mapper.add(stamp, gray, camera)
        self._targets.add(stamp, gray, camera)
        poses = self._mapper.camera_from_model()
        ready = sorted(poses)[:-LOOKAHEAD]
        self._start_depth_maps([other for other in ready if other not in self._depths], poses)
        return report

    def skip(self, stamp: int, problem: str) -> None:
        """Notes a keyframe that could not be used."""
        self._problem = f"keyframe {stamp}: {problem}"

    def retire(self, stamps: Collection[int]) -> None:
        """Takes keyframes out of the map: pose, observations and depth map; unknown stamps are ignored.

        What they have added to the cloud stays until the cloud is made anew, at the latest for the final map.
        """
        self._mapper.retire(stamps)
        self._targets.retire(stamps)
        for stamp in stamps:
            self._encoded.pop(stamp, None)
            self._depths.pop(stamp, None)

    def finish(self) -> None:
        """Registers what still can be, adjusts everything and completes the depth maps."""
        self._mapper.finish()
        poses = self._mapper.camera_from_model()
        self._start_depth_maps([stamp for stamp in sorted(poses) if stamp not in self._depths], poses)
        self._fused.clear()  # the final cloud is made from the final poses alone

    def ties(self) -> list[FrameTie]:
        """Overlap of the keyframes that changed since the last call (Eq. 1)."""
        return self._mapper.ties()

    def status(self) -> Status:
        """Health so far."""
        message = self._problem or ("; ".join(self._scale.warnings) if self._scale else self._reason)
        return Status(
            self._mapper.seen,
            self._mapper.registered,
            self._mapper.waiting,
            self._mapper.models,
            self._mapper.reprojection_error,
            self._scale,
            message,
        )

    def metric_map(self) -> MetricMap:
        """The map as it stands; raises NotMetricError while there are no poses or no scale."""
        camera_from_model = self._mapper.camera_from_model()
        if len(camera_from_model) < 2:
            self._reason = (
                f"{len(camera_from_model)} of {self._mapper.seen} keyframes could be placed: "
                "film textured surroundings while moving sideways, and check the calibration"
            )
            raise NotMetricError(self._reason)
        try:
            self._scale = self._targets.estimate(camera_from_model, self._mapper.covariance)
        except NoScaleError as error:
            self._scale, self._reason = None, str(error)
            raise NotMetricError(self._reason) from error
        poses = {
            stamp: _metric_pose(pose, self._scale.map_from_model) for stamp, pose in sorted(camera_from_model.items())
        }
        self._fuse(poses, camera_from_model)
        return MetricMap(
            self._scale,
            np.array(list(poses), np.int64),
            np.stack([np.linalg.inv(pose) for pose in poses.values()]),
            self._fusion.cloud(),
        )

    def _decode(self, stamp: int) -> NDArray[np.uint8]:
        """The keyframe as the camera saw it, (H, W, 3) BGR."""
        encoded, camera = self._encoded[stamp]
        image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise InputError("the image is damaged: it is left out")
        if image.shape[:2] != (camera.height, camera.width):
            raise InputError(
                f"the image has {image.shape[1]} x {image.shape[0]} pixels, its CameraInfo says "
                f"{camera.width} x {camera.height}: calibrate at the size that the camera sends"
            )
        return image

    def _undistort(self, stamp: int) -> NDArray[np.uint8]:
        """The keyframe as the ideal pinhole camera sees it, (H, W, 3) BGR."""
        return self._encoded[stamp][1].undistort_image(self._raw(stamp))

    def _stereo_image(self, stamp: int, pose: FloatArray) -> StereoImage:
        return StereoImage(stamp, self._image(stamp), self._encoded[stamp][1].pinhole(), pose)

    def _start_depth_maps(self, stamps: Sequence[int], poses: dict[int, FloatArray]) -> None:
        if not stamps:
            return
        for stamp in stamps:
            depth = self._mapper.depths(stamp)
            depth = depth[depth > 0]
            if len(depth) < 10:
                continue
            near, middle, far = np.percentile(depth, [1, 50, 99])
            pairs = choose_pairs(stamp, poses, {stamp: float(middle)}, self._config.stereo)
            if not pairs:
                continue
            # Surfaces without features lie beyond the sparse points' range as often as not.
            depth_range = (0.7 * float(near), 1.5 * float(far))
            reference = self._stereo_image(stamp, poses[stamp])
            neighbours = [self._stereo_image(other, poses[other]) for other in pairs]
            for earlier in list(self._depths.values())[:-STEREO_BACKLOG]:
                earlier.result()
            self._depths[stamp] = self._stereo.submit(self._depth, reference, neighbours, depth_range)

    def _depth(
        self, reference: StereoImage, neighbours: Sequence[StereoImage], depth_range: tuple[float, float]
    ) -> _Depth:
        result = depth_map(reference, neighbours, depth_range, self._config.stereo)
        pose = reference.camera_from_world
        return _Depth(result, {other.stamp: _distance(pose, other.camera_from_world) for other in neighbours})

    def _fuse(self, poses: dict[int, FloatArray], camera_from_model: dict[int, FloatArray]) -> None:
        """Adds new depth maps to the cloud; starts over when the poses have moved by more than a voxel."""
        moved = (
            np.linalg.norm(_centre(poses[stamp]) - _centre(pose))
            for stamp, pose in self._fused.items()
            if stamp in poses
        )
        if not self._fused or max(moved, default=np.inf) > self._config.fusion.voxel:
            self._fusion, self._fused = Fusion(self._config.fusion), {}
        assert self._scale is not None
        for stamp, pose in poses.items():
            if stamp in self._fused or stamp not in self._depths:
                continue
            depth = self._depths[stamp].result()
            left = [other for other in depth.baselines if other in poses]
            if not left:
                continue
            # The model's unit drifts with every adjustment; the baselines tell by how much.
            now = sum(_distance(camera_from_model[stamp], camera_from_model[other]) for other in left)
            drift = now / sum(depth.baselines[other] for other in left)
            self._fusion.add(depth.map, pose, self._scale.scale * drift)
            self._fused[stamp] = pose


def _centre(camera_from_world: FloatArray) -> FloatArray:
    return -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]


def _distance(camera_from_world: FloatArray, other_from_world: FloatArray) -> float:
    return float(np.linalg.norm(_centre(camera_from_world) - _centre(other_from_world)))


def _metric_pose(camera_from_model: FloatArray, map_from_model: FloatArray) -> FloatArray:
    """camera_from_map (4, 4), rigid, from a pose in the model and the similarity map_from_model."""
    scale = np.cbrt(np.linalg.det(map_from_model[:3, :3]))
    rotation = camera_from_model[:3, :3] @ map_from_model[:3, :3].T / scale
    centre = map_from_model[:3, :3] @ _centre(camera_from_model) + map_from_model[:3, 3]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    return pose
