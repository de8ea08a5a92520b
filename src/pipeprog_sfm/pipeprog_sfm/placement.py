"""Target boards placed in the model: from images of known pose, each by a similarity of its own.

The model is what structure from motion gives: right up to a similarity. Lengths in the model's unit end in nothing,
metric ones in `_m`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from pipeprog_camera.camera import Camera
from pipeprog_sfm.board import Board, BoardObservation, identify_predicted, layouts, symmetries
from pipeprog_sfm.config import BoardConfig
from pipeprog_sfm.conic import FloatArray, circle_centre_images
from pipeprog_sfm.ellipse import TargetEllipses

# Errors as expected before any residual is seen, and how many residuals that knowledge is worth: of a centre from
# fitted edges, and of a pose, in px at the board (its tie points, some 0.3 px each, are many).
PRIOR_CENTRE = 0.03
PRIOR_POSE = 0.1
PRIOR_WEIGHT = 4.0

LEAST_SINE = np.sin(np.deg2rad(1.0))  # of the angle between two rays that give a point
PARTNERS = 6  # images that each image is paired with, near to far, to place a board
CAUCHY = 2.385  # 95 % efficiency for normal errors
CAUCHY_SQUARE = 0.630  # mean of weight times squared residual, of normal errors in two dimensions, over that without
LARGEST_SIGMA = 0.01  # relative; a scale known worse than that is not published
CONTRADICTION = 1e-4  # probability with which a sound board is taken for one that contradicts its file


@dataclass(frozen=True)
class BoardPlacement:
    """One board at one place of the model.

    Attributes:
        board: name of the board.
        scale: metres per model unit by this board alone.
        sigma: relative standard deviation of `scale`, from the images alone.
        ratio_scale: the same by the paper's Eq. 2, the ratio of the spreads of given and triangulated centres.
        model_from_board: (4, 4) similarity; takes metres to model units.
        views: stamps of the images used [ns].
        residuals_m: (N, 3) triangulated minus given centres in the board's frame, m; NaN for circles never seen twice.
        residual_sigmas_m: (N, 3) their standard deviations, m.
        residuals_px: (N,) root mean square reprojection error of each circle, px; NaN as above.
    """

    board: str
    scale: float
    sigma: float
    ratio_scale: float
    model_from_board: FloatArray
    views: tuple[int, ...]
    residuals_m: FloatArray
    residual_sigmas_m: FloatArray
    residuals_px: FloatArray


@dataclass(frozen=True)
class _View:
    stamp: int
    seen: BoardObservation


@dataclass(frozen=True)
class _Rows:
    """One row for each circle in each image: pixels, what made them, and the image's camera."""

    pixels: FloatArray  # (M, 2)
    circles: NDArray[np.intp]  # (M,)
    groups: NDArray[np.intp]  # (M,) index of the image
    rotations: FloatArray  # (M, 3, 3)
    translations: FloatArray  # (M, 3)

    def take(self, chosen: NDArray[np.bool_]) -> _Rows:
        return _Rows(*(value[chosen] for value in vars(self).values()))


@dataclass(frozen=True)
class PlacedBoard:
    """A board at one place of the model.

    Attributes:
        board: the board.
        views: images of it.
        placement: (4, 4) model_from_board, a similarity.
        sigma: relative standard deviation of `scale`, from the scatter of the images.
        centre_sigma: standard deviation of a circle's centre, px.
        pose_sigma: what the poses add to that from image to image, px at the board.
    """

    board: Board
    views: tuple[_View, ...]
    placement: FloatArray
    sigma: float
    centre_sigma: float
    pose_sigma: float

    @property
    def scale(self) -> float:
        """Metres per model unit."""
        return 1.0 / float(np.cbrt(np.linalg.det(self.placement[:3, :3])))

    def turned(self) -> PlacedBoard:
        """The same, turned by 180 degrees in the board's plane about the middle of its circles."""
        turn = np.diag([-1.0, -1.0, 1.0, 1.0])
        turn[:3, 3] = 2 * self.board.centres.mean(0)
        return replace(self, placement=self.placement @ turn)


