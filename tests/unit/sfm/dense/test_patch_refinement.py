# SPDX-License-Identifier: Apache-2.0
"""What does not match by chance: views without texture, and what is interpolated at once from four pixels."""

from __future__ import annotations

import numpy as np

from pipeprog_sfm.dense.patch_refinement import fours, refine

SHIFT = 4.0  # px between the views at inverse depth 1


def _refined(view: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`refine` of a textured wall at inverse depth 1 with one view of it, from 1 % beside."""
    wall = np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8)
    start = np.full((24, 32), 1.01, np.float32)
    neighbour = np.roll(wall, int(SHIFT), axis=1) if view is None else view
    return refine(
        start, wall.astype(np.float32), fours(neighbour)[None], np.eye(3)[None], np.array([[SHIFT, 0.0, 0.0]]), 2
    )


def test_a_flat_view_matches_nothing() -> None:
    for grey in (0, 100, 255):
        inverse, correlation, _ = _refined(np.full((48, 64), grey, np.uint8))
        assert np.isnan(inverse).all(), grey
        assert (correlation == 0.0).all(), grey


def test_a_textured_view_places_the_wall() -> None:
    inverse, correlation, sigma = _refined(None)
    inner = np.s_[4:-4, 6:-6]
    assert np.abs(inverse[inner] - 1.0).max() < 0.005  # 0.02 px, of 0.01 at the start; white noise is no linear texture
    assert correlation[inner].min() > 0.95
    assert correlation.max() < 1.0 + 1e-3
    assert sigma[inner].max() < 0.005


def test_four_pixels_in_one() -> None:
    image = np.array([[1, 2], [3, 250]], np.uint8)
    assert fours(image)[0, 0] == 1 + (2 << 8) + (3 << 16) + (250 << 24)
