# SPDX-License-Identifier: Apache-2.0
"""Photographs that prove the pipes: crops of the keyframes that show each best, upright, its outline drawn."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.results.pipe_outlines import NEAR, inside, outline, project
from pipeprog_bringup.results.results_reader import Results
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_camera.rolled_image import RolledImage, RowVelocities
from pipeprog_detect.types import Cylinder

SAMPLES = 25  # positions along an axis at which it is asked whether a keyframe shows it
CELL = 16  # px of a keyframe, the side of a cell of the depth map of what hides a pipe
HIDDEN = 0.1  # m by which the cloud lies before a pipe's surface where it hides it: noise and neighbours touching it
WHOLE = 0.9  # share of a pipe's length that a photograph shows where it counts as the whole pipe
OTHER_SIDE = math.radians(25.0)  # turn around a pipe from which a second photograph tells something new
MARGIN = 0.3  # of the outline's size, shown around it: enough to find the place again on the site
LEAST_CROP = 240  # px of a keyframe, the least side of a crop
LONGEST = 480  # px, the longer side of a photograph: what the page shows of it on a screen of double resolution
SMALLEST = 160  # px; below, a photograph proves nothing
QUALITY = 80  # of the JPEG
ALL_PHOTOGRAPHS = 6_000_000  # bytes of all photographs of a report of 15 MB, as they are before base64
BYTES_PER_PIXEL = 0.25  # of a JPEG of QUALITY of a building site


@dataclass(frozen=True)
class Photograph:
    """A crop of a keyframe: JPEG bytes, size [px], number of the keyframe from 1, share of the pipe's length shown."""

    jpeg: bytes
    width: int
    height: int
    keyframe: int
    share: float


@dataclass(frozen=True)
class Sight:
    """How keyframes show pipes.

    Attributes:
        seen: (K, P, SAMPLES) whether keyframe k shows that position of the axis of pipe p.
        size: (K, P) length of what it shows [px].
        direction: (K, P, 3) unit vectors from the pipe's middle to the camera.
    """

    seen: NDArray[np.bool_]
    size: FloatArray
    direction: FloatArray


def photographs(
    results: Results, points: FloatArray, colors: Sequence[tuple[float, float, float]]
) -> tuple[list[list[Photograph]], str]:
    """At most two photographs of each pipe, the best first, and why there are none (empty where there are).

    `points` (N, 3) of the cloud [m] say what hides a pipe, `colors` (RGB in 0..1) are those of the outlines.
    """
    none: list[list[Photograph]] = [[] for _ in results.pipes]
    path = results.folder / "out.mcap"
    if not path.is_file() or not len(results.stamps):
        return none, "This run has kept no keyframes (out.mcap, trajectory.tum)"
    try:
        bag = Bag.open(path)
        cameras = {frame.stamp: cdr.read_camera_info(frame.camera_info).camera() for frame in bag if not frame.fault}
        rows = [row for row, stamp in enumerate(results.stamps.tolist()) if stamp in cameras]
        views = [(cameras[int(results.stamps[row])], results.map_from_camera[row]) for row in rows]
        if not rows:
            return none, f"{path} holds no keyframe of trajectory.tum"
        chosen = [best_views(*pipe) for pipe in _each_pipe(sight(views, results.cylinders, points))]
        velocities = _velocities(bag, len(results.stamps))
        rolled = [
            velocities.rolled(row, camera) if velocities else None for row, (camera, _) in zip(rows, views, strict=True)
        ]
        return _cropped(bag, results, rows, views, rolled, chosen, colors), ""
    except (InputError, ValueError) as error:
        return none, str(error)


def _velocities(bag: Bag, count: int) -> RowVelocities | None:
    """How the map moves as seen from the `count` keyframes of a rolling shutter, None for another camera."""
    found = None
    for data in bag.messages("/keyframe_velocities"):
        readout, rates = cdr.read_velocities(data)
        if all(len(rate) == count for rate in rates):
            found = RowVelocities(readout, *rates)
    return found


