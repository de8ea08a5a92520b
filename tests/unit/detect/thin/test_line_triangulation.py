# SPDX-License-Identifier: Apache-2.0
"""Thin pipes by lines in the images: edges, segment_pairs, and what tells a pipe from a painted strip."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_detect.refinement.contour_fit import FLAT, SURELY
from pipeprog_detect.refinement.contour_refinement import Start, refine
from pipeprog_detect.thin.line_segments import segment_pairs, straight_edges
from pipeprog_detect.thin.line_triangulation import propose
from pipeprog_detect.thin.pair_views import pair_views
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.pipe_and_wall import PIPE, WALL, front_points, wall_points

# The shadow on the wall of `pipe_views` is as wide as a pipe of this radius.
SHADOW, SHADOW_RADIUS = 0.055, 0.04
RADII = [PIPE.radius]


def cloud(*pipes: Cylinder) -> np.ndarray:
    return np.concatenate([wall_points(), *(front_points(pipe) for pipe in pipes)]).astype(np.float32)


def proposed(views: list[View], points: np.ndarray, radii: list[float], known: list[Cylinder]) -> list[Cylinder]:
    seen = pair_views(views, points, radii, known, {})
    return propose(seen, points, radii, 5)


def test_edges_of_a_band_make_one_segment_pair() -> None:
    image = np.full((200, 300), 90, np.uint8)
    image[:, 140:152] = 180
    edges = straight_edges(image)
    assert len(edges) == 2
    found = segment_pairs(edges, 5.0, 20.0)
    assert len(found) == 1
    assert found.width == pytest.approx(12.0, abs=0.5)
    assert found.ends[..., 0] == pytest.approx(145.5, abs=0.5)
    assert len(segment_pairs(edges, 15.0, 20.0)) == 0


def test_segments_of_one_edge_are_joined_and_a_blank_image_has_none() -> None:
    image = np.full((200, 300), 90, np.uint8)
    image[20:90, 140:] = 180
    image[110:180, 140:] = 180
    vertical = [edge for edge in straight_edges(image) if abs(edge[1, 0] - edge[0, 0]) < 2.0]
    assert max(abs(edge[1, 1] - edge[0, 1]) for edge in vertical) > 150.0
    assert len(straight_edges(np.full((50, 50), 7, np.uint8))) == 0


def test_a_pipe_is_proposed_where_its_contour_lines_agree(pipe_views: list[View]) -> None:
    found = proposed(pipe_views, cloud(PIPE), RADII, [])
    assert found
    offset = found[0].middle - PIPE.start
    assert np.linalg.norm(np.cross(offset, PIPE.axis)) < PIPE.radius
    assert abs(found[0].axis @ PIPE.axis) > np.cos(np.radians(5.0))


def test_known_pipes_and_strips_on_the_wall_are_not_proposed(pipe_views: list[View], empty_views: list[View]) -> None:
    wide = Cylinder(PIPE.start - 0.1 * PIPE.axis, PIPE.end + 0.1 * PIPE.axis, 1.5 * PIPE.radius)
    for cylinder in proposed(pipe_views, cloud(PIPE), RADII, [wide]):
        offset = cylinder.middle - PIPE.start
        assert np.linalg.norm(np.cross(offset, PIPE.axis)) > PIPE.radius
    assert proposed(empty_views, cloud(), [SHADOW_RADIUS], []) == []
    assert proposed([], cloud(), RADII, []) == []


def test_the_contour_of_a_strip_stays_where_it_is(pipe_views: list[View]) -> None:
    pipe = refine(Start(PIPE, 0.004), pipe_views, [])
    assert pipe is not None
    assert abs(pipe.flatness) < 0.3
    assert pipe.flatness_sigma < 0.3
    # The shadow is seen beside the pipe in the lower half of the walk's images, too.
    at = np.array([SHADOW + SHADOW_RADIUS, WALL, 0.0])
    up = np.array([0.0, 0.0, 0.2])
    strip = refine(Start(Cylinder(at - up, at + up, SHADOW_RADIUS), 0.002), pipe_views, [PIPE])
    assert strip is not None
    assert FLAT < strip.flatness < 1.0 + strip.flatness_sigma, "soft edges: the walk tells most of it"
    assert strip.flatness - pipe.flatness > SURELY * np.hypot(strip.flatness_sigma, pipe.flatness_sigma)


def test_a_known_slope_holds_what_one_height_leaves_open(pipe_views: list[View]) -> None:
    """From cameras almost in a plane with the axis the slope towards them is seen badly; that is what is given."""
    few = pipe_views[2:6]
    sloping = Cylinder(PIPE.start + np.array([0.0, 0.02, 0.0]), PIPE.end, PIPE.radius)
    free = refine(Start(sloping, PIPE.radius, True, 0.03), few, [], RADII, False)
    held = refine(Start(sloping, PIPE.radius, True, 0.03, np.radians(0.05)), few, [], RADII, False)
    assert free is not None
    assert held is not None
    turned = [np.arccos(min(abs(float(fit.cylinder.axis @ sloping.axis)), 1.0)) for fit in (free, held)]
    assert turned[1] < 0.5 * turned[0]
