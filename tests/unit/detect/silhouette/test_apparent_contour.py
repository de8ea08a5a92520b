# SPDX-License-Identifier: Apache-2.0
"""The contour model against brute force: points all over a cylinder, projected one by one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_detect.silhouette.apparent_contour import (
    contour_samples,
    project,
    views_showing,
)
from pipeprog_detect.silhouette.occlusion import visible
from pipeprog_detect.silhouette.scene import Scene, frame, viewing_direction
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.straight_ahead import looking_along_y

CAMERA = Camera(1280, 720, 914.0, 910.0, 640.2, 358.7)
BLANK = np.zeros((720, 1280), np.uint8)

numbers = st.floats(-1.0, 1.0)
radii = st.floats(0.005, 0.15)


def view_from(centre: np.ndarray, target: np.ndarray) -> View:
    """A view from `centre` to `target`, the map's z upwards."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return View(0, BLANK, CAMERA, pose)


def contour_lines(cylinder: Cylinder, view: View) -> FloatArray:
    """The two lines of the contour as image segments (2, 2, 2): [side, end, (x, y)] in pixels."""
    at = contour_samples(cylinder, [view], np.eye(3)[:2], 20.0, margin=-np.inf)
    return np.stack([at.pixel[at.side == side][[0, -1]] for side in (0, 1)])


@given(x=numbers, z=numbers, tilt=numbers, turn=numbers, radius=radii)
@settings(max_examples=25, deadline=None)
def test_samples_touch_the_silhouette(x: float, z: float, tilt: float, turn: float, radius: float) -> None:
    direction = np.array([tilt, 0.5 * turn, 1.0])
    direction /= np.linalg.norm(direction)
    cylinder = Cylinder(-0.4 * direction, 0.4 * direction, radius)
    view = view_from(np.array([x, -2.0, z]), np.array([0.3 * x, 0.0, 0.2]))
    basis = frame(cylinder, viewing_direction(cylinder, [view]))
    at = contour_samples(cylinder, [view], basis, 40.0)
    angle = np.linspace(0.0, 2 * np.pi, 720, endpoint=False)
    around = np.cos(angle)[:, None] * basis[0] + np.sin(angle)[:, None] * basis[1]
    for index in range(0, len(at), 9):
        middle = cylinder.middle
        reach = np.linspace(-0.02, 0.02, 9) + at.along[index]
        surface = middle + reach[:, None, None] * direction + radius * around
        pixel, _ = project(view, surface.reshape(-1, 3))
        outward = (pixel - at.pixel[index]) @ at.normal[index]
        tangent = np.array([-at.normal[index, 1], at.normal[index, 0]])
        beside = np.abs((pixel - at.pixel[index]) @ tangent) < 20.0
        assert outward[beside].max() == pytest.approx(0.0, abs=2e-3)


@given(tilt=numbers, parameter=st.integers(0, 4), radius=radii)
@settings(max_examples=30, deadline=None)
def test_jacobian_is_the_derivative(tilt: float, parameter: int, radius: float) -> None:
    cylinder = Cylinder(np.array([0.1 * tilt, 0.0, -0.4]), np.array([-0.2, 0.1 * tilt, 0.4]), radius)
    view = view_from(np.array([0.4, -1.5, 0.3]), np.zeros(3))
    basis = frame(cylinder, viewing_direction(cylinder, [view]))
    at = contour_samples(cylinder, [view], basis, 50.0)
    step = np.zeros(5)
    step[parameter] = 1e-6
    shifted = contour_lines(Scene.of(cylinder, [view], []).moved(step).cylinder, view)
    for index in range(len(at)):
        segment = shifted[at.side[index]]
        normal = np.array([-(segment[1] - segment[0])[1], (segment[1] - segment[0])[0]])
        normal /= np.linalg.norm(normal)
        normal *= np.sign(normal @ at.normal[index])
        moved_by = (segment[0] - at.pixel[index]) @ normal
        assert moved_by == pytest.approx(at.jacobian[index, parameter] * 1e-6, rel=2e-3, abs=1e-7)


def test_no_contour_from_inside_or_behind() -> None:
    cylinder = Cylinder(np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0]), 0.5)
    inside = view_from(np.array([0.1, -0.1, 0.0]), np.array([0.0, 5.0, 0.0]))
    turned_away = view_from(np.array([0.0, -2.0, 0.0]), np.array([0.0, -5.0, 0.1]))
    basis = frame(cylinder, np.array([0.0, 1.0, 0.0]))
    assert len(contour_samples(cylinder, [inside, turned_away], basis, 20.0)) == 0


def test_nearer_pipe_hides_what_lies_behind_it() -> None:
    pipe = Cylinder(np.array([0.0, 0.0, -0.4]), np.array([0.0, 0.0, 0.4]), 0.05)
    crossing = Cylinder(np.array([-0.5, -0.5, 0.0]), np.array([0.5, -0.5, 0.0]), 0.04)
    behind = Cylinder(np.array([-0.5, 0.5, 0.2]), np.array([0.5, 0.5, 0.2]), 0.04)
    view = view_from(np.array([0.0, -2.0, 0.0]), np.zeros(3))
    at = contour_samples(pipe, [view], frame(pipe, viewing_direction(pipe, [view])), 5.0)
    seen = visible(at, pipe, [view], [crossing, behind])
    hidden = at.along[~seen]
    # 0.04 m at 1.5 m covers 0.053 m at 2 m; the margin is 3 px of 2.2 mm.
    assert np.abs(hidden).max() == pytest.approx(0.053 + 0.0066, abs=0.006)
    assert seen[np.abs(at.along) > 0.07].all()


def test_the_few_views_show_the_place_and_are_spread_over_those_that_do() -> None:
    views = [looking_along_y(0.05 * number, number) for number in range(200)]
    place = np.array([[-0.2, 0.0, 0.0], [0.2, 0.0, 0.0]])
    able = [view.stamp for view in views if 0.05 * view.stamp < 0.2 + 1.2 * 239.5 / 345.0]
    few = [view.stamp for view in views_showing(place, views, 10)]
    assert 5 <= len(few) <= 10
    assert set(few) <= set(able)
    assert few[-1] > able[-1] - 6
    assert views_showing(place - 90.0, views, 10) == []
