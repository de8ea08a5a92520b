# SPDX-License-Identifier: Apache-2.0
"""Pictures of a cloud with its pipes: points splatted and cylinders cast into a depth buffer, shaded by depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeprog_bringup.results.results_reader import Color
from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.types import Cylinder

# Everything is drawn twice as large and reduced, which smooths the edges.
OVERSAMPLING = 2
MAX_POINTS = 2_000_000  # of a larger cloud every n-th point is drawn: a picture has 4 million pixels before reduction
BACKGROUND = (247, 248, 250)
# How far a pipe's surface is lifted above the points that it was fitted to, so that they do not hide it [m].
LIFT = 0.025
# Strength of the shading by depth (eye-dome lighting, Boucheny 2009).
SHADING = 0.06
# Height over width at most; what is taller is drawn smaller.
TALLEST = 1.1
# What is shown around the pipes [m].
MARGIN = 0.5


@dataclass(frozen=True)
class ColoredPipe:
    """A pipe to draw: its cylinder, colour (r, g, b) in [0, 1] and label."""

    cylinder: Cylinder
    color: Color
    label: str


def draw(
    points: FloatArray,
    colors: NDArray[np.uint8] | None,
    pipes: Sequence[ColoredPipe],
    towards_eye: FloatArray,
    width: int,
) -> NDArray[np.uint8]:
    """Parallel projection (H, width, 3) RGB of points (N, 3) [m, z up] seen from the direction `towards_eye` (3,)."""
    axes = _screen_axes(towards_eye)
    shown = _shown(points, pipes)
    cloud = points[shown]
    # The cloud is paled, so that the pipes stand out of it.
    pale = np.full((len(cloud), 3), 182.0) if colors is None else 0.55 * colors[shown] + 100
    low, high = _frame(cloud, pipes, axes)
    reach = high - low
    pixel = max(reach[0], reach[1] / TALLEST) / (width * OVERSAMPLING)
    low = low - [(width * OVERSAMPLING * pixel - reach[0]) / 2, 0.0]
    size = width * OVERSAMPLING, int(max(reach[1] / pixel, width))
    nearest, depth = _splat(cloud @ axes.T, low, pixel, size, _spread(cloud, pixel))
    tints = np.concatenate([[BACKGROUND], pale]).astype(np.uint8)
    image = tints[nearest + 1]
    for pipe in pipes:
        _paint(image, depth, pipe, axes, low, pixel)
    image = _shaded(image, depth, pixel)
    image = cv2.resize(image, (width, size[1] // OVERSAMPLING), interpolation=cv2.INTER_AREA)
    taken: list[tuple[FloatArray, FloatArray]] = []
    for pipe in pipes:
        _label(image, pipe.label, _label_places(pipe, depth, axes, low, pixel), taken)
    return image


def two_sides(points: FloatArray, pipes: Sequence[ColoredPipe]) -> list[FloatArray]:
    """Two directions to look from, at least 60 degrees apart, from which the fewest points hide the pipes."""
    azimuths = np.radians(np.arange(0, 360, 15))
    directions = [np.array([np.cos(azimuth), np.sin(azimuth), 0.35]) for azimuth in azimuths]
    shown = _shown(points, pipes)
    cloud = points[shown[:: max(1, len(shown) // 50_000)]]
    hidden = np.array([_hiding(cloud, pipes, _screen_axes(direction)) for direction in directions])
    # Averaged over three neighbouring directions: one that happens to see through a gap is not preferred.
    hidden = np.mean([np.roll(hidden, shift) for shift in (-1, 0, 1)], axis=0)
    first = int(hidden.argmin())
    turn = np.abs((azimuths - azimuths[first] + np.pi) % (2 * np.pi) - np.pi)
    second = int(np.where(turn > np.radians(50), hidden + 1e-6 * turn, np.inf).argmin())
    return [directions[first], directions[second]]


def _screen_axes(towards_eye: FloatArray) -> FloatArray:
    """Rows: right, down, towards the eye."""
    back = towards_eye / np.linalg.norm(towards_eye)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    return np.stack([right, -np.cross(back, right), back])


def _hiding(points: FloatArray, pipes: Sequence[ColoredPipe], axes: FloatArray) -> float:
    """Share of the pipes' length, sampled every 5 cm, with points or another pipe between it and the eye."""
    samples = [
        pipe.cylinder.start + steps[:, None] * (pipe.cylinder.end - pipe.cylinder.start)
        for pipe in pipes
        for steps in [np.linspace(0, 1, max(2, int(pipe.cylinder.length / 0.05)))]
    ]
    if not samples:
        return 0.0
    flat = np.concatenate([points, *samples]) @ axes.T
    tree = cKDTree(flat[:, :2])
    hidden = 0
    for pipe, own in zip(pipes, samples, strict=True):
        across = float(np.linalg.norm(np.cross(pipe.cylinder.axis, axes[2])))
        surface = pipe.cylinder.radius / max(across, 0.3)
        for sample in own @ axes.T:
            near = tree.query_ball_point(sample[:2], max(0.03, pipe.cylinder.radius))
            hidden += bool((flat[near, 2] > sample[2] + surface + 0.03).any())
    return hidden / sum(len(own) for own in samples)