@dataclass(frozen=True)
class Sensitivity:
    """What a placement inherits.

    Attributes:
        covariance: (7, 7) of turn, shift and logarithm of size about the board's middle, model units, from the images.
        derivatives: (7, 6) of these by each pose, turned and shifted from the left, by stamp.
    """

    covariance: FloatArray
    derivatives: Mapping[int, FloatArray]


def place_boards(
    observations: Mapping[int, Sequence[BoardObservation]],
    poses: Mapping[int, FloatArray],
    camera: Camera,
    boards: Sequence[Board],
    config: BoardConfig,
    ellipses: Mapping[int, TargetEllipses] | None,
) -> list[PlacedBoard]:
    """Every board at every place where images of known pose agree on it, in the order in which they were seen.

    For every layout of boards a pair of images places it in the model, the other images vote, and the winner is
    adjusted on all of them with robust weights; what is left over may be another board, or the same one elsewhere.
    """
    placed: list[PlacedBoard] = []
    for group in layouts(boards):
        views = [_View(stamp, found) for stamp, seen in sorted(observations.items()) for found in seen]
        views = [view for view in views if view.stamp in poses and view.seen.board == group[0].name]
        places = _places(views, poses, camera, group[0], config, ellipses)
        for number, place in enumerate(sorted(places, key=lambda place: place.views[0].stamp)):
            placed.append(replace(place, board=group[min(number, len(group) - 1)]))
    order = {board.name: number for number, board in enumerate(boards)}
    return sorted(placed, key=lambda place: (place.views[0].stamp, order[place.board.name]))


def sensitivity(
    place: PlacedBoard, poses: Mapping[int, FloatArray], camera: Camera, config: BoardConfig
) -> Sensitivity:
    """How a placement errs with its images and with the poses, at the minimum of its weighted squares."""
    rows = _rows(place.views, poses, _pixels(place.views, place.placement, poses, camera, config))
    residuals, jacobian = _similarity_rows(rows, place.placement, place.board, camera)
    noise = _noise(jacobian[:, :, 3:6], rows.groups, place.centre_sigma, place.pose_sigma)
    root = np.sqrt(_cauchy(noise.whitened(residuals[..., None])[..., 0]))[:, None, None]
    points = (place.board.centres @ place.placement[:3, :3].T + place.placement[:3, 3])[rows.circles]
    by_shift = _project(rows, points, camera)[1] @ rows.rotations.transpose(0, 2, 1)
    by_turn = by_shift @ -cross_matrices(np.einsum("nij,nj->ni", rows.rotations, points))
    white = noise.whitened(jacobian) * root
    by_pose = noise.whitened(np.concatenate([by_turn, by_shift], axis=-1)) * root
    flat = white.reshape(-1, 7)
    covariance = np.linalg.pinv(flat.T @ flat)
    products = np.zeros((len(place.views), 7, 6))
    np.add.at(products, rows.groups, white.transpose(0, 2, 1) @ by_pose)
    derivatives = -covariance @ products
    stamps = [view.stamp for view in place.views]
    return Sensitivity(covariance, dict(zip(stamps, derivatives, strict=True)))


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """(N, 3, 3) matrices whose product with b is the cross product of (N, 3) vectors with b."""
    matrices = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    matrices[:, 0, 1], matrices[:, 0, 2], matrices[:, 1, 2] = -z, y, -x
    matrices[:, 1, 0], matrices[:, 2, 0], matrices[:, 2, 1] = z, -y, x
    return matrices


def _places(
    views: list[_View],
    poses: Mapping[int, FloatArray],
    camera: Camera,
    board: Board,
    config: BoardConfig,
    ellipses: Mapping[int, TargetEllipses] | None,
) -> list[PlacedBoard]:
    """Places of one layout in the model, each adjusted."""
    places: list[PlacedBoard] = []
    while len(views) >= 2:
        start, members = _consensus(views, poses, camera, board)
        # Two images agree on almost anything: one place may rest on them, further ones need more.
        if len(members) < (3 if places else 2):
            break
        chosen = [views[index] for index in members]
        place = _adjusted(board, chosen, start, poses, camera, config)
        if ellipses is not None:
            place = _completed(place, poses, camera, config, ellipses)
        taken = {(view.stamp, *centre) for view in place.views for centre in view.seen.ellipse_centres}
        left = [view for index, view in enumerate(views) if index not in members]
        views = [view for view in left if not any((view.stamp, *xy) in taken for xy in view.seen.ellipse_centres)]
        if place.sigma <= LARGEST_SIGMA and (not places or abs(place.scale / places[0].scale - 1) < 0.05):
            places.append(place)
    return places


