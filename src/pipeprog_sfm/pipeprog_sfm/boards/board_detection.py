"""Which ellipses of an image are which circles of which board."""

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

MAX_CANDIDATES = 400  # ellipses considered in one image: a perforated sheet must not stall the search
MAX_HYPOTHESES = 20000  # poses from pairs of ellipses, likewise
MAX_TRIALS = 200  # hypotheses looked at closely for one layout in one image


def detect_boards(ellipses: ImageEllipses, boards: Sequence[Board], camera: Camera) -> list[BoardObservation]:
    """Boards of which at least three circles are in the image, known by their own geometry.

    Each ellipse and a circle radius give a place and a normal in space; two of them whose distance and plane fit two
    circles of a board give its pose; the pose that explains the most ellipses is refined on them. Nothing is known
    of the camera's place, and clutter does not matter as long as it does not look like three circles of the board
    in metric places. Mirrored orders do not occur, since poses are proper rotations. Of the two orders of a board
    that looks the same upside down the one is reported that hangs upright in the image.

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
    # Some of the circles may fit by chance, or upside down: they must not take an ellipse from what shows more.
    for board, fit in sorted(partial, key=lambda each: -len(each[1].circles)):
        if free[fit.members].all():
            take(board, fit)
    return found


def detect_predicted_board(
    ellipses: ImageEllipses, board: Board, camera: Camera, camera_from_board: FloatArray
) -> BoardObservation | None:
    """Circles of a board whose pose is known already, or None where none of them is among the ellipses.

    An ellipse is taken for a circle when its centre lies within half a radius and its semi-axes within a fifth of
    the predicted ones: wide enough to see a board that contradicts its file, far narrower than the gaps between
    circles.

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
    fit = _matched_circles(ellipses, np.ones(len(ellipses), bool), board, camera.matrix, camera_from_board, 0.5)
    return _observation(ellipses, board, camera.matrix, fit) if len(fit.circles) else None


def _observation(ellipses: ImageEllipses, board: Board, matrix: FloatArray, fit: BoardFit) -> BoardObservation:
    order = np.argsort(fit.circles)
    circles, members = fit.circles[order], fit.members[order]
    conics = ellipses.conics[members]
    # Two of the five parameters of an ellipse through evenly spread points: variance 2 / n of that of a point.
    sigma = float(np.sqrt(2.0 / PROFILES * np.mean(ellipses.rms[members] ** 2)))
    centres = circle_centre_images(conics, matrix, fit.pose[:3, 2])
    return BoardObservation(board.name, circles, centres, ellipses.centres[members], conics, sigma, fit.pose)


