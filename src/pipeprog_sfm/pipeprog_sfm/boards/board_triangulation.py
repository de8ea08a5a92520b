"""Target boards placed in the model: from images of known pose, each by a similarity of its own.

The model is what structure from motion gives: right up to a similarity. Lengths in the model's unit end in nothing,
metric ones in `_m`.
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
from pipeprog_sfm.boards.placed_board import BoardView, CircleRows, PlacedBoard, image_rows, project_rows
from pipeprog_sfm.boards.triangulation import MIN_SINE, midpoints
from pipeprog_sfm.config import BoardConfig

PARTNER_IMAGES = 6  # images that each image is paired with, near to far, to place a board
MAX_SIGMA = 0.01  # relative; a scale known worse than that is not published


def place_boards(
    observations: Mapping[int, Sequence[BoardObservation]],
    poses: Mapping[int, FloatArray],
    camera: Camera,
    boards: Sequence[Board],
    config: BoardConfig,
    ellipses: Mapping[int, ImageEllipses] | None,
) -> list[PlacedBoard]:
    """Every board at every place where images of known pose agree on it, in the order in which they were seen.

    For every layout of boards a pair of images places it in the model, the other images vote, and the winner is
    adjusted on all of them with robust weights; what is left over may be another board, or the same one elsewhere.
    """
    placed: list[PlacedBoard] = []
    for group in layouts(boards):
        views = [BoardView(stamp, found) for stamp, seen in sorted(observations.items()) for found in seen]
        views = [view for view in views if view.stamp in poses and view.seen.board == group[0].name]
        places = _places(views, poses, camera, group[0], config, ellipses)
        for number, place in enumerate(sorted(places, key=lambda place: place.views[0].stamp)):
            placed.append(replace(place, board=group[min(number, len(group) - 1)]))
    order = {board.name: number for number, board in enumerate(boards)}
    return sorted(placed, key=lambda place: (place.views[0].stamp, order[place.board.name]))


def place_circle(
    board: Board,
    start: FloatArray,
    poses: Mapping[int, FloatArray],
    camera: Camera,
    config: BoardConfig,
    ellipses: Mapping[int, ImageEllipses],
) -> PlacedBoard:
    """A board of one circle, of which a place is known already, adjusted on every image that shows it.

    One circle fixes neither the turn in its plane nor the size of the model: these stay as `start` (4, 4) has them.
    """
    return _adjusted_on_all(
        PlacedBoard(board, (), start, 0.0, PRIOR_CENTRE, PRIOR_POSE), poses, camera, config, ellipses
    )


def _places(
    views: list[BoardView],
    poses: Mapping[int, FloatArray],
    camera: Camera,
    board: Board,
    config: BoardConfig,
    ellipses: Mapping[int, ImageEllipses] | None,
) -> list[PlacedBoard]:
    """Places of one layout in the model, each adjusted."""
    places: list[PlacedBoard] = []
    while len(views) >= 2:
        start, members = _consensus(views, poses, camera, board)
        # Two images agree on almost anything: one place may rest on them, further ones need more.
        if len(members) < (3 if places else 2):
            break
        chosen = [views[index] for index in members]
        place = adjust_board(board, chosen, start, poses, camera, config)
        if ellipses is not None:
            place = _adjusted_on_all(place, poses, camera, config, ellipses)
        taken = {(view.stamp, *centre) for view in place.views for centre in view.seen.ellipse_centres}
        left = [view for index, view in enumerate(views) if index not in members]
        views = [view for view in left if not any((view.stamp, *xy) in taken for xy in view.seen.ellipse_centres)]
        if place.sigma <= MAX_SIGMA and (not places or abs(place.scale / places[0].scale - 1) < 0.05):
            places.append(place)
    return places


def _adjusted_on_all(
    place: PlacedBoard,
    poses: Mapping[int, FloatArray],
    camera: Camera,
    config: BoardConfig,
    ellipses: Mapping[int, ImageEllipses],
) -> PlacedBoard:
    """The place adjusted on every image in which a circle of the board is where it must be."""
    views = []
    for stamp in sorted(stamp for stamp in ellipses if stamp in poses):
        camera_from_board = _metric(poses[stamp] @ place.model_from_board, place.scale)
        found = detect_predicted_board(ellipses[stamp], place.board, camera, camera_from_board)
        if found is not None:
            views.append(BoardView(stamp, found))
    return adjust_board(place.board, views, place.model_from_board, poses, camera, config) if len(views) >= 2 else place


def _metric(camera_from_board: FloatArray, scale: float) -> FloatArray:
    """Camera from board with both in metres, from the product of a pose and a similarity."""
    metric = camera_from_board.copy()
    metric[:3] *= scale
    return metric


def _consensus(
    views: list[BoardView], poses: Mapping[int, FloatArray], camera: Camera, board: Board
) -> tuple[FloatArray, list[int]]:
    """The similarity model_from_board of the pair of images with which most others agree, and who agrees.

    Views of a board that looks the same upside down are turned to agree before they are counted (in place).
    """
    orders = symmetries(board)
    rows = image_rows(views, poses, [view.seen.centres for view in views])
    centres = np.array([-poses[view.stamp][:3, :3].T @ poses[view.stamp][:3, 3] for view in views])
    limits = np.array([_agreement(view, camera, board) for view in views])[rows.groups]
    best, best_score = np.eye(4), (0, 0.0)
    best_inliers: NDArray[np.bool_] = np.zeros((len(orders), len(views)), bool)
    for first in np.unique(np.linspace(0, len(views) - 1, 40).astype(int)):
        # The far ones triangulate best, but may see an equal board elsewhere: the near ones see the same.
        by_distance = np.argsort(np.linalg.norm(centres - centres[first], axis=1), kind="stable")[1:]
        partners = by_distance[np.unique(np.linspace(0, len(by_distance) - 1, PARTNER_IMAGES).astype(int))]
        for partner, order in product(partners.tolist(), orders):
            start = _from_pair(rows, int(first), partner, order, camera, board)
            if start is None:
                continue
            errors = np.stack([_errors(rows, start, board, camera, turn[rows.circles]) for turn in orders])
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


def _agreement(view: BoardView, camera: Camera, board: Board) -> float:
    """Reprojection error in px up to which an image agrees: a tenth of the radius, and never less than poses err."""
    depth = view.seen.camera_from_board[2, 3]
    return max(3.0, 0.1 * camera.fx * board.circle_radius / depth)


def _all_in_group(good: NDArray[np.bool_], groups: NDArray[np.intp], count: int) -> NDArray[np.bool_]:
    return np.bincount(groups, ~good, count) == 0


def _from_pair(
    rows: CircleRows, first: int, second: int, order: NDArray[np.intp], camera: Camera, board: Board
) -> FloatArray | None:
    """model_from_board from the circles that two images share, or None where they do not give it."""
    one, two = rows.take(rows.groups == first), rows.take(rows.groups == second)
    common, in_one, in_two = np.intersect1d(one.circles, order[two.circles], return_indices=True)
    if first == second or len(common) < 3:
        return None
    inverse = np.linalg.inv(camera.matrix)
    rays, origins = [], []
    for part, chosen in ((one, in_one), (two, in_two)):
        rotations = part.rotations[chosen]
        ray = np.einsum("nji,nj->ni", rotations, np.c_[part.pixels[chosen], np.ones(len(chosen))] @ inverse.T)
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
        origins.append(-np.einsum("nji,nj->ni", rotations, part.translations[chosen]))
    points, depths, sines = midpoints(origins[0], rays[0], origins[1], rays[1])
    if sines.min() < MIN_SINE or depths.min() <= 0:
        return None
    return similarity(board.centres[common], points)


def _errors(
    rows: CircleRows, placement: FloatArray, board: Board, camera: Camera, circles: NDArray[np.intp]
) -> FloatArray:
    points = board.centres[circles] @ placement[:3, :3].T + placement[:3, 3]
    return np.linalg.norm(project_rows(rows, points, camera)[0] - rows.pixels, axis=1)
