# SPDX-License-Identifier: Apache-2.0
"""Pipes before a wall whose slope to it the contour tells more or less precisely."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud import octree
from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.types import Cylinder
from pipeprog_detect.verification.measured_pipe import MeasuredPipe
from pipeprog_detect.verification.parallel_to_wall import CLIP_SLOPE, HELD_WITHIN, parallel_to_wall
from pipeprog_detect.verification.scene_context import SceneContext

SIGMA = 1e-3
WALL = Plane(np.array([0.0, 1.0, 0.0]), 0.0, 3.0)  # the camera stands at negative y
FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0, 3.0)
BEFORE = 0.06  # m, between axis and wall
MILLIRADIAN, MILLIMETRE = 1e-3, 1e-3


def surroundings(*planes: Plane, until: float = 2.0) -> SceneContext:
    """A wall, two metres wide or as far as `until`, and a floor below it, as far as they are planes."""
    x, up = (each.ravel() for each in np.meshgrid(np.arange(0.0, until, 0.01), np.arange(0.0, 1.0, 0.01)))
    walls = octree.build(np.concatenate([np.c_[x, 0.0 * x, up], np.c_[x, -up, 0.0 * x]]))
    return SceneContext(walls, None, planes, walls, SIGMA)


def pipe(slope: float, covariance: FloatArray, height: float = 0.5) -> MeasuredPipe:
    """Two metres along the wall, at the right distance in the middle."""
    half = np.array([1.0, -slope, 0.0])
    middle = np.array([1.0, -BEFORE, height])
    cylinder = Cylinder(middle - half, middle + half, 0.0086)
    across = np.array([[0.0, 0.0, -1.0], [slope, 1.0, 0.0]])
    sigma = float(np.sqrt(covariance[4, 4]))
    fit = ContourFit(cylinder, across, covariance, sigma, 0.8, 100.0, 20, (0.0, 0.0), 0.0, 0.5)
    evidence = CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
    return MeasuredPipe.of_contour(Candidate(cylinder, sigma, 100, evidence), fit)


def known_to(slope: float) -> FloatArray:
    """Covariance (5, 5) where the slope away from the cameras is the least known; all else to a tenth of it."""
    return np.diag([0.1 * slope, 0.1 * slope, 0.1 * slope, slope, 0.1 * slope]) ** 2


def slope_of(measured: MeasuredPipe) -> float:
    return float(WALL.normal @ measured.cylinder.axis)


def test_an_open_slope_becomes_that_of_the_wall_and_the_image_stays() -> None:
    before = pipe(12 * MILLIRADIAN, known_to(8 * MILLIRADIAN))
    after = parallel_to_wall(before, surroundings(WALL))
    share = CLIP_SLOPE**2 / (CLIP_SLOPE**2 + (8 * MILLIRADIAN) ** 2)
    assert abs(slope_of(after)) == pytest.approx(share * 12 * MILLIRADIAN, rel=0.01)
    assert after.cylinder.middle == pytest.approx(before.cylinder.middle, abs=1e-9)
    assert after.cylinder.length == pytest.approx(before.cylinder.length, rel=1e-4)
    assert after.cylinder.start[2] == pytest.approx(before.cylinder.start[2], abs=1e-9)
    assert after.rims == before.rims


@given(slope=st.floats(-0.02, 0.02), known=st.floats(0.05, 10.0))
def test_it_is_never_farther_from_the_wall_s_direction_than_before_nor_beyond_it(slope: float, known: float) -> None:
    before = pipe(slope, known_to(known * MILLIRADIAN))
    first, then = slope_of(before), slope_of(parallel_to_wall(before, surroundings(WALL)))
    assert abs(then) <= abs(first) * (1.0 + 1e-9)
    assert then * first >= 0.0


def test_a_slope_that_the_contour_tells_stays() -> None:
    before = pipe(2 * MILLIRADIAN, known_to(0.1 * MILLIRADIAN))
    after = parallel_to_wall(before, surroundings(WALL))
    assert after.cylinder.start == pytest.approx(before.cylinder.start, abs=0.01 * MILLIMETRE)
    drain = pipe(20 * MILLIRADIAN, known_to(3 * MILLIRADIAN))
    assert parallel_to_wall(drain, surroundings(WALL)) is drain


def test_what_goes_with_the_slope_follows_it() -> None:
    covariance = known_to(8 * MILLIRADIAN)
    covariance[1, 3] = covariance[3, 1] = 0.8 * 0.8 * MILLIMETRE * 8 * MILLIRADIAN  # the end that is known stays
    before = pipe(12 * MILLIRADIAN, covariance)
    after = parallel_to_wall(before, surroundings(WALL))
    assert after.cylinder.middle[1] > before.cylinder.middle[1] + 0.5 * MILLIMETRE
    assert after.fit is not None
    assert after.fit.covariance[3, 3] < CLIP_SLOPE**2
    assert after.fit.covariance[1, 1] < covariance[1, 1]


def test_a_wall_counts_that_goes_along_most_of_the_pipe_within_reach() -> None:
    before = pipe(12 * MILLIRADIAN, known_to(8 * MILLIRADIAN))
    assert parallel_to_wall(before, surroundings(WALL, until=0.8)) is before
    assert (
        parallel_to_wall(before, surroundings(FLOOR)) is before
    )  # the wall is none of the large planes, the floor far
    high = pipe(12 * MILLIRADIAN, known_to(8 * MILLIRADIAN), height=1.0 + 1.1 * HELD_WITHIN)
    assert parallel_to_wall(high, surroundings(WALL)) is high
    assert parallel_to_wall(replace(before, fit=None), surroundings(WALL)).cylinder is before.cylinder
