"""Motion blur undone for feature extraction: its spread from the poses and the exposure time, Wiener deconvolution."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Collection, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.dense.dense_mapper import EncodedImage
from pipeprog_sfm.sparse.features import extract
from pipeprog_sfm.sparse.mapper import Mapper

STEADY = 1_000_000_000  # ns between two poses that still tell the velocity between them: hand and gait sway faster
TILES = 8  # across the image: the blur of a walk goes with one over the depth, which differs by twice in one image
NEAREST = 15  # points that tell a tile's depth
NOISE_MIN = 1.0  # grey level: what rounding and JPEG leave at least
MISFIT = 0.05  # of the transfer function, where it is small: poses and depths tell a way to some per cent
LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)  # blind to edges that are straight
LAPLACIAN_GAIN = 6.0  # of its answer to white noise


class Deblurrer:
    """Gives keyframes the features of their deblurred images, where the map agrees with more of these."""

    def __init__(self, config: SfmConfig, mapper: Mapper) -> None:
        self._config = config
        self._mapper = mapper
        self._images: dict[int, EncodedImage] = {}  # of keyframes whose neighbours have not told yet how they moved

    def add(self, stamp: int, image: EncodedImage) -> None:
        """Notes a keyframe that the mapper has just been given, and deblurs those of which the motion is known now."""
        if not self._config.deblur.exposure:
            return
        self._images[stamp] = image
        poses = self._mapper.camera_from_model()
        stamps = sorted(poses)
        for waiting in list(self._images):
            before, after = bisect_left(stamps, waiting) - 1, bisect_right(stamps, waiting)
            if before < 0 or after == len(stamps):
                continue
            image = self._images.pop(waiting)
            if stamps[after] - stamps[before] <= STEADY:
                self._sharpen(waiting, image, stamps[before], stamps[after], poses)

    def retire(self, stamps: Collection[int]) -> None:
        """Forgets keyframes."""
        for stamp in stamps:
            self._images.pop(stamp, None)

    def _sharpen(
        self, stamp: int, image: EncodedImage, before: int, after: int, poses: Mapping[int, FloatArray]
    ) -> None:
        own = poses.get(stamp, between(poses[before], poses[after], (stamp - before) / (after - before)))
        points = self._mapper.points_seen(stamp if stamp in poses else before) @ own[:3, :3].T + own[:3, 3]
        points = points[points[:, 2] > 0]
        if not len(points):
            return
        motion = velocity((before, stamp, after), (poses[before], own, poses[after]))
        exposure = self._config.deblur.exposure
        way = np.linalg.norm(blur(image.camera, points, motion, exposure), axis=1)
        if np.median(way) < self._config.deblur.min_length:
            return
        gray = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert gray is not None  # it could be decoded when it came
        sharp = deblur(gray, image.camera, points, motion, exposure)
        self._mapper.exchange(stamp, extract(sharp, image.camera, self._config.mapper))


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
    """(N, 2) way in px, in the image as the camera sees it, of (N, 3) points during the exposure [s].

    `motion` as from `velocity`. The point-spread function at a point is a line of this length and direction: over
    an exposure the way is straight to a fraction of a pixel.
    """
    half = 0.5 * exposure * (points_in_camera @ motion[:, :3].T + motion[:, 3])
    start, end = (_project(camera, points_in_camera + sign * half) for sign in (-1.0, 1.0))
    return end - start


def transfer(way: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Fourier transform of a line of the (2,) vector `way` px about the origin, of sum 1, laid out as by rfft2."""
    rows, columns = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])
    return np.sinc(columns * way[0] + rows * way[1])


def deblur(
    gray: NDArray[np.uint8], camera: Camera, points_in_camera: FloatArray, motion: FloatArray, exposure: float
) -> NDArray[np.uint8]:
    """The (H, W) image without its motion blur, as far as its noise allows.

    Windows that overlap by half and add up to one are deconvolved each with the line that a point in their middle would
    draw, at the depth of the nearest of the (N, 3) known points before the camera. Wiener's filter, with a signal whose
    power falls with the square of the frequency, as that of natural images does (Field, JOSA A 1987), and white noise
    of the image's own strength.
    """
    size = 2 * int(np.ceil(gray.shape[1] / (2 * TILES)))
    half = size // 2
    # Each window begins half its size before its part of the image, and its answer spreads by half its size all round.
    padded = cv2.copyMakeBorder(gray, size, 2 * size, size, 2 * size, cv2.BORDER_REFLECT_101).astype(np.float32)
    inverse = _inverse_signal(gray, 2 * size)
    window = np.zeros(2 * size)
    window[half : half + size] = 0.5 - 0.5 * np.cos(2 * np.pi * (np.arange(size) + 0.5) / size)
    weight = np.outer(window, window).astype(np.float32)
    # The frame that is padded has windows, too: what they hold reaches into the image.
    corners = [(y, x) for y in range(0, gray.shape[0] + size, half) for x in range(0, gray.shape[1] + size, half)]
    middles = np.array([(x - 0.5, y - 0.5) for y, x in corners])
    ways = _ways(camera, middles, points_in_camera, motion, exposure)
    result = np.zeros_like(padded)
    for (y, x), way in zip(corners, ways, strict=True):
        tile = (slice(y, y + 2 * size), slice(x, x + 2 * size))
        spread = transfer(way, (2 * size, 2 * size))
        inverted = (spread / (spread**2 + inverse)).astype(np.float32)
        result[tile] += irfft2(rfft2(weight * padded[tile]) * inverted, weight.shape)
    return np.clip(np.rint(result[size:, size:][: gray.shape[0], : gray.shape[1]]), 0, 255).astype(np.uint8)


def _inverse_signal(gray: NDArray[np.uint8], size: int) -> FloatArray:
    """Power of noise and misfit over that of the signal, by frequency, laid out as by rfft2 of a (size, size) tile."""
    answer = cv2.filter2D(gray.astype(np.float32), cv2.CV_32F, LAPLACIAN)
    noise = max(float(np.median(np.abs(answer))) / (0.6745 * LAPLACIAN_GAIN), NOISE_MIN)
    signal = max(float(gray.var()) - noise**2, noise**2)
    rows, columns = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)
    # A power of c / f^2 between one wave an image and one every two pixels adds up to the variance.
    level = signal / (2 * np.pi * np.log(0.5 * max(gray.shape)))
    return noise**2 * (rows**2 + columns**2) / level + MISFIT**2


def _ways(
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
