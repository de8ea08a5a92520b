# SPDX-License-Identifier: Apache-2.0
"""Bright discs on dark ground, found in an image as ellipses with sub-pixel edges."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.conic import axes_and_angle, conic_from_ellipse, pixel_change
from pipeprog_sfm.config import BoardConfig

PROFILES = 64  # edge points of an ellipse: a coordinate of its centre has sqrt(2/64), a sixth, of their noise
MIN_PROFILES = 0.75  # of these, that must show an edge: a disc may be partly hidden, or lie at the board's rim
MAX_FLATTENING = 5.0  # ratio of the axes: 78 degrees of tilt; beyond, the two edges' blurs overlap
MIN_CONTRAST = 25.0  # grey levels between disc and ground: ten times the noise of a camera, three times JPEG's ringing
STEP = 0.5  # px between the samples of an edge profile
MIN_REACH, MAX_REACH = 1.5, 4.0  # px of a profile to both sides of the edge: the blur of a sharp and of a soft image
REACH = 0.6  # of the semi-minor axis, likewise: a profile must not reach the disc's opposite edge
EDGE_HALF_WIDTH = 1.8  # px around the steepest place that count as the edge: two sigma of a blur of 0.9 px
MIN_EDGE_SHARE = 0.6  # of all falls of grey along a profile, within the edge: texture has several
MAX_BLUR = 2.4  # px, sigma of an edge of whose fall, as far as MAX_REACH, that share lies within EDGE_HALF_WIDTH
MAX_AREA_ERROR = 0.1  # relative, of a contour's area against its ellipse's ...
AREA_ERROR_PX = 0.5  # ... and px of its semi-minor axis: the staircase of pixels
REJECTION = 3.0  # robust standard deviations of an edge point from its ellipse, plus 0.02 px of interpolation


@dataclass(frozen=True)
class ImageEllipses:
    """Ellipses of one image, in the pixels of the ideal pinhole camera (lens distortion removed).

    Attributes:
        centres: (E, 2) centres of the ellipses, px.
        shapes: (E, 2, 2) shape matrices, px^2; see `pipeprog_sfm.boards.conic`.
        rms: (E,) root mean square distance of the edge points from the ellipse, px.
    """

    centres: FloatArray
    shapes: FloatArray
    rms: FloatArray

    def __len__(self) -> int:
        return len(self.centres)

    def in_pixels_of(self, camera: Camera, own: Camera) -> ImageEllipses:
        """The same in the pixels of another camera than its own, at the same place."""
        stretch, shift = pixel_change(camera, own)
        return ImageEllipses(
            self.centres * stretch + shift,
            self.shapes * np.outer(stretch, stretch),
            self.rms * float(np.sqrt(stretch.prod())),
        )

    @property
    def conics(self) -> FloatArray:
        """(E, 3, 3) conics in pixels."""
        return conic_from_ellipse(self.centres, self.shapes)

    @property
    def axes(self) -> FloatArray:
        """(E, 2) semi-axes, larger first, px."""
        return axes_and_angle(self.shapes)[0]


def detect_ellipses(gray: NDArray[np.uint8], camera: Camera, config: BoardConfig) -> ImageEllipses:
    """Bright elliptic discs on dark ground.

    Contours of the locally thresholded image give candidates; the edge of each is then measured along the normals of
    its ellipse (centroid of the grey gradient), undistorted and fitted again.

    Args:
        gray: (H, W) uint8 image as the camera saw it.
        camera: its calibration.
        config: smallest disc to look for.
    """
    candidates = _candidates(gray, config)
    centres: FloatArray = candidates[:, :2]
    shapes: FloatArray = _shapes(candidates)
    rms: FloatArray = np.zeros(len(candidates))
    for lens in (
        camera.pinhole(),
        camera,
    ):  # the first round leaves the lens distortion in: its ellipses guide the second in the image
        if not len(centres):
            break
        points, weights = _edge_points(gray, centres, shapes)
        undistorted = lens.undistort_points(points.reshape(-1, 2)).reshape(points.shape)
        # Far outside of a lens's image circle its distortion has no inverse.
        known = np.isfinite(undistorted[..., 0]) & np.isfinite(undistorted[..., 1])
        centres, shapes, rms, good = fit_ellipses(np.where(known[..., None], undistorted, 0.0), weights * known)
        centres, shapes, rms = centres[good], shapes[good], rms[good]
        good = _plausible(shapes, config)
        centres, shapes, rms = centres[good], shapes[good], rms[good]
    single = _first_of_each(centres, shapes, rms)
    return ImageEllipses(centres[single], shapes[single], rms[single])


def _candidates(gray: NDArray[np.uint8], config: BoardConfig) -> FloatArray:
    """(E, 5) ellipses x, y, semi-axis 1, semi-axis 2, angle of axis 1 [rad] of bright regions that may be discs."""
    height, width = gray.shape
    # The window spans the rim of a disc and some ground; inside larger discs the offset keeps the flat interior white.
    window = max(15, width // 40) | 1
    smooth = cv2.GaussianBlur(gray, (0, 0), 1.0)
    binary = cv2.adaptiveThreshold(smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, window, MIN_CONTRAST / 4)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(binary, connectivity=4)
    left, top, wide, high, area = boxes.T
    shorter, longer = np.minimum(wide, high), np.maximum(wide, high)
    least = config.min_radius
    # A slanted flat ellipse fills the least of its box, an upright one pi / 4.
    flattest = np.pi / 2 * MAX_FLATTENING / (1 + MAX_FLATTENING**2)
    likely = (
        (longer >= 2 * least)
        & (longer <= height)
        & (shorter >= 2 * least / MAX_FLATTENING)
        & (area >= (0.9 * flattest) * wide * high)
        & (area <= 0.9 * wide * high)
        & (left > 0)
        & (top > 0)
        & (left + wide < width)
        & (top + high < height)
    )
    found = []
    for label in np.flatnonzero(likely):
        x0, y0, w, h = (int(value) for value in boxes[label, :4])
        mask = (labels[y0 : y0 + h, x0 : x0 + w] == label).astype(np.uint8)
        contour = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(x0, y0))[0][0]
        if len(contour) < 4 * least:
            continue
        (x, y), (first, second), degrees = cv2.fitEllipseDirect(contour)
        # The contour runs through the outermost bright pixels, half a pixel inside the edge.
        first, second = first / 2 + 0.5, second / 2 + 0.5
        if not (np.isfinite([x, y]).all() and least <= max(first, second) <= MAX_FLATTENING * min(first, second)):
            continue
        filled = (cv2.contourArea(contour) + 0.5 * len(contour)) / (np.pi * first * second)
        if abs(filled - 1.0) <= MAX_AREA_ERROR + AREA_ERROR_PX / min(first, second):
            found.append((x, y, first, second, np.deg2rad(degrees)))
    return np.array(found).reshape(-1, 5)


def _shapes(candidates: FloatArray) -> FloatArray:
    """(E, 5) ellipses -> (E, 2, 2) shape matrices."""
    cosine, sine = np.cos(candidates[:, 4]), np.sin(candidates[:, 4])
    rotations = np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], -2)
    return (rotations * candidates[:, None, 2:4] ** 2) @ rotations.transpose(0, 2, 1)


def _edge_points(gray: NDArray[np.uint8], centres: FloatArray, shapes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Edge points (E, PROFILES, 2) on normals of ellipses, px of the image, and their 0/1 weights (E, PROFILES)."""
    starts, normals, shorter = rim_points(centres, shapes)
    reach = np.clip(REACH * shorter, MIN_REACH, MAX_REACH)
    count = int(2 * MAX_REACH / STEP) + 1
    offsets = np.linspace(-1.0, 1.0, count)[None, :] * reach[:, None]
    samples = (starts[:, :, None] + normals[:, :, None] * offsets[:, None, :, None]).astype(np.float32)
    grey = cv2.remap(
        gray, samples.reshape(len(centres), -1, 2), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    ).reshape(len(centres), PROFILES, count)
    falls = np.maximum(grey[..., :-1].astype(float) - grey[..., 1:].astype(float), 0.0)
    middles = 0.5 * (offsets[:, :-1] + offsets[:, 1:])
    # The centroid of the steepest place alone, without texture at the ends of the profile.
    total = falls.sum(-1)
    peak = np.take_along_axis(np.broadcast_to(middles[:, None], falls.shape), falls.argmax(-1)[..., None], -1)
    near = falls * (np.abs(middles[:, None] - peak) <= EDGE_HALF_WIDTH)
    shift = (near * middles[:, None]).sum(-1) / np.maximum(near.sum(-1), 1e-9)
    height, width = gray.shape
    inside = ((samples >= 0) & (samples <= np.array([width - 1, height - 1]))).all((-1, -2))
    weights = (near.sum(-1) >= MIN_CONTRAST) & (near.sum(-1) >= MIN_EDGE_SHARE * total) & inside
    return starts + normals * shift[..., None], weights.astype(float)


