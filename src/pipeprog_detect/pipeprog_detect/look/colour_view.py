# SPDX-License-Identifier: Apache-2.0
"""A keyframe in colour: its light relative to that of a white surface, by the boards' circles or by the room."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import in_image, project
from pipeprog_detect.silhouette.light_sampling import LINEAR_LIGHT
from pipeprog_detect.silhouette.occlusion import cylinder_rows, hidden_by_cylinders
from pipeprog_detect.types import Cylinder, View

# Between the pixels of which the room's colour is the median [px]: 3600 of an image of 720p.
_GRID = 16
# Grey levels beyond which a channel says little: the sensor's black level, and its clipping.
DARKEST, BRIGHTEST = 3, 252
_MOST_ROWS = 30_000  # of one call: OpenCV's limit is 32767
# Far behind everything [m]: what lies on a line of sight at any depth hides it.
_FAR = 1e3
# Paper is this white, and so is a room on average: concrete, plaster and screed reflect 0.3 to 0.5.
_PAPER, _ROOM = 0.75, 0.4
# A circle counts where it is 4 px wide at the least, so that its middle is free of blur, and twice as light as the
# darkest quarter of what lies around it, at 1.3 of its radius, where the board is black.
_LEAST_RADIUS, _LEAST_CONTRAST, _AROUND = 4.0, 2.0, 1.3
_DIRECTIONS = np.stack([np.cos(np.arange(16) * np.pi / 8), np.sin(np.arange(16) * np.pi / 8)], axis=1)


class Picture(Protocol):
    """What shows colours at pixels."""

    def levels(self, pixel: FloatArray) -> NDArray[np.float32]:
        """Grey levels (N, 3) of red, green and blue, 0 to 255, at pixel (N, 2)."""
        ...


@dataclass(frozen=True)
class ColourImage:
    """An undistorted image: (H, W, 3) pixels, blue, green and red as OpenCV decodes them."""

    pixels: NDArray[np.uint8]

    def levels(self, pixel: FloatArray) -> NDArray[np.float32]:
        """As `Picture` has it, between pixels linearly."""
        place = np.asarray(pixel, np.float32).reshape(-1, 1, 2)
        found = np.empty((len(place), 3), np.float32)
        for first in range(0, len(place), _MOST_ROWS):
            part = place[first : first + _MOST_ROWS]
            values = cv2.remap(self.pixels, part, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            found[first : first + len(part)] = values.reshape(-1, 3)[:, ::-1]
        return found


@dataclass(frozen=True)
class BoardCircles:
    """White circles on black: their centres (N, 3) [m] in the map, and their radii (N,) [m]."""

    centres: FloatArray
    radii: FloatArray

    @classmethod
    def of(cls, circles: Sequence[tuple[float, float, float, float]]) -> BoardCircles:
        """Those of rows x, y, z, radius."""
        rows = np.array(circles, float).reshape(-1, 4)
        return cls(rows[:, :3], rows[:, 3])


NO_CIRCLES = BoardCircles(np.empty((0, 3)), np.empty(0))


@dataclass(frozen=True)
class ColourView:
    """A keyframe, its picture, and the light (3,) RGB of a white surface in it; whether a board told that."""

    view: View
    picture: Picture
    white: FloatArray
    by_board: bool

    def relative_light(self, pixel: FloatArray) -> NDArray[np.float32]:
        """Light (N, 3) RGB at pixel (N, 2), relative to white."""
        return np.asarray(LINEAR_LIGHT[self.picture.levels(pixel).astype(np.uint8)] / self.white, np.float32)


def colour_views(
    views: Sequence[View],
    picture_of: Callable[[int], Picture],
    pipes: Sequence[Cylinder],
    circles: BoardCircles,
) -> list[ColourView]:
    """The views in colour, each with its white.

    A board in view tells the white of its image. The other images have their room's median colour, times what white was
    to the room where a board was in view; without any board the room is taken for grey.

    Args:
        views: keyframes.
        picture_of: gives the picture of a stamp.
        pipes: all that were found; they do not belong to the room.
        circles: of the boards.
    """
    pictures = [picture_of(view.stamp) for view in views]
    rows = cylinder_rows(pipes)
    rooms = [_room(view, picture, rows) for view, picture in zip(views, pictures, strict=True)]
    papers = [_paper(view, picture, circles) for view, picture in zip(views, pictures, strict=True)]
    told = [np.log(paper / room) for paper, room in zip(papers, rooms, strict=True) if paper is not None]
    ratio = np.exp(np.median(told, axis=0)) / _PAPER if told else np.full(3, 1.0 / _ROOM)
    return [
        ColourView(view, picture, room * ratio if paper is None else paper / _PAPER, bool(told))
        for view, picture, room, paper in zip(views, pictures, rooms, papers, strict=True)
    ]


def _light(picture: Picture, pixel: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Light (N, 3) RGB at pixel (N, 2), and which of these are neither black nor clipped."""
    levels = picture.levels(pixel)
    sound = np.asarray(((levels > DARKEST) & (levels < BRIGHTEST)).all(axis=1), bool)
    return np.asarray(LINEAR_LIGHT[levels.astype(np.uint8)], np.float64), sound


def _room(view: View, picture: Picture, pipes: FloatArray) -> FloatArray:
    """Median light (3,) of what is no pipe."""
    width, height = view.camera.width, view.camera.height
    grid = np.stack(np.meshgrid(np.arange(_GRID / 2, width, _GRID), np.arange(_GRID / 2, height, _GRID)), axis=-1)
    pixel = grid.reshape(-1, 2).astype(float)
    light, sound = _light(picture, pixel)
    free = sound & ~hidden_by_cylinders(view, pixel, np.full(len(pixel), _FAR), pipes)
    chosen = free if free.sum() >= 0.05 * len(pixel) else sound
    return np.asarray(np.median(light[chosen], axis=0) if chosen.any() else np.ones(3)) + 1e-3


def _paper(view: View, picture: Picture, circles: BoardCircles) -> FloatArray | None:
    """Median light (3,) of the circles in view, None where there is none."""
    found = []
    for centre, radius in zip(circles.centres, circles.radii, strict=True):
        if not in_image(view, centre[None])[0]:
            continue
        pixel, depth = project(view, centre[None])
        size = view.camera.fx * float(radius) / float(depth[0])
        if size < _LEAST_RADIUS:
            continue
        middle = view.shown(pixel, depth)
        inside, sound = _light(picture, middle + 0.5 * size * _DIRECTIONS)
        around, _ = _light(picture, middle + _AROUND * size * _DIRECTIONS)
        white = np.median(inside, axis=0)
        if sound.all() and (white > _LEAST_CONTRAST * np.quantile(around, 0.25, axis=0)).all():
            found.append(white)
    return np.asarray(np.median(found, axis=0)) if found else None
