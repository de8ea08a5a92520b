# SPDX-License-Identifier: Apache-2.0
"""What the images show lies where the truth file says, to a small part of a pixel."""

import cv2
import numpy as np
import pytest

from sitegen.primitives import Material, cylinder, disc, frame, rectangle, unit
from sitegen.render import Lens, build_scene, pixel_directions, render, trace
from sitegen.sensor import Sensor, develop
from sitegen.walk import look

LENS = Lens(640, 480, 457.0, 457.0, 319.5, 239.5)

DARK = Material("dark", (0.05, 0.05, 0.05), mottle=0.0, speckle=0.0)
LIGHT = Material("light", (0.7, 0.7, 0.7), mottle=0.0, speckle=0.0)
CENTRE_TOLERANCE = 0.02  # pixels, noise-free
EDGE_TOLERANCE = 0.03  # pixels, noise-free: half a step of the sixteen sub-columns


def view(primitives: list, pose: np.ndarray, lens: Lens = LENS) -> np.ndarray:
    return render(build_scene(primitives, [], 1.0, 1), lens, np.repeat(pose[None], lens.height, 0))[:, :, 0]


def pixel(point: np.ndarray, pose: np.ndarray, lens: Lens = LENS) -> np.ndarray:
    p = (point - pose[:3, 3]) @ pose[:3, :3]
    return np.array([lens.fx * p[0] / p[2] + lens.cx, lens.fy * p[1] / p[2] + lens.cy])


def ellipse_centre(centre: np.ndarray, normal: np.ndarray, radius: float, pose: np.ndarray) -> np.ndarray:
    """Centre of the image of a circle: the pole of the line at infinity with respect to its conic."""
    axes = frame(normal)
    plane = np.c_[radius * axes[0], radius * axes[1], centre - pose[:3, 3]]
    k = np.array([[LENS.fx, 0, LENS.cx], [0, LENS.fy, LENS.cy], [0, 0, 1.0]])
    inverse = np.linalg.inv(k @ pose[:3, :3].T @ plane)
    dual = np.linalg.inv(inverse.T @ np.diag([1.0, 1.0, -1.0]) @ inverse)
    return dual[:2, 2] / dual[2, 2]


def centroid(image: np.ndarray, background: float) -> np.ndarray:
    weight = image - background
    rows, columns = np.indices(weight.shape)
    return np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()


@pytest.mark.parametrize("yaw", [0.0, 0.4, -0.7])
def test_circles_lie_where_they_project(yaw: float) -> None:
    pose = look([0.3 + 1.5 * np.tan(yaw), -1.5, 1.2], yaw, 0.05, 0.1)[0]
    centre, normal = np.array([0.35, -2e-5, 1.25]), np.array([0.0, -1.0, 0.0])
    board = rectangle((0, 0, 1), normal, 30, 30, DARK)
    image = view([board, disc(centre, normal, 0.04, LIGHT)], pose)
    expected = ellipse_centre(centre, normal, 0.04, pose)
    assert np.abs(centroid(image, float(image.min())) - expected).max() < CENTRE_TOLERANCE
    assert np.linalg.norm(expected - pixel(centre, pose)) < 0.5


def test_a_developed_circle_stays_where_it_is() -> None:
    pose = look([0.3, -1.5, 1.2], 0.1, 0.05, 0.1)[0]
    centre, normal = np.array([0.35, -2e-5, 1.25]), np.array([0.0, -1.0, 0.0])
    linear = render(
        build_scene([rectangle((0, 0, 1), normal, 30, 30, DARK), disc(centre, normal, 0.04, LIGHT)], [], 1.0, 1),
        LENS,
        np.repeat(pose[None], LENS.height, 0),
    )
    image = develop(linear, Sensor(noise=0.0), np.random.default_rng(0))[:, :, 1].astype(float)
    _, _, stats, centroids = cv2.connectedComponentsWithStats((image > image.mean() + 60).astype(np.uint8))
    assert len(stats) == 2
    expected = ellipse_centre(centre, normal, 0.04, pose)
    assert np.abs(centroid(image, float(np.median(image))) - expected).max() < 0.1
    assert np.abs(centroids[1] - expected).max() < 0.5


