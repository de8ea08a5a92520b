# SPDX-License-Identifier: Apache-2.0
"""Ends of a pipe at a floor: shown, hidden, beyond it, or not there."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud import octree
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.refinement.axial_evidence import AxialEvidence
from pipeprog_detect.silhouette.apparent_contour import in_image
from pipeprog_detect.silhouette.occlusion import with_depths
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification import wall_ends
from pipeprog_detect.verification.scene_context import SceneContext
from pipeprog_detect.verification.wall_ends import with_ends_on_walls
from tests.unit.detect.pipe_and_wall import PIPE, front_points, wall_points

NO_RIMS = (0.0, 0.0)
TOLERANCE = 1e-3


def walls(plane: Plane, points: FloatArray) -> SceneContext:
    """A scene with one plane and its points (N, 3)."""
    tree = octree.build(points)
    return SceneContext(tree, None, [plane], tree, 1e-3)


def floor(height: float, x_from: float = -0.6, y_from: float = -0.6) -> SceneContext:
    """The plane z = height and its points, 1 cm apart."""
    x, y = np.meshgrid(np.arange(x_from, x_from + 1.21, 0.01), np.arange(y_from, y_from + 1.21, 0.01))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    return walls(Plane(np.array([0.0, 0.0, 1.0]), height, 1.44), points)


def hiding(low: float, high: float) -> list[Cylinder]:
    """A thick cylinder across the views of the pipe between two heights."""
    middle = np.array([0.0, -0.25, 0.5 * (low + high)])
    half = np.array([0.6, 0.0, 0.0])
    return [Cylinder(middle - half, middle + half, 0.5 * (high - low))]


def cut(above: float) -> Cylinder:
    """The pipe without what lies below its end by less than `above` [m]."""
    return Cylinder(PIPE.start + above * PIPE.axis, PIPE.end, PIPE.radius)


def height_of_start(cylinder: Cylinder) -> float:
    return float(cylinder.start[2])


def test_a_pipe_that_the_views_show_to_end_above_the_floor_ends_there(pipe_views: list[View]) -> None:
    for height in (-0.23, -0.3):
        same = with_ends_on_walls(PIPE, NO_RIMS, floor(height), pipe_views, [])
        assert height_of_start(same) == pytest.approx(PIPE.start[2], abs=1e-9)
        assert same.length == pytest.approx(PIPE.length, abs=1e-9)


def test_a_pipe_of_which_the_lower_part_was_not_found_goes_on_to_the_floor(pipe_views: list[View]) -> None:
    longer = with_ends_on_walls(cut(0.1), NO_RIMS, floor(-0.2), pipe_views, [])
    assert height_of_start(longer) == pytest.approx(-0.2, abs=TOLERANCE)
    np.testing.assert_allclose(longer.end, PIPE.end)


def test_a_pipe_does_not_go_on_to_a_floor_where_the_views_see_through_what_is_between(pipe_views: list[View]) -> None:
    """What has edges there, in line with a pipe whose cloud has no holes, is another thing."""
    surface = front_points(PIPE)
    above = surface[(surface - PIPE.start) @ PIPE.axis > 0.1]
    for barrel, end in ((surface, -0.2), (above, -0.1)):
        views = with_depths(pipe_views, np.concatenate([wall_points(), barrel]))
        longer = with_ends_on_walls(cut(0.1), NO_RIMS, floor(-0.2), views, [])
        assert height_of_start(longer) == pytest.approx(end, abs=TOLERANCE)


def test_what_is_hidden_goes_on_to_a_floor_that_is_near(pipe_views: list[View]) -> None:
    hides = hiding(-0.4, -0.06)
    near = with_ends_on_walls(cut(0.1), NO_RIMS, floor(-0.25), pipe_views, hides)
    assert height_of_start(near) == pytest.approx(-0.25, abs=TOLERANCE)
    with_rim = with_ends_on_walls(cut(0.1), (10.0, 0.0), floor(-0.25), pipe_views, hides)
    assert height_of_start(with_rim) == pytest.approx(-0.1, abs=TOLERANCE)
    far = with_ends_on_walls(cut(0.1), NO_RIMS, floor(-0.1 - 0.3 * np.log(2.0) - 0.01), pipe_views, hides)
    assert height_of_start(far) == pytest.approx(-0.1, abs=TOLERANCE)


def test_nothing_goes_on_to_a_plane_that_is_not_there_or_runs_along(pipe_views: list[View]) -> None:
    hides = hiding(-0.4, -0.06)
    elsewhere = with_ends_on_walls(cut(0.1), NO_RIMS, floor(-0.25, x_from=1.0), pipe_views, hides)
    assert elsewhere.length == pytest.approx(cut(0.1).length, abs=1e-9)
    x, z = np.meshgrid(np.arange(-0.6, 0.61, 0.01), np.arange(-0.6, 0.61, 0.01))
    points = np.stack([x.ravel(), np.full(x.size, 0.05), z.ravel()], axis=1)
    wall = walls(Plane(np.array([0.0, 1.0, 0.0]), 0.05, 1.44), points)
    along = with_ends_on_walls(PIPE, NO_RIMS, wall, pipe_views, [])
    assert along.length == pytest.approx(PIPE.length, abs=1e-9)


@pytest.mark.parametrize(("radius", "end"), [(0.1, -0.1), (0.04, -0.25)])
def test_nothing_goes_on_to_the_end_of_another_pipe(pipe_views: list[View], radius: float, end: float) -> None:
    """What is seen there is as large as the end of a pipe of 0.1 m: beside one of 0.04 m it is a wall."""
    beside = Cylinder(np.array([0.25, 0.0, -0.25]), np.array([0.25, 0.0, 0.3]), radius)
    x, y = np.meshgrid(np.arange(-0.1, 0.1, 0.005), np.arange(-0.1, 0.1, 0.005))
    disc = np.stack([x, y, np.zeros_like(x)], axis=-1)[np.hypot(x, y) < 0.1] + beside.start
    seen = walls(Plane(np.array([0.0, 0.0, 1.0]), -0.25, np.pi * 0.1**2), disc)
    same_or_longer = with_ends_on_walls(cut(0.1), NO_RIMS, seen, pipe_views, [*hiding(-0.4, -0.06), beside])
    assert height_of_start(same_or_longer) == pytest.approx(end, abs=TOLERANCE)


def test_one_centimetre_that_is_seen_tells_little_of_a_hidden_stretch(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two to one against the pipe there; that it ends in that centimetre was improbable before."""
    seen = AxialEvidence(np.array([0.01]), np.array([-np.log(2.0)]), np.array([2.0]))
    monkeypatch.setattr(wall_ends, "axial_evidence", lambda *_: seen)
    longer = with_ends_on_walls(cut(0.1), NO_RIMS, floor(-0.25), pipe_views, [])
    assert height_of_start(longer) == pytest.approx(-0.25, abs=TOLERANCE)


