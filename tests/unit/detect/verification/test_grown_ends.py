# SPDX-License-Identifier: Apache-2.0
"""What a pipe has grown by stays where its contour is seen, and goes where it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeprog_detect.silhouette.occlusion import with_depths
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification import grown_ends
from pipeprog_detect.verification.grown_ends import with_grown_ends
from tests.unit.detect.pipe_and_wall import PIPE, front_points, wall_points
from tests.unit.detect.verification.test_open_ends import measured
from tests.unit.detect.verification.test_wall_ends import hiding

FOUND = PIPE.cut(0.4 * PIPE.length, 0.6 * PIPE.length)  # what the cloud shows


@pytest.mark.parametrize("further", [0.1, 0.2, 0.4])
def test_what_is_beyond_the_end_goes(further: float, pipe_views: list[View]) -> None:
    long = replace(measured(FOUND), cylinder=PIPE.cut(-further, PIPE.length), rims=(3.0, 4.0))
    (pipe,) = with_grown_ends([long], pipe_views)
    np.testing.assert_allclose(pipe.cylinder.start, PIPE.start, atol=0.01)
    np.testing.assert_allclose(pipe.cylinder.end, PIPE.end)
    assert pipe.rims[1] == 4.0
    turned = replace(long, cylinder=Cylinder(long.cylinder.end, long.cylinder.start, PIPE.radius))
    (pipe,) = with_grown_ends([turned], pipe_views)
    np.testing.assert_allclose(pipe.cylinder.end, PIPE.start, atol=0.01)


def test_without_views_all_stays() -> None:
    long = replace(measured(FOUND), cylinder=PIPE)
    assert with_grown_ends([long], []) == [long]


def test_what_the_contour_shows_stays(pipe_views: list[View]) -> None:
    whole = replace(measured(FOUND), cylinder=PIPE)
    assert with_grown_ends([whole], pipe_views) == [whole]


@pytest.mark.parametrize(("least", "length"), [(0.05, 0.7), (0.2, 1.0)])
def test_what_the_views_see_through_goes_where_it_is_long(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch, least: float, length: float
) -> None:
    """Its contour is seen, but the cloud has only the upper 0.7 of the pipe, without holes: the wall lies beyond."""
    monkeypatch.setattr(grown_ends, "SEEN_THROUGH", least)
    found = PIPE.cut(0.3 * PIPE.length, PIPE.length)
    views = with_depths(pipe_views, np.concatenate([wall_points(), front_points(found)]))
    (pipe,) = with_grown_ends([replace(measured(found), cylinder=PIPE)], views)
    assert pipe.cylinder.length == pytest.approx(length * PIPE.length, abs=0.02)


def test_what_is_hidden_stays(pipe_views: list[View]) -> None:
    hider = measured(hiding(-0.6, -0.1)[0])
    long = replace(measured(FOUND), cylinder=PIPE.cut(-0.2, PIPE.length))
    assert with_grown_ends([long, hider], pipe_views)[0] is long


def test_what_the_cloud_shows_stays(pipe_views: list[View]) -> None:
    long = measured(PIPE.cut(-0.2, PIPE.length))
    assert with_grown_ends([long], pipe_views) == [long]
