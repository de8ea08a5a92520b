# SPDX-License-Identifier: Apache-2.0
"""Hypotheses of which the cloud alone makes no candidate."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.candidate_search import Search
from pipeprog_detect.cloud import octree
from pipeprog_detect.cloud.acceptance import seen_from_outside
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.types import View
from pipeprog_detect.verification.keyframe_verifier import KeyframeVerifier
from pipeprog_detect.verification.scene_context import SceneContext
from tests.unit.detect.pipe_and_wall import PIPE

NOISE = 1e-3
# Stereo spreads both ends of 75 deg of the barrel outwards, and what is left agrees with a plane as with a pipe.
HALF, OUTWARDS = np.radians(37.5), 4.5e-3


def spread_search(views: list[View], planned: float) -> Search:
    rng = np.random.default_rng(0)
    angle, along = rng.uniform(-HALF, HALF, 3000), rng.uniform(0.0, PIPE.length, 3000)
    seen = barrel_points(angle, along, PIPE.radius + OUTWARDS * (angle / HALF) ** 4)
    return search_in(seen + rng.normal(0.0, NOISE, (3000, 3)), NOISE, views, planned)


def barrel_points(angle: FloatArray, along: FloatArray, distance: FloatArray) -> FloatArray:
    """Points (N, 3) at angles (N,) [rad] from the pipe's front, distances (N,) [m] along its axis and from it."""
    side = np.cross(PIPE.axis, [0.0, -1.0, 0.0])
    normal = np.cos(angle)[:, None] * np.cross(side, PIPE.axis) + np.sin(angle)[:, None] * side
    return np.asarray(PIPE.start + along[:, None] * PIPE.axis + distance[:, None] * normal, np.float64)


def search_in(points: FloatArray, noise: float, views: list[View], planned: float) -> Search:
    boq = BillOfQuantities((PipeClass("planned", planned, 3.0, (0.0, 0.0, 1.0), 4e-4),))
    tree, config = octree.build(points), DetectConfig()
    around = SceneContext(tree, None, [], tree, noise)
    criteria, verifier = seen_from_outside(noise, config), KeyframeVerifier(views, boq)
    return Search(tree, around, criteria, (0.008, 0.2), [planned], config, verifier, lambda *_: None)


def test_at_a_planned_radius_the_keyframes_make_a_pipe_of_it(pipe_views: list[View], empty_views: list[View]) -> None:
    for views, planned, count in (
        (pipe_views, PIPE.radius, 1),
        (pipe_views, 1.2 * PIPE.radius, 0),  # not within half a step between sizes
        (empty_views, PIPE.radius, 0),
        ([], PIPE.radius, 0),
    ):
        search = spread_search(views, planned)
        none = np.zeros(len(search.tree.points), bool)
        candidates = search.candidates(none, [PIPE], [])
        assert len(candidates) == count
        for candidate in candidates:
            assert candidate.radius_held
            [measured] = search.verifier.measure([candidate], [False])
            assert measured.cylinder.radius == pytest.approx(PIPE.radius, abs=2e-4)
            assert np.linalg.norm(measured.cylinder.from_axis(PIPE.middle[None])) < NOISE


def test_a_pipe_whose_bend_the_noise_hides_is_sought_as_a_line(pipe_views: list[View], empty_views: list[View]) -> None:
    noise = PIPE.radius / 5.0
    rng = np.random.default_rng(0)
    angle, along = rng.uniform(-1.2, 1.2, 3000), rng.uniform(0.0, PIPE.length, 3000)
    points = barrel_points(angle, along, PIPE.radius + rng.normal(0.0, noise, 3000))
    for views, planned, count in (
        (pipe_views, PIPE.radius, 1),
        (pipe_views, 2.0 * PIPE.radius, 0),
        (empty_views, PIPE.radius, 0),
    ):
        search = search_in(points, noise, views, planned)
        every = np.ones(len(search.tree.points), bool)
        candidates = search.candidates(every, [], [])
        assert len(candidates) == count
        for candidate in candidates:
            assert candidate.cylinder.radius == PIPE.radius
            assert np.linalg.norm(candidate.cylinder.from_axis(PIPE.middle[None])) < noise
            assert candidate.cylinder.length == pytest.approx(PIPE.length, abs=noise)


def test_a_pipe_whose_points_are_rougher_than_most_is_found(pipe_views: list[View], empty_views: list[View]) -> None:
    noise = 5e-4
    rng = np.random.default_rng(0)
    angle, along = rng.uniform(-1.2, 1.2, 6000), rng.uniform(0.0, PIPE.length, 6000)
    points = barrel_points(angle, along, PIPE.radius + rng.normal(0.0, 6.0 * noise, 6000))
    for views, planned, count in (
        (pipe_views, PIPE.radius, 1),
        (pipe_views, 2.0 * PIPE.radius, 0),
        (empty_views, PIPE.radius, 0),
        ([], PIPE.radius, 0),
    ):
        search = search_in(points, noise, views, planned)
        every = np.ones(len(search.tree.points), bool)
        candidates = search.candidates(every, [], [])
        assert [candidate.cylinder.radius for candidate in candidates] == [PIPE.radius] * count
        # The next map has the same points, none of which is new.
        again = search.candidates(~every, [candidate.cylinder for candidate in candidates], [])
        assert len(again) == count


def two_in_line(gap: float, offset: float, first: float, second: float, shorter: float) -> FloatArray:
    """Points of the front halves of two pipes along x with a gap [m]; the second, a `shorter` one, lies behind [m]."""
    rng = np.random.default_rng(0)

    def half(low: float, high: float, behind: float, radius: float) -> FloatArray:
        count = int(9000 * (high - low))
        along, angle = rng.uniform(low, high, count), rng.uniform(-0.5 * np.pi, 0.5 * np.pi, count)
        distance = radius + rng.normal(0.0, 1.5e-3, count)
        return np.stack([along, behind - distance * np.cos(angle), distance * np.sin(angle)], axis=1)

    return np.vstack([half(-2.0, -0.5 * gap, 0.0, first), half(0.5 * gap, shorter, offset, second)])


@given(gap=st.floats(0.05, 0.29), aside=st.floats(0.6, 1.0), shorter=st.floats(0.6, 2.0))
@settings(max_examples=6, deadline=None)
def test_pipes_in_line_that_one_does_not_explain_are_two(gap: float, aside: float, shorter: float) -> None:
    """Sizes a ninth apart, axes aside by what a pipe might be: no cylinder has the points of both."""
    points = two_in_line(gap, aside * 0.027, 0.1223, 0.1095, shorter)
    search = search_in(points, 1.5e-3, [], 0.1223)
    found = search.candidates(np.ones(len(points), bool), [], [])
    radii = sorted(each.cylinder.radius for each in found)
    assert radii == [pytest.approx(0.1095, abs=2e-3), pytest.approx(0.1223, abs=2e-3)]


@given(gap=st.floats(0.05, 0.29), shorter=st.floats(0.6, 2.0))
@settings(max_examples=4, deadline=None)
def test_pieces_of_one_pipe_are_one_candidate(gap: float, shorter: float) -> None:
    """Without keyframes: those have the last word where the pieces tell their axes themselves."""
    points = two_in_line(gap, 0.0, 0.1095, 0.1095, shorter)
    [found] = search_in(points, 1.5e-3, [], 0.1095).candidates(np.ones(len(points), bool), [], [])
    assert found.cylinder.radius == pytest.approx(0.1095, abs=5e-4)
    assert found.cylinder.length == pytest.approx(2.0 + shorter, abs=0.02)
