# SPDX-License-Identifier: Apache-2.0
"""A thin pipe along a known direction is proposed whole, at the depth that most keyframes bear out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeprog_camera.rolled_image import RolledImage
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_detect.silhouette.apparent_contour import contour_samples
from pipeprog_detect.thin.axis_sweep import Proposal, _best_run, _width_of_peak, propose_parallel
from pipeprog_detect.thin.parallel_directions import LEAST_PARALLEL, parallel_directions
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.straight_ahead import looking_along_y

RADIUS = 0.0125  # 3.6 px wide on each side of its axis
AXIS = np.array([1.0, 0.0, 0.0])
PIPE = Cylinder(np.array([-0.4, 0.0, 0.1]), np.array([0.4, 0.0, 0.1]), RADIUS)
BEHIND, DARK = 130.0, 60.0
# Sub-pixel bits of the drawn outlines.
SHIFT = 6


def moved(pipe: Cylinder, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Cylinder:
    """The pipe elsewhere."""
    offset = np.array([x, y, z])
    return Cylinder(pipe.start + offset, pipe.end + offset, pipe.radius)


def walk(heights: Sequence[float], pipes: Sequence[Cylinder], seed: int = 0) -> list[View]:
    """Eight views at each height that look straight ahead at dark pipes before a wall of fine texture."""
    random = np.random.default_rng(seed)
    views: list[View] = []
    for z in heights:
        for x in np.linspace(-0.5, 0.5, 8):
            view = looking_along_y(float(x), len(views))
            pose = view.camera_from_map.copy()
            pose[:3, 3] -= pose[:3, :3] @ np.array([0.0, 0.0, z])
            view = replace(view, camera_from_map=pose)
            views.append(replace(view, image=drawn(view, pipes, random)))
    return views


def drawn(view: View, pipes: Sequence[Cylinder], random: np.random.Generator) -> np.ndarray:
    """Image (H, W) of the pipes' silhouettes, blurred by half a pixel, with specks and noise."""
    shape = view.image.shape
    light = BEHIND + 60.0 * cv2.GaussianBlur(random.normal(size=shape), (0, 0), 2.0)
    for pipe in pipes:
        samples = contour_samples(pipe, [view], np.eye(3)[:2], spacing=2.0, margin=-50.0)
        one, other = (samples.pixel[samples.side == side] for side in (0, 1))
        mask = np.zeros(shape, np.uint8)
        outline = np.round(np.concatenate([one, other[::-1]]) * 2**SHIFT).astype(np.int32)
        cv2.fillPoly(mask, [outline], 255, cv2.LINE_AA, SHIFT)
        light = np.where(mask > 0, light + (DARK - light) * mask / 255.0, light)
    light = cv2.GaussianBlur(light, (0, 0), 0.5) + random.normal(size=shape)
    return np.clip(np.round(light), 0, 255).astype(np.uint8)


def propose(views: Sequence[View], known: Sequence[Cylinder] = ()) -> list[Proposal]:
    return propose_parallel(views, [AXIS], [RADIUS], known)


def aside(found: Proposal, pipe: Cylinder) -> float:
    """Distance [m] of the middle of a proposal from the axis of a pipe."""
    return float(np.linalg.norm(pipe.from_axis(found.cylinder.middle[None])[0]))


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 1000), st.floats(-0.1, 0.15), st.floats(-0.1, 0.1))
def test_a_pipe_comes_first_whole_and_at_its_depth(seed: int, y: float, z: float) -> None:
    pipe = moved(PIPE, y=y, z=z)
    best = propose(walk((-0.2, 0.1, 0.4), [pipe], seed))[0]
    assert aside(best, pipe) < min(3.0 * best.depth_sigma, 2.0 * RADIUS)
    assert sorted(pipe.along(np.stack([best.cylinder.start, best.cylinder.end]))) == pytest.approx(
        [0.0, pipe.length], abs=0.11
    )


def test_views_from_one_height_leave_the_depth_to_the_width() -> None:
    best = propose(walk((0.5,), [PIPE]))[0]
    assert best.depth_sigma > RADIUS
    assert aside(best, PIPE) < 3.0 * best.depth_sigma


def test_a_peak_is_as_wide_as_at_half_of_its_height() -> None:
    """Other depths beyond a gap, as good as they may be, are no part of it."""
    distances = np.linspace(2.0, 1.0, 101)
    peak = np.maximum(100.0 - 1000.0 * np.abs(distances - 1.5), -5.0)
    assert _width_of_peak(distances, peak) == pytest.approx(0.1, abs=0.021)
    peak[distances < 1.2] = 99.0
    assert _width_of_peak(distances, peak) == pytest.approx(0.1, abs=0.021)
    assert _width_of_peak(distances, np.ones(101)) == 1.0


@pytest.mark.parametrize("apart", [4.5 * RADIUS, 0.12])
def test_pipes_side_by_side_are_two(apart: float) -> None:
    other = moved(PIPE, z=apart)
    # An edge of one and an edge of the other may make a third one, elsewhere.
    found = propose(walk((-0.2, 0.1, 0.4), [PIPE, other]))[:5]
    for pipe in (PIPE, other):
        assert min(aside(each, pipe) for each in found) < RADIUS


