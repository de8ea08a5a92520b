"""Target boards, and which ellipses of an image are which circles of which board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, islice

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pipeprog_camera.camera import Camera
from pipeprog_sfm.conic import FloatArray, circle_centre_images, circles_from_conics, project_circles
from pipeprog_sfm.ellipse import PROFILES, TargetEllipses

LEAST_CIRCLES = 3  # circles that identify a board: fewer agree by chance
MAX_CANDIDATES = 400  # ellipses considered in one image: a perforated sheet must not stall the search
MAX_HYPOTHESES = 20000  # poses from pairs of ellipses, likewise
MAX_TRIALS = 200  # hypotheses looked at closely for one layout in one image
SAME_PLACE = 0.1  # of a circle's radius: circles of two layouts closer than that are the same circle


@dataclass(frozen=True)
class Board:
    """A flat dark board with bright circles.

    Attributes:
        name: unique name.
        circle_radius: radius of every circle, m.
        centres: (N, 3) float64 circle centres in the board's frame, m: z = 0, x right and y up seen from the front.
    """

    name: str
    circle_radius: float
    centres: FloatArray

    @property
    def spread(self) -> float:
        """Root of the summed squared distances of the circles from their mean, m: the lever that a scale rests on."""
        return float(np.linalg.norm(self.centres - self.centres.mean(0)))


@dataclass(frozen=True)
class BoardObservation:
    """Circles of one board in one image; pixels of the ideal pinhole camera.

    Attributes:
        board: name of the board (of the first one where several in the file have the same layout).
        indices: (K,) int, rows of Board.centres.
        centres: (K, 2) images of the circles' centres, px: the ellipses' centres freed from eccentricity.
        ellipse_centres: (K, 2) centres of the ellipses, px.
        conics: (K, 3, 3) the ellipses as conics.
        sigma: standard deviation of one coordinate of a centre, px, from the scatter of the edge points.
        camera_from_board: (4, 4) pose seen from this image alone, m.
    """

    board: str
    indices: NDArray[np.intp]
    centres: FloatArray
    ellipse_centres: FloatArray
    conics: FloatArray
    sigma: float
    camera_from_board: FloatArray


def symmetries(board: Board) -> NDArray[np.intp]:
    """(S, N) orders of the circles that a turn of the board in its plane cannot tell from the given one (row 0).

    Mirrored orders are no symmetry: a board is seen from its front.
    """
    return _turns_onto(board, board)


def _turns_onto(board: Board, other: Board) -> NDArray[np.intp]:
    """(S, N) orders `o` so that other.centres[o] is board.centres turned in the plane and shifted."""
    orders: list[NDArray[np.intp]] = []
    if len(board.centres) == len(other.centres) and abs(board.circle_radius / other.circle_radius - 1) < SAME_PLACE:
        limit = SAME_PLACE * board.circle_radius
        plane, target = (one.centres[:, :2] - one.centres[:, :2].mean(0) for one in (board, other))
        points, goals = (xy[:, 0] + 1j * xy[:, 1] for xy in (plane, target))
        anchor = np.abs(points).argmax()
        for goal in goals:
            if abs(abs(goal) - abs(points[anchor])) > limit:
                continue
            turned = points * (goal / abs(goal)) / (points[anchor] / abs(points[anchor]))
            gaps = np.abs(turned[:, None] - goals[None])
            order = gaps.argmin(1)
            if gaps.min(1).max() <= limit and len(set(order)) == len(order):
                orders.append(order)
    orders.sort(key=lambda order: int((order != np.arange(len(order))).sum()))
    return np.array(orders, dtype=np.intp).reshape(-1, len(board.centres))


def layouts(boards: Sequence[Board]) -> list[list[Board]]:
    """Boards grouped by layout: images alone cannot tell the members of one group apart."""
    groups: list[list[Board]] = []
    for board in boards:
        for group in groups:
            if len(_turns_onto(group[0], board)):
                group.append(board)
                break
        else:
            groups.append([board])
    return groups


def identify(ellipses: TargetEllipses, boards: Sequence[Board], camera: Camera) -> list[BoardObservation]:
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
    matrix, found, least = camera.matrix, [], []

    def take(board: Board, pose: FloatArray, circles: NDArray[np.intp], members: NDArray[np.intp]) -> None:
        free[members] = False
        found.append(_observation(ellipses, board, matrix, *_upright(board, pose, circles), members))

    for board in (group[0] for group in layouts(boards)):
        for circles, members in islice(_hypotheses(ellipses, free, board, matrix), MAX_TRIALS):
            if not free[members].all():
                continue
            fit = _verify(ellipses, free, board, camera, circles, members)
            if fit is None:
                continue
            if len(fit[1]) > LEAST_CIRCLES:
                take(board, *fit)
            else:
                least.append((board, fit))
    # Three circles may fit by chance: they must not take an ellipse from a board of which more is seen.
    for board, fit in least:
        if free[fit[2]].all():
            take(board, *fit)
    return found


def identify_predicted(
    ellipses: TargetEllipses, board: Board, camera: Camera, camera_from_board: FloatArray
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
    circles, members = _matches(ellipses, np.ones(len(ellipses), bool), board, camera.matrix, camera_from_board, 0.5)
    if not len(circles):
        return None
    return _observation(ellipses, board, camera.matrix, camera_from_board, circles, members)


def _observation(
    ellipses: TargetEllipses,
    board: Board,
    matrix: FloatArray,
    pose: FloatArray,
    circles: NDArray[np.intp],
    members: NDArray[np.intp],
) -> BoardObservation:
    order = np.argsort(circles)
    circles, members = circles[order], members[order]
    conics = ellipses.conics[members]
    # Two of the five parameters of an ellipse through evenly spread points: variance 2 / n of that of a point.
    sigma = float(np.sqrt(2.0 / PROFILES * np.mean(ellipses.rms[members] ** 2)))
    centres = circle_centre_images(conics, matrix, pose[:3, 2])
    return BoardObservation(board.name, circles, centres, ellipses.centres[members], conics, sigma, pose)


def _hypotheses(
    ellipses: TargetEllipses, free: NDArray[np.bool_], board: Board, matrix: FloatArray
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Circles of the board and the ellipses that a pose from a pair of ellipses explains them by; the best first."""
    members = np.flatnonzero(free)
    if len(members) < LEAST_CIRCLES:
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
        if matched[index].sum() < LEAST_CIRCLES:
            return
        circles = np.flatnonzero(matched[index])
        chosen = members[nearest[index, circles]]
        key = np.r_[circles, chosen].tobytes()
        if key not in seen and len(set(chosen)) == len(chosen):
            seen.add(key)
            yield circles, chosen


