# SPDX-License-Identifier: Apache-2.0
"""Ellipses of sections: the confocal distance, components, and what is found among stray points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.ellipse_search import _distances, components, find_ellipses

SIGMA = 1e-3


def on_ellipse(angle: FloatArray, ellipse: FloatArray) -> FloatArray:
    x, y = ellipse[2] * np.cos(angle), ellipse[3] * np.sin(angle)
    cosine, sine = np.cos(ellipse[4]), np.sin(ellipse[4])
    return ellipse[:2] + np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)


@given(aspect=st.floats(1.0, 4.0), turn=st.floats(-3.0, 3.0), place=st.floats(0.0, 6.28), off=st.floats(-0.1, 0.1))
def test_the_confocal_distance_is_the_distance(aspect: float, turn: float, place: float, off: float) -> None:
    ellipse = np.array([0.3, -0.2, aspect, 1.0, turn])
    foot = on_ellipse(np.array([place]), ellipse)[0]
    radial = foot - ellipse[:2]
    point = foot + off * radial / np.linalg.norm(radial)
    # A search may end in a local minimum at the tip of a long ellipse; a grid does not.
    angles = np.asarray(place + np.linspace(-0.5, 0.5, 20001), float)
    nearest = np.linalg.norm(on_ellipse(angles, ellipse) - point, axis=1).min()
    distance = _distances(point[None], ellipse)[0]
    assert abs(distance) == pytest.approx(nearest, abs=0.01)
    assert distance * off >= -1e-12


def test_a_circle_is_an_ellipse_too() -> None:
    points = np.array([[0.5, 0.0], [0.0, 2.0], [0.0, 1.0]])
    np.testing.assert_allclose(_distances(points, np.array([0, 0, 1.0, 1.0, 0.3])), [-0.5, 1.0, 0.0], atol=1e-9)


def test_components_are_apart() -> None:
    rng = np.random.default_rng(0)
    blobs = [centre + rng.uniform(-0.02, 0.02, (count, 2)) for centre, count in ((0.0, 200), (0.2, 300), (0.4, 10))]
    parts = components(np.concatenate(blobs))
    assert [sorted(part) for part in parts] == [list(range(200, 500)), list(range(200))]
    assert components(np.zeros((0, 2))) == []


@pytest.mark.parametrize("arc_deg", [130, 180, 360])
def test_two_pipes_of_one_component_and_stray_points(arc_deg: float) -> None:
    rng = np.random.default_rng(3)
    truth = [np.array([0.0, 0.0, 0.060, 0.0575, 0.4]), np.array([0.105, 0.03, 0.042, 0.0365, -1.0])]
    arcs = [rng.uniform(-0.5, 0.5, count) * np.radians(arc_deg) - 1.5 for count in (250, 160)]
    parts = [on_ellipse(arc, ellipse) for arc, ellipse in zip(arcs, truth, strict=True)]
    points = np.concatenate([*parts, rng.uniform([-0.1, -0.1], [0.2, 0.1], (60, 2))])
    found = find_ellipses(points + rng.normal(0.0, SIGMA, points.shape), SIGMA, (0.005, 0.15), np.random.default_rng(0))
    assert len(found) == 2
    for ellipse, wanted in zip(sorted(found, key=lambda each: -each.minor), truth, strict=True):
        # Least squares leave a fifth of the radius open on a third of the circle.
        assert ellipse.minor == pytest.approx(wanted[3], rel=0.2 if arc_deg < 150 else 0.05)
        np.testing.assert_allclose(ellipse.centre, wanted[:2], atol=0.02 if arc_deg < 150 else 2e-3)


def test_a_wall_is_no_ellipse() -> None:
    rng = np.random.default_rng(1)
    wall = np.stack([rng.uniform(0.0, 1.0, 600), rng.normal(0.0, SIGMA, 600)], axis=1)
    assert find_ellipses(wall, SIGMA, (0.005, 0.15), np.random.default_rng(0)) == []
