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
from pipeprog_sfm.alignment.plane_check import agree_across
from pipeprog_sfm.alignment.survey_map import MappedBoard, SurveyMap
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


def with_board(night: Night, shift: tuple[float, float, float], turned: bool = False) -> tuple[SurveyMap, PlacedBoard]:
    """The reference with a board on its wall, shifted [m] and turned there, and the board in the night's model."""
    circles = np.array([[-0.24, 0.15], [0.24, 0.15], [0.0, 0.0], [-0.24, -0.15], [0.24, -0.15]])
    board = Board("A", 0.04, np.c_[circles, np.zeros(5)])
    world_from_board = np.diag([1.0, -1.0, -1.0, 1.0])
    world_from_board[:3, 3] = 1.0, 0.0, 2.0
    placed = PlacedBoard(
        board, (), np.linalg.inv(night.true_similarity) @ MAP_FROM_WORLD @ world_from_board, 1e-4, 0.1, 0.1
    )
    world_from_board[:3, 3] += shift
    hung = circles_of(board, MAP_FROM_WORLD @ world_from_board)
    if turned:
        hung = hung @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return replace(reference(), boards=(MappedBoard("A", hung),)), placed


@pytest.mark.parametrize("painted_anew", [False, True], ids=["places agree", "surfaces agree"])
def test_a_board_that_hangs_in_its_place_aligns(painted_anew: bool) -> None:
    night = second(painted_anew)
    earlier, placed = with_board(night, (0.0, 0.0, 0.0))
    found = align(night.model, night.keyframes, [placed], earlier)
    assert found.by == "boards"
    assert errors(night, found.reference_from_model)[0] < PLACE


@pytest.mark.parametrize(
    ("shift", "turned"),
    [((0.0, 0.0, 0.0), True), ((0.7, 0.0, 0.0), False), ((0.3, -0.2, 0.0), False)],
    ids=["on another wall", "along its wall", "elsewhere on its wall"],
)
def test_a_board_alone_aligns_no_other_room(shift: tuple[float, float, float], turned: bool) -> None:
    """Nothing looks alike, and the wall that the board hangs on agrees in any room."""
    night = second(painted_anew=True)
    earlier, placed = with_board(night, shift, turned)
    with pytest.raises(NotAlignedError, match="by boards"):
        align(night.model, night.keyframes, [placed], earlier)


def room(rng: np.random.Generator, count: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    """Points of a wall (y = 0), a side wall (x = 0) and a floor (z = 0), and their normals."""
    points = rng.uniform(0.0, [3.0, 3.0, 2.5], (3 * count, 3))
    normals = np.repeat(np.eye(3)[[1, 0, 2]], count, axis=0)
    points[normals > 0] = rng.normal(0.0, 0.003, 3 * count)
    return points, normals


@pytest.mark.parametrize(
    ("shift", "agree"),
    [((0.0, 0.0, 0.0), True), ((0.0, 0.08, 0.0), True), ((0.05, 0.0, 0.0), False), ((0.0, 0.0, 0.05), False)],
)
def test_floor_and_side_wall_tell_where_on_its_wall_a_board_hangs(shift: tuple[float, ...], agree: bool) -> None:
    rng = np.random.default_rng(5)
    cloud, normals = (part.astype(np.float32) for part in room(rng))
    points = room(rng)[0] + shift
    assert agree_across(points, cloud, normals, np.array([0.0, 1.0, 0.0])) == agree


def test_a_floor_alone_does_not_tell_where_on_its_wall_a_board_hangs() -> None:
    rng = np.random.default_rng(5)
    cloud, normals = (part.astype(np.float32) for part in room(rng))
    rows = normals[:, 0] < 0.5
    points, own = room(rng)
    assert not agree_across(points[own[:, 0] < 0.5], cloud[rows], normals[rows], np.array([0.0, 1.0, 0.0]))


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
