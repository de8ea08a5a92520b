# SPDX-License-Identifier: Apache-2.0
"""Motion blur with a known spread, and what undoing it brings."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeprog_camera.camera import Camera
from pipeprog_sfm.config import MapperConfig
from pipeprog_sfm.deblur import between, blur, deblur, transfer, velocity
from pipeprog_sfm.features.matching import match
from pipeprog_sfm.features.sift import extract

CAMERA = Camera(640, 400, 500.0, 500.0, 319.5, 199.5)
DISTORTED = Camera(640, 400, 500.0, 500.0, 319.5, 199.5, "plumb_bob", (-0.1, 0.02, 0.0, 0.0, 0.0))
NOISE = 1.0  # grey level
SECOND = 10**9


def pose(turn: tuple[float, float, float], place: tuple[float, float, float]) -> NDArray[np.float64]:
    """camera_from_world of a camera at a place (m), turned by a rotation vector (rad)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(turn).as_matrix().T
    matrix[:3, 3] = -matrix[:3, :3] @ place
    return matrix


def texture(height: int, width: int, seed: int = 0) -> NDArray[np.float32]:
    """Grey levels at all scales, with edges."""
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width), np.float32)
    for cell in (3, 8, 25, 80):
        coarse = rng.uniform(-1, 1, (height // cell + 2, width // cell + 2)).astype(np.float32)
        image += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_NEAREST)
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    return 125 + 28 * image


def wall(camera: Camera, camera_from_world: NDArray[np.float64], depth: float) -> NDArray[np.float32]:
    """The textured plane z = depth as the camera sees it, without noise."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    ideal = camera.undistort_points(np.stack([u.ravel(), v.ravel()], axis=1))
    rays = np.c_[(ideal - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(ideal))]
    rays = rays @ camera_from_world[:3, :3]
    centre = -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]
    place = centre + rays * ((depth - centre[2]) / rays[:, 2:])
    scale = camera.fx / depth
    grid = (place[:, :2] * scale + [640, 400]).astype(np.float32).reshape(camera.height, camera.width, 2)
    return cv2.remap(texture(800, 1280), grid, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def exposed(images: list[NDArray[np.float32]]) -> NDArray[np.uint8]:
    """The mean of images with the sensor's noise."""
    mean = np.mean(images, axis=0)
    return np.clip(np.rint(mean + np.random.default_rng(1).normal(0, NOISE, mean.shape)), 0, 255).astype(np.uint8)


def psnr(image: NDArray[np.uint8], truth: NDArray[np.float32]) -> float:
    inner = (slice(30, -30), slice(30, -30))
    return float(10 * np.log10(255**2 / np.mean((image[inner].astype(float) - truth[inner]) ** 2)))


@given(length=st.floats(0.0, 30.0), angle=st.floats(0.0, np.pi))
def test_the_spread_sums_to_one_and_is_as_long_as_the_way(length: float, angle: float) -> None:
    size = 128
    way = length * np.array([np.cos(angle), np.sin(angle)])
    spread = transfer(way, (size, size))
    assert spread[0, 0] == 1.0
    # The transform's curvature at zero is the variance: (2 pi)^2 length^2 / 12 along the way, nothing across it.
    step = 1 / size
    along = 6 * (1 - spread[0, 1]) / (np.pi * step) ** 2
    across = 6 * (1 - spread[1, 0]) / (np.pi * step) ** 2
    assert along == pytest.approx(way[0] ** 2, rel=0.03, abs=1e-6)
    assert across == pytest.approx(way[1] ** 2, rel=0.03, abs=1e-6)


@given(
    turn=st.tuples(*[st.floats(-0.6, 0.6)] * 3),
    move=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    place=st.tuples(st.floats(-1, 1), st.floats(-0.6, 0.6), st.floats(2, 5)),
    distorted=st.booleans(),
)
def test_the_way_of_a_point_is_that_of_its_image(turn, move, place, distorted) -> None:
    """Steady turn (rad/s) and motion (m/s): between the poses at the exposure's begin and end."""
    camera = DISTORTED if distorted else CAMERA
    exposure, gap = 0.02, 0.2

    def at(seconds: float) -> NDArray[np.float64]:
        return pose(tuple(seconds * np.array(turn)), tuple(seconds * np.array(move)))

    stamps = [0, int(gap * SECOND), int(2.5 * gap * SECOND)]
    motion = velocity(stamps, [at(-gap), at(0), at(1.5 * gap)])
    point = np.array([*place, 1.0])
    ends = [at(half) @ point for half in (-exposure / 2, exposure / 2)]
    pixels = [
        camera.distort_points(end[None, :2] / end[2] * [camera.fx, camera.fy] + [camera.cx, camera.cy])[0]
        for end in ends
    ]
    np.testing.assert_allclose(blur(camera, point[None, :3], motion, exposure)[0], pixels[1] - pixels[0], atol=0.25)


def test_half_way_between_two_poses() -> None:
    middle = between(pose((0, 0.2, 0), (0, 0, 0)), pose((0, 0.6, 0), (1, 0, 0)), 0.5)
    np.testing.assert_allclose(middle, pose((0, 0.4, 0), (0.5, 0, 0)), atol=1e-12)


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED])
@pytest.mark.parametrize("way", [6.0, 12.0])
def test_a_blurred_wall_is_restored_and_matches_better(camera: Camera, way: float) -> None:
    depth, exposure = 2.0, 0.02
    speed = way / exposure * depth / camera.fx
    moves = np.linspace(-0.5, 0.5, 25) * exposure * speed
    roll = 0.5  # rad/s: the blur differs from place to place
    blurred = exposed([wall(camera, pose((0, 0, roll * x / speed), (x, 0.3 * x, 0)), depth) for x in moves])
    truth = wall(camera, np.eye(4), depth)
    stamps, gap = [0, SECOND // 5, 2 * SECOND // 5], 0.2
    poses = [pose((0, 0, roll * t), (speed * t, 0.3 * speed * t, 0)) for t in (-gap, 0.0, gap)]
    rng = np.random.default_rng(2)
    points = np.c_[rng.uniform([-1.2, -0.7], [1.2, 0.7], (300, 2)), np.full(300, depth)]
    sharp = deblur(blurred, camera, points, velocity(stamps, poses), exposure)
    assert psnr(sharp, truth) > psnr(blurred, truth) + 2.0

    other = extract(exposed([wall(camera, pose((0, 0, 0.1), (0.2, 0, 0)), depth)]), camera, MapperConfig())
    before, after = (
        len(match(extract(image, camera, MapperConfig()).descriptors, other.descriptors)) for image in (blurred, sharp)
    )
    assert after > 1.3 * before


def test_an_image_that_is_not_blurred_stays_as_it_is() -> None:
    image = exposed([wall(CAMERA, np.eye(4), 2.0)])
    points = np.array([[0.0, 0.0, 2.0], [0.5, 0.2, 2.0]])
    still = velocity([0, 1, 2], [np.eye(4)] * 3)
    assert psnr(deblur(image, CAMERA, points, still, 0.02), image.astype(np.float32)) > 40