@pytest.mark.parametrize(("beyond", "end"), [(None, -1.0), (-1.3, -0.55)])
def test_a_pipe_that_leaves_the_images_goes_on_to_the_floor_of_the_room(
    pipe_views: list[View], beyond: float | None, end: float
) -> None:
    """Of the floor a part elsewhere is seen; what has a floor under it, too, is a platform and ends somewhere."""
    pipe = Cylinder(np.array([0.0, 0.0, -0.55]), np.array([0.0, 0.0, 0.6]), 0.04)
    assert not any(in_image(view, np.array([[0.0, 0.0, -1.0]])).any() for view in pipe_views)
    seen = floor(-1.0, x_from=1.0)
    if beyond is not None:
        points = np.concatenate([seen.walls.points, floor(beyond, x_from=2.0).walls.points])
        seen = walls(seen.planes[0], points)
    same_or_longer = with_ends_on_walls(pipe, NO_RIMS, seen, pipe_views, [])
    assert height_of_start(same_or_longer) == pytest.approx(end, abs=TOLERANCE)
    assert same_or_longer.end[2] == pytest.approx(0.6, abs=1e-9)


@pytest.mark.parametrize("below", [0.08, 0.9])
def test_what_lies_under_the_floor_is_cut_off(pipe_views: list[View], below: float) -> None:
    deeper = Cylinder(PIPE.start - below * PIPE.axis, PIPE.end, PIPE.radius)
    whole = with_ends_on_walls(deeper, (10.0, 10.0), floor(-0.2), pipe_views, [])
    assert height_of_start(whole) == pytest.approx(-0.2, abs=TOLERANCE)


def test_a_pipe_through_a_shelf_with_a_view_from_below_is_not_cut(pipe_views: list[View]) -> None:
    assert min(view.centre[2] for view in pipe_views) > -0.15
    below = PIPE.start - 1.0 * PIPE.axis - np.array([0.0, 1.0, 0.0])
    pose = pipe_views[0].camera_from_map.copy()
    pose[:3, 3] = -pose[:3, :3] @ below
    view = View(99, pipe_views[0].image, pipe_views[0].camera, pose)
    same = with_ends_on_walls(PIPE, NO_RIMS, floor(-0.15), [*pipe_views, view], [])
    assert height_of_start(same) == pytest.approx(PIPE.start[2], abs=1e-9)


def test_a_pipe_beside_an_edge_of_the_floor_is_not_cut(pipe_views: list[View]) -> None:
    same = with_ends_on_walls(PIPE, NO_RIMS, floor(-0.15, y_from=0.06), pipe_views, [])
    assert height_of_start(same) == pytest.approx(PIPE.start[2], abs=1e-9)


@pytest.mark.parametrize("length", [0.5, 3.0])
def test_without_views_a_pipe_goes_on_to_a_floor_nearer_than_half_of_the_ends_would_be(length: float) -> None:
    """Ends come at one a length: half of them lie within ln 2 = 0.69 lengths."""
    pipe = Cylinder(np.zeros(3), np.array([0.0, 0.0, length]), 0.04)
    near, far = (with_ends_on_walls(pipe, NO_RIMS, floor(-share * length), [], []) for share in (0.66, 0.72))
    assert height_of_start(near) == pytest.approx(-0.66 * length, abs=TOLERANCE)
    assert height_of_start(far) == 0.0
