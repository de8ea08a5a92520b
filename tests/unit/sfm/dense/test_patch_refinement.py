# SPDX-License-Identifier: Apache-2.0
"""What does not match by chance: views without texture, and what is interpolated at once from four pixels."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

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


@pytest.mark.parametrize("beside", [-0.003, 0.003])
def test_noise_does_not_hold_the_depth_where_it_was(beside: float) -> None:
    # Half a pixel in the farthest views. Gauss-Newton on derivatives with noise leaves 0.0013 and 0.0011 of it.
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.normal(0.0, 1.0, (96, 640)), (0, 0), 2.0)
    wall *= 20.0 / wall.std()  # grey levels, of which noise has 3

    def seen(shift: float) -> np.ndarray:
        affine = np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0]])
        moved = cv2.warpAffine(wall, affine, (640, 96), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
        return np.clip(np.round(100.0 + moved + rng.normal(0.0, 3.0, wall.shape)), 0.0, 255.0).astype(np.uint8)

    shifts = (-160.3, -80.6, 80.2, 160.9)  # px at inverse depth 1
    epipoles = np.array([[shift, 0.0, 0.0] for shift in shifts])
    start = np.full((48, 320), 1.0 + beside, np.float32)
    views = np.stack([fours(seen(shift)) for shift in shifts])
    inverse, *_ = refine(start, seen(0.0).astype(np.float32), views, np.stack([np.eye(3)] * 4), epipoles, 2)
    inner = np.s_[6:-6, 90:230]  # what all views show
    assert abs(inverse[inner].mean() - 1.0) < 0.3 * abs(beside)


def test_four_pixels_in_one() -> None:
    image = np.array([[1, 2], [3, 250]], np.uint8)
    assert fours(image)[0, 0] == 1 + (2 << 8) + (3 << 16) + (250 << 24)
