# SPDX-License-Identifier: Apache-2.0
"""Coarse depth images of a cloud: what stands before a surface hides it, the surface does not hide itself."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_detect.silhouette.apparent_contour import contour_samples
from pipeprog_detect.silhouette.occlusion import (
    BEFORE,
    MARGIN,
    cylinder_rows,
    depth_of_cylinders,
    hidden_by_cloud,
    on_contours,
    with_depths,
)
from pipeprog_detect.silhouette.scene import frame
from pipeprog_detect.types import Cylinder, View


@pytest.fixture
def view() -> View:
    """A camera at the origin that looks along z."""
    camera = Camera.from_calibration(320, 180, [300.0, 0.0, 159.5, 0.0, 300.0, 89.5, 0.0, 0.0, 1.0], "plumb_bob", [])
    return View(0, np.zeros((180, 320), np.uint8), camera, np.eye(4))


def _plate(depth: float, left: float, right: float) -> FloatArray:
    """Points (N, 3) every 4 mm of a plate across the view."""
    x, y = np.meshgrid(np.arange(left, right, 0.004), np.arange(-0.5, 0.5, 0.004))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, depth)], axis=1)


def _seen_at(view: View, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    depth = points[:, 2]
    camera = view.camera
    return points[:, :2] / depth[:, None] * camera.fx + np.array([camera.cx, camera.cy]), depth


def test_a_plate_hides_what_lies_behind_it(view: View) -> None:
    with_cloud = with_depths([view], np.concatenate([_plate(1.0, -0.6, 0.0), _plate(2.0, -1.0, 1.0)]))[0]
    wall = np.array([[-0.6, 0.1, 2.0], [-0.2, 0.0, 2.0], [0.2, 0.0, 2.0], [0.6, -0.1, 2.0]])
    assert hidden_by_cloud(with_cloud, *_seen_at(view, wall)).tolist() == [True, True, False, False]
    plate = np.array([[-0.4, 0.1, 1.0 + 0.8 * BEFORE], [-0.1, 0.0, 1.0 + 0.8 * BEFORE]])
    assert not hidden_by_cloud(with_cloud, *_seen_at(view, plate)).any()


def test_without_a_cloud_nothing_is_hidden(view: View) -> None:
    assert not hidden_by_cloud(view, np.array([[100.0, 50.0]]), np.array([3.0])).any()
    empty = with_depths([view], np.zeros((0, 3)))[0]
    assert not hidden_by_cloud(empty, np.array([[100.0, 50.0]]), np.array([3.0])).any()


def test_a_slanted_surface_does_not_hide_itself(view: View) -> None:
    share = np.linspace(0.0, 1.0, 4000)[:, None]
    row = np.array([-0.4, 0.0, 1.0]) + share * np.array([0.8, 0.0, 3.0])
    strip = np.concatenate([row + np.array([0.0, y, 0.0]) for y in np.arange(-0.1, 0.1, 0.004)])
    seen = with_depths([view], strip)[0]
    assert not hidden_by_cloud(seen, *_seen_at(view, row[::50])).any()


def test_a_hole_in_the_cloud_of_what_hides_shows_nothing_behind_it(view: View) -> None:
    plate = np.concatenate([_plate(1.0, -0.5, 0.5), _plate(1.0, -0.498, 0.5) + np.array([0.0, 0.002, 0.0])])
    hole = np.abs(_seen_at(view, plate)[0] - [161.0, 91.0]).max(axis=1) < 1.01  # one cell of two pixels
    behind = np.array([[0.01, 0.01, 2.0]])
    behind[:, :2] = (np.array([161.0, 91.0]) - [159.5, 89.5]) / 300.0 * 2.0
    for cloud in (plate[~hole], np.concatenate([plate[~hole], _plate(2.0, -1.0, 1.0)])):
        assert hidden_by_cloud(with_depths([view], cloud)[0], *_seen_at(view, behind)).all()
    gap = np.abs(_seen_at(view, plate)[0][:, 0] - 161.0) < 1.01  # a slit from top to bottom is one to look through
    slit = with_depths([view], np.concatenate([plate[~gap], _plate(2.0, -1.0, 1.0)]))[0]
    assert not hidden_by_cloud(slit, *_seen_at(view, behind)).any()


@pytest.mark.parametrize("behind", [-0.2, 0.0, 0.3])
@pytest.mark.parametrize(("beside", "shared"), [(0.0, True), (0.8 * MARGIN, True), (1.5 * MARGIN, False)])
def test_what_lies_on_the_contour_of_another_pipe_may_be_its_edge(
    view: View, behind: float, beside: float, shared: bool
) -> None:
    """A pipe and another one, three times as thick, before or behind it: they are seen in line along half of the first.

    One side of the other is seen `beside` [px] one side of the pipe.
    """
    depth, radius = 1.2, 0.02
    pipe = Cylinder(np.array([-0.4, 0.0, depth]), np.array([0.4, 0.0, depth]), radius)
    samples = contour_samples(pipe, [view], frame(pipe, np.array([0.0, 0.0, 1.0])), 6.0)
    distance = depth + behind
    angle = np.arcsin(radius / depth) + beside / view.camera.fx - np.arcsin(3.0 * radius / distance)
    middle = distance * np.array([0.0, np.sin(angle), np.cos(angle)])
    half = np.array([0.2 * distance / depth, 0.0, 0.0])
    other = Cylinder(middle - half, middle + half, 3.0 * radius)
    found = on_contours(samples, [view], [other])
    lower, place = samples.pixel[:, 1] > view.camera.cy, np.abs(samples.along)
    assert (found[lower & (place < 0.17)] == shared).all()
    assert not found[~lower | (place > 0.23)].any()
    assert not on_contours(samples, [view], []).any()


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(0.1, 0.9), st.floats(-1.2, 1.2), st.floats(0.005, 0.15), st.floats(-1.2, 1.2), st.booleans())
def test_a_line_of_sight_meets_the_first_surface(
    view: View, share: float, angle: float, radius: float, slope: float, hidden: bool
) -> None:
    """A point on the side of a cylinder that faces the camera, with another cylinder before it or behind it."""
    axis = np.array([np.cos(slope), 0.0, np.sin(slope)])
    towards = np.cross(axis, [0.0, 1.0, 0.0])  # across the axis, level
    towards *= -np.sign(towards[2])
    start = np.array([0.0, 0.0, 1.5]) - 0.4 * axis
    cylinder = Cylinder(start, start + 0.8 * axis, radius)
    outward = np.cos(angle) * towards + np.sin(angle) * np.array([0.0, 1.0, 0.0])
    point = start + share * cylinder.length * axis + radius * outward
    assume(outward @ point < -1e-3)
    other = Cylinder(point - 0.5 * point + [-1.0, 0.0, 0.0], point - 0.5 * point + [1.0, 0.0, 0.0], 0.01)
    rows = cylinder_rows([cylinder, other] if hidden else [cylinder])
    found = depth_of_cylinders(view, _seen_at(view, point[None])[0], rows)
    if hidden:
        assert 0.5 * point[2] - 0.02 < found[0] < 0.5 * point[2]
    else:
        assert found == pytest.approx(point[2], abs=1e-9)
    assert not np.isfinite(depth_of_cylinders(view, np.array([[2.0, 2.0]]), rows)).any()
