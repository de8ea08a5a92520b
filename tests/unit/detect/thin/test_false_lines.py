# SPDX-License-Identifier: Apache-2.0
"""A step of the light is one edge, and a strip of it lies on a surface; a pipe has two edges and hides the surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.silhouette.apparent_contour import contour_samples
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.thin import false_lines
from pipeprog_detect.thin.false_lines import is_bare, is_false_line, is_one_step, is_strip_of_light
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.pipe_and_wall import PIPE, WALL, wall_points
from tests.unit.detect.straight_ahead import looking_along_y

SHADOW = 0.055  # x [m] of its edge on the wall


@pytest.mark.parametrize("radius", [0.0086, 0.0125, 0.02])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_edge_of_a_shadow_is_one_step(radius: float, side: float, empty_views: list[View]) -> None:
    place = np.array([SHADOW + side * radius, WALL, 0.0])
    half = np.array([0.0, 0.0, 0.2])
    line = Cylinder(place - half, place + half, radius)
    assert is_one_step(Scene.of(line, empty_views, []))
    assert is_false_line(line, None, wall_points().astype(np.float32), [], empty_views, [])


@pytest.mark.parametrize(
    ("beyond", "texture", "is_step"),
    [
        *((-4.0, 0.0, True), (-8.0, 0.0, False), (4.0, 0.0, False)),
        *((4.0, 1.0, False), (4.0, 3.0, True), (-8.0, 3.0, False), (-8.0, 5.0, True)),
    ],
)
def test_light_that_goes_on_beside_a_step_is_the_steps_or_the_textures(
    beyond: float, texture: float, is_step: bool, empty_views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside a step of 24 grey levels the light changes by 4 in its direction, by 8, and by 4 against it.

    Right beside that the texture changes it.
    """
    line = Cylinder(np.array([SHADOW, WALL, -0.2]), np.array([SHADOW, WALL, 0.2]), 0.0086)
    scene = Scene.of(line, empty_views, [])
    inwards = np.where(scene.samples().side == 0, 24.0, beyond)
    monkeypatch.setattr(Scene, "support", lambda *_: Support(0.0))
    monkeypatch.setattr(Scene, "light", stepping(inwards, texture))
    assert is_one_step(scene) is is_step


