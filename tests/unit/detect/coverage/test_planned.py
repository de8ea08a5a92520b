# SPDX-License-Identifier: Apache-2.0
"""Pipes that are planned before a wall and behind a curtain."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.coverage.axes import axis_coverage
from pipeprog_detect.coverage.places import Sight
from pipeprog_detect.coverage.planned import planned_coverage
from pipeprog_detect.coverage.survey import views_of
from pipeprog_detect.coverage.walls import wall_coverage
from pipeprog_detect.product.boq import PlannedPipe
from pipeprog_detect.product.installed_where_planned import FoundPipe, installed_where_planned
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.coverage.wall import CAMERA, RADIUS, poses, sheet, upright, wall_and_curtain


@pytest.fixture(scope="module")
def cloud() -> FloatArray:
    return wall_and_curtain()


@pytest.fixture(scope="module")
def views(cloud: FloatArray) -> list[View]:
    return views_of([CAMERA] * 9, poses(), cloud)


def words(planned: list[Cylinder], found: list[Cylinder], views: list[View]) -> list[str]:
    """What is told of planned pipes."""
    plan = [PlannedPipe(str(k), str(k), cylinder, "DN", 0) for k, cylinder in enumerate(planned)]
    there = [FoundPipe(f"p{k}", cylinder, "DN") for k, cylinder in enumerate(found)]
    return [each.word for each in planned_coverage(installed_where_planned(plan, there), views)]


def test_what_is_not_there_is_told_apart_from_what_was_not_seen(views: list[View]) -> None:
    planned = [upright(0.0), upright(-0.4), upright(1.0), upright(4.0), upright(0.0, y=-1.0), upright(-0.8, 0.004)]
    told = words(planned, [upright(-0.4)], views)
    assert told == ["missing", "installed", "hidden", "not_seen", "not_seen", "unclear"]


def test_a_pipe_that_is_there_is_never_missing_though_nobody_found_it() -> None:
    random = np.random.default_rng(2)
    angle, height = random.uniform(np.pi, 2 * np.pi, 20_000), random.uniform(-0.4, 0.4, 20_000)
    pipe = upright(0.0)
    surface = pipe.start * [1, 1, 0] + np.c_[RADIUS * np.cos(angle), RADIUS * np.sin(angle), height]
    views = views_of([CAMERA] * 9, poses(), np.concatenate([sheet((-2.4, 2.4), 2.0), surface]))
    assert words([pipe], [], views) == ["unclear"]


def test_a_pipe_too_small_in_all_images_is_not_seen(cloud: FloatArray) -> None:
    views = views_of([CAMERA.scaled(0.25)] * 9, poses(), cloud)
    assert words([upright(0.0, 0.008)], [], views) == ["not_seen"]


def test_the_fitting_beyond_an_installed_end_is_not_missing(views: list[View]) -> None:
    planned, short = upright(0.0), upright(0.0).cut(0.0, 0.8 - 2.5 * RADIUS)
    plan = [PlannedPipe("1", "1", planned, "DN", 0)]
    (told,) = planned_coverage(installed_where_planned(plan, [FoundPipe("p", short, "DN")]), views)
    assert told.missing == 0.0
    (told,) = planned_coverage(installed_where_planned(plan, [FoundPipe("p", planned.cut(0.0, 0.5), "DN")]), views)
    assert told.missing == pytest.approx(0.3 - 3 * RADIUS, abs=0.03)


def test_axes_are_told_in_metres(views: list[View]) -> None:
    across = Cylinder(np.array([-0.4, 1.9, 0.0]), np.array([1.4, 1.9, 0.0]), RADIUS)
    (own,) = axis_coverage([across], views)
    assert own.metres(*Sight) == pytest.approx(1.8)
    assert 0.2 < own.metres(Sight.HIDDEN) < 1.4
    assert axis_coverage([], views) == []


def test_walls_in_square_metres(cloud: FloatArray, views: list[View]) -> None:
    told = wall_coverage(cloud, [RADIUS, 0.001], views)
    assert told.area == pytest.approx(2 * 4.8, rel=0.1)
    assert 0.04 * told.area < told.hidden[0] < 0.25 * told.area
    assert 0.35 * told.area < told.seen[0] < 0.7 * told.area, "three cameras do not see its ends, top and bottom"
    assert told.seen[1] == 0.0, "a wire of a millimetre would not have been seen"
    assert wall_coverage(np.zeros((0, 3)), [RADIUS], views).area == 0.0
