# SPDX-License-Identifier: Apache-2.0
"""Boards placed in the model: a similarity each, from images whose poses are known.

The model is that of structure from motion, which is correct up to a similarity. Lengths are in the model's unit, and
in metres where a name ends in `_m`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.similarity import similarity
from pipeprog_sfm.boards.board import Board, BoardObservation, layouts, symmetries
from pipeprog_sfm.boards.board_adjustment import adjust_board
from pipeprog_sfm.boards.board_covariance import PRIOR_CENTRE, PRIOR_POSE
from pipeprog_sfm.boards.board_detection import detect_predicted_board
from pipeprog_sfm.boards.ellipses import ImageEllipses
from pipeprog_sfm.boards.placed_board import BoardView, CircleRows, PlacedBoard, PosedCamera
from pipeprog_sfm.boards.rays import MIN_SINE, midpoints

START_IMAGES = 40  # images that start a pair, spread over all: enough that some see the board well
PARTNER_IMAGES = 6  # images that each of them is paired with, near to far
MAX_SIGMA = 0.01  # relative; a board whose scale is less certain is left out, since others or the odometry know better
MAX_SCALE_GAP = 0.05  # relative, of a further place of one layout: the model drifts by less, a wrong match by more
MIN_IMAGES = 2  # for the first place of a layout
MIN_IMAGES_FURTHER = 3  # for further places: two images may agree on a wrong match by chance
# Reprojection error up to which an image agrees with a placement: the larger of 3 px, which poses may err by, and a
# tenth of a circle's radius, which is far from the next circle.
AGREEMENT_PX = 3.0
AGREEMENT_RADIUS = 0.1


def place_boards(
    observations: Mapping[int, Sequence[BoardObservation]],
    posed: PosedCamera,
    boards: Sequence[Board],
    ellipses: Mapping[int, ImageEllipses] | None,
) -> list[PlacedBoard]:
    """Every board at every place where images of known pose agree on it, in the order in which they were seen.

    For every layout of boards, pairs of images propose a placement, the other images vote, and the placement with
    most votes is adjusted on all that agree. The remaining images may show another board of the layout, or the same
    board elsewhere.

    Args:
        observations: boards detected, by image stamp [ns].
        posed: camera and poses; images without a pose are left out.
        boards: boards to look for.
        ellipses: all ellipses of the images, by stamp; None uses the observed circles alone.
    """
    placed: list[PlacedBoard] = []
    for group in layouts(boards):
        views = [BoardView(stamp, found) for stamp, seen in sorted(observations.items()) for found in seen]
        views = [view for view in views if view.stamp in posed.poses and view.seen.board == group[0].name]
        places = _places(views, posed, group[0], ellipses)
        for number, place in enumerate(sorted(places, key=lambda place: place.views[0].stamp)):
            placed.append(replace(place, board=group[min(number, len(group) - 1)]))
    order = {board.name: number for number, board in enumerate(boards)}
    return sorted(placed, key=lambda place: (place.views[0].stamp, order[place.board.name]))


def place_circle(
    board: Board, model_from_board: FloatArray, posed: PosedCamera, ellipses: Mapping[int, ImageEllipses]
) -> PlacedBoard:
    """A board of one circle, whose place is known roughly, adjusted on every image that shows it.

    One circle fixes neither the turn in its plane nor the size of the model: these stay as (4, 4) model_from_board
    has them.
    """
    start = PlacedBoard(board, (), model_from_board, 0.0, PRIOR_CENTRE, PRIOR_POSE)
    return _adjusted_on_all(start, posed, ellipses)


def _places(
    views: list[BoardView], posed: PosedCamera, board: Board, ellipses: Mapping[int, ImageEllipses] | None
) -> list[PlacedBoard]:
    """Places of one layout in the model, each adjusted."""
    places: list[PlacedBoard] = []
    while len(views) >= MIN_IMAGES:
        start, members = _consensus(views, posed, board)
        if len(members) < (MIN_IMAGES_FURTHER if places else MIN_IMAGES):
            break
        chosen = [views[index] for index in members]
        place = adjust_board(board, chosen, start, posed)
        if ellipses is not None:
            place = _adjusted_on_all(place, posed, ellipses)
        taken = {(view.stamp, *centre) for view in place.views for centre in view.seen.ellipse_centres}
        left = [view for index, view in enumerate(views) if index not in members]
        views = [view for view in left if not any((view.stamp, *xy) in taken for xy in view.seen.ellipse_centres)]
        if place.sigma <= MAX_SIGMA and (not places or abs(place.scale / places[0].scale - 1) < MAX_SCALE_GAP):
            places.append(place)
    return places


def _adjusted_on_all(place: PlacedBoard, posed: PosedCamera, ellipses: Mapping[int, ImageEllipses]) -> PlacedBoard:
    """The placed board adjusted on every image that has an ellipse where one of its circles is predicted."""
    views = []
    for stamp in sorted(stamp for stamp in ellipses if stamp in posed.poses):
        camera_from_board_m = posed.poses[stamp] @ place.model_from_board
        camera_from_board_m[:3] *= place.scale
        found = detect_predicted_board(ellipses[stamp], place.board, posed.camera, camera_from_board_m)
        if found is not None:
            views.append(BoardView(stamp, found))
    return adjust_board(place.board, views, place.model_from_board, posed) if len(views) >= MIN_IMAGES else place


def _consensus(views: list[BoardView], posed: PosedCamera, board: Board) -> tuple[FloatArray, list[int]]:
    """The similarity model_from_board of the pair of images with which most others agree, and indices of these views.

    Views of a board that looks the same upside down are turned to agree with it (in place).
    """
    orders = symmetries(board)
    rows = posed.rows_at(views, [view.seen.centres for view in views])
    limits = np.array([_agreement(view, posed.camera, board) for view in views])[rows.groups]
    sights = _sights(rows, posed.camera, len(views), len(board.centres))
    best, best_score = np.eye(4), (0, 0.0)
    best_inliers: NDArray[np.bool_] = np.zeros((len(orders), len(views)), bool)
    for (first, partner), order in product(_image_pairs(views, posed), orders):
        renumbered = np.empty_like(sights[partner])
        renumbered[order] = sights[partner]
        start = _from_pair(sights[first], renumbered, board)
        if start is None:
            continue
        points = board.centres @ start[:3, :3].T + start[:3, 3]
        errors = np.stack(
            [np.linalg.norm(posed.pixels(rows, points[turn[rows.circles]]) - rows.pixels, axis=1) for turn in orders]
        )
        inliers = np.stack([_all_in_group(error <= limits, rows.groups, len(views)) for error in errors])
        score = (int(inliers.any(0).sum()), -float(np.minimum(errors.min(0), limits).sum()))
        if score > best_score:
            best, best_inliers, best_score = start, inliers, score
    members = [int(index) for index in np.flatnonzero(best_inliers.any(0))]
    for index in members:
        turn = orders[best_inliers[:, index].argmax()]
        found = views[index].seen
        views[index] = replace(views[index], seen=replace(found, indices=turn[found.indices]))
    return best, members


def _image_pairs(views: Sequence[BoardView], posed: PosedCamera) -> list[tuple[int, int]]:
    """Pairs of images to triangulate from: distant ones are more precise, near ones see the same of several boards."""
    centres = np.array([posed.centre(view.stamp) for view in views])
    pairs = []
    for first in np.unique(np.linspace(0, len(views) - 1, START_IMAGES).astype(int)):
        by_distance = np.argsort(np.linalg.norm(centres - centres[first], axis=1), kind="stable")[1:]
        partners = by_distance[np.unique(np.linspace(0, len(by_distance) - 1, PARTNER_IMAGES).astype(int))]
        pairs += [(int(first), int(partner)) for partner in partners]
    return pairs


def _agreement(view: BoardView, camera: Camera, board: Board) -> float:
    """Reprojection error, px, up to which an image agrees with a placement."""
    depth = view.seen.camera_from_board[2, 3]
    return max(AGREEMENT_PX, AGREEMENT_RADIUS * camera.fx * board.circle_radius / depth)


def _all_in_group(good: NDArray[np.bool_], groups: NDArray[np.intp], count: int) -> NDArray[np.bool_]:
    return np.bincount(groups, ~good, count) == 0


def _sights(rows: CircleRows, camera: Camera, images: int, circles: int) -> FloatArray:
    """(I, C, 2, 3) lines of sight to the circles in the images, origin and unit direction; NaN where not seen."""
    rays = np.c_[rows.pixels, np.ones(len(rows.pixels))] @ np.linalg.inv(camera.matrix).T
    rays = np.einsum("nji,nj->ni", rows.rotations, rays)
    sights = np.full((images, circles, 2, 3), np.nan)
    sights[rows.groups, rows.circles, 0] = -np.einsum("nji,nj->ni", rows.rotations, rows.translations)
    sights[rows.groups, rows.circles, 1] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return sights


def _from_pair(one: FloatArray, two: FloatArray, board: Board) -> FloatArray | None:
    """(4, 4) model_from_board from the circles that two images share; None where fewer than three can be triangulated.

    Two views of one image, which may show several boards, have no depth between them.

    one, two: (C, 2, 3) lines of sight in each image, see `_sights`.
    """
    common = np.flatnonzero(np.isfinite(one[:, 0, 0] + two[:, 0, 0]))
    if len(common) < 3:
        return None
    points, depths, sines = midpoints(one[common, 0], one[common, 1], two[common, 0], two[common, 1])
    if sines.min() < MIN_SINE or depths.min() <= 0:
        return None
    return similarity(board.centres[common], points)
