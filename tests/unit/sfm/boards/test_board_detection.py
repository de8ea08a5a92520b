# SPDX-License-Identifier: Apache-2.0
import time

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from targets import BOARD, CAMERA, LOPSIDED, camera_from_board, exact_ellipses, render

from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board import Board, symmetries
from pipeprog_sfm.boards.board_detection import detect_boards, detect_predicted_board, observed_in
from pipeprog_sfm.boards.ellipses import ImageEllipses, detect_ellipses
from pipeprog_sfm.config import BoardConfig

CONFIG = BoardConfig()
CENTRE_TOLERANCE = 0.06  # px; edges of 64 profiles at grey noise 2 and contrast 155
PARTLY_HIDDEN = 0.6  # px, of a disc of 20 px: its ellipse is up to 3.5 px off


def images_of_centres(board, pose, camera=CAMERA):
    x = (board.centres @ pose[:3, :3].T + pose[:3, 3]) @ camera.matrix.T
    return x[:, :2] / x[:, 2:]


def clutter(rng, count):
    axes = rng.uniform(4, 30, (count, 1)) * rng.uniform(0.3, 1.0, (count, 2))
    turn = rng.uniform(0, np.pi, count)
    rotation = np.stack([np.stack([np.cos(turn), -np.sin(turn)], -1), np.stack([np.sin(turn), np.cos(turn)], -1)], -2)
    shapes = (rotation * axes[:, None] ** 2) @ rotation.transpose(0, 2, 1)
    return ImageEllipses(rng.uniform([20, 20], [620, 380], (count, 2)), shapes, np.full(count, 0.1))


def joined(*parts):
    return ImageEllipses(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("centres", "shapes", "rms"))
    )


@pytest.mark.parametrize("place", [(0.0, 0.1, 1.2), (0.7, -0.2, 1.0), (-0.9, 0.3, 1.6)])
def test_rendered_centres_are_found_to_a_twentieth_of_a_pixel(place):
    pose = camera_from_board(place, (0, 0, 0), roll=0.1)
    (found,) = detect_boards(detect_ellipses(render(BOARD, pose), CAMERA, CONFIG), [BOARD], CAMERA)
    error = found.centres - images_of_centres(BOARD, pose)[found.indices]
    assert found.indices.tolist() == [0, 1, 2, 3, 4]
    assert np.sqrt((error**2).sum(1).mean()) < CENTRE_TOLERANCE


def test_lens_distortion_is_removed_before_the_fit():
    camera = Camera(640, 400, 500.0, 500.0, 319.5, 199.5, "plumb_bob", (-0.25, 0.08, 0.001, -0.001, 0.0))
    pose = camera_from_board((0.3, 0.0, 1.1), (-0.05, 0.0, 0.0))
    (found,) = detect_boards(detect_ellipses(render(BOARD, pose, camera), camera, CONFIG), [BOARD], camera)
    error = found.centres - images_of_centres(BOARD, pose)[found.indices]
    assert np.sqrt((error**2).sum(1).mean()) < CENTRE_TOLERANCE


def test_a_board_is_followed_where_its_ellipses_move():
    """By 3 px, as a rolling shutter moves them: the same circles as by detection, and centres as exact."""
    rng = np.random.default_rng(0)
    before, after = (camera_from_board((0.3 + aside, 0.1, 1.2), (0, 0, 0), roll=0.1) for aside in (0.0, 0.0072))
    others = clutter(rng, 20)
    ellipses, moved = (joined(exact_ellipses([BOARD], [pose]), others) for pose in (before, after))
    (found,) = detect_boards(ellipses, [BOARD], CAMERA)
    (expected,) = detect_boards(moved, [BOARD], CAMERA)
    followed = observed_in(moved, found, ellipses, CAMERA)
    np.testing.assert_array_equal(followed.indices, expected.indices)
    np.testing.assert_array_equal(followed.ellipse_centres, expected.ellipse_centres)
    np.testing.assert_array_equal(followed.conics, expected.conics)
    np.testing.assert_allclose(followed.centres, images_of_centres(BOARD, after), atol=0.01)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.05, 0.6), st.integers(0, 200))
def test_a_circle_that_is_partly_hidden_is_left_out_or_exact(share, grey):
    """A pipe before the board hides the upper part of its uppermost circles, each over a share of its height."""
    pose = camera_from_board((0.0, 0.1, 1.0), (0, 0, 0), roll=0.02)
    image = render(BOARD, pose)
    centres = images_of_centres(BOARD, pose)
    radius = BOARD.circle_radius * CAMERA.fx / np.linalg.norm(pose[:3, 3])
    image[: int(centres[:, 1].min() - radius + 2.0 * radius * share)] = grey
    ellipses = detect_ellipses(image, CAMERA, CONFIG)
    predicted = detect_predicted_board(ellipses, BOARD, CAMERA, pose)
    assert predicted is not None
    for each in (*detect_boards(ellipses, [BOARD], CAMERA), predicted):
        assert len(each.indices) >= 3
        error = np.linalg.norm(each.centres - centres[each.indices], axis=1)
        assert error.max() < PARTLY_HIDDEN


