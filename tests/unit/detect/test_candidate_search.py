# SPDX-License-Identifier: Apache-2.0
"""Hypotheses of which the cloud alone makes no candidate."""

from __future__ import annotations

import numpy as np
import pytest

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
