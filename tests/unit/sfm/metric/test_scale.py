# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from targets import BOARD, CAMERA, LOPSIDED, Walk, camera_from_board, exact_ellipses, render

from pipeprog_camera.camera import Camera
from pipeprog_camera.similarity import similarity
from pipeprog_sfm.boards.board import Board
from pipeprog_sfm.boards.board_check import circle_residuals
from pipeprog_sfm.boards.board_detection import detect_boards
from pipeprog_sfm.boards.board_file import BoardFile, KnownDistance
from pipeprog_sfm.boards.ellipses import ImageEllipses
from pipeprog_sfm.boards.placed_board import PosedCamera
from pipeprog_sfm.config import BoardConfig
from pipeprog_sfm.metric.map_frame import Vertical, board_vertical
from pipeprog_sfm.metric.metric_frame import estimate_scale
from pipeprog_sfm.metric.metric_tracker import MetricTracker
from pipeprog_sfm.metric.scale import Measurement, NoScaleError, ScaleWarning
from pipeprog_sfm.metric.scale_evidence import PosedEvidence, ScaleEvidence
from pipeprog_sfm.metric.scale_sources import SOURCES
from pipeprog_sfm.metric.vertical_from_planes import PlanesError, vertical_from_planes
from pipeprog_sfm.model.bundle_adjustment import Bundle, adjust, function_covariance

CONFIG = BoardConfig()


def told(walk, boards=(BOARD,), config=CONFIG, distances=(), camera=CAMERA):
    seen = {stamp: detect_boards(ellipses, boards, camera) for stamp, ellipses in walk.ellipses.items()}
    evidence = ScaleEvidence(BoardFile(boards, distances), seen, walk.ellipses)
    return estimate_scale(PosedEvidence(evidence, walk.poses, camera, config))


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**16))
def test_exact_images_give_the_exact_scale_and_frame(seed):
    walk = Walk(seed)
    estimate = told(walk)
    assert estimate.scale * walk.factor == pytest.approx(1.0, abs=1e-6)
    board_in_map = estimate.map_from_model @ walk.model_from_board
    # x along the board, y into the wall, z up; the origin is the board's.
    assert board_in_map == pytest.approx(
        np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]]), abs=1e-5
    )
    # The paper's Eq. 2, the ratio of the spreads of given and triangulated centres, gives the same scale.
    residuals = circle_residuals(estimate.boards[0], PosedCamera(CAMERA, walk.poses))
    triangulated = Board("A", BOARD.circle_radius, BOARD.centres + residuals.offsets)
    assert estimate.scale * BOARD.spread / triangulated.spread == pytest.approx(estimate.scale, rel=1e-6)


def test_a_source_of_ones_own_is_combined_with_the_others():
    walk = Walk(2, noise=0.05, pose_noise=0.0003)

    def laser(posed):
        return [Measurement.of_trajectory("laser", "the laser", 1.01 / walk.factor, 1e-5, posed.poses)]

    def silent(posed):
        return [ScaleWarning("the GNSS has no fix", "no_fix")]

    seen = {stamp: detect_boards(ellipses, (BOARD,), CAMERA) for stamp, ellipses in walk.ellipses.items()}
    posed = PosedEvidence(ScaleEvidence(BoardFile((BOARD,)), seen, walk.ellipses), walk.poses, CAMERA)
    estimate = estimate_scale(posed, sources=(*SOURCES, laser, silent))
    assert estimate.source == "board+laser"
    assert estimate.scale * walk.factor == pytest.approx(1.01, abs=1e-3)
    assert any("off that of the laser" in text for text in estimate.warnings)
    assert "the GNSS has no fix" in estimate.warnings
    with pytest.raises(NoScaleError, match="no fix") as caught:
        estimate_scale(posed, sources=(silent,))
    assert caught.value.reason == "no_fix"


def test_sigma_is_honest_at_the_noise_of_a_good_model():
    """Chi-square of the scale's error over seeds: centres 0.1 px, camera places 0.5 mm."""
    scores = []
    for seed in range(24):
        walk = Walk(seed, views=8, noise=0.1, pose_noise=0.0005)
        place = told(walk).boards[0]
        scores.append((place.scale * walk.factor - 1) / place.sigma)
    assert 0.4 < np.mean(np.square(scores)) < 2.0
    assert np.abs(scores).max() < 4.0