@pytest.mark.parametrize("heights", [(0.1,), (-0.2, 0.1, 0.4)])
@pytest.mark.parametrize("deeper", [0.0, 0.09])
def test_pipes_in_line_are_two(heights: Sequence[float], deeper: float) -> None:
    """A gap of 0.2 m parts them, also where they lie at two depths and look like one from a single height."""
    first, second = PIPE.cut(0.0, 0.3), moved(PIPE.cut(0.5, 0.8), y=deeper)
    found = propose(walk(heights, [first, second]))
    assert all(each.cylinder.length < 0.45 for each in found)
    for pipe in (first, second):
        middles = [float(pipe.along(each.cylinder.middle[None])[0]) for each in found]
        assert any(0.3 * pipe.length < middle < 0.7 * pipe.length for middle in middles)


def test_a_clamp_ends_no_pipe() -> None:
    clamped = [PIPE.cut(0.0, 0.37), PIPE.cut(0.43, 0.8)]
    assert propose(walk((-0.2, 0.1, 0.4), clamped))[0].cylinder.length == pytest.approx(PIPE.length, abs=0.11)


@given(st.integers(12, 30), st.floats(0.3, 1.5), st.integers(3, 6), st.floats(2.0, 7.0), st.floats(0.0, 0.2))
def test_a_run_ends_where_edges_become_rare(long: int, ratio: float, gap: int, gain: float, share: float) -> None:
    """Behind a gap, edges that are a fifth as frequent are another thing's; hidden stretches are no gap."""
    after = round(ratio * long)
    seen = np.concatenate([np.full(long, gain), np.full(gap, -1.0), np.full(after, share * gain)])
    assert _best_run(seen, np.full(len(seen), 3.0))[1:] == (0, long)
    hidden = np.concatenate([np.full(long, gain), np.zeros(gap), np.full(after, gain)])
    assert _best_run(hidden, 3.0 * (hidden != 0.0)) == (pytest.approx(gain * (long + after)), 0, len(hidden))
    assert _best_run(np.full(long, -1.0), np.full(long, 3.0)) == (0.0, 0, 0)


def test_what_a_known_pipe_hides_or_shows_is_no_other_one() -> None:
    """A pipe whose contour is known is not proposed again, nor one behind it where no view sees it."""
    views = walk((-0.2, 0.1, 0.4), [PIPE])
    assert all(aside(each, PIPE) > RADIUS for each in propose(views, known=[PIPE]))
    screen = Cylinder(np.array([-3.0, -0.5, 0.1]), np.array([3.0, -0.5, 0.1]), 0.45)
    assert not any(aside(each, PIPE) < RADIUS for each in propose(views, known=[screen]))


def test_texture_other_directions_and_other_widths_make_no_pipe() -> None:
    heights = (-0.2, 0.1, 0.4)
    assert propose(walk(heights, [])) == []
    assert propose([]) == []
    upright = Cylinder(np.array([0.1, 0.0, -0.3]), np.array([0.1, 0.0, 0.5]), RADIUS)
    assert propose(walk(heights, [upright])) == []
    thick = replace(PIPE, radius=4.0 * RADIUS)
    assert not any(aside(each, PIPE) < 4.0 * RADIUS for each in propose(walk(heights, [thick])))


def test_a_rolling_shutter_is_undone() -> None:
    """A camera shakes by 2 m/s while it reads its images out: seen from three heights, lines seem to be nearer."""
    views = walk((-0.2, 0.1, 0.4), [PIPE])
    motion = RowMotion(0.03, views[0].camera.height, np.array([0.0, 2.0, 0.0]), np.zeros(3))
    rolled = [replace(view, rolled=RolledImage(motion, view.camera)) for view in views]

    def skewed(view: View) -> View:
        u, v = np.meshgrid(np.arange(view.camera.width, dtype=float), np.arange(view.camera.height, dtype=float))
        assert view.rolled is not None
        shown = np.stack([u, v], axis=-1).reshape(-1, 2)
        at = view.rolled.motion.unrolled_pixels(shown, np.full(len(shown), 1.2), view.camera)
        at = at.reshape(*u.shape, 2).astype(np.float32)
        return replace(view, image=cv2.remap(view.image, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))

    shown = [skewed(view) for view in rolled]
    with_depth = [replace(view, nearest=np.full((9, 16), 1.2, np.float32)) for view in shown]
    best = propose(with_depth)[0]
    assert aside(best, PIPE) < RADIUS
    ignored = [replace(view, rolled=None) for view in with_depth]
    assert all(aside(each, PIPE) > 4.0 * RADIUS for each in propose(ignored))


def test_three_pipes_make_a_direction() -> None:
    level = [moved(PIPE, z=float(k)) for k in range(LEAST_PARALLEL)]
    upright = [Cylinder(np.array([k, 0.0, 0.0]), np.array([k, 0.0, 1.0]), 0.05) for k in range(LEAST_PARALLEL - 1)]
    turned = [Cylinder(each.end, each.start, each.radius) for each in level[:1]]
    directions = parallel_directions([*upright, *level[1:], *turned])
    assert len(directions) == 1
    assert abs(directions[0] @ AXIS) > np.cos(np.radians(1.0))
    assert parallel_directions([]) == []
