# SPDX-License-Identifier: Apache-2.0
"""All that tells the scale and the vertical of a model: what was seen, what a robot told, and the model's poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board import BoardObservation
from pipeprog_sfm.boards.board_adjustment import PlacementSensitivity, placement_sensitivity
from pipeprog_sfm.boards.board_check import circle_residuals, contradiction, missed_circles
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.boards.board_triangulation import place_boards
from pipeprog_sfm.boards.ellipses import ImageEllipses
from pipeprog_sfm.boards.placed_board import PlacedBoard, PosedCamera
from pipeprog_sfm.config import BoardConfig, OdometryConfig
from pipeprog_sfm.metric.transform_tree import Acceleration, CameraPath, TransformTree


@dataclass(frozen=True)
class ScaleEvidence:
    """What was seen of boards and scale bars, and what a robot told of its motion; independent of any pose.

    Attributes:
        board_file: boards, known distances and scale bars.
        observations: boards detected, by image stamp [ns].
        ellipses: all ellipses of the images, by stamp: an image counts even where it shows a single circle of a board.
        transforms: odometry and TF.
        accelerations: of an IMU.
        camera_frame: optical frame of the camera whose way odometry and IMU tell.
        frames: optical frame of each image, by stamp; missing for images of `camera_frame`. Images of another camera
            of the rig tell the scale by where it is mounted.
    """

    board_file: BoardFile = BoardFile()  # noqa: RUF009  # frozen
    observations: Mapping[int, Sequence[BoardObservation]] = field(default_factory=dict)
    ellipses: Mapping[int, ImageEllipses] | None = None
    transforms: TransformTree = field(default_factory=TransformTree)
    accelerations: Sequence[Acceleration] = ()
    camera_frame: str = ""
    frames: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True)
class CheckedBoards:
    """Boards placed in a model.

    Attributes:
        sound: those that agree with their file, in the order in which they were seen.
        sensitivities: how errors of images and poses propagate to each of them.
        refused: why others are not used, in full sentences.
        reason: one word with underscores, where none is left: no_board, too_few_views or contradiction.
        missed: circles of sound boards that were not found where their file has them, in full sentences.
    """

    sound: tuple[PlacedBoard, ...] = ()
    sensitivities: tuple[PlacementSensitivity, ...] = ()
    refused: tuple[str, ...] = ()
    reason: str = ""
    missed: tuple[str, ...] = ()


@dataclass(frozen=True)
class PosedEvidence:
    """Evidence together with the poses of one model: what every source of scale and of the vertical is given.

    Attributes:
        seen: the evidence.
        poses: (4, 4) camera_from_model by stamp [ns] in order of time, model units; other images are left out.
        camera: in whose pixels boards and ellipses are given.
        board_config: eccentricity, tolerance, upright.
        odometry_config: standard deviations of odometry and rig.
        points: gives (N, 3) points of the model, should nothing else tell the vertical.
    """

    seen: ScaleEvidence
    poses: Mapping[int, FloatArray]
    camera: Camera
    board_config: BoardConfig = BoardConfig()  # noqa: RUF009  # frozen
    odometry_config: OdometryConfig = OdometryConfig()  # noqa: RUF009  # frozen
    points: Callable[[], FloatArray] | None = None

    @property
    def posed_camera(self) -> PosedCamera:
        """The camera at its poses, as boards are measured with it."""
        return PosedCamera(self.camera, self.poses, self.board_config.eccentricity)

    @cached_property
    def own_poses(self) -> dict[int, FloatArray]:
        """The poses of images of `seen.camera_frame`."""
        own = self.seen.camera_frame
        return {stamp: pose for stamp, pose in self.poses.items() if self.seen.frames.get(stamp, own) == own}

    @cached_property
    def path(self) -> CameraPath | None:
        """The camera's path by odometry, None without odometry; raises NoPathError where none leads to the camera."""
        return self.seen.transforms.path(self.seen.camera_frame, list(self.own_poses)) if self.seen.transforms else None

    @cached_property
    def placed(self) -> list[PlacedBoard]:
        """The boards of the file at every place where they were seen, whether or not they agree with it."""
        return place_boards(self.seen.observations, self.posed_camera, self.seen.board_file.boards, self.seen.ellipses)

    @cached_property
    def boards(self) -> CheckedBoards:
        """The boards of the file at every place where they were seen."""
        boards = self.seen.board_file.boards
        if not boards:
            return CheckedBoards()
        images = sum(stamp in self.poses and len(found) > 0 for stamp, found in self.seen.observations.items())
        if not images:
            names = ", ".join(board.name for board in boards)
            text = (
                f"no board ({names}) was identified in any of {len(self.poses)} images with a pose: is "
                f"{self.seen.board_file.path} that of the board that hangs, and is the board near, sharp and lit?"
            )
            return CheckedBoards(refused=(text,), reason="no_board")
        posed = self.posed_camera
        placed = self.placed
        if not placed:
            text = f"a board was seen in {images} images, but from too few sides to be measured"
            return CheckedBoards(refused=(text,), reason="too_few_views")
        tolerance = self.board_config.tolerance
        faults = [contradiction(place, circle_residuals(place, posed), tolerance) for place in placed]
        sound = tuple(place for place, fault in zip(placed, faults, strict=True) if not fault)
        sensitivities = tuple(placement_sensitivity(place, posed) for place in sound)
        refused = tuple(fault for fault in faults if fault)
        missed = tuple(filter(None, (missed_circles(place, posed) for place in sound)))
        return CheckedBoards(sound, sensitivities, refused, "" if sound else "contradiction", missed)