def rim_points(centres: FloatArray, shapes: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(E, PROFILES, 2) points of ellipses, px, their unit normals, and the (E,) semi-minor axes."""
    angles = np.arange(PROFILES) * (2 * np.pi / PROFILES)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    values, vectors = np.linalg.eigh(shapes)
    axes = np.sqrt(np.maximum(values, 1e-6))
    rim = np.einsum("eij,ej,pj->epi", vectors, axes, circle)
    normals = np.einsum("eij,ej,pj->epi", vectors, 1.0 / axes, circle)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return centres[:, None] + rim, normals, axes[:, 0]


def fit_ellipses(
    points: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Ellipses through (E, P, 2) points with 0/1 weights (E, P): centres, shapes, rms and which of them are good.

    Points are scaled to a unit circle first, where the algebraic distance is twice the geometric one, which frees the
    linear fit from its bias; outliers are rejected once.
    """
    used = np.maximum(weights.sum(1), 1.0)
    mean = (points * weights[..., None]).sum(1) / used[:, None]
    centred = points - mean[:, None]
    spread = np.einsum("ep,epi,epj->eij", weights, centred, centred) / used[:, None, None]
    spread += 1e-3 * np.eye(2)
    root = np.linalg.cholesky(2.0 * spread)  # maps the unit circle to the ellipse, roughly
    unit = np.linalg.solve(root[:, None], centred[..., None])[..., 0]
    x, y = unit[..., 0], unit[..., 1]
    design = np.stack([x * x, 2 * x * y, y * y, 2 * x, 2 * y], axis=-1)
    size = np.sqrt(np.abs(np.linalg.det(root)))
    for _ in range(2):
        normal = np.einsum("ep,epi,epj->eij", weights, design, design) + 1e-9 * np.eye(5)
        solution = np.linalg.solve(normal, np.einsum("ep,epi->ei", weights, design)[..., None])[..., 0]
        distance = 0.5 * (np.einsum("epi,ei->ep", design, solution) - 1.0) * size[:, None]
        masked = np.where(weights > 0, np.abs(distance), np.nan)
        empty = weights.sum(1) < 1
        masked[empty] = 0.0
        limit = REJECTION * 1.4826 * np.nanmedian(masked, axis=1) + 0.02
        weights = weights * (np.abs(distance) <= limit[:, None])
    used = np.maximum(weights.sum(1), 1.0)
    rms = np.sqrt((weights * distance**2).sum(1) / used)
    a, b, c, d, e = solution.T
    quadratic = np.stack([np.stack([a, b], -1), np.stack([b, c], -1)], -2)
    determinant = a * c - b * b
    good = (weights.sum(1) >= MIN_PROFILES * PROFILES) & (a > 0) & (determinant > 1e-3)
    quadratic[~good] = np.eye(2)
    linear = np.stack([d, e], -1)
    centre = -np.linalg.solve(quadratic, linear[..., None])[..., 0]
    level = 1.0 + np.einsum("ei,eij,ej->e", centre, quadratic, centre)
    shape = np.linalg.inv(quadratic) * level[:, None, None]
    centres = mean + np.einsum("eij,ej->ei", root, centre)
    shapes = root @ shape @ root.transpose(0, 2, 1)
    return centres, shapes, rms, good & np.isfinite(shapes).all((1, 2))


def _plausible(shapes: FloatArray, config: BoardConfig) -> NDArray[np.bool_]:
    """Which (E, 2, 2) shapes are ellipses large and round enough."""
    axes = axes_and_angle(shapes)[0]
    return (axes[:, 0] >= config.min_radius) & (axes[:, 0] <= MAX_FLATTENING * axes[:, 1])


def _first_of_each(centres: FloatArray, shapes: FloatArray, rms: FloatArray) -> NDArray[np.intp]:
    """Indices of ellipses, each edge once: contours inside one another converge to the same edge."""
    radius = axes_and_angle(shapes)[0][:, 0]
    order = np.lexsort((centres[:, 0], centres[:, 1], rms))
    kept: list[int] = []
    for index in order:
        apart = np.linalg.norm(centres[kept] - centres[index], axis=1) if kept else np.empty(0)
        if (apart > 0.5 * radius[index]).all():
            kept.append(int(index))
    return np.sort(np.array(kept, dtype=np.intp))