def test_sigma_holds_the_tolerance_of_the_board():
    walk = Walk(1, noise=0.05, pose_noise=0.0003)
    coarse = told(walk, config=replace(CONFIG, tolerance=0.002))
    assert coarse.sigma == pytest.approx(np.hypot(coarse.boards[0].sigma, 0.002 / BOARD.spread))


def test_uncorrected_centres_are_off_by_the_eccentricity():
    walk = Walk(3, boards=((Board("A", 0.06, BOARD.centres), np.eye(4)),))
    board = Board("A", 0.06, BOARD.centres)
    corrected = told(walk, (board,)).scale * walk.factor - 1
    raw = told(walk, (board,), replace(CONFIG, eccentricity=False)).scale * walk.factor - 1
    assert abs(corrected) < 1e-6
    assert 1e-5 < abs(raw) < 1e-2


def test_images_with_one_circle_take_part():
    walk = Walk(5, views=16, span=3.0, follow=1.0)
    assert len(told(walk).views) > sum(len(one) >= 3 for one in walk.ellipses.values())


def test_a_board_upside_down_in_all_images_is_turned_up():
    walk = Walk(2, roll=np.pi)
    z_of_board_up = (told(walk).map_from_model @ walk.model_from_board)[2, 1]
    assert z_of_board_up == pytest.approx(-1.0, abs=1e-4)


@pytest.mark.parametrize("roll", [0.5 * np.pi, -0.5 * np.pi])
def test_a_board_filmed_sideways_is_up_by_another_source_or_said_to_be_uncertain(roll):
    walk = Walk(2, roll=roll)
    (place,) = told(walk).boards
    assert any("which side of board A is up is not certain" in text for text in told(walk).warnings)
    up = walk.model_from_board[:3, 1] / walk.factor
    for truth in (up, -up):
        found, warning = board_vertical(place, walk.poses, iter([Vertical(truth, "IMU")]))
        assert found.up_in_model == pytest.approx(truth, abs=1e-6)
        assert not warning


def test_a_lopsided_board_upside_down_is_warned_about():
    walk = Walk(2, roll=np.pi, boards=((LOPSIDED, np.eye(4)),))
    assert "upright" in told(walk, (LOPSIDED,)).warnings[0]


def test_boards_of_one_layout_are_told_apart_by_place():
    apart = np.eye(4)
    apart[0, 3] = 0.8
    twins = (BOARD, replace(BOARD, name="twin"))
    walk = Walk(4, views=12, noise=0.03, pose_noise=0.0003, span=3.0, boards=((BOARD, np.eye(4)), (BOARD, apart)))
    estimate = told(walk, twins)
    assert sorted(one.board.name for one in estimate.boards) == ["A", "twin"]
    assert estimate.scale * walk.factor == pytest.approx(1.0, abs=5e-4)
    gap = estimate.boards[1].model_from_board[:3, 3] - estimate.boards[0].model_from_board[:3, 3]
    assert np.linalg.norm(gap) * estimate.scale == pytest.approx(0.8, abs=0.001)


def test_equal_boards_at_both_ends_of_a_walk_are_told_apart():
    left, right = np.eye(4), np.eye(4)
    left[0, 3], right[0, 3] = -3.0, 3.0
    walk = Walk(
        5, views=24, noise=0.03, pose_noise=0.0003, span=7.0, follow=1.0, boards=((BOARD, left), (BOARD, right))
    )
    estimate = told(walk, (BOARD, replace(BOARD, name="twin")))
    assert sorted(one.board.name for one in estimate.boards) == ["A", "twin"]
    assert estimate.scale * walk.factor == pytest.approx(1.0, abs=5e-4)


def test_an_image_with_a_wrong_pose_leaves_the_scale():
    walk = Walk(6, views=10, noise=0.03, pose_noise=0.0003)
    walk.poses[4][:3, 3] += 0.09 * walk.factor
    estimate = told(walk)
    assert 4 not in estimate.views
    assert abs(estimate.scale * walk.factor - 1) < 5 * estimate.sigma


def far_apart(seed, views=24):
    left, right = np.eye(4), np.eye(4)
    left[0, 3], right[0, 3] = -3.0, 3.0
    boards = ((BOARD, left), (LOPSIDED, right))
    return Walk(seed, views=views, noise=0.03, pose_noise=0.0003, span=7.0, follow=1.0, boards=boards)


