# SPDX-License-Identifier: Apache-2.0
"""Depth maps of keyframes on the CPU: each keyframe is matched with a few neighbours of known pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RolledImage
from pipeprog_sfm.config import StereoConfig
from pipeprog_sfm.dense.patch_refinement import fours, refine
from pipeprog_sfm.dense.plane_sweep import OVERSAMPLING, census, sweep
from pipeprog_sfm.dense.row_mapping import RowMapping, depth_at_the_stamp, row_mapping

FloatImage = NDArray[np.float32]
ByteImage = NDArray[np.uint8]

BASELINE_RATIO = (0.08, 0.35)  # of the depth; below, depth is noise; above, the views differ too much to be matched
BASELINE_RATIO_BEST = 0.2  # of the depth, near the geometric mean (0.17) of the range: 11 degrees between the rays
VIEW_ANGLE_MAX = np.radians(30.0)  # between optical axes: the images must overlap
FORWARD_MAX = np.radians(50.0)  # baseline out of the image plane: towards 90 the epipole enters the image
STRIDE = OVERSAMPLING  # px of the working resolution: the sweep's neighbours are at that resolution
SHADING = (
    4.0  # px of the working resolution, sigma of a high-pass: texture within a patch of 5 px passes, shading does not
)
CORRELATION_MIN = 0.5  # of patches: at 0.5 signal and noise have the same power (correlation = S / (S + N))
SIGMA_MAX = 0.005  # of the depth, half of AGREEMENT in fusion: two maps then agree within 0.01 with 84 % probability


@dataclass(frozen=True, eq=False)
class Picture:
    """An undistorted keyframe (H, W, 3) uint8 BGR of a pinhole camera, and what matching takes of it, made once."""

    color: ByteImage
    camera: Camera

    @classmethod
    def reduced(cls, image: ByteImage, camera: Camera, width: int) -> Picture:
        """A picture of `width`, or of its own where it is narrower."""
        factor = width / camera.width
        if factor >= 1.0:
            return cls(image, camera)
        camera = camera.scaled(factor)
        resized = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        return cls(np.asarray(resized, np.uint8), camera)

    @cached_property
    def gray(self) -> ByteImage:
        """(H, W)."""
        return np.asarray(cv2.cvtColor(self.color, cv2.COLOR_BGR2GRAY), np.uint8)

    @cached_property
    def codes(self) -> NDArray[np.uint32]:
        """(H, W) census as the sweep reads it of a neighbour."""
        return census(_low_pass(_without_shading(self.gray.astype(np.float32))), OVERSAMPLING)

    @cached_property
    def halved(self) -> Picture:
        """The picture at half of its width."""
        return Picture.reduced(self.color, self.camera, self.camera.width // 2)

    @cached_property
    def fours(self) -> NDArray[np.uint32]:
        """(H, W) as the refinement reads them of a neighbour."""
        return fours(self.gray)


@dataclass(frozen=True)
class StereoImage:
    """A keyframe's picture at working resolution, and its pose in any unit of length.

    `rolled`: how its rolling shutter shows the scene, in the same unit, at the picture's size or a larger one.
    """

    stamp: int
    picture: Picture
    camera_from_world: FloatArray
    rolled: RolledImage | None = None


@dataclass(frozen=True)
class DepthMap:
    """Depth along the optical axis, (h, w) float32 in the unit of the poses, NaN where unknown; (h, w, 3) uint8 BGR.

    Both are seen from the pose of the stamp, with a rolling shutter, too.
    """

    stamp: int
    depth: FloatImage
    camera: Camera
    color: ByteImage


def choose_pairs(
    reference_stamp: int,
    poses: Mapping[int, FloatArray],
    median_depth: float,
    config: StereoConfig,
) -> list[int]:
    """Neighbours of a keyframe that are worth matching with it, best first, at most `max_pairs`.

    A neighbour qualifies by its baseline (a share of the median depth), by looking the same way and by standing
    beside, not in front or behind. Among those, baselines of different direction complement each other: an edge along
    the one is no match along the other, and what one side occludes the other side sees.
    """
    reference = poses[reference_stamp]
    rotation, centre = reference[:3, :3], _centre(reference)
    stamps = sorted(stamp for stamp in poses if stamp != reference_stamp)
    if not stamps:
        return []
    stack = np.stack([poses[stamp] for stamp in stamps])
    centres = -np.einsum("vji,vj->vi", stack[:, :3, :3], stack[:, :3, 3])
    baselines = (centres - centre) @ rotation.T
    lengths = np.maximum(np.linalg.norm(baselines, axis=1), 1e-12)
    ratios = lengths / median_depth
    view_angles = np.arccos(np.clip(stack[:, 2, :3] @ reference[2, :3], -1.0, 1.0))
    forward_angles = np.arcsin(np.minimum(1.0, np.abs(baselines[:, 2]) / lengths))
    fit = (ratios >= BASELINE_RATIO[0]) & (ratios <= BASELINE_RATIO[1])
    fit &= (view_angles <= VIEW_ANGLE_MAX) & (forward_angles <= FORWARD_MAX)
    costs = np.abs(np.log(ratios / BASELINE_RATIO_BEST)) + view_angles / VIEW_ANGLE_MAX + forward_angles / FORWARD_MAX
    candidates = [(stamps[n], float(costs[n]), baselines[n] / lengths[n]) for n in np.flatnonzero(fit)]
    chosen: list[tuple[int, FloatArray]] = []
    while candidates and len(chosen) < config.max_pairs:
        # 1 for a baseline that repeats a chosen one, 0.5 for the opposite one, 0 for one at right angles to all
        scores = [
            cost + max((max(float(d @ other), -0.5 * float(d @ other)) for _, other in chosen), default=0.0)
            for _, cost, d in candidates
        ]
        stamp, _, direction = candidates.pop(int(np.argmin(scores)))
        chosen.append((stamp, direction))
    return [stamp for stamp, _ in chosen]


def depth_map(reference: StereoImage, neighbours: Sequence[StereoImage], depth_range: tuple[float, float]) -> DepthMap:
    """Depth of every STRIDE-th pixel of the reference; depth_range = (near, far) of the scene.

    A semi-global sweep over all neighbours at reduced resolution finds the surface, patches at full working resolution
    then place it to a fraction of a pixel.
    """
    near, far = depth_range
    if not 0.0 < near < far:
        raise ValueError(f"depth range {near:g} to {far:g} is empty")
    camera = reference.picture.camera
    color = cv2.pyrDown(reference.picture.color)  # its pixel (u, v) is centred at (2 u, 2 v)
    height, width = color.shape[:2]
    grid = Camera(width, height, camera.fx / STRIDE, camera.fy / STRIDE, camera.cx / STRIDE, camera.cy / STRIDE)
    if not neighbours:
        return DepthMap(reference.stamp, np.full((height, width), np.nan, np.float32), grid, color)
    gray = reference.picture.gray.astype(np.float32)
    inverse_range = 1.0 / far, 1.0 / near
    images = [reference, *neighbours]
    halves = [replace(image, picture=image.picture.halved) for image in images]
    homography, epipole, rows = geometry = _geometry(reference, neighbours)
    coarse = _swept(halves, _geometry(halves[0], halves[1:]), inverse_range)
    inverse = _swept(images, geometry, inverse_range, coarse)
    others = np.stack([other.picture.fours for other in neighbours])
    inverse, correlation, sigma = refine(inverse, gray, others, homography, epipole, STRIDE, rows)
    known = (correlation >= CORRELATION_MIN) & (sigma <= SIGMA_MAX)
    depth = np.where(known, 1.0 / np.where(known, inverse, 1.0), np.nan).astype(np.float32)
    rolled = _at_width(reference.rolled, camera.width)
    if rolled is not None:
        depth, places = depth_at_the_stamp(depth, rolled, STRIDE)
        color = np.asarray(cv2.remap(color, places, None, cv2.INTER_LINEAR), np.uint8)
    return DepthMap(reference.stamp, depth, grid, color)


def _swept(
    images: Sequence[StereoImage],
    geometry: tuple[FloatArray, FloatArray, RowMapping | None],
    inverse_range: tuple[float, float],
    coarse: FloatImage | None = None,
) -> FloatImage:
    """Inverse depth of every STRIDE-th pixel of the first image, matched with the others, of their `_geometry`."""
    reference, *neighbours = images
    homographies, epipoles, rows = geometry
    return sweep(
        census(cv2.pyrDown(_without_shading(reference.picture.gray.astype(np.float32))), 1),
        np.stack([other.picture.codes for other in neighbours]),
        homographies @ np.diag([STRIDE, STRIDE, 1.0]),
        epipoles,
        inverse_range,
        None if rows is None else rows.thinned(STRIDE),
        coarse,
    )


def _geometry(
    reference: StereoImage, neighbours: Sequence[StereoImage]
) -> tuple[FloatArray, FloatArray, RowMapping | None]:
    """(N, 3, 3) homographies, (N, 3) epipoles and rolling rows of N neighbours, if the reference has any.

    A pixel x of inverse depth i lies at homographies[n] @ x + i * epipoles[n] of them, with rolling rows at the stamps.
    """
    homographies, epipoles = [], []
    camera = reference.picture.camera
    for neighbour in neighbours:
        other = neighbour.picture.camera.matrix
        other_from_reference = neighbour.camera_from_world @ np.linalg.inv(reference.camera_from_world)
        homographies.append(other @ other_from_reference[:3, :3] @ np.linalg.inv(camera.matrix))
        epipoles.append(other @ other_from_reference[:3, 3])
    rolled = _at_width(reference.rolled, camera.width)
    rows = None if rolled is None else _rows(rolled, reference, neighbours)
    return np.stack(homographies), np.stack(epipoles), rows


def _rows(rolled: RolledImage, reference: StereoImage, neighbours: Sequence[StereoImage]) -> RowMapping:
    """The mapping of rolling rows at the width of the reference's `rolled`; all neighbours have rolling shutters."""
    pairs = [(_at_width(other.rolled, rolled.camera.width), other.camera_from_world) for other in neighbours]
    world_from_reference = np.linalg.inv(reference.camera_from_world)
    others = [(other, pose @ world_from_reference) for other, pose in pairs if other is not None]
    return row_mapping(rolled, [other for other, _ in others], [pose for _, pose in others])


def _at_width(rolled: RolledImage | None, width: int) -> RolledImage | None:
    """The rolling shutter of an image reduced to `width`."""
    if rolled is None or rolled.camera.width == width:
        return rolled
    return rolled.scaled(width / rolled.camera.width)


def _without_shading(gray: FloatImage) -> FloatImage:
    """Only what is finer than SHADING: highlights and shades do not lie on the surface, and move with the camera."""
    return gray - cv2.GaussianBlur(gray, (0, 0), SHADING)


def _low_pass(image: FloatImage) -> FloatImage:
    """The kernel of cv2.pyrDown, without its decimation."""
    kernel = np.array([1.0, 4.0, 6.0, 4.0, 1.0], np.float32) / 16.0
    return cv2.sepFilter2D(image, -1, kernel, kernel)


def _centre(camera_from_world: FloatArray) -> FloatArray:
    return -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]


def working_size(camera: Camera, width: int) -> tuple[int, int]:
    """(width, height) of a camera's working image."""
    factor = min(width / camera.width, 1.0)
    return round(camera.width * factor), round(camera.height * factor)