def sight(views: Sequence[tuple[Camera, FloatArray]], cylinders: Sequence[Cylinder], points: FloatArray) -> Sight:
    """How these views, each a camera and its pose map_from_camera (4, 4), show the cylinders."""
    shares = np.linspace(0.0, 1.0, SAMPLES)
    axes = np.array([cylinder.at(shares) for cylinder in cylinders]).reshape(len(cylinders), SAMPLES, 3)
    radii = np.array([cylinder.radius for cylinder in cylinders])
    seen = np.zeros((len(views), len(cylinders), SAMPLES), bool)
    size = np.zeros((len(views), len(cylinders)))
    direction = np.zeros((len(views), len(cylinders), 3))
    for number, (camera, pose) in enumerate(views):
        pixels, depth = project(camera, pose, axes.reshape(-1, 3))
        nearest = _nearest(camera, pose, points)
        rows, columns = _cells(camera, pixels)
        front = depth - np.repeat(radii, SAMPLES)
        shown = inside(camera, pixels) & (front > NEAR)
        shown &= nearest[rows, columns] > front - HIDDEN
        seen[number] = shown.reshape(-1, SAMPLES)
        steps = np.linalg.norm(np.diff(pixels.reshape(-1, SAMPLES, 2), axis=1), axis=2)
        both = seen[number, :, 1:] & seen[number, :, :-1]
        size[number] = np.where(both, steps, 0.0).sum(axis=1)
        towards = pose[:3, 3] - axes.mean(axis=1)
        direction[number] = towards / np.maximum(np.linalg.norm(towards, axis=1), 1e-9)[:, None]
    return Sight(seen, size, direction)


def best_views(seen: NDArray[np.bool_], size: FloatArray, direction: FloatArray) -> list[int]:
    """At most two views of one pipe, of which seen (K, SAMPLES), size (K,) and direction (K, 3) are given.

    The first shows the most of the pipe, and of several the largest. Where that is not the whole pipe, the second adds
    the most to it; else it shows the pipe from another side.
    """
    share = seen.mean(axis=1)
    if not share.any():
        return []
    # Shares are compared in tenths: a sample at an end more or less is worth less than twice the size.
    first = int(np.lexsort((size, np.round(10 * share)))[-1])
    if share[first] >= WHOLE:
        turned = direction @ direction[first] < math.cos(OTHER_SIDE)
        gain = np.where(turned, share, 0.0)
    else:
        gain = (seen & ~seen[first]).mean(axis=1)
    second = int(np.lexsort((size, np.round(10 * gain)))[-1])
    return [first, second] if gain[second] >= 0.1 else [first]


def _each_pipe(found: Sight) -> list[tuple[NDArray[np.bool_], FloatArray, FloatArray]]:
    count = found.size.shape[1]
    return [(found.seen[:, pipe], found.size[:, pipe], found.direction[:, pipe]) for pipe in range(count)]


