# SPDX-License-Identifier: Apache-2.0
"""A step of the light between two surfaces is one edge; a pipe has two."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.thin.false_lines import is_false_line, is_one_step
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.pipe_and_wall import PIPE, WALL, wall_points

SHADOW = 0.055  # x [m] of its edge on the wall


@pytest.mark.parametrize("radius", [0.0086, 0.0125, 0.02])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_edge_of_a_shadow_is_one_step(radius: float, side: float, empty_views: list[View]) -> None:
    place = np.array([SHADOW + side * radius, WALL, 0.0])
    half = np.array([0.0, 0.0, 0.2])
    line = Cylinder(place - half, place + half, radius)
    assert is_one_step(Scene.of(line, empty_views, []))
    assert is_false_line(line, wall_points().astype(np.float32), empty_views, [])


def test_a_pipe_is_none(pipe_views: list[View]) -> None:
    assert not is_one_step(Scene.of(PIPE, pipe_views, []))
    assert not is_false_line(PIPE, wall_points().astype(np.float32), pipe_views, [])


def test_what_no_view_shows_is_no_step(pipe_views: list[View]) -> None:
    far = np.array([50.0, 0.0, 0.0])
    assert not is_one_step(Scene.of(Cylinder(PIPE.start + far, PIPE.end + far, PIPE.radius), pipe_views, []))
