# SPDX-License-Identifier: Apache-2.0
"""What is at the ends of a ray-cast pipe: nothing, the floor, something that hides them, the border of the images."""

from __future__ import annotations

import numpy as np

from pipeprog_detect.cloud import octree
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.end_states import ends_in_cloud, ends_in_views
from pipeprog_detect.verification.scene_context import SceneContext
from tests.unit.detect.pipe_and_wall import PIPE
from tests.unit.detect.verification.test_wall_ends import floor

NOWHERE = np.full((1, 3), 9.0)
NO_WALLS = SceneContext(octree.build(NOWHERE), None, [], octree.build(NOWHERE), 1e-3)


def across(height: float, half: float) -> Cylinder:
    """A thick pipe across the views of the pipe."""
    middle, aside = np.array([0.0, -0.25, height]), np.array([0.6, 0.0, 0.0])
    return Cylinder(middle - aside, middle + aside, half)


def test_ends_that_the_images_show_are_free(pipe_views: list[View]) -> None:
    ends = ends_in_views(PIPE, NO_WALLS, pipe_views, [])
    assert [end.state for end in ends] == ["free", "free"]
    assert max(end.sigma for end in ends) < 5e-3


def test_an_end_on_the_floor_is_at_a_wall_whichever_side_rounding_puts_it(pipe_views: list[View]) -> None:
    """What hides the end would leave it open; the pipe cannot go on through the floor."""
    hides = [across(-0.25, 0.1)]
    for height in (PIPE.start[2] - 1e-9, PIPE.start[2] + 1e-9):
        start, end = ends_in_views(PIPE, floor(height), pipe_views, hides)
        assert (start.state, end.state) == ("wall", "free")
        assert start.sigma < ends_in_views(PIPE, NO_WALLS, pipe_views, hides)[0].sigma


def test_an_end_behind_a_thick_pipe_is_hidden(pipe_views: list[View]) -> None:
    start, end = ends_in_views(PIPE, NO_WALLS, pipe_views, [across(PIPE.end[2] + 0.03, 0.08)])
    assert (start.state, end.state) == ("free", "hidden")


def test_an_end_beyond_the_images_is_out_of_view(pipe_views: list[View]) -> None:
    longer = Cylinder(PIPE.start, PIPE.start + 3.0 * PIPE.axis, PIPE.radius)
    start, end = ends_in_views(longer, NO_WALLS, pipe_views, [])
    assert (start.state, end.state) == ("free", "out_of_view")
    assert end.sigma > 0.3


def test_a_cloud_tells_an_end_to_a_bin() -> None:
    """A bin holds twelve points on average and is 5 mm long at least."""
    dense, sparse = ends_in_cloud(PIPE, 100_000), ends_in_cloud(PIPE, 400)
    assert [end.state for end in dense] == ["unknown", "unknown"]
    assert dense[0].sigma == 5e-3
    np.testing.assert_allclose(sparse[1].sigma, 12.0 * PIPE.length / 400)
