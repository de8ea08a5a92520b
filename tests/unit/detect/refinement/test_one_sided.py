# SPDX-License-Identifier: Apache-2.0
"""A pipe of a rack of which a neighbour hides one side."""

import numpy as np
import pytest

from pipeprog_detect.refinement.contour_refinement import Start, refine
from pipeprog_detect.refinement.one_sided import SeenArc, arc_precision, only_visible_side, with_radius
from pipeprog_detect.silhouette.scene import Scene, frame, viewing_direction
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.pipe_and_wall import PIPE

# Another pipe, which hides the side of that of `pipe_views` towards +x from all of the walk.
NEIGHBOUR = Cylinder(np.array([0.1, -0.08, -0.5]), np.array([0.08, -0.08, 0.5]), 0.09)
SEEN = SeenArc(np.radians(105.0), 1e-3)


def side_of_the_neighbour(views: list[View]) -> float:
    basis = frame(PIPE, viewing_direction(PIPE, views))
    return float(np.sign(basis[0] @ (NEIGHBOUR.start - PIPE.start)))


def test_the_side_away_from_the_neighbour_is_the_only_one(pipe_views: list[View]) -> None:
    assert only_visible_side(Scene.of(PIPE, pipe_views, [NEIGHBOUR])) == -side_of_the_neighbour(pipe_views)
    assert only_visible_side(Scene.of(PIPE, pipe_views, [])) is None


def test_a_gap_in_what_hides_a_side_does_not_show_it(pipe_views: list[View]) -> None:
    def up_to(height: float) -> Cylinder:
        share = (height - NEIGHBOUR.start[2]) / (NEIGHBOUR.end[2] - NEIGHBOUR.start[2])
        return Cylinder(NEIGHBOUR.start, NEIGHBOUR.start + share * (NEIGHBOUR.end - NEIGHBOUR.start), NEIGHBOUR.radius)

    nearly_all, half = up_to(0.065), up_to(-0.1)
    assert only_visible_side(Scene.of(PIPE, pipe_views, [nearly_all])) == -side_of_the_neighbour(pipe_views)
    assert refine(Start(PIPE, SEEN.sigma), pipe_views, [nearly_all], follow=False) is None
    assert only_visible_side(Scene.of(PIPE, pipe_views, [half])) is None


def test_one_side_mends_what_the_cloud_has(pipe_views: list[View]) -> None:
    """A radius 4 mm too large whose surface lies where it was seen; to the cloud that is 1.6 sigma."""
    half = 0.5 * SEEN.arc
    middle = np.array([-side_of_the_neighbour(pipe_views) * np.cos(half), -np.sin(half)])
    step = np.concatenate([-0.004 * middle, -0.004 * middle, [0.004]])
    start = Scene.of(PIPE, pipe_views, []).moved(step).cylinder
    assert refine(Start(start, SEEN.sigma), pipe_views, [NEIGHBOUR], follow=False) is None
    fit = refine(Start(start, SEEN.sigma, seen=SEEN), pipe_views, [NEIGHBOUR], follow=False)
    assert fit is not None
    assert abs(fit.cylinder.radius - PIPE.radius) < 0.5 * abs(start.radius - PIPE.radius)
    assert abs(fit.cylinder.radius - PIPE.radius) < 2.0 * fit.radius_sigma < 6e-3


@pytest.mark.parametrize("limb", [-1.0, 1.0])
def test_an_arc_leaves_the_radius_open_along_its_sagitta(limb: float) -> None:
    """Moving the seen surface costs most; growing so that it stays costs what the sagitta tells."""
    information = arc_precision(SEEN, limb)
    half = 0.5 * SEEN.arc
    middle = np.array([limb * np.cos(half), -np.sin(half)])
    along = np.concatenate([-middle, -middle, [1.0]])
    sigma = SEEN.sigma / (1.0 - np.cos(half))
    assert along @ information @ along == pytest.approx(1.0 / sigma**2)
    towards = np.concatenate([middle, middle, [0.0]])
    assert towards @ information @ towards == pytest.approx(2.0 / SEEN.sigma**2)
    assert np.linalg.eigvalsh(information).min() > 0.0


def test_with_another_radius_the_surface_stays_where_it_was_seen(pipe_views: list[View]) -> None:
    """The arc's middle is on both surfaces; without a neighbour both sides are seen, and the axis stays."""
    scene = Scene.of(PIPE, pipe_views, [NEIGHBOUR])
    thicker = with_radius(scene, SEEN, PIPE.radius + 0.015)
    middle = SEEN.middle(-side_of_the_neighbour(pipe_views)) @ scene.basis
    assert thicker.radius == pytest.approx(PIPE.radius + 0.015)
    for one, other in ((PIPE.start, thicker.start), (PIPE.end, thicker.end)):
        np.testing.assert_allclose(other + thicker.radius * middle, one + PIPE.radius * middle, atol=1e-12)
    alone = with_radius(Scene.of(PIPE, pipe_views, []), SEEN, PIPE.radius + 0.015)
    np.testing.assert_array_equal(alone.start, PIPE.start)