def _verify(
    ellipses: TargetEllipses,
    free: NDArray[np.bool_],
    board: Board,
    camera: Camera,
    circles: NDArray[np.intp],
    members: NDArray[np.intp],
) -> tuple[FloatArray, NDArray[np.intp], NDArray[np.intp]] | None:
    """The refined pose, its circles and their ellipses, or None where they do not form the board.

    The centres of three circles give up to four poses, and each predicts three whole ellipses: nine numbers to be
    refuted by. What survives is refined and has to fit in every circle.
    """
    matrix = camera.matrix
    triple = list(max(combinations(range(len(circles)), 3), key=lambda rows: _area(board.centres[circles[list(rows)]])))
    if _area(board.centres[circles[triple]]) < board.circle_radius**2:
        return None
    starts = _three_point_poses(board.centres[circles[triple]], ellipses.centres[members[triple]], matrix)
    misfits = [_misfit(ellipses, board, matrix, start, circles, members)[triple].max() for start in starts]
    if not misfits or min(misfits) > 4.0:
        return None
    pose = starts[int(np.argmin(misfits))]
    circles, members = _matches(ellipses, free, board, matrix, pose, 0.25)
    while len(circles) >= LEAST_CIRCLES:
        pose = _refine(ellipses, board, matrix, pose, circles, members)
        misfit = _misfit(ellipses, board, matrix, pose, circles, members)
        if misfit.max() <= 1.0:
            break
        circles, members = np.delete(circles, misfit.argmax()), np.delete(members, misfit.argmax())
    if len(circles) < LEAST_CIRCLES:
        return None
    # Circles that the image should show as well but does not: some may be hidden, not most of them.
    centres, shapes = project_circles(matrix, pose, board.centres, board.circle_radius)
    reach = np.sqrt(np.abs(shapes[:, [0, 1], [0, 1]])) + 4.0
    within = ((centres > reach) & (centres < np.array([camera.width, camera.height]) - reach)).all(1)
    return (pose, circles, members) if 2 * len(circles) > within.sum() else None


def _area(corners: FloatArray) -> float:
    """Area of a triangle (3, 3) in the plane z = 0."""
    (ax, ay), (bx, by) = corners[1, :2] - corners[0, :2], corners[2, :2] - corners[0, :2]
    return 0.5 * abs(float(ax * by - ay * bx))


