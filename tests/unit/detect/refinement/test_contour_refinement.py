# SPDX-License-Identifier: Apache-2.0
"""Refinement by the apparent contour on ray-cast images: shadows, starts, occluders and empty walls."""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
import pytest

from pipeprog_camera.camera import Camera
from pipeprog_detect.refinement import contour_refinement
from pipeprog_detect.refinement.contour_adjustment import LEAST_IN_VIEW, AdjustedCylinder, adjusted
from pipeprog_detect.refinement.contour_refinement import Start, refine
from pipeprog_detect.refinement.extension import followed
from pipeprog_detect.refinement.global_search import MOST_SAMPLES, best_steps
from pipeprog_detect.silhouette.scene import Scene, frame
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.pipe_and_wall import PIPE

UP = np.array([0.0, 0.0, 1.0])
# One pixel is 3.5 mm here; the limb operator resolves a tenth of the blur, which is about one pixel.
RADIUS_TOLERANCE = 0.35e-3
# [m] The axis is as good across the view; along it by distance over half the baseline worse, 1.2 m / 0.45 m.
AXIS_TOLERANCE = 0.35e-3 * 1.2 / 0.45
# [m] The search ends within a pixel of the contour; sub-pixel edges come after it.
SEARCH_TOLERANCE = 3.5e-3 * 1.2 / 0.45


def disturbed(random: np.random.Generator) -> Cylinder:
    """Both ends a fifth of the radius aside, the radius a tenth off."""
    basis = frame(PIPE, np.array([0.0, 1.0, 0.0]))
    angle = random.uniform(0.0, 2.0 * np.pi, 2)
    aside = 0.2 * PIPE.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1) @ basis
    return Cylinder(PIPE.start + aside[0], PIPE.end + aside[1], PIPE.radius * (1.0 + 0.1 * random.choice([-1, 1])))


def test_converges_from_every_start_beside_a_shadow(pipe_views: list[View]) -> None:
    random = np.random.default_rng(5)
    for _ in range(4):
        fit = refine(Start(disturbed(random), 0.1 * PIPE.radius), pipe_views, [])
        assert fit is not None
        assert fit.cylinder.radius == pytest.approx(PIPE.radius, abs=RADIUS_TOLERANCE)
        assert abs(fit.cylinder.radius - PIPE.radius) < 3.0 * fit.radius_sigma < 2e-3
        assert fit.support > 0.8
        assert fit.views == len(pipe_views)
        for point in (fit.cylinder.start, fit.cylinder.end):
            across = np.cross(point - PIPE.start, PIPE.axis)
            assert np.linalg.norm(across) < AXIS_TOLERANCE


def test_wrong_poses_widen_the_axis_sigma_and_spare_the_radius(pipe_views: list[View]) -> None:
    random = np.random.default_rng(2)
    noisy = []
    for view in pipe_views:
        pose = view.camera_from_map.copy()
        pose[:3, 3] += random.normal(0.0, 1.5e-3, 3)
        noisy.append(dataclasses.replace(view, camera_from_map=pose))
    clean = refine(Start(PIPE, 0.002), pipe_views, [])
    fit = refine(Start(PIPE, 0.002), noisy, [])
    assert clean is not None
    assert fit is not None
    assert abs(fit.cylinder.radius - PIPE.radius) < 3.0 * fit.radius_sigma
    assert fit.cylinder.radius == pytest.approx(PIPE.radius, abs=RADIUS_TOLERANCE)
    assert np.trace(fit.covariance[:2, :2]) > 1.5 * np.trace(clean.covariance[:2, :2])


def test_the_ends_are_found_from_a_short_start(pipe_views: list[View]) -> None:
    short = Cylinder(PIPE.start + 0.04 * PIPE.axis, PIPE.end - 0.04 * PIPE.axis, PIPE.radius)
    fit = refine(Start(short, 0.002), pipe_views, [])
    assert fit is not None
    # One pixel along the pipe, and what the rim is worth against it.
    assert fit.cylinder.length == pytest.approx(PIPE.length, abs=3.5e-3)


def test_a_catalogue_radius_does_not_pull(pipe_views: list[View]) -> None:
    free = refine(Start(PIPE, 0.003), pipe_views, [])
    seeded = refine(Start(PIPE, 0.003), pipe_views, [], planned_radii=(0.042, 0.0365))
    assert free is not None
    assert seeded is not None
    assert seeded.cylinder.radius == pytest.approx(free.cylinder.radius, abs=2e-5)


def test_edges_that_may_be_off_let_go_of_a_fixed_radius(pipe_views: list[View]) -> None:
    wide = dataclasses.replace(PIPE, radius=PIPE.radius + 1e-3)
    for error, radius in ((0.0, wide.radius), (2e-3, PIPE.radius)):
        fit = refine(Start(wide, 1e-3, radius_known=True, radius_fixed=True, radius_error=error), pipe_views, [])
        assert fit is not None
        assert fit.cylinder.radius == pytest.approx(radius, abs=RADIUS_TOLERANCE)


@pytest.mark.parametrize("tilt", [2e-3, np.inf])
def test_the_search_tilts_no_more_than_the_slope_may(pipe_views: list[View], tilt: float) -> None:
    away = frame(PIPE, np.array([0.0, 1.0, 0.0]))[1] * 0.05
    scene = Scene.of(Cylinder(PIPE.start + away, PIPE.end + away, PIPE.radius), pipe_views, [])
    samples = scene.samples(limit=MOST_SAMPLES)
    reach = np.array([0.02, 0.1, 0.02, 0.1, 1e-3])
    steps = best_steps(samples, scene.wide_profiles(samples, 30.0), reach, tilt=tilt)
    assert (np.abs(steps[:, 3] - steps[:, 1]) <= tilt + 1e-12).all()
    found = scene.moved(steps[0]).cylinder
    for point in (found.start, found.end):
        assert np.linalg.norm(PIPE.from_axis(point[None])) < SEARCH_TOLERANCE