def _hypotheses(
    ellipses: ImageEllipses, free: NDArray[np.bool_], board: Board, matrix: FloatArray
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Circles of the board and the ellipses that a pose from a pair of ellipses explains them by; the best first."""
    members = np.flatnonzero(free)
    if len(members) < MIN_CIRCLES:
        return
    places, normals = circles_from_conics(ellipses.conics[members], matrix, board.circle_radius)
    owners = np.repeat(members, 2)
    places, normals = places.reshape(-1, 3), normals.reshape(-1, 3)
    offsets = places[None] - places[:, None]
    lengths = np.linalg.norm(offsets, axis=-1)
    means = normals[None] + normals[:, None]
    means /= np.maximum(np.linalg.norm(means, axis=-1, keepdims=True), 1e-9)
    slopes = np.einsum("ijk,ijk->ij", offsets, means)
    # The tilt of a small ellipse is known to some ten degrees only, its distance to some percent.
    fits = (normals @ normals.T > 0.7) & (np.abs(slopes) < 0.4 * lengths) & (owners[:, None] != owners[None])
    starts, ends = np.nonzero(fits)
    lengths, offsets, means = lengths[starts, ends], offsets[starts, ends], means[starts, ends]
    poses = []
    for first, second in np.argwhere(~np.eye(len(board.centres), dtype=bool)):
        edge = board.centres[second] - board.centres[first]
        distance = np.linalg.norm(edge)
        chosen = np.flatnonzero(np.abs(lengths / distance - 1.0) < 0.15)
        along = offsets[chosen] / lengths[chosen, None]
        normal = means[chosen] - np.einsum("ij,ij->i", means[chosen], along)[:, None] * along
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        across = np.cross(normal, along)
        cosine, sine = edge[0] / distance, edge[1] / distance
        pose = np.tile(np.eye(4), (len(chosen), 1, 1))
        pose[:, :3, 0] = cosine * along - sine * across
        pose[:, :3, 1] = sine * along + cosine * across
        pose[:, :3, 2] = normal
        middle = 0.5 * (places[starts[chosen]] + places[ends[chosen]])
        pose[:, :3, 3] = middle - pose[:, :3, :3] @ (0.5 * (board.centres[first] + board.centres[second]))
        poses.append(pose)
    stack = np.concatenate(poses)
    stack = stack[:: len(stack) // MAX_HYPOTHESES + 1]
    predicted = board.centres @ stack[:, :3, :3].transpose(0, 2, 1) + stack[:, None, :3, 3]
    depths = np.maximum(predicted[..., 2], 1e-6)
    pixels = (predicted / depths[..., None]) @ matrix[:2].T
    gaps, nearest = cKDTree(ellipses.centres[members]).query(pixels.reshape(-1, 2))
    gaps, nearest = gaps.reshape(depths.shape), nearest.reshape(depths.shape)
    gate = 0.75 * matrix[0, 0] * board.circle_radius / depths
    matched = (gaps < gate) & (np.abs(places[::2, 2][nearest] / depths - 1.0) < 0.2)
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


def _verify(
    ellipses: ImageEllipses,
    free: NDArray[np.bool_],
    board: Board,
    camera: Camera,
    circles: NDArray[np.intp],
    members: NDArray[np.intp],
) -> BoardFit | None:
    """The refined pose with all that it explains, or None where circles and ellipses (K,) do not form the board.

    The centres of three circles give up to four poses, and each predicts three whole ellipses: nine numbers to be
    refuted by. What survives is refined and has to fit in every circle.
    """
    matrix = camera.matrix
    triple = list(max(combinations(range(len(circles)), 3), key=lambda rows: _area(board.centres[circles[list(rows)]])))
    if _area(board.centres[circles[triple]]) < board.circle_radius**2:
        return None
    starts = three_point_poses(board.centres[circles[triple]], ellipses.centres[members[triple]], matrix)
    fits = [BoardFit(start, circles, members) for start in starts]
    misfits = [misfit(ellipses, board, matrix, fit)[triple].max() for fit in fits]
    if not misfits or min(misfits) > 4.0:
        return None
    fit = _matched_circles(ellipses, free, board, matrix, starts[int(np.argmin(misfits))], 0.25)
    while len(fit.circles) >= MIN_CIRCLES:
        fit = refine_pose(ellipses, board, matrix, fit)
        off = misfit(ellipses, board, matrix, fit)
        if off.max() <= 1.0:
            break
        fit = fit.without(int(off.argmax()))
    if len(fit.circles) < MIN_CIRCLES:
        return None
    # Circles that the image should show as well but does not: some may be hidden, not most of them.
    centres, shapes = project_circles(matrix, fit.pose, board.centres, board.circle_radius)
    reach = np.sqrt(np.abs(shapes[:, [0, 1], [0, 1]])) + 4.0
    within = ((centres > reach) & (centres < np.array([camera.width, camera.height]) - reach)).all(1)
    return fit if 2 * len(fit.circles) > within.sum() else None


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
    """The pose with the circles that have a free ellipse within `gate` radii of where it puts them, one for one."""
    centres, shapes = project_circles(matrix, pose, board.centres, board.circle_radius)
    predicted = np.sqrt(np.maximum(np.linalg.eigvalsh(shapes), 1e-12))
    measured = np.sqrt(np.maximum(np.linalg.eigvalsh(ellipses.shapes), 1e-12))
    gaps = np.linalg.norm(centres[:, None] - ellipses.centres[None], axis=-1) / predicted[:, None, 1]
    sizes = np.abs(predicted[:, None] - measured[None]).max(-1)
    gaps[:, ~free] = np.inf
    gaps[sizes > np.maximum(0.2 * predicted[:, 1], 1.5)[:, None]] = np.inf
    nearest = gaps.argmin(1)
    circles = np.flatnonzero((gaps.min(1) < gate) & (gaps.argmin(0)[nearest] == np.arange(len(nearest))))
    return BoardFit(pose, circles, nearest[circles])


def _upright(board: Board, fit: BoardFit) -> BoardFit:
    """Of the fits that the board's symmetry allows the one with y up in the image."""
    orders = symmetries(board)
    if len(orders) == 1 or fit.pose[1, 1] <= 0:
        return fit
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    turn[:3, 3] = 2 * board.centres.mean(0)
    return replace(fit, pose=fit.pose @ turn, circles=orders[1][fit.circles])