def _cells(camera: Camera, pixels: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns (N,) of the depth map's cells in which pixels (N, 2) lie; those outside get the nearest."""
    clipped = np.clip(pixels, 0, [camera.width - 1, camera.height - 1]).astype(np.int64) // CELL
    return clipped[:, 1], clipped[:, 0]


def _nearest(camera: Camera, pose: FloatArray, points: FloatArray) -> FloatArray:
    """Depth [m] of the nearest point in each cell of CELL px; infinite where there is none."""
    depths = np.full((-(-camera.height // CELL), -(-camera.width // CELL)), np.inf)
    if len(points):
        pixels, depth = project(camera, pose, points)
        shown = inside(camera, pixels) & (depth > NEAR)
        rows, columns = _cells(camera, pixels[shown])
        np.minimum.at(depths, (rows, columns), depth[shown])
    return depths


def _cropped(
    bag: Bag,
    results: Results,
    rows: Sequence[int],
    views: Sequence[tuple[Camera, FloatArray]],
    rolled: Sequence[RolledImage | None],
    chosen: Sequence[list[int]],
    colors: Sequence[tuple[float, float, float]],
) -> list[list[Photograph]]:
    """The photographs of each pipe from the views that were chosen for it."""
    wanted: dict[int, list[tuple[int, int]]] = defaultdict(list)  # stamp -> view, pipe
    for pipe, numbers in enumerate(chosen):
        for view in numbers:
            wanted[int(results.stamps[rows[view]])].append((view, pipe))
    side = _longest_side(sum(map(len, chosen)))
    found: dict[tuple[int, int], Photograph] = {}
    for frame in bag:
        if side < SMALLEST or frame.stamp not in wanted or frame.fault:
            continue
        encoded = np.frombuffer(cdr.read_image(frame.data, bag.image_type).data, np.uint8)
        image = cv2.imdecode(encoded, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            continue
        for view, pipe in wanted.pop(frame.stamp):
            cylinder, number = results.cylinders[pipe], rows[view] + 1
            photograph = _crop(image.astype(np.uint8), *views[view], rolled[view], cylinder, colors[pipe], side, number)
            if photograph is not None:
                found[view, pipe] = photograph
    return [[found[view, pipe] for view in numbers if (view, pipe) in found] for pipe, numbers in enumerate(chosen)]


def _longest_side(count: int) -> int:
    """Longer side [px] at which `count` photographs of 3 : 4 take ALL_PHOTOGRAPHS bytes together at most."""
    area = ALL_PHOTOGRAPHS / BYTES_PER_PIXEL / max(count, 1)
    return min(LONGEST, int(math.sqrt(area / 0.75)))


def _crop(
    image: NDArray[np.uint8],
    camera: Camera,
    pose: FloatArray,
    rolled: RolledImage | None,
    cylinder: Cylinder,
    color: tuple[float, float, float],
    side: int,
    keyframe: int,
) -> Photograph | None:
    """The part of a keyframe (H, W, 3) BGR around a pipe, upright, `side` px at most, with its outline; None within it.

    What lies above is up to a quarter turn: a keyframe of a camera that is mounted on its side is turned.
    """
    edge = outline(cylinder, pose[:3, 3])
    if not len(edge):
        return None
    pixels, depth = project(camera, pose, edge, rolled)
    shown = inside(camera, pixels) & (depth > NEAR)
    if not shown.any():
        return None
    low, high = _crop_box(camera, pixels[shown])
    part = image[low[1] : high[1], low[0] : high[0]]
    turns = _quarter_turns(camera, pose, cylinder)
    factor = min(1.0, side / max(part.shape[:2]))
    part = np.ascontiguousarray(
        np.rot90(cv2.resize(part, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), turns)
    )
    line = _turned((np.clip(pixels, -1e4, 1e4) - low) * factor, turns, (high - low) * factor)
    # Sub-pixel coordinates with 4 binary digits; white below, so that the colour is seen on every background.
    polygon = [np.round(16 * line).astype(np.int32)]
    bgr = [round(255 * part_of) for part_of in reversed(color)]
    for tint, width in (([255, 255, 255], 4), (bgr, 2)):
        cv2.polylines(part, polygon, True, tint, width, cv2.LINE_AA, 4)
    encoded = cv2.imencode(".jpg", part, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    axis, depth = project(camera, pose, cylinder.at(np.linspace(0.0, 1.0, SAMPLES)))
    share = float((inside(camera, axis) & (depth > NEAR)).mean())
    return Photograph(encoded.tobytes(), part.shape[1], part.shape[0], keyframe, share)


def _crop_box(camera: Camera, pixels: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Corners [px] of the part of the image around an outline's pixels (N, 2)."""
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    grown = np.maximum((0.5 + MARGIN) * (high - low).max() * np.array([0.75, 0.75]), 0.5 * LEAST_CROP)
    reach = np.maximum(grown, 0.5 * (high - low) + 0.1 * (high - low).max())
    middle, size = 0.5 * (low + high), np.array([camera.width, camera.height])
    return (
        np.clip(middle - reach, 0, size - 1).astype(np.int64),
        np.clip(middle + reach + 1, 1, size).astype(np.int64),
    )


def _quarter_turns(camera: Camera, pose: FloatArray, cylinder: Cylinder) -> int:
    """Quarter turns, counterclockwise, that bring what is up in the map up in the picture."""
    up = pose[:3, :3].T @ [0.0, 0.0, 1.0]
    towards = pose[:3, :3].T @ (cylinder.middle - pose[:3, 3])
    # How the image of the pipe's middle moves when it is raised.
    motion = up[:2] - towards[:2] / max(towards[2], NEAR) * up[2]
    return round(math.atan2(motion[0], -motion[1]) / (0.5 * math.pi)) % 4


def _turned(pixels: FloatArray, turns: int, size: NDArray[np.floating]) -> FloatArray:
    """Where pixels (N, 2) of a picture of this size (width, height) lie after quarter turns counterclockwise."""
    for _ in range(turns):
        pixels = np.stack([pixels[:, 1], size[0] - 1 - pixels[:, 0]], axis=1)
        size = size[::-1]
    return pixels
