# SPDX-License-Identifier: Apache-2.0
"""Boards in one image: which ellipse is which circle of which board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, islice

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board import MIN_CIRCLES, Board, BoardObservation, layouts, symmetries
from pipeprog_sfm.boards.board_pose import BoardFit, misfit, refine_pose, three_point_poses
from pipeprog_sfm.boards.conic import circle_centre_images, circles_from_conics, project_circles
from pipeprog_sfm.boards.ellipses import PROFILES, ImageEllipses

MAX_CANDIDATES = 400  # ellipses considered in one image, those with the least rms: bounds time on a perforated sheet
MAX_HYPOTHESES = 20000  # poses from pairs of ellipses, evenly thinned out; bounds time likewise
MAX_TRIALS = 200  # hypotheses verified for one layout in one image

# A pair of ellipses fixes a pose as well as ellipses of 4 px do. With edges known to 0.05 px their axes' ratio is known
# to 2 %, which is 11 degrees of tilt for a disc seen face on, and their depth to 1 %. Exposure enlarges a bright disc
# by up to 0.5 px, 12 %, and its depth is too small by as much.
MIN_NORMAL_COSINE = 0.7  # of the angle between two normals: 45 degrees, 3 sigma of their difference
MAX_SLOPE = (
    0.4  # of the line through two discs against their plane: 3 sigma where they are a tenth of their depth apart
)
MAX_LENGTH_ERROR = 0.15  # relative, of the distance of two discs: the 12 %, and 3 %
MAX_DEPTH_ERROR = 0.2  # relative, of a predicted circle's depth: the 12 %, and what the pair's tilt adds
HYPOTHESIS_GATE = 0.75  # of the radius, around predicted centres: less than half the distance of circles that touch
CLOSE_GATE = 0.25  # of the radius, around the centres that a verified pose predicts
PREDICTED_GATE = 0.5  # of the radius, around those of a known pose: a board that contradicts its file is still found
MAX_AXIS_ERROR = 0.2  # of the semi-major axis, of both semi-axes against the predicted ones ...
MIN_AXIS_ERROR = 1.5  # ... but never less than this, px: blur and exposure widen the image of a bright disc
# A disc that something hides a part of still makes an ellipse, whose centre is pixels off. Its edge points lie off it
# by several times as much as those of the other discs of the image, which have the same noise and blur, and by more
# than noise alone explains [px].
ROUGHER, ROUGH = 4.0, 0.2
MAX_STARTS = 4  # triangles that a pose is started from: those of a rectangle are equally large
MAX_START_MISFIT = 4.0  # of the three ellipses that start a pose, in units of the largest allowed after refinement
MARGIN = 4.0  # px from the image's edge within which a circle may be missed


def detect_boards(ellipses: ImageEllipses, boards: Sequence[Board], camera: Camera) -> list[BoardObservation]:
    """Boards of which at least three circles are in the image, identified by their geometry.

    Each ellipse and a circle radius give a place and a normal in space; two of them whose distance and plane fit two
    circles of a board give its pose; the pose that explains the most ellipses is refined on them. The camera's place
    need not be known, and clutter is harmless unless three ellipses lie like three circles of the board. Mirrored
    orders do not occur, since poses are proper rotations. Of the two orders of a board that looks the same upside
    down, the one that is upright in the image is reported.

    Args:
        ellipses: ellipses of one image.
        boards: boards to look for.
        camera: calibration.
    """
    best = np.sort(np.argsort(ellipses.rms, kind="stable")[:MAX_CANDIDATES])
    free = np.zeros(len(ellipses), bool)
    free[best] = True
    matrix, found, partial = camera.matrix, [], []

    def take(board: Board, fit: BoardFit) -> None:
        free[fit.members] = False
        found.append(_observation(ellipses, board, matrix, _upright(board, fit)))

    for board in (group[0] for group in layouts(boards)):
        for circles, members in islice(_hypotheses(ellipses, free, board, matrix), MAX_TRIALS):
            if not free[members].all():
                continue
            fit = _verify(ellipses, free, board, camera, circles, members)
            if fit is None:
                continue
            if len(fit.circles) == len(board.centres):
                take(board, fit)
            else:
                partial.append((board, fit))
    # A partial fit may be by chance or upside down: the one with most circles has the first claim on its ellipses.
    for board, fit in sorted(partial, key=lambda each: -len(each[1].circles)):
        if free[fit.members].all():
            take(board, fit)
    return found


def observed_in(
    ellipses: ImageEllipses, found: BoardObservation, before: ImageEllipses, camera: Camera
) -> BoardObservation:
    """A board that was found among ellipses of before, which have moved a little: the same circles, where they are now.

    Args:
        ellipses: the ellipses now, in the order of before.
        found: what was found before.
        before: among which it was found.
        camera: calibration.
    """
    members = (before.centres[:, None] == found.ellipse_centres[None]).all(axis=2).argmax(axis=0)
    conics = ellipses.conics[members]
    centres = circle_centre_images(conics, camera.matrix, found.camera_from_board[:3, 2])
    return replace(found, centres=centres, ellipse_centres=ellipses.centres[members], conics=conics)


def detect_predicted_board(
    ellipses: ImageEllipses, board: Board, camera: Camera, camera_from_board: FloatArray
) -> BoardObservation | None:
    """Circles of a board whose pose is known, or None where none of them is among the ellipses.

    The gates (PREDICTED_GATE, MAX_AXIS_ERROR) are wide enough for a board that contradicts its file, and far narrower
    than the gaps between circles.

    Args:
        ellipses: ellipses of one image.
        board: the board.
        camera: calibration.
        camera_from_board: (4, 4) predicted pose, m.
    """
    depths = (board.centres @ camera_from_board[:3, :3].T + camera_from_board[:3, 3])[:, 2]
    faces_camera = camera_from_board[:3, 2] @ camera_from_board[:3, 3] < 0
    if not faces_camera or depths.min() <= board.circle_radius or not len(ellipses):
        return None
    fit = _matched_circles(
        ellipses, np.ones(len(ellipses), bool), board, camera.matrix, camera_from_board, PREDICTED_GATE
    )
    return _observation(ellipses, board, camera.matrix, fit) if len(fit.circles) else None


def circles_in_image(board: Board, camera: Camera, camera_from_board: FloatArray) -> NDArray[np.bool_]:
    """Which circles (N,) of a board at the pose (4, 4) [m] are wholly in the image, by MARGIN."""
    centres, shapes = project_circles(camera.matrix, camera_from_board, board.centres, board.circle_radius)
    reach = np.sqrt(np.abs(shapes[:, [0, 1], [0, 1]])) + MARGIN
    within = (centres > reach) & (centres < np.array([camera.width, camera.height]) - reach)
    return np.asarray(within.all(axis=1))


def _observation(ellipses: ImageEllipses, board: Board, matrix: FloatArray, fit: BoardFit) -> BoardObservation:
    order = np.argsort(fit.circles)
    circles, members = fit.circles[order], fit.members[order]
    conics = ellipses.conics[members]
    # The centre of an ellipse fitted to n evenly spread points has the variance of a point times 2 / n, a coordinate.
    sigma = float(np.sqrt(2.0 / PROFILES * np.mean(ellipses.rms[members] ** 2)))
    centres = circle_centre_images(conics, matrix, fit.pose[:3, 2])
    return BoardObservation(board.name, circles, centres, ellipses.centres[members], conics, sigma, fit.pose)


def _hypotheses(
    ellipses: ImageEllipses, free: NDArray[np.bool_], board: Board, matrix: FloatArray
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Circles of the board and the ellipses that the pose of a pair of ellipses assigns to them, best first."""
    members = np.flatnonzero(free)
    if len(members) < MIN_CIRCLES:
        return
    places, normals = circles_from_conics(ellipses.conics[members], matrix, board.circle_radius)
    stack = _pair_poses(places, normals, board)
    stack = stack[:: len(stack) // MAX_HYPOTHESES + 1]
    predicted = board.centres @ stack[:, :3, :3].transpose(0, 2, 1) + stack[:, None, :3, 3]
    depths = np.maximum(predicted[..., 2], 1e-6)
    pixels = (predicted / depths[..., None]) @ matrix[:2].T
    gaps, nearest = cKDTree(ellipses.centres[members]).query(pixels.reshape(-1, 2))
    gaps, nearest = gaps.reshape(depths.shape), nearest.reshape(depths.shape)
    gate = HYPOTHESIS_GATE * matrix[0, 0] * board.circle_radius / depths
    matched = (gaps < gate) & (np.abs(places[:, 0, 2][nearest] / depths - 1.0) < MAX_DEPTH_ERROR)
    # By the number of circles; among equals, by how close they are.
    scores = matched.sum(1) - 0.5 * np.where(matched, gaps / gate, 0.0).sum(1) / np.maximum(matched.sum(1), 1)
    seen: set[bytes] = set()
    for index in np.argsort(-scores, kind="stable"):
        if matched[index].sum() < MIN_CIRCLES:
            return
        circles = np.flatnonzero(matched[index])
        chosen = members[nearest[index, circles]]
        key = np.r_[circles, chosen].tobytes()
        if key not in seen and len(set(chosen)) == len(chosen):
            seen.add(key)
            yield circles, chosen


def _pair_poses(places: FloatArray, normals: FloatArray, board: Board) -> FloatArray:
    """(H, 4, 4) poses of the board that lay two of its circles on two discs.

    Args:
        places: (E, 2, 3) centres of the two discs that each ellipse may show, in the camera's frame, m.
        normals: (E, 2, 3) their unit normals.
        board: the board.
    """
    owners = np.repeat(np.arange(len(places)), 2)
    places, normals = places.reshape(-1, 3), normals.reshape(-1, 3)
    offsets = places[None] - places[:, None]
    lengths = np.linalg.norm(offsets, axis=-1)
    means = normals[None] + normals[:, None]
    means /= np.maximum(np.linalg.norm(means, axis=-1, keepdims=True), 1e-9)
    slopes = np.abs(np.einsum("ijk,ijk->ij", offsets, means))
    fits = (normals @ normals.T > MIN_NORMAL_COSINE) & (slopes < MAX_SLOPE * lengths)
    starts, ends = np.nonzero(fits & (owners[:, None] != owners[None]))
    lengths, offsets, means = lengths[starts, ends], offsets[starts, ends], means[starts, ends]
    middles = 0.5 * (places[starts] + places[ends])
    poses = []
    for first, second in np.argwhere(~np.eye(len(board.centres), dtype=bool)):
        edge = board.centres[second] - board.centres[first]
        distance = np.linalg.norm(edge)
        chosen = np.flatnonzero(np.abs(lengths / distance - 1.0) < MAX_LENGTH_ERROR)
        along = offsets[chosen] / lengths[chosen, None]
        normal = means[chosen] - np.einsum("ij,ij->i", means[chosen], along)[:, None] * along
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        across = np.cross(normal, along)
        cosine, sine = edge[0] / distance, edge[1] / distance
        pose = np.tile(np.eye(4), (len(chosen), 1, 1))
        pose[:, :3, 0] = cosine * along - sine * across
        pose[:, :3, 1] = sine * along + cosine * across
        pose[:, :3, 2] = normal
        middle_on_board = 0.5 * (board.centres[first] + board.centres[second])
        pose[:, :3, 3] = middles[chosen] - pose[:, :3, :3] @ middle_on_board
        poses.append(pose)
    return np.concatenate(poses)


def _verify(
    ellipses: ImageEllipses,
    free: NDArray[np.bool_],
    board: Board,
    camera: Camera,
    circles: NDArray[np.intp],
    members: NDArray[np.intp],
) -> BoardFit | None:
    """The refined pose and the circles it explains, or None where circles and ellipses (K,) do not form the board.

    A pose from three circles is refined with all that it explains, and circles that do not fit are removed one by one.
    """
    matrix = camera.matrix
    fit = None
    for start in _starts(ellipses, board, matrix, circles, members):
        matched = _matched_circles(ellipses, free, board, matrix, start, CLOSE_GATE)
        if fit is None or len(matched.circles) > len(fit.circles):
            fit = matched
        if len(fit.circles) >= len(circles):
            break
    if fit is None:
        return None
    while len(fit.circles) >= MIN_CIRCLES:
        fit = refine_pose(ellipses, board, matrix, fit)
        off = misfit(ellipses, board, matrix, fit)
        if off.max() <= 1.0:
            break
        fit = fit.without(int(off.argmax()))
    if len(fit.circles) < MIN_CIRCLES:
        return None
    # Of the circles that are wholly in the image more than half must be found; the others may be hidden.
    return fit if 2 * len(fit.circles) > circles_in_image(board, camera, fit.pose).sum() else None


def _starts(
    ellipses: ImageEllipses, board: Board, matrix: FloatArray, circles: NDArray[np.intp], members: NDArray[np.intp]
) -> Iterator[FloatArray]:
    """Poses (4, 4) of the board from three of its circles each, the largest triangles first, up to one that misfits.

    The centres of three circles give up to four poses, each of which predicts the shapes of their ellipses as well:
    nine numbers to test it by. Of a board that faces the camera two poses are nearly one: noise may leave neither.
    """
    triples = sorted(combinations(range(len(circles)), 3), key=lambda rows: -_area(board.centres[circles[list(rows)]]))
    for rows in triples[:MAX_STARTS]:
        three, their = circles[list(rows)], members[list(rows)]
        if _area(board.centres[three]) < board.circle_radius**2:
            return
        starts = three_point_poses(board.centres[three], ellipses.centres[their], matrix)
        misfits = [misfit(ellipses, board, matrix, BoardFit(start, three, their)).max() for start in starts]
        if not misfits or min(misfits) > MAX_START_MISFIT:
            return
        yield starts[int(np.argmin(misfits))]


def _area(corners: FloatArray) -> float:
    """Area of a triangle (3, 3) in the plane z = 0."""
    (ax, ay), (bx, by) = corners[1, :2] - corners[0, :2], corners[2, :2] - corners[0, :2]
    return 0.5 * abs(float(ax * by - ay * bx))


def _matched_circles(
    ellipses: ImageEllipses,
    free: NDArray[np.bool_],
    board: Board,
    matrix: FloatArray,
    pose: FloatArray,
    gate: float,
) -> BoardFit:
    """The pose with the circles that have a free ellipse within `gate` radii of their predicted centre, one to one.

    Those that something hides a part of are left out.
    """
    centres, shapes = project_circles(matrix, pose, board.centres, board.circle_radius)
    if not np.isfinite(shapes).all():  # the camera is in the plane of the board
        return BoardFit(pose, np.empty(0, np.intp), np.empty(0, np.intp))
    predicted = np.sqrt(np.maximum(np.linalg.eigvalsh(shapes), 1e-12))
    measured = np.sqrt(np.maximum(np.linalg.eigvalsh(ellipses.shapes), 1e-12))
    gaps = np.linalg.norm(centres[:, None] - ellipses.centres[None], axis=-1) / predicted[:, None, 1]
    sizes = np.abs(predicted[:, None] - measured[None]).max(-1)
    gaps[:, ~free] = np.inf
    gaps[sizes > np.maximum(MAX_AXIS_ERROR * predicted[:, 1], MIN_AXIS_ERROR)[:, None]] = np.inf
    nearest = gaps.argmin(1)
    circles = np.flatnonzero((gaps.min(1) < gate) & (gaps.argmin(0)[nearest] == np.arange(len(nearest))))
    rms = ellipses.rms[nearest[circles]]
    circles = circles[rms <= max(ROUGHER * rms.min(initial=np.inf), ROUGH)]
    return BoardFit(pose, circles, nearest[circles])


def _upright(board: Board, fit: BoardFit) -> BoardFit:
    """The fit, turned where the board's symmetry allows it so that its y axis points up in the image."""
    orders = symmetries(board)
    if len(orders) == 1 or fit.pose[1, 1] <= 0:
        return fit
    return replace(fit, pose=fit.pose @ board.half_turn, circles=orders[1][fit.circles])
