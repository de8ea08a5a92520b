"""Thin pipes by lines in the images: edges, ribbons, and what tells a pipe from a painted strip."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeprog_detect.config import ContourConfig
from pipeprog_detect.contour import Start, refine
from pipeprog_detect.lines import ribbons, straight_edges
from pipeprog_detect.pipe import Cylinder, FloatArray, View
from pipeprog_detect.ribbons import SAME_LINE, covers, laid, mean_centre, propose

# The pipe and the wall of `pipe_views`; the shadow on the wall is as wide as a pipe of this radius.
PIPE = Cylinder(np.array([0.01, 0.0, -0.2]), np.array([-0.01, 0.01, 0.2]), 0.04)
WALL, SHADOW, SHADOW_RADIUS = 0.12, 0.055, 0.04
RADII = [PIPE.radius]


def wall_points() -> FloatArray:
    x, z = np.meshgrid(np.arange(-0.8, 0.8, 0.005), np.arange(-0.5, 0.5, 0.005))
    return np.stack([x.ravel(), np.full(x.size, WALL), z.ravel()], axis=1)


def front_points(cylinder: Cylinder) -> FloatArray:
    """The half of the barrel that faces -y."""
    angle, along = np.meshgrid(np.linspace(-1.3, 1.3, 30), np.arange(0.0, cylinder.length, 0.004))
    side = np.cross(cylinder.axis, [0.0, -1.0, 0.0])
    radial = np.cos(angle)[..., None] * np.array([0.0, -1.0, 0.0]) + np.sin(angle)[..., None] * side
    return (cylinder.start + along[..., None] * cylinder.axis + cylinder.radius * radial).reshape(-1, 3)


def cloud(*pipes: Cylinder) -> np.ndarray:
    return np.concatenate([wall_points(), *(front_points(pipe) for pipe in pipes)]).astype(np.float32)


def test_edges_of_a_band_make_one_ribbon() -> None:
    image = np.full((200, 300), 90, np.uint8)
    image[:, 140:152] = 180
    edges = straight_edges(image)
    assert len(edges) == 2
    found = ribbons(edges, 5.0, 20.0)
    assert len(found) == 1
    assert found.width == pytest.approx(12.0, abs=0.5)
    assert found.ends[..., 0] == pytest.approx(145.5, abs=0.5)
    assert len(ribbons(edges, 15.0, 20.0)) == 0


def test_pieces_of_one_edge_are_joined_and_a_blank_image_has_none() -> None:
    image = np.full((200, 300), 90, np.uint8)
    image[20:90, 140:] = 180
    image[110:180, 140:] = 180
    vertical = [edge for edge in straight_edges(image) if abs(edge[1, 0] - edge[0, 0]) < 2.0]
    assert max(abs(edge[1, 1] - edge[0, 1]) for edge in vertical) > 150.0
    assert len(straight_edges(np.full((50, 50), 7, np.uint8))) == 0


def test_a_pipe_is_proposed_where_its_outlines_agree(pipe_views: list[View]) -> None:
    found = propose(pipe_views, cloud(PIPE), RADII, [], 5)
    assert found
    offset = 0.5 * (found[0].start + found[0].end) - PIPE.start
    assert np.linalg.norm(np.cross(offset, PIPE.axis)) < PIPE.radius
    assert abs(found[0].axis @ PIPE.axis) > np.cos(np.radians(5.0))


def test_known_pipes_and_strips_on_the_wall_are_not_proposed(pipe_views: list[View], empty_views: list[View]) -> None:
    wide = Cylinder(PIPE.start - 0.1 * PIPE.axis, PIPE.end + 0.1 * PIPE.axis, 1.5 * PIPE.radius)
    for cylinder in propose(pipe_views, cloud(PIPE), RADII, [wide], 5):
        offset = 0.5 * (cylinder.start + cylinder.end) - PIPE.start
        assert np.linalg.norm(np.cross(offset, PIPE.axis)) > PIPE.radius
    assert propose(empty_views, cloud(), [SHADOW_RADIUS], [], 5) == []
    assert propose([], cloud(), RADII, [], 5) == []


def test_outlines_of_a_strip_stay_where_they_are(pipe_views: list[View]) -> None:
    pipe = refine(Start(PIPE, 0.004), pipe_views, [], ContourConfig())
    assert pipe is not None
    assert abs(pipe.flatness) < 0.3
    assert pipe.flatness_sigma < 0.3
    # The shadow is seen beside the pipe in the lower half of the walk's images, too.
    at = np.array([SHADOW + SHADOW_RADIUS, WALL, 0.0])
    up = np.array([0.0, 0.0, 0.2])
    strip = refine(Start(Cylinder(at - up, at + up, SHADOW_RADIUS), 0.002), pipe_views, [PIPE], ContourConfig())
    assert strip is None or strip.flatness - 0.5 > -strip.flatness_sigma


def test_a_thin_pipe_is_laid_at_the_depth_of_the_points_before_the_wall() -> None:
    thin = Cylinder(PIPE.start, PIPE.end, 0.0086)
    centre = np.array([0.0, -1.2, 0.0])
    sparse = front_points(thin)[::7]
    deep = np.array([0.0, 0.05, 0.0])
    proposed = Cylinder(centre + 1.05 * (thin.start - centre) + deep, centre + 1.05 * (thin.end - centre), thin.radius)
    found = laid(proposed, np.concatenate([wall_points(), sparse]).astype(np.float32), centre)
    assert found is not None
    for end, true in ((found.start, thin.start), (found.end, thin.end)):
        assert end[1] == pytest.approx(true[1], abs=thin.radius)
    assert laid(proposed, np.zeros((0, 3), np.float32), centre) is None


def test_the_wall_beside_and_behind_a_pipe_does_not_lay_it() -> None:
    """Stereo keeps half of a thin pipe and draws the rest to the wall, up to it: the depth is that of the near half."""
    thin = Cylinder(np.array([-0.3, 0.0, 0.0]), np.array([0.3, 0.0, 0.0]), 0.0086)
    centre = np.array([0.0, -1.2, 0.0])
    near = front_points(Cylinder(thin.start, thin.start + 0.5 * thin.length * thin.axis, thin.radius))[::7]
    rng = np.random.default_rng(5)
    drawn = np.stack([rng.uniform(0.0, 0.3, 400), rng.uniform(0.0, WALL, 400), rng.uniform(-0.009, 0.009, 400)], axis=1)
    points = np.concatenate([wall_points(), near, drawn]).astype(np.float32)
    proposed = Cylinder(np.array([-0.31, 0.04, 0.0]), np.array([0.31, 0.04, 0.0]), thin.radius)
    found = laid(proposed, points, centre, sloping=False)
    assert found is not None
    assert found.start[1] == pytest.approx(thin.start[1], abs=thin.radius)
    assert found.end[1] == pytest.approx(thin.end[1], abs=thin.radius)
    assert laid(proposed, wall_points().astype(np.float32), centre) is None


def test_mean_centre_is_of_the_views_that_show_a_pipe(pipe_views: list[View]) -> None:
    centre = mean_centre(PIPE, pipe_views)
    assert centre is not None
    assert centre[1] < -0.5
    far = np.array([50.0, 0.0, 0.0])
    assert mean_centre(Cylinder(PIPE.start + far, PIPE.end + far, PIPE.radius), pipe_views) is None


def test_a_known_slope_holds_what_one_height_leaves_open(pipe_views: list[View]) -> None:
    """From cameras almost in a plane with the axis the slope towards them is seen badly; that is what is given."""
    few = pipe_views[2:6]
    sloping = Cylinder(PIPE.start + np.array([0.0, 0.02, 0.0]), PIPE.end, PIPE.radius)
    free = refine(Start(sloping, PIPE.radius, True, 0.03), few, [], ContourConfig(), RADII, False)
    held = refine(Start(sloping, PIPE.radius, True, 0.03, np.radians(0.05)), few, [], ContourConfig(), RADII, False)
    assert free is not None
    assert held is not None
    turned = [np.arccos(min(abs(float(fit.cylinder.axis @ sloping.axis)), 1.0)) for fit in (free, held)]
    assert turned[1] < 0.5 * turned[0]


@settings(max_examples=50, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(0.85, 1.15), st.floats(-0.5, 1.0))
def test_lines_are_pieces_of_one_pipe_by_what_the_image_shows(radii: float, farther: float, ahead: float) -> None:
    """Whatever their depths: beside each other by less than the given radii, and no farther on than a clamp hides."""
    one = Cylinder(np.array([-0.3, 0.0, 0.0]), np.array([0.3, 0.0, 0.0]), 0.0086)
    centre = np.array([0.0, -1.2, 0.0])
    moved = np.array([ahead, 0.0, radii * one.radius])
    start, end = (centre + farther * (end + moved - centre) for end in (one.start, one.end))
    other = Cylinder(start, end, one.radius)
    for allowed in (SAME_LINE, 2.0):
        if abs(abs(radii) - allowed) > 1e-3 and abs(ahead - 0.9) > 1e-3:
            assert covers(one, other, centre, allowed) == (abs(radii) < allowed and ahead < 0.9)
