# SPDX-License-Identifier: Apache-2.0
"""A keyframe resampled for one direction in space, so that lines along that direction are its rows.

The rows are the angles about the line through the camera's centre along the direction, the columns how far a line of
sight gets along the direction while it gets a metre away from that line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.cylinder_fit import basis
from pipeprog_detect.silhouette.apparent_contour import contour_samples, parts_by_view
from pipeprog_detect.silhouette.occlusion import cylinder_rows, depth_of_cylinders
from pipeprog_detect.silhouette.scene import SPACING
from pipeprog_detect.threads import mapped
from pipeprog_detect.types import Cylinder, View

# What a cell of the image shows: no edge along its row, or one within a row of it; what lies outside the image or on
# the contour of a known pipe, whose edge it may be, tells nothing.
NO_EDGE, EDGE, UNKNOWN = 0, 1, 2
# Views that look along the direction within 40 deg, and lines of sight within 40 deg of it, hardly see lines move.
LEAST_FACING, STEEPEST = float(np.sin(np.radians(40.0))), float(1.0 / np.tan(np.radians(40.0)))
# Of the pixels along a cell's row this many are sampled.
LINES = 4
# Blur of lens and pixel together, of which the gradient is taken [px].
BLUR = 0.8
# Half of an image's edges are at least as strong as their median, which is texture's. The contour of a pipe stands out
# from it: an edge twice as strong counts.
STRONG = 2.0
# Rows and columns that share the distance of what hides the rest.
BLOCK = 4
# Width of a known pipe's contour [rows], whose place is known to a row and whose edges count within one.
CONTOUR = 5
# Contours of pipes turned from the direction by more than this cross the rows and leave no edge along them.
CROSSING = float(np.cos(np.radians(10.0)))
# Nearer than this [m] nothing is projected.
NEAREST = 0.05


@dataclass(frozen=True)
class RectifiedView:
    """The edges along one direction that a view shows.

    Attributes:
        place: (8,): of the view's centre across the direction (2) and along it [m]; the angle that it faces [rad],
            radians to a row; number of columns before the one of slope 0, slope to a column; row of the angle it faces.
        edges: (R, C) `NO_EDGE`, `EDGE` or `UNKNOWN`.
        reach: (R / BLOCK, C) distance [m] across the direction of what is seen there first; infinite: not known.
    """

    place: FloatArray
    edges: NDArray[np.uint8]
    reach: NDArray[np.float32]


def rectified_views(views: Sequence[View], direction: FloatArray, known: Sequence[Cylinder]) -> list[RectifiedView]:
    """Those of the views that see lines along a direction (3,) from aside; `known` pipes hide what is behind them."""
    contours = _contours(views, direction, known)
    rows = cylinder_rows(known)
    sights = [_Sight.of(view, direction) for view in views]
    found = mapped(lambda sight: _rectified(sight[0], sight[1], rows), zip(sights, contours, strict=True))
    return [each for each in found if each is not None]


@dataclass(frozen=True)
class _Sight:
    """A view with the vectors (2, 3) across a direction (3,), and the angle [rad] about it that the view faces."""

    view: View
    direction: FloatArray
    across: FloatArray
    facing: float

    @classmethod
    def of(cls, view: View, direction: FloatArray) -> _Sight:
        across = np.stack(basis(direction))
        ahead = across @ view.camera_from_map[2, :3]
        return cls(view, direction, across, float(np.arctan2(ahead[1], ahead[0])))

    def is_facing(self) -> bool:
        """Whether the view looks at lines along the direction from aside."""
        return float(np.linalg.norm(self.across @ self.view.camera_from_map[2, :3])) > LEAST_FACING

    def angles(self, pixel: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Angles (N,) from the one faced [rad], and slopes (N,) along the direction, of the sight through pixels."""
        camera = self.view.camera
        x, y = (pixel[:, 0] - camera.cx) / camera.fx, (pixel[:, 1] - camera.cy) / camera.fy
        ray = np.stack([x, y, np.ones_like(x)], axis=1) @ self.view.camera_from_map[:3, :3]
        plane = ray @ self.across.T
        angle = np.arctan2(plane[:, 1], plane[:, 0]) - self.facing
        return (angle + np.pi) % (2.0 * np.pi) - np.pi, ray @ self.direction / np.linalg.norm(plane, axis=1)

    def pixels(self, angle: FloatArray, slope: FloatArray) -> tuple[NDArray[np.float32], FloatArray]:
        """Pixels (R, C, 2) of angles (R,) and slopes (C,), and depths (R, C) for a metre away from the line; or NaN."""
        rotation, camera = self.view.camera_from_map[:3, :3], self.view.camera
        turn = self.facing + angle
        away = (np.cos(turn)[:, None] * self.across[0] + np.sin(turn)[:, None] * self.across[1]) @ rotation.T
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        return _projected(away, rotation @ self.direction, slope, lens)


