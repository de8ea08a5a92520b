# SPDX-License-Identifier: Apache-2.0
"""A survey found again in the map of an earlier one, or not."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from nights import MAP_FROM_WORLD, Night, as_it_is, errors, painted, reference, walk
from scenes import CAMERA

from pipeprog_sfm.alignment.alignment import align
from pipeprog_sfm.alignment.placing import NotAlignedError
from pipeprog_sfm.alignment.survey_map import MappedBoard
from pipeprog_sfm.boards.board import Board
from pipeprog_sfm.boards.placed_board import PlacedBoard
from pipeprog_sfm.features.keyframe import Keyframe
from pipeprog_sfm.features.sift import Features

# The first night's own errors, a millimetre as the mapper's tests have them, and as much again.
PLACE, TURN = 2e-3, 0.05


@lru_cache
def filmed(painted_anew: bool) -> Night:
    return walk(np.arange(0.1, 1.6, 0.25), 2, painted if painted_anew else as_it_is)


def second(painted_anew: bool = False) -> Night:
    """The second night, its model free to be changed."""
    return deepcopy(filmed(painted_anew))


def test_a_second_night_lies_where_it_was_filmed() -> None:
    night = second()
    found = align(night.model, night.keyframes, (), reference())
    place, turn = errors(night, found.reference_from_model)
    assert (found.by, place < PLACE, turn < TURN) == ("places", True, True), (place, turn)
    assert found.shared > 500
    assert found.scale == pytest.approx(np.cbrt(np.linalg.det(night.true_similarity[:3, :3])), rel=1e-3)
    assert 1e-6 < found.scale_sigma < 1e-3


def test_another_room_is_not_aligned() -> None:
    night = second(painted_anew=True)
    before = night.model.rotation.tobytes()
    with pytest.raises(NotAlignedError, match="keyframes show places of the reference"):
        align(night.model, night.keyframes, (), reference())
    assert night.model.rotation.tobytes() == before


def test_one_thing_that_was_carried_elsewhere_does_not_align() -> None:
    """All else looks different: what is seen again spans less than a metre."""

    def but_one_box(features: Features) -> Features:
        elsewhere = painted(features).descriptors
        inside = np.linalg.norm(features.keypoints - [CAMERA.cx, CAMERA.cy], axis=1) < 150
        return replace(features, descriptors=np.where(inside[:, None], features.descriptors, elsewhere))

    night = walk(np.arange(0.5, 0.95, 0.15), 2, but_one_box)
    with pytest.raises(NotAlignedError, match="a single thing may have been carried"):
        align(night.model, night.keyframes, (), reference())


def test_surfaces_that_lie_elsewhere_contradict() -> None:
    night = second()
    moved = replace(reference(), cloud=reference().cloud + np.float32(0.06))
    with pytest.raises(NotAlignedError, match="of its points lie on surfaces of the reference"):
        align(night.model, night.keyframes, (), moved)


@pytest.mark.parametrize("hung_on", ["its place", "another wall"])
def test_boards_align_where_nothing_else_looks_alike(hung_on: str) -> None:
    """By boards where both have them; a board that hangs elsewhere is found out by the walls."""
    night = second(painted_anew=True)
    circles = np.array([[-0.24, 0.15], [0.24, 0.15], [0.0, 0.0], [-0.24, -0.15], [0.24, -0.15]])
    board = Board("A", 0.04, np.c_[circles, np.zeros(5)])
    world_from_board = np.diag([1.0, -1.0, -1.0, 1.0])
    world_from_board[:3, 3] = 1.0, 0.0, 2.0
    map_from_board = MAP_FROM_WORLD @ world_from_board
    placed = PlacedBoard(board, (), np.linalg.inv(night.true_similarity) @ map_from_board, 1e-4, 0.1, 0.1)
    hung = circles_of(board, map_from_board)
    if hung_on == "another wall":
        hung = hung @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    earlier = replace(reference(), boards=(MappedBoard("A", hung),))
    if hung_on == "another wall":
        with pytest.raises(NotAlignedError, match="by boards"):
            align(night.model, night.keyframes, [placed], earlier)
    else:
        found = align(night.model, night.keyframes, [placed], earlier)
        assert found.by == "boards"
        assert errors(night, found.reference_from_model)[0] < PLACE


def circles_of(board: Board, map_from_board: np.ndarray) -> np.ndarray:
    return np.asarray(board.centres @ map_from_board[:3, :3].T + map_from_board[:3, 3])


def test_a_reference_keeps_only_what_a_pose_needs() -> None:
    survey = reference()
    counts = np.diff(survey.offsets)
    assert counts.max() <= 600
    assert len(survey.points) < len(survey.pixels)
    model = survey.model()
    assert model.errors(np.flatnonzero(model.point_of >= 0)).mean() < 0.6
    assert isinstance(survey.keyframes()[0], Keyframe)