def test_a_known_distance_between_boards_sharpens_the_scale():
    walk, length = far_apart(1), float(np.linalg.norm([6.0 + 0.06, 0.02]))
    distance = KnownDistance("A/1 to B/1", (("A", 0), ("B", 0)), length, 0.0002)
    alone, both = told(walk, (BOARD, LOPSIDED)), told(walk, (BOARD, LOPSIDED), distances=(distance,))
    assert alone.source == "board"
    assert both.source == "board+known_distance"
    assert both.warnings == ()
    assert both.sigma < 0.6 * alone.sigma
    assert abs(both.scale * walk.factor - 1) < 3 * both.sigma


def test_a_wrong_distance_is_told():
    walk = far_apart(2)
    distance = KnownDistance("A/1 to B/1", (("A", 0), ("B", 0)), 5.9, 0.001)
    estimate = told(walk, (BOARD, LOPSIDED), distances=(distance,))
    assert any("the distance A/1 to B/1" in text and "off" in text for text in estimate.warnings)
    assert estimate.sigma > 3 * told(walk, (BOARD, LOPSIDED)).sigma
    lonely = told(Walk(2), (BOARD, LOPSIDED), distances=(distance,))
    assert "tells nothing" in lonely.warnings[0]


def test_a_board_of_another_size_than_its_neighbour_is_told():
    """Its file is of a print at 99 %: alone it could not be told, the other board contradicts it."""
    walk = far_apart(3)
    shrunk = Board("B", 0.99 * LOPSIDED.circle_radius, 0.99 * LOPSIDED.centres)
    estimate = told(walk, (BOARD, shrunk))
    assert any("-1.0" in text or "+1.0" in text for text in estimate.warnings)


def test_the_origin_stays_at_the_board_that_was_seen_first():
    walk = far_apart(4)
    for boards in ((BOARD, LOPSIDED), (LOPSIDED, BOARD)):
        estimate = told(walk, boards)
        assert estimate.boards[0].board.name == "A"
        origin = estimate.map_from_model @ walk.model_from_board @ [-3.0, 0.0, 0.0, 1.0]
        assert origin[:3] == pytest.approx(np.zeros(3), abs=0.002)


def bent(offset):
    centres = BOARD.centres.copy()
    centres[1] += offset
    return Board("A", BOARD.circle_radius, centres)


@pytest.mark.parametrize("offset", [(0.003, 0, 0), (0, -0.012, 0), (0, 0, 0.006)])
def test_a_board_that_contradicts_its_file_is_refused_with_the_residuals(offset):
    walk = Walk(7, views=10, noise=0.03, pose_noise=0.0003, boards=((bent(offset), np.eye(4)),))
    with pytest.raises(NoScaleError, match=r"2: \d+\.\d\d mm") as caught:
        told(walk)
    assert caught.value.reason == "contradiction"


def test_of_two_boards_the_bent_one_is_refused_and_the_other_counts():
    centres = LOPSIDED.centres.copy()
    centres[2] += [0.0, 0.004, 0.0]
    right = np.eye(4)
    right[0, 3] = 1.0
    boards = ((BOARD, np.eye(4)), (Board("B", LOPSIDED.circle_radius, centres), right))
    walk = Walk(3, views=14, noise=0.03, pose_noise=0.0003, span=3.0, follow=1.0, boards=boards)
    estimate = told(walk, (BOARD, LOPSIDED))
    assert [place.board.name for place in estimate.boards] == ["A"]
    assert "board B contradicts its file" in estimate.warnings[0]
    assert "3: " in estimate.warnings[0]
    assert abs(estimate.scale * walk.factor - 1) < 4 * estimate.sigma


def test_circles_that_lie_elsewhere_than_in_the_file_are_told_and_the_others_tell_the_scale():
    centres = BOARD.centres.copy()
    centres[2] += [0.09, 0.06, 0.0]
    centres[4] += [0.0, 0.03, 0.0]
    walk = Walk(7, views=10, noise=0.03, pose_noise=0.0003)
    estimate = told(walk, (Board("A", BOARD.circle_radius, centres),))
    assert [text for text in estimate.warnings if "not found where its file has them" in text] == [
        "board A: not found where its file has them, though 10 images or more show the place: circles 3, 5; the others "
        "tell the scale: measure these centres again, or uncover them"
    ]
    assert abs(estimate.scale * walk.factor - 1) < 4 * estimate.sigma


