# SPDX-License-Identifier: Apache-2.0
"""Local features of a keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_sfm.config import MapperConfig
from pipeprog_sfm.features.sift_descriptors import LAYERS, SIGMA, describe

PIXELS = 600_000  # above, the image is halved: finer detail is mostly noise, and SIFT doubles the resolution itself
CONTRAST = 0.004  # of the grey range; divided by LAYERS it is a third of a grey level, as bare painted walls have
TILES = (16, 9)  # features are ranked within tiles, so that weakly textured regions of the image are represented


@dataclass(frozen=True)
class Features:
    """Features of one keyframe, strongest and best spread first.

    keypoints: (N, 2) float32 pixels of the ideal pinhole image (pixel centres at integers).
    descriptors: (N, 128) uint8, square roots of L1-normalised SIFT: 512 times a unit vector.
    """

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.keypoints)


def extract(gray: NDArray[np.uint8], camera: Camera, config: MapperConfig) -> Features:
    """Features of a (H, W) uint8 image; keypoints are undistorted by the camera's lens model.

    RootSIFT (Arandjelovic and Zisserman, CVPR 2012).
    """
    small, factor = working_image(gray)
    found = keypoint_search().detect(small, None)
    if not found:
        return Features(np.empty((0, 2), np.float32), np.empty((0, 128), np.uint8))
    places = np.array([keypoint.pt for keypoint in found], np.float32)
    response = np.array([keypoint.response for keypoint in found])
    chosen = _spread(places, response, small.shape)[: config.max_features]
    descriptors = describe(small, [found[index] for index in chosen])
    pixels = (places[chosen] + 0.5) / factor - 0.5
    keypoints = camera.undistort_points(pixels).astype(np.float32)
    # Far outside of a lens's image circle its distortion has no inverse.
    known = np.isfinite(keypoints).all(axis=1)
    return Features(keypoints[known], root_sift(descriptors[known]))


def working_image(gray: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], float]:
    """The image (H, W) uint8 that is searched, halved where it has more than PIXELS, and its scale."""
    if gray.size <= PIXELS:
        return gray, 1.0
    return np.asarray(cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8), 0.5


def keypoint_search() -> cv2.SIFT:
    """OpenCV's search, in the scale space in which `describe` describes."""
    return cv2.SIFT.create(nOctaveLayers=LAYERS, contrastThreshold=CONTRAST, sigma=SIGMA, enable_precise_upscale=True)


def root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(N, 128) SIFT descriptors -> (N, 128) uint8 with Euclidean norm 512."""
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9)
    return np.minimum(np.rint(512 * np.sqrt(descriptors / total)), 255).astype(np.uint8)


def _spread(pixels: NDArray[np.float32], response: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.intp]:
    """Order by rank within the tile, then by response."""
    column = np.minimum(pixels[:, 0] * TILES[0] // shape[1], TILES[0] - 1)
    row = np.minimum(pixels[:, 1] * TILES[1] // shape[0], TILES[1] - 1)
    tile = row * TILES[0] + column
    order = np.lexsort((pixels[:, 1], pixels[:, 0], -response, tile))
    first = np.searchsorted(tile[order], tile[order], side="left")
    rank = np.empty(len(order), np.intp)
    rank[order] = np.arange(len(order)) - first
    return np.lexsort((pixels[:, 1], pixels[:, 0], -response, rank))
