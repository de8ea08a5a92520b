# SPDX-License-Identifier: Apache-2.0
"""Outlines that a cylinder shares with a pipe before it."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.edge_support import MIN_SUPPORT, SupportProfile
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.measured_pipe import own_contours
from tests.unit.detect.pipe_and_wall import PIPE

BEHIND = 0.012  # [m]


def ghost_of(pipe: Cylinder, views: list[View]) -> Cylinder:
    """What fills the pipe's silhouette from the views' mean centre, a little behind it."""
    centre = np.mean([view.centre for view in views], axis=0)
    grown = 1.0 + BEHIND / float(np.linalg.norm(pipe.middle - centre))
    return Cylinder(centre + grown * (pipe.start - centre), centre + grown * (pipe.end - centre), grown * pipe.radius)


def test_a_ghost_behind_a_pipe_has_no_contour_of_its_own(pipe_views: list[View]) -> None:
    views = pipe_views[2:6]
    ghost = ghost_of(PIPE, views)
    assert Scene.of(ghost, views, []).support().share > MIN_SUPPORT
    assert own_contours([ghost, PIPE], views).tolist() == [False, True]
    assert own_contours([PIPE, ghost], views).tolist() == [True, False]


def test_a_pipe_alone_keeps_its_contour_and_what_never_had_one_is_not_judged_by_it(pipe_views: list[View]) -> None:
    aside = np.array([0.2, 0.0, 0.0])
    nothing = Cylinder(PIPE.start + aside, PIPE.end + aside, PIPE.radius)
    assert Scene.of(nothing, pipe_views, []).support().share < MIN_SUPPORT
    assert own_contours([PIPE, nothing], pipe_views).tolist() == [True, True]


def test_an_edge_on_one_side_of_a_cylinder_is_not_both(pipe_views: list[View]) -> None:
    aside = np.array([1.5 * PIPE.radius, 0.0, 0.0])
    beside = Cylinder(PIPE.start + aside, PIPE.end + aside, 0.5 * PIPE.radius)
    seen = Scene.of(beside, pipe_views, []).support()
    assert seen.share > 2.0 * MIN_SUPPORT
    assert seen.weaker_share < MIN_SUPPORT
    assert Scene.of(PIPE, pipe_views, []).support().weaker_share > 0.8


@pytest.mark.parametrize("views", [3, 4, 5, 8, 20])
def test_few_views_of_a_real_contour_count_as_well_as_many(views: int) -> None:
    """Edges that are found at chance in each view: 7 of 10 on a pipe, 1 of 5 on what is none."""
    random = np.random.default_rng(views)
    seen = np.full((4000, 2), float(views))
    along: FloatArray = np.linspace(-1.0, 1.0, len(seen)).astype(np.float64)
    pipe = SupportProfile(along, seen, random.binomial(views, 0.7, seen.shape).astype(float))
    texture = SupportProfile(along, seen, random.binomial(views, 0.2, seen.shape).astype(float))
    assert pipe.share == pytest.approx(1.0, abs=0.05)
    assert pipe.weaker_share == pytest.approx(1.0, abs=0.07)
    assert texture.share < MIN_SUPPORT


def test_two_views_support_nothing() -> None:
    seen = np.full((50, 2), 2.0)
    along: FloatArray = np.arange(50.0).astype(np.float64)
    assert SupportProfile(along, seen, seen).share == 0.0
