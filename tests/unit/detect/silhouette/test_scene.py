# SPDX-License-Identifier: Apache-2.0
"""The directions in which a cylinder is moved: along the line of sight of those that see it."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_detect.silhouette.apparent_contour import project
from pipeprog_detect.silhouette.scene import Scene, viewing_direction
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.straight_ahead import looking_along_y

LYING = Cylinder(np.array([-0.3, 0.0, 0.0]), np.array([0.3, 0.0, 0.0]), 0.0086)


def raised(view: View, by: float) -> View:
    """The view from a place higher by `by` [m], straight ahead as before."""
    pose = view.camera_from_map.copy()
    pose[:3, 3] -= pose[:3, :3] @ np.array([0.0, 0.0, by])
    return View(view.stamp, view.image, view.camera, pose)


def test_a_step_away_from_the_cameras_that_see_a_pipe_does_not_move_their_images() -> None:
    """Three views see the pipe; seven that pass above it do not."""
    seeing = [looking_along_y(x, stamp) for stamp, x in enumerate((-0.2, 0.0, 0.2))]
    passing = [raised(looking_along_y(x, 10 + stamp), 1.5) for stamp, x in enumerate(np.linspace(-1.0, 1.0, 7))]
    scene = Scene.of(LYING, [*seeing, *passing], [])
    deeper = scene.moved(np.array([0.0, 0.1, 0.0, 0.1, 0.0])).cylinder
    for view in seeing:
        before, after = (project(view, each.middle[None])[0][0] for each in (LYING, deeper))
        assert abs(after[1] - before[1]) < 1e-6


def test_without_a_view_that_shows_it_all_tell_where_a_cylinder_lies() -> None:
    passing = [raised(looking_along_y(0.0, 1), 1.5)]
    assert viewing_direction(LYING, passing) == pytest.approx(np.array([0.0, 1.2, -1.5]) / np.hypot(1.2, 1.5))


@pytest.mark.parametrize("hidden", [0.0, 0.25, 0.75])
def test_the_share_of_a_pipe_that_is_visible(hidden: float) -> None:
    """A thick pipe before it hides its first part, from one place as far as `hidden` says."""
    line = Cylinder(np.array([-0.5, 0.0, 0.0]), np.array([0.5, 0.0, 0.0]), 0.0086)
    view = looking_along_y(0.0, 0)
    reach = float(np.linalg.norm(view.centre)) - 0.3
    edge = (hidden - 0.5) * reach / float(np.linalg.norm(view.centre))
    before, up = np.array([edge - 1.0, -0.3, 0.0]), np.array([0.0, 0.0, 1.0])
    column = Cylinder(before - up, before + up, 1.0)
    others = [column] if hidden else []
    assert Scene.of(line, [view], others).visible_share() == pytest.approx(1.0 - hidden, abs=0.06)
    assert Scene.of(line.shifted(np.array([50.0, 0.0, 0.0])), [view], []).visible_share() == 0.0