@pytest.mark.parametrize(("radius", "roll"), [(0.0086, 0.02), (0.0575, -0.05), (0.1223, 0.0)])
def test_apparent_contours_of_cylinders_lie_in_tangent_planes(radius: float, roll: float) -> None:
    # Upright, so that it is equally bright all round; the camera is tilted instead.
    pose = look([0.1, -1.6, 1.0], 0.1, 0.08, roll)[0]
    start, end = np.array([0.0, -0.2, -1.0]), np.array([0.0, -0.2, 3.0])
    wall = rectangle((0, 0, 1), (0, -1, 0), 30, 30, DARK)
    image = view([wall, cylinder(start, end, radius, LIGHT)], pose)
    low, high = float(image.min()), float(image.max())
    share = (image - low) / (high - low)

    axis = unit(end - start)
    across = start - pose[:3, 3]
    across = across - (across @ axis) * axis
    d = np.linalg.norm(across)
    toward, side = across / d, np.cross(axis, across / d)
    k_inverse = np.linalg.inv(np.array([[LENS.fx, 0, LENS.cx], [0, LENS.fy, LENS.cy], [0, 0, 1.0]]))
    rows = np.arange(20, 460)
    edges = []
    for sign in (-1.0, 1.0):
        # The plane through the camera along the axis, a radius away from it.
        normal = toward * radius / d + sign * side * np.sqrt(1 - (radius / d) ** 2)
        line = k_inverse.T @ (pose[:3, :3].T @ normal)
        edges.append(-(line[1] * rows + line[2]) / line[0])
    left, right = np.minimum(*edges), np.maximum(*edges)

    middle = ((left + right) / 2).round().astype(int)
    for row, l_edge, r_edge, m in zip(rows, left, right, middle, strict=True):
        # Area left and right of the middle column gives each edge without any threshold.
        assert abs(m - 0.5 - share[row, :m].sum() - l_edge) < EDGE_TOLERANCE + 1 / 32
        assert abs(m - 0.5 + share[row, m:].sum() - r_edge) < EDGE_TOLERANCE + 1 / 32
    mean = np.mean([m - 0.5 - share[r, :m].sum() for r, m in zip(rows, middle, strict=True)] - left)
    assert abs(mean) < EDGE_TOLERANCE


def test_the_lens_distorts_as_opencv_does() -> None:
    lens = Lens(640, 480, 457.0, 460.0, 322.0, 236.0, (-0.12, 0.05, 0.001, -0.0008, 0.004))
    pose = look([0.1, -1.6, 1.0], 0.1, 0.05, 0.02)[0]
    wall = rectangle((0, 0, 1), (0, -1, 0), 30, 30, DARK)
    _, points, ranges = trace(build_scene([wall], [], 1.0, 1), lens, pose)
    camera_from_world = np.linalg.inv(pose)
    k = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
    rotation = cv2.Rodrigues(camera_from_world[:3, :3])[0]
    found = cv2.projectPoints(points.reshape(-1, 3), rotation, camera_from_world[:3, 3], k, np.array(lens.distortion))[
        0
    ].reshape(480, 640, 2)
    rows, columns = np.indices((480, 640))
    assert np.abs(found - np.stack([columns, rows], -1)).max() < 1e-5
    assert np.allclose(np.linalg.norm(points - pose[:3, 3], axis=-1), ranges)


def test_a_fisheye_projects_as_opencv_has_it() -> None:
    lens = Lens(640, 480, 300.0, 303.0, 322.0, 236.0, (-0.03, 0.008, -0.003, 0.0005), is_fisheye=True)
    offsets = np.zeros((1, 2))
    directions = pixel_directions(lens, offsets)[0].reshape(-1, 1, 2)
    k = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
    found = cv2.fisheye.distortPoints(directions, k, np.array(lens.distortion)).reshape(480, 640, 2)
    rows, columns = np.indices((480, 640))
    assert np.abs(found - np.stack([columns, rows], -1)).max() < 1e-6


def test_rolling_shutter_reads_each_row_with_its_own_pose() -> None:
    small = Lens(64, 48, 45.7, 45.7, 31.5, 23.5)
    primitives = [rectangle((0, 0, 1), (0, -1, 0), 30, 30, Material("w", (0.5, 0.5, 0.5)))]
    scene = build_scene(primitives, [], 1.0, 1)
    poses = look(np.c_[np.linspace(0, 0.5, 48), np.full(48, -1.0), np.full(48, 1.0)], 0.0, 0.0, 0.0)
    rolling = render(scene, small, poses)
    for row in (0, 20, 47):
        still = render(scene, small, np.repeat(poses[row][None], 48, 0))
        assert np.array_equal(rolling[row], still[row])
        assert not np.array_equal(rolling[(row + 24) % 48], still[(row + 24) % 48])