@njit(cache=True, nogil=True)
def _projected(
    away: FloatArray, forth: FloatArray, slope: FloatArray, lens: FloatArray
) -> tuple[NDArray[np.float32], FloatArray]:
    """See `_Sight.pixels`: of rays `away` (R, 3) + `slope` (C,) `forth` (3,) of the camera; `lens`: fx, fy, cx, cy."""
    pixel = np.empty((len(away), len(slope), 2), np.float32)
    depth = np.empty((len(away), len(slope)))
    for r in range(len(away)):
        for c in range(len(slope)):
            far = away[r, 2] + slope[c] * forth[2]
            if far <= NEAREST:
                pixel[r, c, :], depth[r, c] = np.nan, np.nan
                continue
            pixel[r, c, 0] = lens[0] * (away[r, 0] + slope[c] * forth[0]) / far + lens[2]
            pixel[r, c, 1] = lens[1] * (away[r, 1] + slope[c] * forth[1]) / far + lens[3]
            depth[r, c] = far
    return pixel, depth


def _rectified(sight: _Sight, contours: Sequence[FloatArray], rows: FloatArray) -> RectifiedView | None:
    """The view of a sight; `contours` [(K, 2)] of known pipes in it [px], and their `rows` for `depth_of_cylinders`."""
    if not sight.is_facing():
        return None
    camera = sight.view.camera
    row_step, column_step = 1.0 / camera.fx, SPACING / camera.fx
    angle, slope = sight.angles(_border(camera.width, camera.height))
    top, bottom = int(np.floor(angle.min() / row_step)), int(np.ceil(angle.max() / row_step))
    left = int(np.floor(max(float(slope.min()), -STEEPEST) / column_step))
    right = int(np.ceil(min(float(slope.max()), STEEPEST) / column_step))
    if right <= left:
        return None
    angles = np.arange(top, bottom + 1, dtype=np.float64) * row_step
    columns: FloatArray = np.arange(left, right, dtype=np.float64)
    slopes: FloatArray = (columns[:, None] + (np.arange(LINES) + 0.5) / LINES).ravel() * column_step
    pixel, _ = sight.pixels(angles, slopes)
    cells, depth = sight.pixels(angles[::BLOCK], (columns + 0.5) * column_step)
    seen = _first_seen(sight.view, cells, rows)
    edges = _edges(sight.view, _as_shown(sight.view, pixel, cells, seen))
    for line in contours:
        angle, slope = sight.angles(line)
        at = np.stack([slope / column_step - left - 0.5, angle / row_step - top], axis=1)
        cv2.polylines(edges, [np.round(at).astype(np.int32)], False, UNKNOWN, CONTOUR)
    centre = sight.view.centre
    place = [*(sight.across @ centre), sight.direction @ centre, sight.facing, row_step, left, column_step, -top]
    reach = np.where(np.isnan(depth), 0.0, seen / depth)
    return RectifiedView(np.array(place, np.float64), edges, reach.astype(np.float32))


def _contours(views: Sequence[View], direction: FloatArray, known: Sequence[Cylinder]) -> list[list[FloatArray]]:
    """The contour lines [(K, 2)] in each view [px] of the known pipes that run along the direction."""
    lines: list[list[FloatArray]] = [[] for _ in views]
    for cylinder in known:
        if abs(cylinder.axis @ direction) < CROSSING:
            continue
        samples = contour_samples(cylinder, views, np.eye(3)[:2], spacing=SPACING, margin=0.0)
        for number, part in parts_by_view(samples, len(views)):
            for side in (0, 1):
                line = samples.pixel[part][samples.side[part] == side]
                if len(line) > 1:
                    lines[number].append(line)
    return lines


