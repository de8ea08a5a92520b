"""Outlines that a cylinder shares with a pipe before it."""

from __future__ import annotations

import numpy as np

from pipeprog_detect.outline import camera_centre
from pipeprog_detect.pipe import Cylinder, View
from pipeprog_detect.support import MIN_SUPPORT, outline_support, own_outlines, support

BEHIND = 0.012  # [m]
PIPE = Cylinder(np.array([0.01, 0.0, -0.2]), np.array([-0.01, 0.01, 0.2]), 0.04)  # as in pipe_views


def ghost_of(pipe: Cylinder, views: list[View]) -> Cylinder:
    """What fills the pipe's silhouette from the views' mean centre, a little behind it."""
    centre = np.mean([camera_centre(view) for view in views], axis=0)
    grown = 1.0 + BEHIND / float(np.linalg.norm(0.5 * (pipe.start + pipe.end) - centre))
    return Cylinder(centre + grown * (pipe.start - centre), centre + grown * (pipe.end - centre), grown * pipe.radius)


def test_a_ghost_behind_a_pipe_has_no_outlines_of_its_own(pipe_views: list[View]) -> None:
    views = pipe_views[2:6]
    ghost = ghost_of(PIPE, views)
    assert support(ghost, views, []) > MIN_SUPPORT
    assert own_outlines([ghost, PIPE], views).tolist() == [False, True]
    assert own_outlines([PIPE, ghost], views).tolist() == [True, False]


def test_a_pipe_alone_keeps_its_outlines_and_what_never_had_any_is_not_judged_by_them(pipe_views: list[View]) -> None:
    aside = np.array([0.2, 0.0, 0.0])
    nothing = Cylinder(PIPE.start + aside, PIPE.end + aside, PIPE.radius)
    assert support(nothing, pipe_views, []) < MIN_SUPPORT
    assert own_outlines([PIPE, nothing], pipe_views).tolist() == [True, True]


def test_an_edge_that_is_one_outline_of_a_cylinder_is_not_both(pipe_views: list[View]) -> None:
    aside = np.array([1.5 * PIPE.radius, 0.0, 0.0])
    beside = Cylinder(PIPE.start + aside, PIPE.end + aside, 0.5 * PIPE.radius)
    seen = outline_support(beside, pipe_views, [])
    assert seen.share > 2.0 * MIN_SUPPORT
    assert seen.weaker_share < MIN_SUPPORT
    assert outline_support(PIPE, pipe_views, []).weaker_share > 0.8