def test_circles_beyond_the_edge_of_the_image_are_not_missed_but_those_that_something_covers_are():
    walk = Walk(7, views=10, noise=0.03, pose_noise=0.0003, follow=0.0)
    for stamp, seen in walk.ellipses.items():
        left = seen.centres[:, 0] < 360.0  # circles 1, 3 and 4
        walk.ellipses[stamp] = ImageEllipses(seen.centres[left], seen.shapes[left], seen.rms[left])
    (warning,) = told(walk).warnings
    assert "circles 2, 5" in warning
    assert not told(walk, camera=replace(CAMERA, width=370)).warnings


def test_without_anything_that_tells_the_vertical_there_is_no_map():
    with pytest.raises(NoScaleError, match="what is up") as caught:
        told(Walk(1), config=replace(CONFIG, upright=False))
    assert caught.value.reason == "no_vertical"


def room(rng, surfaces):
    """Points (N, 3) on surfaces of a room in a board's frame (y up), each a coordinate and its value; 5 mm noise."""
    parts = []
    for axis, value in surfaces:
        points = rng.uniform([-2, -1, 0], [2, 1, 2], (3000, 3))
        points[:, axis] = value
        parts.append(points + rng.normal(0, 0.005, points.shape))
    return np.concatenate(parts)


@pytest.mark.parametrize("surfaces", [[(0, -2.0), (2, 0.0)], [(1, -1.0)], [(0, -2.0), (1, -1.0), (2, 0.0)]])
def test_floor_and_walls_tell_what_is_up(surfaces):
    rng = np.random.default_rng(0)
    walk = Walk(1, roll=0.2)
    points = room(rng, surfaces) @ walk.model_from_board[:3, :3].T + walk.model_from_board[:3, 3]
    seen = {stamp: detect_boards(ellipses, (BOARD,), CAMERA) for stamp, ellipses in walk.ellipses.items()}
    config = replace(CONFIG, upright=False)
    evidence = ScaleEvidence(BoardFile((BOARD,)), seen, walk.ellipses)
    estimate = estimate_scale(PosedEvidence(evidence, walk.poses, CAMERA, config, points=lambda: points))
    up = (estimate.map_from_model @ walk.model_from_board)[:3, 1]
    assert np.degrees(np.arccos(up @ [0, 0, 1] / np.linalg.norm(up))) < 0.5
    assert "floor and walls" in estimate.frame


def test_one_wall_or_a_cloud_of_nothing_tell_no_vertical():
    rng = np.random.default_rng(1)
    for points in (room(rng, [(2, 0.0)]), rng.normal(0, 1, (5000, 3)), np.empty((0, 3))):
        with pytest.raises(PlanesError):
            vertical_from_planes(points, np.array([0.0, 1.0, 0.0]))


def test_reasons_for_no_scale():
    walk = Walk(8)
    with pytest.raises(NoScaleError, match="nothing tells the scale") as caught:
        estimate_scale(PosedEvidence(ScaleEvidence(), walk.poses, CAMERA, CONFIG))
    evidence = ScaleEvidence(BoardFile((LOPSIDED,), path="other.yaml"))
    with pytest.raises(NoScaleError, match=r"no board \(B\) .* is other\.yaml that of the board that hangs") as caught:
        estimate_scale(PosedEvidence(evidence, walk.poses, CAMERA, CONFIG))
    assert caught.value.reason == "no_board"
    walk.poses = {0: walk.poses[0]}
    with pytest.raises(NoScaleError) as caught:
        told(walk)
    assert caught.value.reason == "too_few_views"
    with pytest.raises(NoScaleError, match="no keyframe"):
        MetricTracker(BoardFile([BOARD]), CONFIG).estimate({})


def test_tracker_measures_rendered_images():
    tracker, places, walk = MetricTracker(BoardFile([BOARD]), CONFIG), (-0.6, 0.0, 0.6), Walk(9)
    poses = {}
    for stamp, x in enumerate(places):
        pose = camera_from_board((x, 0.05, 1.3), (0.3 * x, 0, 0))
        assert len(tracker.add(stamp, render(BOARD, pose, seed=stamp), CAMERA)) == 1
        poses[stamp] = walk.in_model(pose)
    assert tracker.estimate(poses).scale * walk.factor == pytest.approx(1.0, abs=5e-4)


