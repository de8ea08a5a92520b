# SPDX-License-Identifier: Apache-2.0
"""Removes motion blur before feature extraction: blur from poses and exposure time, then Wiener deconvolution."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.features.sift import Features, extract
from pipeprog_sfm.types import EncodedImage

MAX_GAP = 1_000_000_000  # ns between two poses that still give the velocity between them: a hand sways at 1 to 2 Hz
TILES = 8  # across the image: blur is proportional to 1 / depth, which varies by a factor of two within one image
NEAREST = 15  # points whose median gives a tile's depth
NOISE_MIN = 1.0  # grey level: at least the noise of rounding and JPEG
MISFIT = 0.05  # of the transfer function, where it is small: the blur is known to some per cent from poses and depths
LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)  # gives 0 on straight edges
LAPLACIAN_GAIN = 6.0  # standard deviation of its output for white noise of 1: the root of the sum of squares, 36


class Deblurrer:
    """Makes features of deblurred images, once the poses before and after a keyframe tell how the camera moved."""

    def __init__(self, config: SfmConfig) -> None:
        self._config = config
        self._images: dict[int, EncodedImage] = {}  # of keyframes that wait for the pose after them

    def deblurred(
        self, stamp: int, image: EncodedImage, poses: Mapping[int, FloatArray], points_seen: Callable[[int], FloatArray]
    ) -> Iterator[tuple[int, Features]]:
        """Takes a new keyframe; yields stamps and features of the keyframes that could be deblurred since.

        Args:
            stamp: of the new keyframe [ns].
            image: the new keyframe.
            poses: (4, 4) camera_from_model by stamp.
            points_seen: the (K, 3) points in the model that a keyframe of `poses` sees.
        """
        if not self._config.deblur.exposure:
            return
        self._images[stamp] = image
        stamps = sorted(poses)
        for waiting in list(self._images):
            before, after = bisect_left(stamps, waiting) - 1, bisect_right(stamps, waiting)
            if before < 0 or after == len(stamps):
                continue
            image = self._images.pop(waiting)
            if stamps[after] - stamps[before] <= MAX_GAP:
                around = (stamps[before], waiting, stamps[after])
                features = self._features(around, image, poses, points_seen)
                if features is not None:
                    yield waiting, features

    def retire(self, stamps: Collection[int]) -> None:
        """Forgets keyframes."""
        for stamp in stamps:
            self._images.pop(stamp, None)

    def replace_camera(self, camera: Camera) -> None:
        """The images that wait have another calibration now."""
        self._images = {stamp: EncodedImage(image.data, camera) for stamp, image in self._images.items()}

    def _features(
        self,
        stamps: tuple[int, int, int],
        image: EncodedImage,
        poses: Mapping[int, FloatArray],
        points_seen: Callable[[int], FloatArray],
    ) -> Features | None:
        """Features of the deblurred image of the second of three stamps; None if its blur is short."""
        before, stamp, after = stamps
        own = poses.get(stamp, between(poses[before], poses[after], (stamp - before) / (after - before)))
        points = points_seen(stamp if stamp in poses else before) @ own[:3, :3].T + own[:3, 3]
        points = points[points[:, 2] > 0]
        if not len(points):
            return None
        motion = velocity(stamps, (poses[before], own, poses[after]))
        exposure = self._config.deblur.exposure
        length = np.linalg.norm(blur(image.camera, points, motion, exposure), axis=1)
        if np.median(length) < self._config.deblur.min_length:
            return None
        sharp = deblur(image.gray(), image.camera, points, motion, exposure)
        return extract(sharp, image.camera, self._config.mapper)


def velocity(stamps: Sequence[int], poses: Sequence[FloatArray]) -> FloatArray:
    """How a camera moves at the second of three poses, by the parabola through them.

    Args:
        stamps: three, ascending, ns.
        poses: three (4, 4) camera_from_model.

    Returns:
        (3, 4) matrix D: a point at x in the second camera's frame moves at D @ [x, 1] per second.
    """
    before, after = (1e-9 * (stamps[1] - stamps[0]), 1e-9 * (stamps[2] - stamps[1]))
    backward, forward = (poses[1] - poses[0]) / before, (poses[2] - poses[1]) / after
    change = (after * backward + before * forward) / (before + after)
    return (change @ np.linalg.inv(poses[1]))[:3]


def between(before: FloatArray, after: FloatArray, share: float) -> FloatArray:
    """The (4, 4) camera_from_model at a share of the time between two."""
    turns = Rotation.from_matrix(np.stack([before[:3, :3], after[:3, :3]]))
    place = (1 - share) * np.linalg.inv(before)[:3, 3] + share * np.linalg.inv(after)[:3, 3]
    pose = np.eye(4)
    pose[:3, :3] = Slerp([0.0, 1.0], turns)(share).as_matrix()
    pose[:3, 3] = -pose[:3, :3] @ place
    return pose


def blur(camera: Camera, points_in_camera: FloatArray, motion: FloatArray, exposure: float) -> FloatArray:
    """(N, 2) displacement in px, in the distorted image, of (N, 3) points during the exposure [s].

    `motion` as from `velocity`. The point-spread function at a point is a line of this length and direction: during
    an exposure a point moves along a straight line, to a fraction of a pixel.
    """
    half = 0.5 * exposure * (points_in_camera @ motion[:, :3].T + motion[:, 3])
    start, end = (_project(camera, points_in_camera + sign * half) for sign in (-1.0, 1.0))
    return end - start


def transfer(displacement: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Fourier transform of a line along `displacement` (2,) px about the origin, of sum 1, in the order of rfft2."""
    rows, columns = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])
    return np.sinc(columns * displacement[0] + rows * displacement[1])