@pytest.mark.parametrize(("step", "odds", "is_step"), [(4.0, -20.0, True), (4.0, -5.0, False), (8.0, -20.0, False)])
def test_a_step_that_the_edges_speak_against_is_the_textures(
    step: float, odds: float, is_step: bool, empty_views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the other side the light steps by 24 grey levels, in the same direction."""
    line = Cylinder(np.array([SHADOW, WALL, -0.2]), np.array([SHADOW, WALL, 0.2]), 0.0086)
    scene = Scene.of(line, empty_views, [])
    monkeypatch.setattr(Scene, "support", lambda *_: Support(odds))
    monkeypatch.setattr(Scene, "light", stepping(np.where(scene.samples().side == 0, 24.0, step), 0.0))
    assert is_one_step(scene) is is_step


@pytest.mark.parametrize(("share", "odds", "is_step"), [(0.55, 2.0, True), (0.55, 9.0, False), (0.45, 9.0, True)])
def test_a_side_that_few_edges_support_may_be_texture(
    share: float, odds: float, is_step: bool, empty_views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A highlight: on one side the light steps by 24 grey levels, on the other by 2 in the other direction."""
    line = Cylinder(np.array([SHADOW, WALL, -0.2]), np.array([SHADOW, WALL, 0.2]), 0.0086)
    scene = Scene.of(line, empty_views, [])
    monkeypatch.setattr(Scene, "support", lambda *_: Support(odds, share))
    monkeypatch.setattr(Scene, "light", stepping(np.where(scene.samples().side == 0, 24.0, -2.0), 0.5))
    assert is_one_step(scene) is is_step


def stepping(inwards: FloatArray, texture: float) -> Callable[..., FloatArray]:
    """Stands for `Scene.light`: steps (N,) at the contour, one of texture beside it."""

    def light(_: Scene, samples: object, offsets: FloatArray, lines: int) -> FloatArray:
        step = inwards if offsets[0] < 0.0 else np.full(len(inwards), texture)
        return np.column_stack([step, np.zeros(len(inwards))])

    return light


def test_a_pipe_is_none(pipe_views: list[View]) -> None:
    assert not is_one_step(Scene.of(PIPE, pipe_views, []))
    assert not is_false_line(PIPE, None, wall_points().astype(np.float32), [], pipe_views, [])


def test_what_no_view_shows_is_no_step(pipe_views: list[View]) -> None:
    far = np.array([50.0, 0.0, 0.0])
    assert not is_one_step(Scene.of(Cylinder(PIPE.start + far, PIPE.end + far, PIPE.radius), pipe_views, []))


@pytest.mark.parametrize(("flatness_sigma", "is_line"), [(0.03, False), (0.5, True)])
def test_what_the_views_show_to_be_round_is_no_edge(
    flatness_sigma: float, is_line: bool, pipe_views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cloud takes a pipe before a face for the edge of that face."""
    monkeypatch.setattr(false_lines, "is_edge_of_face", lambda *_: True)
    fit = ContourFit(PIPE, np.eye(3)[1:], np.eye(5), 1e-4, 1.0, 100.0, 20, (0.0, 0.0), 0.0, flatness_sigma)
    assert is_false_line(PIPE, fit, wall_points().astype(np.float32), [], pipe_views, []) is is_line


def test_a_pipe_that_turns_from_darker_to_brighter_than_what_is_behind_it_has_two_edges(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On one side the pipe is darker all along, on the other along a half: the sum of the steps there is 0."""
    scene = Scene.of(replace(PIPE, radius=0.0086), pipe_views, [])
    samples = scene.samples(spacing=2)
    behind = np.where(samples.along > np.median(samples.along), 24.0, -24.0)
    inwards = np.where(samples.side == 0, 24.0, behind)
    monkeypatch.setattr(Scene, "samples", lambda *_, **__: samples)
    monkeypatch.setattr(Scene, "support", lambda *_: Support(0.0))
    monkeypatch.setattr(Scene, "light", stepping(inwards, 0.0))
    assert not is_one_step(scene)


@dataclass
class Support:
    """Stands for that of a contour, with these log odds of the weaker side and the share of it that is supported."""

    odds: float
    weaker_share: float = 0.0

    def log_odds(self) -> np.ndarray:
        return np.array([[max(self.odds, 0.0), self.odds]])


@pytest.mark.parametrize(("inside", "is_strip"), [(None, True), (60.0, False)])
def test_texture_goes_on_within_a_shadow_and_not_within_a_pipe(inside: float | None, is_strip: bool) -> None:
    """A strip across walls with specks 4 px wide, at half of the light, and one of another texture."""
    place = np.array([0.0, 0.3, 0.1])
    half = np.array([0.5, 0.0, 0.0])
    strip = Cylinder(place - half, place + half, 0.0125)
    wall = 40.0 * cv2.GaussianBlur(np.random.default_rng(0).normal(size=(900, 900)), (0, 0), 4.0) * 4.0
    views = []
    for number, x in enumerate(np.linspace(-0.3, 0.3, 8)):
        view = looking_along_y(float(x), number)
        shift = round(x / 1.5 * view.camera.fx)  # how far the wall moves in the image
        light = 130.0 + wall[200 : 200 + view.camera.height, 200 + shift : 200 + shift + view.camera.width]
        samples = contour_samples(strip, [view], np.eye(3)[:2], spacing=2.0, margin=-50.0)
        one, other = (samples.pixel[samples.side == side] for side in (0, 1))
        mask = np.zeros(light.shape, np.uint8)
        cv2.fillPoly(mask, [np.round(np.concatenate([one, other[::-1]])).astype(np.int32)], 1)
        own = 0.5 * light if inside is None else inside + 0.5 * wall[: light.shape[0], : light.shape[1]]
        light = np.where(mask > 0, own, light) + np.random.default_rng(number).normal(size=light.shape)
        views.append(replace(view, image=np.clip(np.round(light), 0, 255).astype(np.uint8)))
    assert is_strip_of_light(Scene.of(strip, views, [])) is is_strip
    assert not is_strip_of_light(Scene.of(strip.shifted(np.array([50.0, 0.0, 0.0])), views, []))


@pytest.mark.parametrize("before", [0.05, 0.3])
@pytest.mark.parametrize(("shown", "stands"), [(0.0, False), (0.1, False), (0.3, True), (0.8, True)])
def test_a_line_is_bare_where_the_cloud_shows_what_is_beside_and_behind_it_alone(
    before: float, shown: float, stands: bool
) -> None:
    line = Cylinder(np.array([-0.5, WALL - before, 0.0]), np.array([0.5, WALL - before, 0.0]), 0.0086)
    wall = wall_points().astype(np.float32)
    along = np.arange(-0.5, -0.5 + shown, 0.02)[:, None]
    barrel = (line.middle + along * line.axis + [0.0, -line.radius, 0.0]).astype(np.float32)
    centre = np.array([0.0, WALL - 2.0, 0.1])
    assert is_bare(line, np.concatenate([wall, barrel]), centre) is not stands
    # A wall that stereo hardly shows does not tell whether it would show the line, nor does one before it.
    assert not is_bare(line, wall[:: len(wall) // 20], centre)
    assert not is_bare(line, wall - np.array([0.0, 1.0, 0.0], np.float32), centre)