def test_tracker_measures_images_of_every_size_and_camera():
    tracker, walk = MetricTracker(BoardFile([BOARD]), CONFIG), Walk(9)
    small = Camera(480, 320, 371.0, 373.0, 241.0, 158.0)
    poses = {}
    tracker.add(100, np.zeros((48, 64), np.uint8), Camera(64, 48, 50.0, 50.0, 31.5, 23.5), "somebody else's")
    for stamp, x in enumerate((-0.6, -0.3, 0.0, 0.3, 0.6)):
        camera = small if stamp % 2 else CAMERA
        pose = camera_from_board((x, 0.05, 1.3), (0.3 * x, 0, 0))
        assert len(tracker.add(stamp, render(BOARD, pose, camera, seed=stamp), camera, "camera")) == 1
        poses[stamp] = walk.in_model(pose)
    estimate = tracker.estimate(poses)
    assert estimate.scale * walk.factor == pytest.approx(1.0, abs=5e-4)
    assert estimate.views == (0, 1, 2, 3, 4)


class DriftingWalk:
    """A board at the beginning of a walk along a wall, whose poses come out of a bundle adjustment."""

    def __init__(self, seed, track_noise=0.0, views=14, points=400):
        rng = np.random.default_rng(seed)
        xs = np.linspace(0.0, 4.0, views)
        true = np.stack([camera_from_board((x, rng.normal(0, 0.1), 1.7 + rng.normal(0, 0.1)), (x, 0, 0)) for x in xs])
        wall = rng.uniform([-1.5, -0.8, -0.6], [5.5, 0.8, 0.1], (points, 3))
        inside = np.einsum("vij,pj->pvi", true[:, :3, :3], wall) + true[:, :3, 3]
        pixels = inside[..., :2] / inside[..., 2:] * [CAMERA.fx, CAMERA.fy]
        seen = (np.abs(pixels) < [CAMERA.width / 2, CAMERA.height / 2]).all(-1)
        pixels += rng.normal(0, 0.3, pixels.shape)
        # What the localisation of a feature depends on, the view angle, changes slowly along the walk.
        pixels += (
            track_noise * rng.normal(0, 1, (points, 1, 2)) * (xs[:, None] - wall[:, None, None, 0][..., 0, :, None])
        )
        seen[seen.sum(1) < 2] = False
        wall, pixels, seen = wall[seen.any(1)], pixels[seen.any(1)], seen[seen.any(1)]
        views_of_points = np.nonzero(seen)[1]
        truth = Bundle(
            rotation=true[:, :3, :3],
            translation=true[:, :3, 3],
            points=wall,
            start=np.append(0, np.cumsum(seen.sum(1))),
            view=views_of_points,
            rays=pixels[seen] / [CAMERA.fx, CAMERA.fy],
            focal=np.full((views, 2), CAMERA.fx),
        )
        free = np.ones(views, bool)
        free[0] = False
        loss_scale = 2.385 * 0.3
        result = adjust(truth, free, loss_scale=loss_scale, max_iterations=30, tolerance=1e-10)
        self.poses = {}
        for stamp in range(views):
            self.poses[stamp] = true[stamp].copy()
            self.poses[stamp][:3, :3], self.poses[stamp][:3, 3] = result.rotation[stamp], result.translation[stamp]
        self.covariance = lambda gradients: function_covariance(gradients, result, loss_scale=loss_scale)
        ellipses = {stamp: exact_ellipses([BOARD], [true[stamp]], noise=0.03, rng=rng) for stamp in range(views)}
        seen_boards = {stamp: detect_boards(found, (BOARD,), CAMERA) for stamp, found in ellipses.items()}
        self.evidence = ScaleEvidence(BoardFile((BOARD,)), seen_boards, ellipses)
        found = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in self.poses.values()])
        centres = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in true])
        self.true_scale = np.cbrt(np.linalg.det(similarity(found, centres)[:3, :3]))

    def score(self, covariance):
        """Error of the scale over its standard deviation."""
        config = replace(CONFIG, tolerance=0.0)
        estimate = estimate_scale(PosedEvidence(self.evidence, self.poses, CAMERA, config), covariance)
        return np.log(estimate.scale / self.true_scale) / estimate.sigma


@pytest.mark.parametrize("track_noise", [0.0, 0.5])
def test_sigma_holds_the_drift_away_from_the_board(track_noise):
    """Chi-square over seeds; to take the poses for exact would be far off. The board itself is exact here."""
    walks = [DriftingWalk(seed, track_noise) for seed in range(20)]
    scores = np.array([walk.score(walk.covariance) for walk in walks])
    assert 0.5 < np.mean(scores**2) < 2.0
    assert np.abs(scores).max() < 3.5
    assert np.mean([walk.score(None) ** 2 for walk in walks[:8]]) > 4.0
