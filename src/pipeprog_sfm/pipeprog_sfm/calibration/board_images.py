# SPDX-License-Identifier: Apache-2.0
"""What the images of a film show of a board, and in which order they follow one another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board import Board, symmetries
from pipeprog_sfm.boards.board_detection import detect_boards
from pipeprog_sfm.boards.ellipses import detect_ellipses
from pipeprog_sfm.config import BoardConfig

# Images that follow one another tell how the camera moves. Of five, a polynomial gives the speed of a hand that shakes
# three times a second to 1 %, of three to 6 %.
RUN = 5
MIN_RUN = 3  # images: of two, the speed is that between them, half a frame off
MAX_GAP = 150_000_000  # ns between two images of a run: 10 Hz, and one image in which the board was missed
MIN_CIRCLES = 4  # of a board in an image: three fit any pose of a camera without a trace of its lens


@dataclass(frozen=True)
class BoardImage:
    """What one image shows of a board.

    Attributes:
        stamp: ns.
        circles: (K,) rows of Board.centres.
        pixels: (K, 2) images of the circles' centres in the image as it is, px.
        camera_from_board: (4, 4) pose to start from, m.
    """

    stamp: int
    circles: NDArray[np.intp]
    pixels: FloatArray
    camera_from_board: FloatArray


def board_image(stamp: int, gray: NDArray[np.uint8], board: Board, camera: Camera) -> BoardImage | None:
    """The board in an image (H, W) of a camera that may be a guess; None where too little of it is found."""
    found = detect_boards(detect_ellipses(gray, camera, BoardConfig()), [board], camera)
    best = max(found, key=lambda each: len(each.indices), default=None)
    if best is None or len(best.indices) < MIN_CIRCLES:
        return None
    return BoardImage(stamp, best.indices, camera.distort_points(best.centres), best.camera_from_board)


def runs_of(stamps: Sequence[int]) -> NDArray[np.intp]:
    """(V,) number of the run that each image belongs to; stamps rise."""
    numbers, length = [0], 1
    for gap in np.diff(stamps):
        is_next = gap <= MAX_GAP and length < RUN
        length = length + 1 if is_next else 1
        numbers.append(numbers[-1] + (not is_next))
    return np.array(numbers, np.intp)[: len(stamps)]


def shows_motion(images: Sequence[BoardImage]) -> NDArray[np.bool_]:
    """(V,) whether the run of each image tells how the camera moves."""
    run = runs_of([image.stamp for image in images])
    return (np.bincount(run, minlength=1) >= MIN_RUN)[run]


def turned_alike(images: Sequence[BoardImage], board: Board) -> list[BoardImage]:
    """The same with a board that looks alike upside down turned as in the image before it."""
    orders = symmetries(board)
    found: list[BoardImage] = []
    for image in images:
        if found and len(orders) > 1:
            own, turned = image.camera_from_board, image.camera_from_board @ board.half_turn
            before = found[-1].camera_from_board
            if np.trace(before[:3, :3].T @ turned[:3, :3]) > np.trace(before[:3, :3].T @ own[:3, :3]):
                image = replace(image, circles=orders[1][image.circles], camera_from_board=turned)
        found.append(image)
    return found
