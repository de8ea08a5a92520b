# SPDX-License-Identifier: Apache-2.0
"""The metric evidence of a stream of keyframes: each image is measured once, the scale estimated at any poses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board import BoardObservation
from pipeprog_sfm.boards.board_detection import detect_boards, observed_in
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.boards.ellipses import ImageEllipses, detect_ellipses
from pipeprog_sfm.boards.placed_board import PlacedBoard
from pipeprog_sfm.config import BoardConfig, OdometryConfig
from pipeprog_sfm.metric.metric_frame import estimate_scale
from pipeprog_sfm.metric.scale import NoScaleError, PoseCovariance, ScaleEstimate
from pipeprog_sfm.metric.scale_evidence import PosedEvidence, ScaleEvidence
from pipeprog_sfm.metric.scale_sources import SOURCES, ScaleSource, scale_bar_discs
from pipeprog_sfm.metric.transform_tree import Acceleration, RobotMotion, TransformTree
from pipeprog_sfm.metric.unrolled_ellipses import RollingViews, unrolled_ellipses

# px by which unrolled ellipses may move before boards are sought among them anew: circles of a board that can be read
# are ten and more apart.
FOLLOWED = 1.0


class MetricTracker:
    """Holds the ellipses and detected boards of every keyframe, not the images, and what a robot told of its motion.

    Args:
        board_file: boards, known distances and scale bars.
        config: how boards are measured.
        odometry: standard deviations of odometry and rig.
        sources: what measures the scale; `(*SOURCES, own)` adds a source of one's own.
    """

    def __init__(
        self,
        board_file: BoardFile,
        config: BoardConfig,
        odometry: OdometryConfig = OdometryConfig(),  # noqa: B008  # frozen
        sources: Sequence[ScaleSource] = SOURCES,
    ) -> None:
        self._board_file = board_file
        self._config = config
        self._odometry = odometry
        self._sources = sources
        self._cameras: dict[int, Camera] = {}
        self._first_frame: str | None = None
        self._frames: dict[int, str] = {}
        self._ellipses: dict[int, ImageEllipses] = {}
        self._observations: dict[int, list[BoardObservation]] = {}
        self._sought: dict[int, tuple[ImageEllipses, list[BoardObservation]]] = {}  # boards among unrolled ellipses
        self._transforms = TransformTree()
        self._accelerations: list[Acceleration] = []

    def add(self, stamp: int, gray: NDArray[np.uint8], camera: Camera, frame: str = "") -> list[BoardObservation]:
        """Looks for boards in a keyframe and returns those that it finds.

        Args:
            stamp: time of the keyframe [ns].
            gray: (H, W) uint8 image as the camera saw it: edges are measured before the lens distortion is removed.
            camera: calibration.
            frame: name of the camera's optical frame.
        """
        self._frames[stamp] = frame
        if self._first_frame is None:
            self._first_frame = frame
        self._cameras[stamp] = camera
        ellipses = detect_ellipses(gray, camera, self._config)
        self._sought.pop(stamp, None)  # of another image of that stamp
        found = detect_boards(ellipses, self._board_file.boards, camera)
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
            self._sought.pop(stamp, None)
            self._frames.pop(stamp, None)
            self._cameras.pop(stamp, None)

    def estimate(
        self,
        poses: Mapping[int, FloatArray],
        covariance: PoseCovariance | None = None,
        points: Callable[[], FloatArray] | None = None,
        rolling: RollingViews | None = None,
    ) -> ScaleEstimate:
        """Scale and map frame at given poses.

        Args:
            poses: (4, 4) camera_from_model by stamp [ns], in order of time.
            covariance: of functions of the poses; None takes these for exact.
            points: gives (N, 3) points of the model, should nothing else tell the vertical.
            rolling: motions of the views while their rows were read out; None: all rows at once.

        Raises:
            NoScaleError: as `estimate_scale`.
        """
        if not any(stamp in self._cameras for stamp in poses):
            raise NoScaleError("no_board", "no keyframe has been seen yet")
        return estimate_scale(self._posed(poses, points, rolling), covariance, self._sources)

    def board_misfit(self, poses: Mapping[int, FloatArray], rolling: RollingViews | None = None) -> float | None:
        """By how many px the boards' circles, in their images, differ from their file; None where none is placed."""
        placed = self._posed(poses, None, rolling).placed
        return max((float(np.hypot(place.centre_sigma, place.pose_sigma)) for place in placed), default=None)

    def remeasured(self, images: Iterable[tuple[int, NDArray[np.uint8]]], camera: Camera) -> MetricTracker:
        """The same with boards measured by another calibration; images: all keyframes, (H, W) uint8 by stamp."""
        other = MetricTracker(self._board_file, self._config, self._odometry, self._sources)
        for stamp, gray in images:
            other.add(stamp, gray, camera, self._frames[stamp])
        other._first_frame = self._first_frame
        other._transforms, other._accelerations = self._transforms, self._accelerations
        return other

    def _posed(
        self,
        poses: Mapping[int, FloatArray],
        points: Callable[[], FloatArray] | None,
        rolling: RollingViews | None,
    ) -> PosedEvidence:
        """What was seen, in pixels of one camera, at given poses."""
        cameras = Counter(self._cameras[stamp] for stamp in poses if stamp in self._cameras)
        # A camera may switch its resolution, and a robot has several: all is measured in pixels of the usual one. Noise
        # is taken to be the same number of these in every image, which is right for most of them.
        camera = cameras.most_common(1)[0][0]
        posed = PosedEvidence(
            self._evidence(camera, poses, self._ellipses, self._observations),
            poses, camera, self._config, self._odometry, points,
        )  # fmt: skip
        return posed if rolling is None else self._unrolled(posed, rolling)

    def _unrolled(self, posed: PosedEvidence, rolling: RollingViews) -> PosedEvidence:
        """The same by ellipses as the middle row's camera has them: boards are sought again only where these moved."""

        def found_in(stamp: int, ellipses: ImageEllipses) -> list[BoardObservation]:
            camera = self._cameras[stamp]
            before, found = self._sought.get(stamp, (None, []))
            if before is None or np.abs(ellipses.centres - before.centres).max() > FOLLOWED:
                before, found = self._sought[stamp] = ellipses, detect_boards(ellipses, self._board_file.boards, camera)
            return [observed_in(ellipses, board, before, camera) for board in found]

        def evidence(ellipses: Mapping[int, ImageEllipses]) -> PosedEvidence:
            unrolled = {stamp: found_in(stamp, own) for stamp, own in ellipses.items() if stamp in rolling.motions}
            observations = self._observations | unrolled
            return replace(posed, seen=self._evidence(posed.camera, posed.poses, ellipses, observations))

        def place(ellipses: Mapping[int, ImageEllipses]) -> tuple[Mapping[int, ImageEllipses], list[PlacedBoard]]:
            current = evidence(ellipses)
            return current.seen.ellipses or {}, [*current.placed, *scale_bar_discs(current)]

        return evidence(unrolled_ellipses(self._ellipses, self._cameras, posed.poses, rolling, place))

    def _evidence(
        self,
        camera: Camera,
        poses: Mapping[int, FloatArray],
        ellipses: Mapping[int, ImageEllipses],
        observations: Mapping[int, Sequence[BoardObservation]],
    ) -> ScaleEvidence:
        """What was seen, in pixels of one camera."""
        other = {stamp: own for stamp, own in self._cameras.items() if own != camera}
        return ScaleEvidence(
            self._board_file,
            {
                stamp: [one.in_pixels_of(camera, other[stamp]) for one in found] if stamp in other else found
                for stamp, found in observations.items()
            },
            {
                stamp: found.in_pixels_of(camera, other[stamp]) if stamp in other else found
                for stamp, found in ellipses.items()
            },
            self._transforms,
            self._accelerations,
            self._usual_frame(poses),
            self._frames,
        )

    def _usual_frame(self, poses: Mapping[int, FloatArray]) -> str:
        """The frame that is followed by odometry and IMU: the first one, unless another has twice as many keyframes.

        Cameras of a rig have as many each; a few keyframes that somebody else published before do not count.
        """
        counts = Counter(self._frames[stamp] for stamp in poses if stamp in self._frames)
        assert self._first_frame is not None
        usual, most = max(counts.items(), key=lambda item: item[1], default=(self._first_frame, 0))
        return usual if most > 2 * counts[self._first_frame] else self._first_frame