def _completed(
    place: PlacedBoard,
    poses: Mapping[int, FloatArray],
    camera: Camera,
    config: BoardConfig,
    ellipses: Mapping[int, TargetEllipses],
) -> PlacedBoard:
    """The place adjusted on every image in which a circle of the board is where it must be."""
    views = []
    for stamp in sorted(stamp for stamp in ellipses if stamp in poses):
        camera_from_board = _metric(poses[stamp] @ place.placement, place.scale)
        found = identify_predicted(ellipses[stamp], place.board, camera, camera_from_board)
        if found is not None:
            views.append(_View(stamp, found))
    return _adjusted(place.board, views, place.placement, poses, camera, config) if len(views) >= 2 else place


def place_circle(
    board: Board,
    start: FloatArray,
    poses: Mapping[int, FloatArray],
    camera: Camera,
    config: BoardConfig,
    ellipses: Mapping[int, TargetEllipses],
) -> PlacedBoard:
    """A board of one circle, of which a place is known already, adjusted on every image that shows it.

    One circle fixes neither the turn in its plane nor the size of the model: these stay as `start` (4, 4) has them.
    """
    return _completed(PlacedBoard(board, (), start, 0.0, PRIOR_CENTRE, PRIOR_POSE), poses, camera, config, ellipses)


def _metric(camera_from_board: FloatArray, scale: float) -> FloatArray:
    """Camera from board with both in metres, from the product of a pose and a similarity."""
    metric = camera_from_board.copy()
    metric[:3] *= scale
    return metric


def _consensus(
    views: list[_View], poses: Mapping[int, FloatArray], camera: Camera, board: Board
) -> tuple[FloatArray, list[int]]:
    """The similarity model_from_board of the pair of images with which most others agree, and who agrees.

    Views of a board that looks the same upside down are turned to agree before they are counted (in place).
    """
    orders = symmetries(board)
    rows = _rows(views, poses, [view.seen.centres for view in views])
    centres = np.array([-poses[view.stamp][:3, :3].T @ poses[view.stamp][:3, 3] for view in views])
    limits = np.array([_agreement(view, camera, board) for view in views])[rows.groups]
    best, best_score = np.eye(4), (0, 0.0)
    best_inliers: NDArray[np.bool_] = np.zeros((len(orders), len(views)), bool)
    for first in np.unique(np.linspace(0, len(views) - 1, 40).astype(int)):
        # The far ones triangulate best, but may see an equal board elsewhere: the near ones see the same.
        by_distance = np.argsort(np.linalg.norm(centres - centres[first], axis=1), kind="stable")[1:]
        partners = by_distance[np.unique(np.linspace(0, len(by_distance) - 1, PARTNERS).astype(int))]
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


def _agreement(view: _View, camera: Camera, board: Board) -> float:
    """Reprojection error in px up to which an image agrees: a tenth of the radius, and never less than poses err."""
    depth = view.seen.camera_from_board[2, 3]
    return max(3.0, 0.1 * camera.fx * board.circle_radius / depth)


def _all_in_group(good: NDArray[np.bool_], groups: NDArray[np.intp], count: int) -> NDArray[np.bool_]:
    return np.bincount(groups, ~good, count) == 0


def _rows(views: Sequence[_View], poses: Mapping[int, FloatArray], pixels: Sequence[FloatArray]) -> _Rows:
    groups = np.concatenate([np.full(len(view.seen.indices), index) for index, view in enumerate(views)])
    stack = np.array([poses[view.stamp] for view in views])[groups]
    circles = np.concatenate([view.seen.indices for view in views])
    return _Rows(np.concatenate(pixels), circles, groups, stack[:, :3, :3], stack[:, :3, 3])