def test_no_ellipses_in_flat_and_noisy_images():
    rng = np.random.default_rng(0)
    assert len(detect_ellipses(np.full((400, 640), 90, np.uint8), CAMERA, CONFIG)) == 0
    ellipses = detect_ellipses(rng.integers(0, 255, (400, 640)).astype(np.uint8), CAMERA, CONFIG)
    assert detect_boards(ellipses, [BOARD], CAMERA) == []


@settings(max_examples=15, deadline=None)
@given(st.floats(-1.2, 1.2), st.floats(-0.7, 0.7), st.floats(1.0, 2.5), st.floats(-0.6, 0.6), st.integers(0, 2**16))
@example(0.25, 0.0, 1.0, 0.0, 16)  # the largest triangle of circles gives no pose of the right order
@example(0.25, 0.0, 1.25, 0.0, 1)  # that triangle gives a wrong pose, by which four circles look upside down
@example(1.1875, 0.25, 2.0, 0.0, 2944)  # three ellipses look like the other board, two of them circles of this one
def test_identity_from_geometry_in_clutter(x, y, z, roll, seed):
    rng = np.random.default_rng(seed)
    pose = camera_from_board((x, y, z), (0, 0, 0), roll)
    true = exact_ellipses([LOPSIDED], [pose], noise=0.05, rng=rng)
    found = detect_boards(joined(clutter(rng, 25), true), [BOARD, LOPSIDED], CAMERA)
    # Three of 25 small ellipses look like a board in one image of fifty; the other images tell (test_scale).
    assert {one.board for one in found if len(one.indices) > 3} == {"B"}
    board = next(one for one in found if one.board == "B")
    assert board.centres == pytest.approx(images_of_centres(LOPSIDED, pose)[board.indices], abs=0.5)


def test_clutter_alone_is_no_board():
    for seed in range(5):
        assert detect_boards(clutter(np.random.default_rng(seed), 60), [BOARD, LOPSIDED], CAMERA) == []


def test_three_circles_in_view_are_enough():
    pose = camera_from_board((0.0, 0.0, 1.0), (0.55, 0.1, 0.0))
    ellipses = exact_ellipses([LOPSIDED], [pose])
    assert len(ellipses) == 3
    (found,) = detect_boards(ellipses, [LOPSIDED], CAMERA)
    assert found.indices.tolist() == [1, 2, 4]


def test_two_boards_at_once():
    first, second = camera_from_board((0.4, 0.0, 2.2), (0.4, 0, 0)), camera_from_board((-0.5, 0.0, 2.2), (-0.5, 0, 0))
    found = detect_boards(exact_ellipses([BOARD, LOPSIDED], [first, second]), [LOPSIDED, BOARD], CAMERA)
    assert sorted(one.board for one in found) == ["A", "B"]
    assert all(len(one.indices) == 5 for one in found)


def test_a_mirrored_board_is_refused():
    mirrored = Board("B", LOPSIDED.circle_radius, LOPSIDED.centres * [-1, 1, 1])
    ellipses = exact_ellipses([mirrored], [camera_from_board((0.2, 0.1, 1.2), (0, 0, 0))])
    assert all(len(one.indices) < 5 for one in detect_boards(ellipses, [LOPSIDED], CAMERA))


def test_a_symmetric_board_hangs_upright_in_the_image():
    for roll in (0.0, np.pi - 0.2):
        pose = camera_from_board((0.2, 0.1, 1.2), (0, 0, 0), roll)
        (found,) = detect_boards(exact_ellipses([BOARD], [pose]), [BOARD], CAMERA)
        order = symmetries(BOARD)[0 if roll == 0 else 1]
        assert found.centres == pytest.approx(images_of_centres(BOARD, pose)[order], abs=1e-3)


def test_a_single_circle_is_known_from_the_predicted_pose():
    pose = camera_from_board((0.0, 0.0, 1.0), (0.75, -0.4, 0.0))
    ellipses = exact_ellipses([BOARD], [pose])
    assert len(ellipses) == 1
    assert detect_boards(ellipses, [BOARD], CAMERA) == []
    found = detect_predicted_board(ellipses, BOARD, CAMERA, pose)
    assert found is not None
    assert found.indices.tolist() == [4]
    away = pose.copy()
    away[0, 3] += 0.3
    assert detect_predicted_board(ellipses, BOARD, CAMERA, away) is None


def test_a_perforated_sheet_does_not_stall_the_search():
    grid = np.stack(np.meshgrid(np.arange(20, 620, 20.0), np.arange(20, 380, 20.0)), -1).reshape(-1, 2)
    sheet = ImageEllipses(grid, np.tile(36.0 * np.eye(2), (len(grid), 1, 1)), np.full(len(grid), 0.1))
    start = time.process_time()
    detect_boards(sheet, [BOARD], CAMERA)
    assert time.process_time() - start < 5.0
