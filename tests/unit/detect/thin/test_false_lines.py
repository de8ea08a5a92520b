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
    assert is_false_line(line, wall_points().astype(np.float32), [], empty_views, [])


@pytest.mark.parametrize(("beyond", "is_step"), [(-4.0, True), (-8.0, False), (4.0, False)])
def test_light_that_goes_on_beside_a_step_is_the_steps(
    beyond: float, is_step: bool, empty_views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside a step of 24 grey levels the light changes by 4 in its direction, by 8, and by 4 against it."""
    line = Cylinder(np.array([SHADOW, WALL, -0.2]), np.array([SHADOW, WALL, 0.2]), 0.0086)
    scene = Scene.of(line, empty_views, [])
    samples = scene.samples()
    inwards = np.where(samples.side == 0, 24.0, beyond)
    monkeypatch.setattr(Scene, "light", lambda *_: np.column_stack([inwards, np.zeros(len(inwards))]))
    assert is_one_step(scene) is is_step


def test_a_pipe_is_none(pipe_views: list[View]) -> None:
    assert not is_one_step(Scene.of(PIPE, pipe_views, []))
    assert not is_false_line(PIPE, wall_points().astype(np.float32), [], pipe_views, [])


def test_what_no_view_shows_is_no_step(pipe_views: list[View]) -> None:
    far = np.array([50.0, 0.0, 0.0])
    assert not is_one_step(Scene.of(Cylinder(PIPE.start + far, PIPE.end + far, PIPE.radius), pipe_views, []))