def _from_pair(
    rows: _Rows, first: int, second: int, order: NDArray[np.intp], camera: Camera, board: Board
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
    if sines.min() < LEAST_SINE or depths.min() <= 0:
        return None
    return similarity(board.centres[common], points)


def midpoints(
    origins_a: FloatArray, rays_a: FloatArray, origins_b: FloatArray, rays_b: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points (..., 3) halfway between rays from two places, with their depths (2, ...) and the rays' sine (...).

    Args:
        origins_a: (..., 3) places of the first camera.
        rays_a: (..., 3) unit directions.
        origins_b: (..., 3) places of the second camera.
        rays_b: (..., 3) unit directions.
    """
    cosine = (rays_a * rays_b).sum(-1)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    gap = origins_b - origins_a
    along_a, along_b = (rays_a * gap).sum(-1), (rays_b * gap).sum(-1)
    depths = np.stack([(along_a - cosine * along_b) / sine2, (cosine * along_a - along_b) / sine2])
    points = 0.5 * (origins_a + depths[0][..., None] * rays_a + origins_b + depths[1][..., None] * rays_b)
    return points, depths, np.sqrt(sine2)


def similarity(source: FloatArray, target: FloatArray) -> FloatArray:
    """(4, 4) least-squares similarity target_from_source of (N, 3) points (Umeyama, 1991)."""
    mean_source, mean_target = source.mean(0), target.mean(0)
    centred = source - mean_source
    left, values, right = np.linalg.svd((target - mean_target).T @ centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    linear = (left * signs) @ right * ((values * signs).sum() / (centred**2).sum())
    transform = np.eye(4)
    transform[:3, :3] = linear
    transform[:3, 3] = mean_target - linear @ mean_source
    return transform


def _project(rows: _Rows, points: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Pixels (M, 2) of model points (M, 3), and derivatives (M, 2, 3) by the points."""
    x, y, z = (np.einsum("nij,nj->ni", rows.rotations, points) + rows.translations).T
    z = np.where(z > 1e-9, z, 1e-9)
    zero = np.zeros_like(z)
    by_camera = np.stack(
        [
            np.stack([camera.fx / z, zero, -camera.fx * x / z**2], -1),
            np.stack([zero, camera.fy / z, -camera.fy * y / z**2], -1),
        ],
        axis=1,
    )
    return np.c_[camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], by_camera @ rows.rotations


def _errors(rows: _Rows, placement: FloatArray, board: Board, camera: Camera, circles: NDArray[np.intp]) -> FloatArray:
    points = board.centres[circles] @ placement[:3, :3].T + placement[:3, 3]
    return np.linalg.norm(_project(rows, points, camera)[0] - rows.pixels, axis=1)


def _adjusted(
    board: Board,
    views: Sequence[_View],
    start: FloatArray,
    poses: Mapping[int, FloatArray],
    camera: Camera,
    config: BoardConfig,
) -> PlacedBoard:
    """The placement adjusted on all views: seven parameters, robust weights, two variance components.

    The residuals of one image share what an error of its pose does to them, so that five circles in one image are
    not five independent witnesses: the covariance of an image is centre^2 I + pose^2 B B^T, where B holds the
    derivatives by the camera's place, in px per px at the board.
    """
    placement, centre, pose = start, PRIOR_CENTRE, PRIOR_POSE
    for _ in range(4):
        rows = _rows(views, poses, _pixels(views, placement, poses, camera, config))
        for _ in range(6):
            residuals, jacobian = _similarity_rows(rows, placement, board, camera)
            noise = _noise(jacobian[:, :, 3:6], rows.groups, centre, pose)
            white, white_jacobian = noise.whitened(residuals[..., None])[..., 0], noise.whitened(jacobian)
            root = np.sqrt(_cauchy(white))[:, None]
            flat, target = (white_jacobian * root[..., None]).reshape(-1, 7), (white * root).ravel()
            change = np.linalg.lstsq(flat, -target, rcond=None)[0]
            placement = _turned(placement, change, board)
            if np.abs(change).max() < 1e-10:
                break
        sigma = float(np.sqrt(np.linalg.pinv(flat.T @ flat)[6, 6]))
        components = centre, pose
        centre, pose = _components(noise, target, flat)
    return PlacedBoard(board, tuple(views), placement, sigma, *components)


def _pixels(
    views: Sequence[_View],
    placement: FloatArray,
    poses: Mapping[int, FloatArray],
    camera: Camera,
    config: BoardConfig,
) -> list[FloatArray]:
    """Images of the circles' centres, freed from eccentricity with the plane of the placement."""
    if not config.eccentricity:
        return [view.seen.ellipse_centres for view in views]
    normal = placement[:3, 2] / np.linalg.norm(placement[:3, 2])
    return [circle_centre_images(view.seen.conics, camera.matrix, poses[view.stamp][:3, :3] @ normal) for view in views]


def _similarity_rows(rows: _Rows, placement: FloatArray, board: Board, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Residuals (M, 2) and derivatives (M, 2, 7) by turn, shift and logarithm of size about the board's middle."""
    middle = placement[:3, :3] @ board.centres.mean(0) + placement[:3, 3]
    arms = (board.centres @ placement[:3, :3].T + placement[:3, 3] - middle)[rows.circles]
    pixels, by_point = _project(rows, middle + arms, camera)
    by_size = by_point @ arms[..., None]
    return pixels - rows.pixels, np.concatenate([by_point @ -cross_matrices(arms), by_point, by_size], axis=-1)


def _turned(placement: FloatArray, change: FloatArray, board: Board) -> FloatArray:
    """The placement changed by the seven parameters of `_similarity_rows`."""
    centre = board.centres.mean(0)
    middle = placement[:3, :3] @ centre + placement[:3, 3]
    changed = np.eye(4)
    changed[:3, :3] = np.exp(change[6]) * Rotation.from_rotvec(change[:3]).as_matrix() @ placement[:3, :3]
    changed[:3, 3] = middle + change[3:6] - changed[:3, :3] @ centre
    return changed


@dataclass(frozen=True)
class _Noise:
    """Covariance of all rows: images are independent, centre^2 I + pose^2 B B^T each; U holds B's left directions."""

    groups: NDArray[np.intp]
    directions: FloatArray  # (M, 2, 3) U
    shares: FloatArray  # (G, 3) part of the variance along each direction that is the pose's
    centre: float
    pose: float

    def along(self, values: FloatArray) -> FloatArray:
        """(G, 3, P) components of (M, 2, P) values along the directions."""
        products = np.einsum("mik,mip->mkp", self.directions, values)
        sums = np.zeros((len(self.shares), *products.shape[1:]))
        np.add.at(sums, self.groups, products)
        return sums

    def whitened(self, values: FloatArray) -> FloatArray:
        """(M, 2, P) rows times the inverse root of the covariance."""
        shrink = self.along(values) * (np.sqrt(1.0 - self.shares) - 1.0)[..., None]
        return (values + np.einsum("mik,mkp->mip", self.directions, shrink[self.groups])) / self.centre


def _noise(by_place: FloatArray, groups: NDArray[np.intp], centre: float, pose: float) -> _Noise:
    """Noise of rows whose derivatives by the camera's place (up to sign) are (M, 2, 3)."""
    count = np.bincount(groups)
    products = np.zeros((len(count), 3, 3))
    np.add.at(products, groups, by_place.transpose(0, 2, 1) @ by_place)
    values, vectors = np.linalg.eigh(products)
    # Unit of the place: a shift of 1 px of all circles, the two larger of the three directions.
    values = np.maximum(values, 1e-12 * values[:, 2:])
    directions = by_place @ (vectors / np.sqrt(values)[:, None, :])[groups]
    variances = pose**2 * values * (count / values[:, 2])[:, None]
    # A single circle has two residuals: its third direction is nought and carries nothing.
    shares = np.where(values > 1e-9 * values[:, 2:], variances / (variances + centre**2), 0.0)
    return _Noise(groups, directions * (shares > 0)[groups][:, None, :], shares, centre, pose)


def _cauchy(residuals: FloatArray) -> FloatArray:
    """(M,) weights of whitened rows (M, 2)."""
    return 1.0 / (1.0 + (residuals**2).sum(-1) / CAUCHY**2)


def _components(noise: _Noise, residuals: FloatArray, jacobian: FloatArray) -> tuple[float, float]:
    """Standard deviations of a centre and of a pose, px, from whitened, weighted residuals (2M,) and derivatives.

    One step of restricted maximum likelihood: each residual counts for a component by its share of the variance,
    less what the seven parameters absorb of it; the mean of the posterior that starts from the priors.
    """
    covariance = np.linalg.pinv(jacobian.T @ jacobian)
    parts = noise.along(jacobian.reshape(-1, 2, 7))
    absorbed = np.einsum("gki,ij,gkj->gk", parts, covariance, parts)
    squares = noise.along(residuals.reshape(-1, 2, 1))[..., 0] ** 2
    by_pose = float((noise.shares * squares).sum())
    pose_freedom = max(float((noise.shares * (1.0 - absorbed)).sum()), 0.0)
    by_centre = float(residuals @ residuals) - by_pose
    centre_freedom = max(len(residuals) - 7 - pose_freedom, 0.0)
    found = []
    for prior, sigma, squared, freedom in (
        (PRIOR_CENTRE, noise.centre, by_centre, centre_freedom),
        (PRIOR_POSE, noise.pose, by_pose, pose_freedom),
    ):
        found.append(
            np.sqrt((PRIOR_WEIGHT * prior**2 + sigma**2 * squared / CAUCHY_SQUARE) / (PRIOR_WEIGHT - 2.0 + freedom))
        )
    return float(found[0]), float(found[1])


def measure(place: PlacedBoard, poses: Mapping[int, FloatArray], camera: Camera, config: BoardConfig) -> BoardPlacement:
    """Every circle triangulated on its own, and what it says against the file."""
    board, scale = place.board, place.scale
    rows = _rows(place.views, poses, _pixels(place.views, place.placement, poses, camera, config))
    residuals = np.full((len(board.centres), 3), np.nan)
    sigmas, pixels = residuals.copy(), residuals[:, 0].copy()
    noise = np.hypot(place.centre_sigma, place.pose_sigma)
    to_metres = place.placement[:3, :3].T * scale**2  # its transpose is the rotation over the scale
    points = np.full((len(board.centres), 3), np.nan)
    for circle in range(len(board.centres)):
        own = rows.take(rows.circles == circle)
        if len(own.pixels) < 2:
            continue
        point = place.placement[:3, :3] @ board.centres[circle] + place.placement[:3, 3]
        for _ in range(10):
            projected, jacobian = _project(own, np.broadcast_to(point, (len(own.pixels), 3)), camera)
            error = (projected - own.pixels) / noise
            weights = np.sqrt(_cauchy(error))[:, None]
            flat = (jacobian / noise * weights[..., None]).reshape(-1, 3)
            change = np.linalg.lstsq(flat, -(error * weights).ravel(), rcond=1e-9)[0]
            point = point + change
        covariance = np.linalg.pinv(flat.T @ flat)
        points[circle] = point
        residuals[circle] = to_metres @ (point - place.placement[:3, 3]) - board.centres[circle]
        sigmas[circle] = np.sqrt(np.diag(to_metres @ covariance @ to_metres.T))
        pixels[circle] = np.sqrt(np.mean(((projected - own.pixels) ** 2).sum(1)))
    known = ~np.isnan(residuals[:, 0])
    spreads = [np.linalg.norm(xyz[known] - xyz[known].mean(0)) for xyz in (board.centres, points)]
    return BoardPlacement(
        board.name,
        scale,
        place.sigma,
        float(spreads[0] / spreads[1]),
        place.placement,
        tuple(view.stamp for view in place.views),
        residuals,
        sigmas,
        pixels,
    )


def contradiction(place: PlacedBoard, measured: BoardPlacement, config: BoardConfig) -> str:
    """Why the board is refused, or an empty text: a circle off by more than its sigma and the tolerance allow."""
    variance = measured.residual_sigmas_m**2 + config.tolerance**2
    distance = (measured.residuals_m**2 / variance).sum(1)
    known = ~np.isnan(distance)
    if not (distance[known] > chi2.ppf(1 - CONTRADICTION, 3)).any():
        return ""
    offsets = 1000 * np.linalg.norm(measured.residuals_m, axis=1)
    listed = ", ".join(f"{number + 1}: {offset:.2f} mm" for number, offset in enumerate(offsets) if known[number])
    return (
        f"board {place.board.name} contradicts its file (circles off by {listed}; they should be right to "
        f"{1000 * config.tolerance:g} mm): measure its centres again, or check that it is flat and the file is its own"
    )