def _three_point_poses(points: FloatArray, pixels: FloatArray, matrix: FloatArray) -> list[FloatArray]:
    """Poses camera_from_board that see three points in three pixels, with the board's front to the camera."""
    _, turns, shifts = cv2.solveP3P(points[:, None], pixels[:, None], matrix, None, cv2.SOLVEPNP_AP3P)
    poses = []
    for turn, shift in zip(turns, shifts, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        if np.isfinite(pose).all() and pose[:3, 2] @ pose[:3, 3] < 0 < pose[2, 3]:
            poses.append(pose)
    return poses


def _misfit(
    ellipses: TargetEllipses,
    board: Board,
    matrix: FloatArray,
    pose: FloatArray,
    circles: NDArray[np.intp],
    members: NDArray[np.intp],
) -> FloatArray:
    """(K,) how far ellipses are from what the pose predicts; up to 1 is agreement.

    Allowed are, for a centre, half a pixel or 3 % of the radius (lens, print), and for the outline one pixel or 5 %
    (exposure makes bright discs larger).
    """
    centres, shapes = project_circles(matrix, pose, board.centres[circles], board.circle_radius)
    radii = np.sqrt(np.sqrt(np.abs(np.linalg.det(shapes))))
    gaps = np.linalg.norm(centres - ellipses.centres[members], axis=1) / np.maximum(0.03 * radii, 0.5)
    bends = np.linalg.norm(shapes - ellipses.shapes[members], axis=(1, 2)) / (2 * radii)
    return np.maximum(gaps, bends / np.maximum(0.05 * radii, 1.0))


def _matches(
    ellipses: TargetEllipses,
    free: NDArray[np.bool_],
    board: Board,
    matrix: FloatArray,
    pose: FloatArray,
    gate: float,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Circles and the free ellipses within `gate` radii of where the pose puts them, one for one."""
    centres, shapes = project_circles(matrix, pose, board.centres, board.circle_radius)
    predicted = np.sqrt(np.maximum(np.linalg.eigvalsh(shapes), 1e-12))
    measured = np.sqrt(np.maximum(np.linalg.eigvalsh(ellipses.shapes), 1e-12))
    gaps = np.linalg.norm(centres[:, None] - ellipses.centres[None], axis=-1) / predicted[:, None, 1]
    sizes = np.abs(predicted[:, None] - measured[None]).max(-1)
    gaps[:, ~free] = np.inf
    gaps[sizes > np.maximum(0.2 * predicted[:, 1], 1.5)[:, None]] = np.inf
    nearest = gaps.argmin(1)
    circles = np.flatnonzero((gaps.min(1) < gate) & (gaps.argmin(0)[nearest] == np.arange(len(nearest))))
    return circles, nearest[circles]


def _refine(
    ellipses: TargetEllipses,
    board: Board,
    matrix: FloatArray,
    pose: FloatArray,
    circles: NDArray[np.intp],
    members: NDArray[np.intp],
) -> FloatArray:
    """The pose that fits the ellipses best (damped Gauss-Newton).

    Residuals are the centres, to 0.1 px, and the shapes, to 0.5 px: the size of a disc suffers from exposure.
    """
    centres, shapes = ellipses.centres[members], ellipses.shapes[members]
    size = 2 * np.sqrt(np.sqrt(np.abs(np.linalg.det(shapes))))[:, None]

    def residuals(candidate: FloatArray) -> FloatArray:
        centre, shape = project_circles(matrix, candidate, board.centres[circles], board.circle_radius)
        bend = (shape - shapes)[:, [0, 1, 0], [0, 1, 1]] / size
        return np.concatenate([(centre - centres) / 0.1, bend / 0.5], axis=1).ravel()

    steps = np.full(6, 1e-6)
    steps[3:] *= np.linalg.norm(pose[:3, 3])
    current = residuals(pose)
    damping = 1e-3
    for _ in range(20):
        jacobian = np.stack([(residuals(_moved(pose, step)) - current) / step.sum() for step in np.diag(steps)], axis=1)
        normal = jacobian.T @ jacobian
        gradient = jacobian.T @ current
        change = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -gradient)
        candidate = _moved(pose, change)
        trial = residuals(candidate)
        if trial @ trial < current @ current and candidate[2, 3] > board.circle_radius:
            gain = 1.0 - (trial @ trial) / (current @ current)
            pose, current, damping = candidate, trial, damping / 10
            if gain < 1e-6:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return pose


def _moved(pose: FloatArray, change: FloatArray) -> FloatArray:
    """The pose turned by the rotation vector change[:3] about the board's origin and shifted by change[3:]."""
    moved = pose.copy()
    moved[:3, :3] = Rotation.from_rotvec(change[:3]).as_matrix() @ pose[:3, :3]
    moved[:3, 3] += change[3:]
    return moved


def _upright(board: Board, pose: FloatArray, circles: NDArray[np.intp]) -> tuple[FloatArray, NDArray[np.intp]]:
    """The pose and circle numbers among those that the board's symmetry allows with y up in the image."""
    orders = symmetries(board)
    if len(orders) == 1 or pose[1, 1] <= 0:
        return pose, circles
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    turn[:3, 3] = 2 * board.centres.mean(0)
    return pose @ turn, orders[1][circles]
