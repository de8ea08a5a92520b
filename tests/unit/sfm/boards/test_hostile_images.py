# SPDX-License-Identifier: Apache-2.0
"""Ellipses and circles where an image or a lens gives none: what is not finite is left out, nothing is raised."""

from __future__ import annotations

import numpy as np
import pytest
from targets import BOARD, CAMERA, camera_from_board, exact_ellipses, render

from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board_detection import detect_boards, detect_predicted_board
from pipeprog_sfm.boards.conic import circles_from_conics
from pipeprog_sfm.boards.ellipses import detect_ellipses
from pipeprog_sfm.config import BoardConfig

FACING = camera_from_board((0.1, 0.05, 1.2), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200, 0.0])
def test_the_circles_of_what_is_no_ellipse_are_unknown(value: float) -> None:
    conics = exact_ellipses([BOARD], [FACING]).conics
    centres, _ = circles_from_conics(conics, CAMERA.matrix, BOARD.circle_radius)
    spoilt = conics.copy()
    spoilt[2] = value
    with np.errstate(all="ignore"):
        found, normals = circles_from_conics(spoilt, CAMERA.matrix, BOARD.circle_radius)
    others = [0, 1, 3, 4]
    assert np.array_equal(found[others], centres[others])
    assert np.isnan(found[2]).all()
    assert np.isnan(normals[2]).all()


def test_edges_without_an_inverse_of_the_distortion_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    image = render(BOARD, FACING)
    whole = detect_ellipses(image, CAMERA, BoardConfig())
    assert len(whole) >= 5

    def undistort(camera: Camera, pixels: np.ndarray) -> np.ndarray:
        points = np.array(pixels, float)
        points[points[:, 0] > 330.0] = np.nan  # the two circles on the right, and half of that in the middle
        return points

    monkeypatch.setattr(Camera, "undistort_points", undistort)
    left = detect_ellipses(image, CAMERA, BoardConfig())
    assert 0 < len(left) < len(whole)
    assert np.isfinite(left.shapes).all()
    assert detect_boards(left, [BOARD], CAMERA) == []


def test_a_board_seen_along_its_plane_has_no_circles() -> None:
    ellipses = exact_ellipses([BOARD], [FACING])
    flat = FACING.copy()
    flat[:3, 3] = 0.0
    with np.errstate(all="ignore"):
        assert detect_predicted_board(ellipses, BOARD, CAMERA, flat) is None


@pytest.mark.parametrize("kind", ["black", "white", "noise", "stripes"])
def test_images_that_show_nothing_have_no_board(kind: str) -> None:
    shape = CAMERA.height, CAMERA.width
    image = {
        "black": np.zeros(shape, np.uint8),
        "white": np.full(shape, 255, np.uint8),
        "noise": np.random.default_rng(0).integers(0, 256, shape, np.uint8),
        "stripes": np.tile(np.arange(CAMERA.width) // 4 % 2 * 255, (CAMERA.height, 1)).astype(np.uint8),
    }[kind]
    assert detect_boards(detect_ellipses(image, CAMERA, BoardConfig()), [BOARD], CAMERA) == []