def test_same_input_same_result(pipe_views: list[View]) -> None:
    first, second = (refine(Start(PIPE, 0.003), pipe_views, []) for _ in range(2))
    assert first is not None
    assert second is not None
    assert first.cylinder.radius == second.cylinder.radius
    np.testing.assert_array_equal(first.covariance, second.covariance)


def test_the_blur_of_views_is_measured_unless_it_is_known(pipe_views: list[View]) -> None:
    blurred = [dataclasses.replace(view, image=cv2.GaussianBlur(view.image, (0, 0), 1.2)) for view in pipe_views]
    known = [dataclasses.replace(view, blur=1.35) for view in blurred]
    sharp, measured, told = (refine(Start(PIPE, 0.002), views, []) for views in (pipe_views, blurred, known))
    assert sharp is not None
    assert measured is not None
    assert told is not None
    # Blurs are tried in steps of a fifth.
    assert measured.blur == pytest.approx(np.hypot(sharp.blur, 1.2), rel=0.2)
    assert told.blur == 1.35
    # On a contour whose own blur is not measured, the views' one places its edges better than a sharp image's.
    as_sharp, as_blurred = (
        np.median(Scene.of(PIPE, views, []).edges(1.5)[1].sigma[:, 0]) for views in (blurred, known)
    )
    assert as_blurred < 0.5 * as_sharp


def test_nothing_to_see_is_no_measurement(empty_views: list[View]) -> None:
    assert refine(Start(PIPE, 0.004), empty_views, []) is None
    assert refine(Start(PIPE, 0.004), [], []) is None
    above = Cylinder(PIPE.start + 3.0 * UP, PIPE.end + 3.0 * UP, PIPE.radius)
    assert refine(Start(above, 0.004), empty_views, []) is None


def test_what_is_hardly_seen_is_not_followed(
    pipe_views: list[View], empty_views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would take as long again, of most lines that are no pipes."""
    lengths = []

    def noted(known: AdjustedCylinder, *others: Any) -> AdjustedCylinder:
        lengths.append(known.cylinder.length)
        return followed(known, *others)

    monkeypatch.setattr(contour_refinement, "followed", noted)
    start = Start(PIPE, PIPE.radius, radius_known=True, depth_sigma=0.03)
    assert refine(start, empty_views, []) is None
    assert not lengths
    assert refine(start, pipe_views, []) is not None
    assert lengths


def test_a_wrong_radius_and_an_empty_wall_have_no_support(pipe_views: list[View], empty_views: list[View]) -> None:
    thick = Cylinder(PIPE.start, PIPE.end, 1.2 * PIPE.radius)
    assert Scene.of(PIPE, pipe_views, []).support().share > 0.9
    assert Scene.of(thick, pipe_views, []).support().share < 0.2
    assert Scene.of(PIPE, empty_views, []).support().share < 0.2


def test_hidden_samples_are_left_out(pipe_views: list[View]) -> None:
    screen = Cylinder(np.array([-0.5, -0.3, 0.0]), np.array([0.5, -0.3, 0.0]), 0.05)
    fit = refine(Start(PIPE, 0.002), pipe_views, [screen])
    assert fit is not None
    assert fit.cylinder.radius == pytest.approx(PIPE.radius, abs=RADIUS_TOLERANCE)


@pytest.mark.parametrize("radius_known", [True, False])
@pytest.mark.parametrize("aside", [0.0, 0.02, 0.04])
def test_a_cylinder_thinner_than_a_pixel_is_measured_nowhere(
    empty_views: list[View], pipe_views: list[View], radius_known: bool, aside: float
) -> None:
    """Neither on texture nor on one edge, the pipe's contour or its shadow's (0.04 m aside)."""
    place = np.array([aside, 0.0, 0.1])
    radii = (0.3e-3, 0.6e-3, 1e-3)
    threads = [Cylinder(PIPE.start + place, PIPE.end + place - [0.0, 0.0, 0.2], radius) for radius in radii]
    for views in (empty_views, pipe_views):
        for thread in threads:
            fit = refine(Start(thread, thread.radius, radius_known, 0.03), views, [], [thread.radius])
            assert fit is None


def test_a_glimpse_of_a_pipe_does_not_measure_it(pipe_views: list[View]) -> None:
    """A view that shows 24 px of its length: fewer samples than tell its edges from those of texture."""
    whole = pipe_views[0]
    left, top = 200, 120
    lens = whole.camera
    camera = Camera(80, 24, lens.fx, lens.fy, lens.cx - left, lens.cy - top)
    image = np.ascontiguousarray(whole.image[top : top + camera.height, left : left + camera.width])
    glimpse = dataclasses.replace(whole, stamp=99, image=image, camera=camera)
    scene = Scene.of(PIPE, [*pipe_views, glimpse], [])
    assert 0 < (scene.samples().view == len(pipe_views)).sum() < LEAST_IN_VIEW
    found = adjusted(scene, np.zeros((5, 5)), np.zeros(5))
    assert found is not None
    assert set(found.samples.view.tolist()) == set(range(len(pipe_views)))