def _splat(
    flat: FloatArray, corner: FloatArray, pixel: float, size: tuple[int, int], spread: int
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Number of the nearest point of each pixel (-1: none) and its depth; each point covers `spread` pixels square."""
    places = ((flat[:, :2] - corner) / pixel).astype(np.int64)
    seen = np.flatnonzero(((places >= 0) & (places < size)).all(axis=1))
    order = seen[np.argsort(flat[seen, 2], kind="stable")]  # from far to near: of several in one pixel the last stays
    ranks = np.zeros((size[1], size[0]))
    ranks[places[order, 1], places[order, 0]] = np.arange(1, len(order) + 1)
    ranks = cv2.dilate(ranks, np.ones((spread, spread), np.uint8)).astype(np.int64)  # a higher rank is nearer
    numbered = np.concatenate([[-1], order])
    depths = np.concatenate([[-np.inf], flat[order, 2]]).astype(np.float32)
    return numbered[ranks], depths[ranks]


def _spread(cloud: FloatArray, pixel: float) -> int:
    """Size of a splat that closes the gaps between the points of a surface."""
    sample = cloud[:: max(1, len(cloud) // 20_000)]
    if len(sample) < 10:
        return 2
    distance = float(np.median(cKDTree(sample).query(sample, 2)[0][:, 1]))
    return int(np.clip(np.ceil(2.5 * distance * np.sqrt(len(sample) / len(cloud)) / pixel), 2, 9))


def _shaded(image: NDArray[np.uint8], depth: NDArray[np.float32], pixel: float) -> NDArray[np.uint8]:
    """Darkened where the neighbourhood lies nearer to the eye."""
    known = np.isfinite(depth)
    if not known.any():
        return image
    smooth = cv2.medianBlur(np.where(known, depth, depth[known].min()).astype(np.float32), 5)
    height, width = smooth.shape
    wide = np.pad(smooth, 7, mode="edge")
    shade = np.zeros_like(smooth)
    for reach in (3, 7):
        for turn in range(8):
            down, right = (7 + round(reach * part) for part in (np.sin(turn * np.pi / 4), np.cos(turn * np.pi / 4)))
            nearer = np.clip(wide[down : down + height, right : right + width] - smooth, 0, 0.2)
            shade += np.log1p(nearer / (4 * reach * pixel))
    dark = np.where(known, np.exp(-SHADING * shade), 1.0)
    return (image * dark[..., None]).astype(np.uint8)


def _frame(cloud: FloatArray, pipes: Sequence[ColoredPipe], axes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners of the picture on the screen [m]: the pipes whole, the cloud but for its outermost points."""
    corners = (
        [np.percentile(cloud[:: 1 + len(cloud) // 100_000] @ axes[:2].T, (0.3, 99.7), axis=0)] if len(cloud) else []
    )
    for pipe in pipes:
        ends = np.stack([pipe.cylinder.start, pipe.cylinder.end]) @ axes[:2].T
        reach = pipe.cylinder.radius + 0.05
        corners += [ends - reach, ends + reach]
    every = np.concatenate(corners)
    return every.min(axis=0), every.max(axis=0)


def _shown(points: FloatArray, pipes: Sequence[ColoredPipe]) -> NDArray[np.int64]:
    """Indices of the points to draw: around the pipes, or without pipes all but the outermost; at most MAX_POINTS."""
    if not len(points):
        return np.empty(0, np.int64)
    if pipes:
        ends = np.concatenate([[pipe.cylinder.start, pipe.cylinder.end] for pipe in pipes])
        low, high = ends.min(0) - MARGIN, ends.max(0) + MARGIN
    else:
        low, high = np.percentile(points, (1, 99), axis=0)
    inside = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    return inside[:: -(-len(inside) // MAX_POINTS)] if len(inside) else inside


def _paint(
    image: NDArray[np.uint8],
    depth: NDArray[np.float32],
    pipe: ColoredPipe,
    axes: FloatArray,
    corner: FloatArray,
    pixel: float,
) -> None:
    """Draw a cylinder into the picture where nothing lies before it: the ray of each pixel is cut with it."""
    cylinder, back = pipe.cylinder, axes[2]
    ends = (np.stack([cylinder.start, cylinder.end]) @ axes[:2].T - corner) / pixel
    reach = cylinder.radius / pixel + 1
    left, top = np.clip(ends.min(axis=0) - reach, 0, None).astype(int)
    right, bottom = np.clip(ends.max(axis=0) + reach + 1, 0, (image.shape[1], image.shape[0])).astype(int)
    rows, columns = np.mgrid[top:bottom, left:right]
    across = corner[0] + (columns + 0.5) * pixel, corner[1] + (rows + 0.5) * pixel
    # Points of the screen plane, from the start of the axis: across * axes[0] + down * axes[1] + t * back.
    origin = across[0][..., None] * axes[0] + across[1][..., None] * axes[1] - cylinder.start
    along, slope = origin @ cylinder.axis, float(back @ cylinder.axis)
    radial, climb = origin - along[..., None] * cylinder.axis, back - slope * cylinder.axis
    half, steep = radial @ climb, float(climb @ climb)
    root = half**2 - steep * ((radial**2).sum(-1) - cylinder.radius**2)
    hits = (root >= 0) & (steep > 1e-9)
    t = (-half + np.sqrt(np.clip(root, 0, None))) / max(steep, 1e-9)
    hits &= (along + t * slope >= 0) & (along + t * slope <= cylinder.length)
    facing = (radial + t[..., None] * climb) @ back / cylinder.radius
    tint = 255 * np.asarray(pipe.color) * (0.4 + 0.6 * facing[..., None]) + 70 * np.clip(facing, 0, 1)[..., None] ** 12
    if abs(slope) > 1e-9:
        # The end that faces the eye is a disc.
        t_end = ((cylinder.length if slope > 0 else 0.0) - along) / slope
        disc = ((radial + t_end[..., None] * climb) ** 2).sum(-1) <= cylinder.radius**2
        t = np.where(disc, t_end, t)
        tint = np.where(disc[..., None], 255 * 0.45 * np.asarray(pipe.color), tint)
        hits |= disc
    window = depth[top:bottom, left:right]
    seen = hits & (t + LIFT > window)
    window[seen] = t[seen] + LIFT
    image[top:bottom, left:right][seen] = np.clip(tint[seen], 0, 255)


def _label_places(
    pipe: ColoredPipe, depth: NDArray[np.float32], axes: FloatArray, corner: FloatArray, pixel: float
) -> FloatArray:
    """Where (P, 2) [px of the reduced picture] a label may stand on a pipe: where it is seen, the middle first."""
    cylinder = pipe.cylinder
    steps = 0.5 + np.array([0, 1, -1, 2, -2, 3, -3, 4, -4])[:, None] / 10
    points = (cylinder.start + steps * (cylinder.end - cylinder.start)) @ axes.T
    places = (points[:, :2] - corner) / pixel
    column, row = np.clip(places.astype(int), 0, np.array(depth.shape[::-1]) - 1).T
    seen = depth[row, column] < points[:, 2] + 2 * cylinder.radius + LIFT
    return np.concatenate([places[seen], places[~seen]]) / OVERSAMPLING


def _label(image: NDArray[np.uint8], text: str, places: FloatArray, taken: list[tuple[FloatArray, FloatArray]]) -> None:
    """Write `text` at the first place whose box is free of those in `taken`, or at the first; takes the box."""
    size = np.array(cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, 0.5, 1)[0])
    boxes = [(place - size / 2 - 2, place + size / 2 + 2) for place in places]
    free = (box for box in boxes if not any(((box[0] < high) & (low < box[1])).all() for low, high in taken))
    low, high = next(free, boxes[0])
    taken.append((low, high))
    corner = int(low[0] + 2), int(high[1] - 2)
    for color, thickness in (((255, 255, 255), 4), ((20, 20, 20), 1)):
        cv2.putText(image, text, corner, cv2.FONT_HERSHEY_DUPLEX, 0.5, color, thickness, cv2.LINE_AA)
