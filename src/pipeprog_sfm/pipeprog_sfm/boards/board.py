# SPDX-License-Identifier: Apache-2.0
"""Boards, what an image shows of one, and which boards look the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.conic import pixel_change

MIN_CIRCLES = 3  # circles that identify a board and fix its pose; two agree with a wrong pose by chance
LAYOUT_TOLERANCE = (
    0.1  # of a circle's radius, up to which circles of two layouts coincide; ellipses are matched to half a radius
)


@dataclass(frozen=True)
class Board:
    """A flat dark board with bright circles.

    Attributes:
        name: unique name.
        circle_radius: radius of every circle, m.
        centres: (N, 3) float64 circle centres in the board's frame, m: z = 0, x right and y up seen from the front.
    """

    name: str
    circle_radius: float
    centres: FloatArray

    @property
    def spread(self) -> float:
        """Root of the summed squared distances of the circles from their mean, m.

        An error of the circles' places of standard deviation s makes a relative error s / spread of the scale.
        """
        return float(np.linalg.norm(self.centres - self.centres.mean(0)))

    @property
    def half_turn(self) -> FloatArray:
        """(4, 4) turn by 180 degrees in the board's plane about the mean of its circles, m."""
        turn = np.diag([-1.0, -1.0, 1.0, 1.0])
        turn[:3, 3] = 2 * self.centres.mean(0)
        return turn


@dataclass(frozen=True)
class BoardObservation:
    """Circles of one board in one image; pixels of the ideal pinhole camera.

    Attributes:
        board: name of the board (of the first one where several in the file share a layout).
        indices: (K,) int, rows of Board.centres.
        centres: (K, 2) images of the circles' centres, px: the ellipses' centres corrected for eccentricity.
        ellipse_centres: (K, 2) centres of the ellipses, px.
        conics: (K, 3, 3) the ellipses as conics.
        sigma: standard deviation of one coordinate of a centre, px, from the scatter of the edge points.
        camera_from_board: (4, 4) pose seen from this image alone, m.
    """

    board: str
    indices: NDArray[np.intp]
    centres: FloatArray
    ellipse_centres: FloatArray
    conics: FloatArray
    sigma: float
    camera_from_board: FloatArray

    def in_pixels_of(self, camera: Camera, own: Camera) -> BoardObservation:
        """The same in the pixels of another camera than its own, at the same place."""
        stretch, shift = pixel_change(camera, own)
        back = own.matrix @ np.linalg.inv(camera.matrix)
        conics = back.T @ self.conics @ back
        return replace(
            self,
            centres=self.centres * stretch + shift,
            ellipse_centres=self.ellipse_centres * stretch + shift,
            conics=conics / np.linalg.norm(conics, axis=(-2, -1), keepdims=True),
            sigma=self.sigma * float(np.sqrt(stretch.prod())),
        )


def symmetries(board: Board) -> NDArray[np.intp]:
    """(S, N) orders of the circles in which the board, turned in its plane, looks the same; row 0 is 0..N-1.

    Mirrored orders do not count, since a board is seen from its front.
    """
    return _orders_onto(board, board)


def layouts(boards: Sequence[Board]) -> list[list[Board]]:
    """Boards grouped by layout: boards of one group cannot be distinguished in an image."""
    groups: list[list[Board]] = []
    for board in boards:
        for group in groups:
            if len(_orders_onto(group[0], board)):
                group.append(board)
                break
        else:
            groups.append([board])
    return groups


def _orders_onto(board: Board, other: Board) -> NDArray[np.intp]:
    """(S, N) orders `o` for which other.centres[o] is board.centres turned in the plane and shifted."""
    orders: list[NDArray[np.intp]] = []
    if (
        len(board.centres) == len(other.centres)
        and abs(board.circle_radius / other.circle_radius - 1) < LAYOUT_TOLERANCE
    ):
        limit = LAYOUT_TOLERANCE * board.circle_radius
        plane, target = (one.centres[:, :2] - one.centres[:, :2].mean(0) for one in (board, other))
        points, goals = (xy[:, 0] + 1j * xy[:, 1] for xy in (plane, target))
        anchor = np.abs(points).argmax()
        for goal in goals:
            if abs(abs(goal) - abs(points[anchor])) > limit:
                continue
            turned = points * (goal / abs(goal)) / (points[anchor] / abs(points[anchor]))
            gaps = np.abs(turned[:, None] - goals[None])
            order = gaps.argmin(1)
            if gaps.min(1).max() <= limit and len(set(order)) == len(order):
                orders.append(order)
    orders.sort(key=lambda order: int((order != np.arange(len(order))).sum()))
    return np.array(orders, dtype=np.intp).reshape(-1, len(board.centres))