def _first_seen(view: View, pixel: NDArray[np.float32], rows: FloatArray) -> FloatArray:
    """Depth (R, C) [m] of what a view shows first at pixels (R, C, 2): a known pipe or the cloud."""
    at = np.where(np.isfinite(pixel), pixel, 0.0).reshape(-1, 2).astype(float)
    depth = depth_of_cylinders(view, at, rows)
    if view.nearest is not None:
        height, width = view.nearest.shape
        cell = np.floor(at * (width / view.camera.width)).astype(np.int64)
        cloud = view.nearest[np.clip(cell[:, 1], 0, height - 1), np.clip(cell[:, 0], 0, width - 1)]
        depth = np.minimum(depth, cloud)
    return depth.reshape(pixel.shape[:2])


def _as_shown(
    view: View, pixel: NDArray[np.float32], cells: NDArray[np.float32], seen: FloatArray
) -> NDArray[np.float32]:
    """Where the image shows pixels (R, C * LINES, 2) of the stamp; by the depths `seen` (R', C) [m] at the `cells`."""
    if view.rolled is None:
        return pixel
    known = np.isfinite(seen) & np.isfinite(cells).all(axis=2)
    depth = np.where(known, seen, np.median(seen[known]) if known.any() else 1.0)
    at = np.where(np.isfinite(cells), cells, 0.0).astype(float)
    moved = (view.shown(at.reshape(-1, 2), depth.ravel()).reshape(cells.shape) - at).astype(np.float32)
    rows, columns = pixel.shape[:2]
    return np.asarray(pixel + cv2.resize(moved, (columns, rows), interpolation=cv2.INTER_LINEAR), np.float32)


def _edges(view: View, pixel: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Edges (R, C) along the rows of the image sampled at pixels (R, C * LINES, 2)."""
    ends = pixel[:, ::LINES], pixel[:, LINES - 1 :: LINES]  # a cell's first and last line: the others are between them
    missing = ~(_is_inside(view, ends[0]) & _is_inside(view, ends[1]))
    pixel = np.nan_to_num(pixel, nan=-1.0)
    light = cv2.remap(view.image, pixel, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    mean = np.asarray(sum(light[:, line::LINES] for line in range(LINES)) / LINES, np.float32)
    reach = int(np.ceil(3.0 * BLUR))
    at = np.arange(-reach, reach + 1)
    gradient = -at * np.exp(-0.5 * (at / BLUR) ** 2)
    slope = np.abs(cv2.sepFilter2D(mean, cv2.CV_32F, np.ones(1), gradient))
    peak: NDArray[np.bool_] = np.zeros(slope.shape, bool)
    peak[1:-1] = (slope[1:-1] >= slope[:-2]) & (slope[1:-1] > slope[2:]) & ~missing[1:-1]
    if peak.any():
        peak &= slope > STRONG * np.median(slope[peak])
    near = cv2.dilate(peak.astype(np.uint8), np.ones((3, 1), np.uint8))
    return np.where(missing, UNKNOWN, np.where(near > 0, EDGE, NO_EDGE)).astype(np.uint8)


def _is_inside(view: View, pixel: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mask (R, C) of the pixels (R, C, 2) that lie farther than one within the image."""
    u, v = pixel[..., 0], pixel[..., 1]
    return np.asarray((u > 1.0) & (u < view.camera.width - 2.0) & (v > 1.0) & (v < view.camera.height - 2.0), bool)


def _border(width: int, height: int) -> FloatArray:
    """Pixels (N, 2) along the border of an image."""
    u, v = np.linspace(0.0, width - 1.0, 33), np.linspace(0.0, height - 1.0, 33)
    sides = [np.stack([u, np.full_like(u, end)], axis=1) for end in v[[0, -1]]]
    sides += [np.stack([np.full_like(v, end), v], axis=1) for end in u[[0, -1]]]
    return np.concatenate(sides)
