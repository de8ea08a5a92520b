# SPDX-License-Identifier: Apache-2.0
"""Two discs and a tape measure: seen with and without a board and clutter, by poses up to a similarity."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from targets import BOARD, CAMERA, Walk

from pipeprog_sfm.boards.board import Board
from pipeprog_sfm.boards.board_detection import detect_boards
from pipeprog_sfm.boards.board_file import BoardFile, ScaleBar
from pipeprog_sfm.config import BoardConfig
from pipeprog_sfm.metric.metric_frame import estimate_scale
from pipeprog_sfm.metric.scale import NoScaleError
from pipeprog_sfm.metric.scale_evidence import PosedEvidence, ScaleEvidence

CONFIG = BoardConfig()
RADIUS, SIGMA = 0.05, 0.001


def disc(place, turn=(0.0, 0.0, 0.0), radius=RADIUS):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), place
    return Board("disc", radius, np.zeros((1, 3))), pose


MARKS = (disc((-0.45, 0.1, 0.0), (0.1, 0.3, 0.0)), disc((0.4, -0.15, -0.1), (-0.2, 0.1, 0.0)))
LENGTH = float(np.linalg.norm(MARKS[0][1][:3, 3] - MARKS[1][1][:3, 3]))
PAIR = ScaleBar("marks 1", RADIUS, LENGTH, SIGMA)


def floor(walk):
    """Points of a floor in the model, which tells the vertical."""
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-2, 2, 4000), np.full(4000, -1.0), rng.uniform(0, 3, 4000)]
    return points @ walk.model_from_board[:3, :3].T + walk.model_from_board[:3, 3]


def estimate(walk, targets):
    seen = {stamp: detect_boards(ellipses, targets.boards, CAMERA) for stamp, ellipses in walk.ellipses.items()}
    evidence = ScaleEvidence(targets, seen, walk.ellipses)
    return estimate_scale(PosedEvidence(evidence, walk.poses, CAMERA, CONFIG, points=lambda: floor(walk)))


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**16))
def test_exact_images_give_the_exact_scale(seed):
    walk = Walk(seed, boards=MARKS)
    found = estimate(walk, BoardFile(scale_bars=(PAIR,)))
    assert found.scale * walk.factor == pytest.approx(1.0, abs=1e-5)
    assert found.source == "known_distance"
    assert found.sigma == pytest.approx(SIGMA / LENGTH, rel=0.5)


def test_sigma_is_honest():
    ratios = []
    for seed in range(20):
        walk = Walk(seed, boards=MARKS, noise=0.1, pose_noise=0.0005)
        measured = replace(PAIR, length=LENGTH + np.random.default_rng(seed).normal(0, SIGMA))
        found = estimate(walk, BoardFile(scale_bars=(measured,)))
        ratios.append(np.log(found.scale * walk.factor) / found.sigma)
    assert np.abs(ratios).max() < 3.5
    assert 0.4 < np.mean(np.square(ratios)) < 1.9


def test_discs_of_another_size_are_no_marks():
    others = (disc((0.0, 0.3, 0.0), radius=0.03), disc((0.1, -0.3, 0.0), radius=0.035))
    walk = Walk(3, boards=(*MARKS, *others))
    assert estimate(walk, BoardFile(scale_bars=(PAIR,))).scale * walk.factor == pytest.approx(1.0, abs=1e-4)


def test_circles_of_a_board_are_no_marks():
    """A board nearby whose circles are of the marks' size and lie at the marks' distance."""
    board = replace(BOARD, circle_radius=RADIUS)
    gap = float(np.linalg.norm(board.centres[0] - board.centres[1]))
    marks = (disc((-0.6, 0.35, 0.0)), disc((-0.6 + gap, 0.35, 0.0)))
    walk = Walk(5, boards=((board, np.eye(4)), *marks))
    found = estimate(walk, BoardFile(boards=(board,), scale_bars=(replace(PAIR, length=gap),)))
    assert found.scale * walk.factor == pytest.approx(1.0, abs=1e-4)
    assert found.source == "board+known_distance"


def test_pairs_that_cannot_be_told_apart_are_refused():
    third = disc((-0.45 - 0.02, 0.1 - 0.25, 0.0))
    gap = float(np.linalg.norm(third[1][:3, 3] - MARKS[0][1][:3, 3]))
    walk = Walk(4, boards=(*MARKS, third, disc((0.4, -0.15 + gap, -0.1))))
    with pytest.raises(NoScaleError, match="2 pairs of them"):
        estimate(walk, BoardFile(scale_bars=(replace(PAIR, length=gap),)))


def test_marks_that_nobody_saw_are_missed_by_name():
    walk = Walk(6, boards=MARKS[:1])
    with pytest.raises(NoScaleError, match=r"marks 1: 1 discs .* film both"):
        estimate(walk, BoardFile(scale_bars=(PAIR,)))
