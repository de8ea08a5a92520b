# SPDX-License-Identifier: Apache-2.0
"""The limb operator on profiles whose edge is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeprog_detect.silhouette.limb_edges import limb_edges

OFFSETS: NDArray[np.float64] = np.arange(-10.0, 4.01, 0.5).astype(np.float64)


# How much a surface mirrors at grazing incidence is unknown: it moves the edge by less than this [px].
UNKNOWN_RIM = 0.09


def profile(edge: float, half_width: float, outside: float, lamp: float, mirrored: float = 0.25) -> np.ndarray:
    """A Lambert cylinder under a lamp beside the camera, with ambient light 60, blurred by 0.5 px and sampled.

    `mirrored` is the share of Schlick's reflectance that shows what lies behind the limb.
    """
    fine = np.arange(-30.0, 20.0, 0.01)
    depth = np.clip((edge - fine) / half_width, 0.0, 1.0)
    towards = np.sqrt(depth * (2.0 - depth))
    rim = mirrored * (1.0 - towards) ** 5
    value = np.where(fine < edge, (1.0 - rim) * (60.0 + lamp * towards) + rim * outside, outside)
    taps = np.exp(-0.5 * (np.arange(-3.0, 3.005, 0.01) / 0.5) ** 2)
    return np.interp(OFFSETS, fine, np.convolve(value, taps / taps.sum(), mode="same"))


@pytest.mark.parametrize("mirrored", [0.0, 0.25, 0.5])
@pytest.mark.parametrize("outside", [20.0, 110.0, 180.0])
@pytest.mark.parametrize("edge", [-0.83, 0.0, 0.41])
def test_edge_of_a_limb_darkened_pipe(edge: float, outside: float, mirrored: float) -> None:
    values = profile(edge, 16.0, outside, 80.0, mirrored)[None]
    found = limb_edges(values, OFFSETS, np.array([16.0]), 0.5, 1.5)
    assert found.offset[0, 0] == pytest.approx(edge, abs=0.02 if mirrored == 0.25 else UNKNOWN_RIM)
    assert found.explained[0, 0] > 0.5


def test_gradient_would_be_biased_where_the_limb_model_is_not() -> None:
    values = profile(0.0, 16.0, 20.0, 120.0)
    slope = np.abs(np.diff(values))
    window = np.abs(OFFSETS[1:] - 0.25) < 2.0
    centroid = float((slope * (OFFSETS[1:] - 0.25))[window].sum() / slope[window].sum())
    found = limb_edges(values[None], OFFSETS, np.array([16.0]), 0.5, 1.5)
    assert abs(centroid) > 0.15
    assert abs(found.offset[0, 0]) < 0.03


def noisy_profiles(half_width: float, outside: float, aside: float, ambient: float) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (Q,) and the light (400, Q) of a thin pipe under a lamp `aside` (1: at the height of this limb)."""
    offsets = np.arange(-0.8 * half_width - 1.2, 3.31, 0.5, dtype=float)
    fine = np.arange(-3.0 * half_width, 8.0, 0.01)
    away = np.clip(1.0 + fine / half_width, -1.0, 1.0)
    towards = np.sqrt(1.0 - away**2)
    rim = 0.25 * (1.0 - towards) ** 5
    surface = ambient + 80.0 * np.maximum(aside * away + np.sqrt(1.0 - aside**2) * towards, 0.0)
    is_pipe = (fine < 0.0) & (fine > -2.0 * half_width)
    value = np.where(is_pipe, (1.0 - rim) * surface + rim * outside, outside)
    taps = np.exp(-0.5 * (np.arange(-3.0, 3.005, 0.01) / 0.6) ** 2)
    clean = np.interp(offsets, fine, np.convolve(value, taps / taps.sum(), mode="same"))
    return offsets, clean + np.random.default_rng(5).normal(0.0, 2.0, (400, len(offsets)))


@pytest.mark.parametrize("aside", [-0.8, 0.0, 0.8])
@pytest.mark.parametrize("outside", [20.0, 180.0])
def test_shading_hardly_moves_the_edge_of_a_thin_pipe(outside: float, aside: float) -> None:
    """A lamp aside shades a pipe 8 px wide by a skew curve, which fitted freely takes other places for the edge.

    Held by its prior it moves the edge by a quarter of a pixel at the most.
    """
    offsets, noisy = noisy_profiles(4.0, outside, aside, 60.0)
    found = limb_edges(noisy, offsets, np.full(400, 4.0), 0.6, 1.2)
    assert np.isfinite(found.offset[:, 0]).mean() > 0.99, "fitted freely, every second profile has no edge or two"
    assert abs(np.median(found.offset[:, 0])) < 0.25
    assert np.quantile(np.abs(found.offset[:, 0]), 0.8) < 0.35


@pytest.mark.parametrize("aside", [0.0, 0.3, 0.8])
@pytest.mark.parametrize("outside", [10.0, 150.0])
def test_shading_does_not_move_the_edge_where_the_window_resolves_it(outside: float, aside: float) -> None:
    """A DN65 at 640 x 480 px from 2 m: held as tightly as on a thinner pipe, the shading moved it by up to 0.6 px."""
    offsets, noisy = noisy_profiles(8.4, outside, aside, 20.0)
    found = limb_edges(noisy, offsets, np.full(400, 8.4), 0.6, 1.5)
    assert abs(np.median(found.offset[:, 0])) < 0.12


def test_stated_sigma_covers_noise() -> None:
    random = np.random.default_rng(3)
    values = profile(0.2, 20.0, 140.0, 60.0) + random.normal(0.0, 2.0, (400, len(OFFSETS)))
    found = limb_edges(values, OFFSETS, np.full(400, 20.0), 0.5, 1.5)
    pull = (found.offset[:, 0] - 0.2) / found.sigma[:, 0]
    assert np.median(found.sigma[:, 0]) < 0.15
    assert 0.6 < np.sqrt(np.median(pull**2) / 0.455) < 1.5


def test_featureless_profile_explains_nothing() -> None:
    values = (80.0 + 2.0 * OFFSETS + 0.1 * OFFSETS**2)[None] + np.random.default_rng(0).normal(
        0, 1.0, (50, len(OFFSETS))
    )
    found = limb_edges(values, OFFSETS, np.full(50, 20.0), 0.5, 1.5)
    assert np.median(found.explained[:, 0]) < 0.2
