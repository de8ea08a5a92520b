"""Boards and motion over a stream of keyframes: look once at each image, estimate whenever the poses move."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board import BoardObservation
from pipeprog_sfm.boards.board_detection import detect_boards
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.boards.ellipses import ImageEllipses, detect_ellipses
from pipeprog_sfm.config import BoardConfig, OdometryConfig
from pipeprog_sfm.metric.metric_frame import ScaleEvidence, estimate_scale
from pipeprog_sfm.metric.scale import NoScaleError, PoseCovariance, ScaleEstimate
from pipeprog_sfm.metric.transform_tree import Acceleration, RobotMotion, TransformTree


class MetricTracker:
    """Keeps the ellipses and the identified boards of every keyframe, not the images, and what a robot's motion was."""

    def __init__(
        self,
        targets: BoardFile,
        config: BoardConfig,
        odometry: OdometryConfig = OdometryConfig(),  # noqa: B008  # frozen
    ) -> None:
        self._targets = targets
        self._config = config
        self._odometry = odometry
        self._camera: Camera | None = None
        self._frame: str | None = None
        self._frames: dict[int, str] = {}
        self._ellipses: dict[int, ImageEllipses] = {}
        self._observations: dict[int, list[BoardObservation]] = {}
        self._transforms = TransformTree()
        self._accelerations: list[Acceleration] = []

    def add(self, stamp: int, gray: NDArray[np.uint8], camera: Camera, frame: str = "") -> list[BoardObservation]:
        """Looks for boards in the keyframe of `stamp` [ns] and returns those that it identifies.

        Args:
            stamp: time of the keyframe [ns].
            gray: (H, W) uint8 image as the camera saw it: edges are measured before the lens distortion is removed.
            camera: calibration, the same for every keyframe of one frame.
            frame: name of the camera's optical frame; targets are measured with the first camera alone.
        """
        self._frames[stamp] = frame
        if self._frame is None:
            self._frame = frame
        if frame != self._frame:
            return []
        self._camera = camera
        ellipses = detect_ellipses(gray, camera, self._config)
        found = detect_boards(ellipses, self._targets.boards, camera)
        if len(ellipses):
            self._ellipses[stamp] = ellipses
        if found:
            self._observations[stamp] = found
        return found

    def move(self, motion: RobotMotion) -> None:
        """Takes what odometry, TF and IMU have told since the last call."""
        self._transforms.add(motion.transforms)
        self._accelerations += motion.accelerations

    def retire(self, stamps: Iterable[int]) -> None:
        """Forgets keyframes [ns]; unknown ones are ignored."""
        for stamp in stamps:
            self._ellipses.pop(stamp, None)
            self._observations.pop(stamp, None)
            self._frames.pop(stamp, None)

    def estimate(
        self,
        poses: Mapping[int, FloatArray],
        covariance: PoseCovariance | None = None,
        points: Callable[[], FloatArray] | None = None,
    ) -> ScaleEstimate:
        """Scale and map frame for (4, 4) poses camera_from_model by stamp; the rest as for `estimate_scale`."""
        if self._camera is None or self._frame is None:
            raise NoScaleError("no_board", "no keyframe has been seen yet")
        evidence = ScaleEvidence(
            self._targets,
            self._observations,
            self._ellipses,
            self._transforms,
            self._accelerations,
            self._frame,
            self._frames,
        )
        return estimate_scale(evidence, poses, self._camera, self._config, self._odometry, covariance, points)