def deblur(
    gray: NDArray[np.uint8], camera: Camera, points_in_camera: FloatArray, motion: FloatArray, exposure: float
) -> NDArray[np.uint8]:
    """The (H, W) image without its motion blur, as far as its noise allows.

    Windows that overlap by half and add up to one are each deconvolved with the blur of a point at their centre, at
    the depth of the nearest of the (N, 3) points in front of the camera. Wiener filter; the signal's power falls with
    the square of the frequency, as in natural images (Field, JOSA A 1987), and the noise is white, of the variance
    that is estimated from the image.
    """
    size = 2 * int(np.ceil(gray.shape[1] / (2 * TILES)))
    half = size // 2
    # Each window begins half its size before its part of the image, and deconvolution spreads it by half its size.
    padded = cv2.copyMakeBorder(gray, size, 2 * size, size, 2 * size, cv2.BORDER_REFLECT_101).astype(np.float32)
    inverse = _inverse_signal(gray, 2 * size)
    window = np.zeros(2 * size)
    window[half : half + size] = 0.5 - 0.5 * np.cos(2 * np.pi * (np.arange(size) + 0.5) / size)
    weight = np.outer(window, window).astype(np.float32)
    # The padding has windows, too, as they overlap the image.
    corners = [(y, x) for y in range(0, gray.shape[0] + size, half) for x in range(0, gray.shape[1] + size, half)]
    middles = np.array([(x - 0.5, y - 0.5) for y, x in corners])
    displacements = _displacements(camera, middles, points_in_camera, motion, exposure)
    result = np.zeros_like(padded)
    for (y, x), displacement in zip(corners, displacements, strict=True):
        tile = (slice(y, y + 2 * size), slice(x, x + 2 * size))
        spread = transfer(displacement, (2 * size, 2 * size))
        inverted = (spread / (spread**2 + inverse)).astype(np.float32)
        result[tile] += irfft2(rfft2(weight * padded[tile]) * inverted, weight.shape)
    return np.clip(np.rint(result[size:, size:][: gray.shape[0], : gray.shape[1]]), 0, 255).astype(np.uint8)


def _inverse_signal(gray: NDArray[np.uint8], size: int) -> FloatArray:
    """Power of noise and misfit over that of the signal, by frequency, laid out as by rfft2 of a (size, size) tile."""
    response = cv2.filter2D(gray.astype(np.float32), cv2.CV_32F, LAPLACIAN)
    noise = max(float(np.median(np.abs(response))) / (0.6745 * LAPLACIAN_GAIN), NOISE_MIN)
    signal = max(float(gray.var()) - noise**2, noise**2)
    rows, columns = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)
    # A power of c / f^2 between one wave an image and one every two pixels adds up to the variance.
    level = signal / (2 * np.pi * np.log(0.5 * max(gray.shape)))
    return noise**2 * (rows**2 + columns**2) / level + MISFIT**2


def _displacements(
    camera: Camera, pixels: FloatArray, points_in_camera: FloatArray, motion: FloatArray, exposure: float
) -> FloatArray:
    """(N, 2) blur at (N, 2) pixels of the image, at the depths of the points nearest to them."""
    ideal = camera.undistort_points(np.clip(pixels, 0, [camera.width - 1, camera.height - 1]))
    rays = np.c_[(ideal - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(ideal))]
    places = points_in_camera[:, :2] / points_in_camera[:, 2:]
    nearest = cKDTree(places).query(rays[:, :2], min(NEAREST, len(places)))[1].reshape(len(rays), -1)
    depth = np.median(points_in_camera[nearest, 2], axis=1)
    return blur(camera, rays * depth[:, None], motion, exposure)


def _project(camera: Camera, points_in_camera: FloatArray) -> FloatArray:
    ideal = points_in_camera[:, :2] / points_in_camera[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return camera.distort_points(ideal)
