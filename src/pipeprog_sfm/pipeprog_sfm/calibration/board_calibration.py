# SPDX-License-Identifier: Apache-2.0
"""A camera from a film of a board: focal lengths, principal point, distortion, and the read-out of its shutter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_READOUT
from pipeprog_sfm.boards.board import Board
from pipeprog_sfm.calibration.adjustment import Adjustment, Lens
from pipeprog_sfm.calibration.board_images import BoardImage, board_image, shows_motion, turned_alike
from pipeprog_sfm.calibration.calibration import Calibration, coverage, rms_by_radius

MIN_VIEWS = 15  # images: each has 6 numbers of its own, and ten numbers of the camera are sought
MIN_TILT = np.radians(20)  # between two of the board's normals: f and distance are one number for a board seen face on
FOCAL_FACTORS = (1.0, 0.75, 1.33)  # of a focal length that nothing tells: boards are found up to 15 % beside the truth
SAMPLE = 20  # images in which these are tried
ROUNDS = 4  # of looking for the board with the camera of the round before
SETTLED = 0.1  # px, of the image's corners from round to round: a fiftieth of a circle's gate
MAX_READOUT_ROUNDS = 10  # of adjustments, each with the motions of the poses before: their change halves or better
READOUT_SETTLED = 1e-3  # relative change of the read-out at which these end
# k3 is what k1 and k2 are not, at the corners: where these are not filmed, it would be noise.
HELD = frozenset({"k3"})
READOUT = frozenset({"readout"})
SURE = 5.0  # standard deviations of k3 from zero, from which it is used: a lens without it has none
TOLD = 3.0  # standard deviations from zero, from which there is a read-out
FINE_READOUT = 1e-3  # s, standard deviation below which a read-out of zero is told: at 1.5 m/s, half a millimetre

Image = tuple[int, NDArray[np.uint8]]  # stamp [ns] and (H, W) pixels


def calibrate_film(
    film: Sequence[Image], board: Board, start: Camera, is_guess: bool, report: Callable[[float, str], None]
) -> Calibration:
    """The camera that filmed a board.

    Args:
        film: images in order of time, in runs of up to RUN that follow one another.
        board: the board.
        start: camera to start from; its distortion model is that of the result.
        is_guess: its focal length is no more than usual.
        report: is told the share that is done, and what is being done.

    Raises:
        InputError: the images cannot tell the camera.
    """
    camera = _best_start(film, board, start) if is_guess else start
    for number in range(ROUNDS):
        images = []
        for done, (stamp, gray) in enumerate(film):
            images.append(board_image(stamp, gray, board, camera))
            report((number + (done + 1) / len(film)) / (ROUNDS + 1), f"round {number + 1}: board in image {done + 1}")
        seen = turned_alike([image for image in images if image is not None], board)
        earlier, camera = camera, adjusted_camera(seen, board, camera)
        if _corner_shift(earlier, camera) < SETTLED:
            break
    report(ROUNDS / (ROUNDS + 1), "read-out")
    return calibrate(seen, board, camera)


def adjusted_camera(images: Sequence[BoardImage], board: Board, start: Camera) -> Camera:
    """The camera from images of a board, rows read at once; raises InputError where they cannot tell it."""
    _check(images)
    poses = np.stack([image.camera_from_board for image in images])
    lens, held = _starting_at(_first(images, board, start))
    return Adjustment(images, board).adjusted(lens, poses, held | READOUT)[0].camera


def calibrate(images: Sequence[BoardImage], board: Board, start: Camera) -> Calibration:
    """Camera and read-out from images of a board.

    Args:
        images: in order of time; those without neighbours say nothing of the read-out, and are left out where enough
            have them.
        board: the board.
        start: camera to start from; its distortion model is that of the result.

    Raises:
        InputError: the images cannot tell the camera.
    """
    moving = [image for image, shows in zip(images, shows_motion(images), strict=True) if shows]
    if len(moving) >= MIN_VIEWS:  # the others would be of a shutter that reads all rows at once
        images = moving
    _check(images)
    adjustment = Adjustment(images, board)
    poses = np.stack([image.camera_from_board for image in images])
    lens, held = _starting_at(start)
    still = adjustment.adjusted(lens, poses, held | READOUT)
    if len(moving) < MIN_VIEWS:
        return _result(adjustment, *_with_k3(adjustment, *still, held | READOUT), None)
    lens, poses = still
    for _ in range(MAX_READOUT_ROUNDS):
        before = lens.readout
        adjustment.take_motion(poses)
        # From a millisecond on: at zero the residuals are those of all rows at once.
        lens, poses = adjustment.adjusted(replace(lens, readout=lens.readout or FINE_READOUT), poses, held)
        if abs(lens.readout - before) < READOUT_SETTLED * abs(lens.readout):
            break
    sigma = adjustment.sigmas(lens, poses, held)["readout"]
    if TOLD * sigma < lens.readout <= MAX_READOUT:
        return _result(adjustment, *_with_k3(adjustment, lens, poses, held), lens.readout)
    found = _result(adjustment, *_with_k3(adjustment, *still, held | READOUT), 0.0 if sigma < FINE_READOUT else None)
    return replace(found, sigmas=found.sigmas | {"readout": sigma})


def _with_k3(
    adjustment: Adjustment, lens: Lens, poses: FloatArray, held: frozenset[str]
) -> tuple[Lens, FloatArray, frozenset[str]]:
    """The same with k3, where the images tell it, and the numbers that are held."""
    if not held & HELD:
        return lens, poses, held
    free = adjustment.adjusted(lens, poses, held - HELD)
    is_told = abs(free[0].camera.distortion[4]) > SURE * adjustment.sigmas(*free, held - HELD)["k3"]
    return (*free, held - HELD) if is_told else (lens, poses, held)


def _starting_at(start: Camera) -> tuple[Lens, frozenset[str]]:
    """The lens to start from, rows read at once, and the numbers that are held at first."""
    lens = Lens.starting_at(start)
    if start.distortion_model != "plumb_bob":
        return lens, frozenset()
    return Lens(replace(lens.camera, distortion=(*lens.camera.distortion[:4], 0.0))), HELD


def _result(
    adjustment: Adjustment, lens: Lens, poses: FloatArray, held: frozenset[str], readout: float | None
) -> Calibration:
    """What was found, with how well."""
    lengths = np.linalg.norm(adjustment.residuals(lens, poses), axis=1)
    return Calibration(
        lens.camera,
        adjustment.sigmas(lens, poses, held),
        readout,
        float(np.sqrt((lengths**2).mean())),
        coverage(adjustment.pixels, lens.camera),
        rms_by_radius(adjustment.pixels, lengths, lens.camera),
        len(poses),
    )


def _best_start(film: Sequence[Image], board: Board, start: Camera) -> Camera:
    """Of several focal lengths, the one with which the board is found in most images."""
    sample = film[:: max(1, len(film) // SAMPLE)]
    cameras = [replace(start, fx=factor * start.fx, fy=factor * start.fy) for factor in FOCAL_FACTORS]
    return max(cameras, key=lambda camera: sum(board_image(*image, board, camera) is not None for image in sample))


def _first(images: Sequence[BoardImage], board: Board, start: Camera) -> Camera:
    """The pinhole camera that OpenCV finds with one coefficient, to start from; `start` where it finds none."""
    if start.distortion_model != "plumb_bob" or start.is_distorted:
        return start
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_PRINCIPAL_POINT
    flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    few = images[:: max(1, len(images) // SAMPLE)]  # its time grows with the cube of their number
    try:
        _, matrix, distortion, _, _ = cv2.calibrateCamera(
            [board.centres[image.circles].astype(np.float32) for image in few],
            [image.pixels.astype(np.float32) for image in few],
            (start.width, start.height), start.matrix, np.zeros(5), flags=flags,
        )  # fmt: skip
    except cv2.error:
        return start
    found = tuple(np.asarray(distortion).ravel()[:5].tolist())
    return replace(start, fx=float(matrix[0, 0]), fy=float(matrix[1, 1]), distortion=found)


def _corner_shift(one: Camera, other: Camera) -> float:
    """By how many px the two show a direction at the image's corners differently."""
    width, height = one.width - 1.0, one.height - 1.0
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    ideal = one.undistort_points(corners)
    rays = (ideal - [one.cx, one.cy]) / [one.fx, one.fy]
    shift = other.distort_points(rays * [other.fx, other.fy] + [other.cx, other.cy]) - corners
    return float(np.linalg.norm(shift, axis=1).max())


def _check(images: Sequence[BoardImage]) -> None:
    if not images:
        raise InputError(
            "the board was not seen in any image: is BOARD.yaml that of the board, and is it sharp and well lit?"
        )
    if len(images) < MIN_VIEWS:
        raise InputError(
            f"the board was seen in {len(images)} images, {MIN_VIEWS} are needed: film it for half a minute, with at "
            "least four of its circles in view"
        )
    normals = np.stack([image.camera_from_board[:3, 2] for image in images])
    if (normals @ normals.T).min() > np.cos(MIN_TILT):
        raise InputError(
            "the board was seen from one side only, and the focal length cannot be told from its distance: walk around "
            "it, so that it is tilted to the left, to the right, up and down by 30 to 45 degrees"
        )
