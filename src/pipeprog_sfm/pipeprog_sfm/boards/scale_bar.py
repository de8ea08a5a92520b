"""Round marks without a board: two discs of one size, put up a measured distance apart.

No layout tells which ellipse is which mark, so the views must: two ellipses match when the poses bring their centres
together and the cones over them share one plane conic; what a match says of the disc is then looked for in all other
views. Of the discs found so, the pair counts whose size over distance is that of the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board_file import ScaleBar
from pipeprog_sfm.boards.board_triangulation import place_circle
from pipeprog_sfm.boards.conic import circles_from_conics, conic_score
from pipeprog_sfm.boards.ellipses import ImageEllipses
from pipeprog_sfm.boards.placed_board import PlacedBoard
from pipeprog_sfm.boards.triangulation import MIN_SINE, midpoints
from pipeprog_sfm.config import BoardConfig

SAME_CONIC = 0.1  # conic score up to which two ellipses may show one disc, at the poses of a good reconstruction
EPIPOLAR_GATE = (
    3.0  # px that poses may err by at the disc, or half its small semi-axis, since its centre's image is shifted
)
SAME_SIZE = 0.1  # of a disc's radius, between views and against the file: exposure makes bright discs larger
MIN_VIEWS = 3  # two ellipses agree on a disc by chance, a third one does not
START_IMAGES, PARTNER_IMAGES = 20, 4  # images that start a match, and images near to far that each is paired with


class ScaleBarError(Exception):
    """The marks tell no scale; the text says why."""


def find_scale_bar(
    pair: ScaleBar,
    ellipses: Mapping[int, ImageEllipses],
    poses: Mapping[int, FloatArray],
    camera: Camera,
    config: BoardConfig,
) -> dict[str, PlacedBoard]:
    """The two marks in the model, by the names of `MarkPair.discs`.

    Args:
        pair: the marks.
        ellipses: ellipses of the images that belong to no board, by stamp.
        poses: (4, 4) camera_from_model by stamp.
        camera: calibration.
        config: eccentricity.

    Raises:
        MarksError: no two discs fit the pair, or more than two do.
    """
    found = _discs(pair, ellipses, poses, camera, config)
    ratio = pair.circle_radius / pair.length
    fitting = []
    for one, two in combinations(found, 2):
        gap = np.linalg.norm(one.model_from_board[:3, 3] - two.model_from_board[:3, 3])
        radii = np.array([pair.circle_radius / one.scale, pair.circle_radius / two.scale])
        if (np.abs(radii / gap / ratio - 1.0) < SAME_SIZE).all():
            fitting.append((one, two))
    if len(fitting) != 1:
        what = "no two of them have" if not fitting else f"{len(fitting)} pairs of them have"
        raise ScaleBarError(
            f"{pair.name}: {len(found)} discs were seen from {MIN_VIEWS} sides or more, and {what} the size and "
            "distance of the file: film both marks from several sides, and keep other bright discs out of view"
        )
    return {disc.name: replace(place, board=disc) for disc, place in zip(pair.discs, fitting[0], strict=True)}


def _discs(
    pair: ScaleBar,
    ellipses: Mapping[int, ImageEllipses],
    poses: Mapping[int, FloatArray],
    camera: Camera,
    config: BoardConfig,
) -> list[PlacedBoard]:
    """Discs that at least three images agree on, each as a board of one circle."""
    stamps = [stamp for stamp in sorted(ellipses) if stamp in poses and len(ellipses[stamp])]
    claimed: set[tuple[float, ...]] = set()
    found = []
    for members, start in _matches(stamps, ellipses, poses, camera, pair.circle_radius):
        if any(member in claimed for member in members):
            continue
        place = place_circle(pair.discs[0], start, poses, camera, config, ellipses)
        if len(place.views) >= MIN_VIEWS:
            claimed |= {(view.stamp, *centre) for view in place.views for centre in view.seen.ellipse_centres}
            found.append(place)
    return found


def _matches(
    stamps: Sequence[int],
    ellipses: Mapping[int, ImageEllipses],
    poses: Mapping[int, FloatArray],
    camera: Camera,
    radius: float,
) -> Iterator[tuple[list[tuple[float, ...]], FloatArray]]:
    """Pairs of ellipses that show one disc, the surest first, and the disc's (4, 4) model_from_disc."""
    if len(stamps) < MIN_VIEWS:
        return
    places = np.array([-poses[stamp][:3, :3].T @ poses[stamp][:3, 3] for stamp in stamps])
    scores, matches = [], []
    for first in np.unique(np.linspace(0, len(stamps) - 1, START_IMAGES).astype(int)):
        others = np.argsort(np.linalg.norm(places - places[first], axis=1), kind="stable")[1:]
        for second in others[np.unique(np.linspace(0, len(others) - 1, PARTNER_IMAGES).astype(int))]:
            pair = stamps[first], stamps[int(second)]
            for score, rows, start in _pair_matches(pair, ellipses, poses, camera, radius):
                scores.append(score)
                matches.append(
                    ([(stamp, *ellipses[stamp].centres[row]) for stamp, row in zip(pair, rows, strict=True)], start)
                )
    for index in np.argsort(scores, kind="stable"):
        yield matches[index]


def _pair_matches(
    stamps: tuple[int, int],
    ellipses: Mapping[int, ImageEllipses],
    poses: Mapping[int, FloatArray],
    camera: Camera,
    radius: float,
) -> Iterator[tuple[float, tuple[int, int], FloatArray]]:
    """Conic score, rows of the two ellipses and model_from_disc of what may match in two images."""
    seen = [ellipses[stamp] for stamp in stamps]
    cameras = [poses[stamp] for stamp in stamps]
    projections = [camera.matrix @ pose[:3] for pose in cameras]
    rows = np.stack(np.meshgrid(*(np.arange(len(one)) for one in seen), indexing="ij"), -1).reshape(-1, 2)
    origins = [-pose[:3, :3].T @ pose[:3, 3] for pose in cameras]
    pixels = [one.centres[rows[:, side]] for side, one in enumerate(seen)]
    rays = [_rays(pixels[side], pose, camera) for side, pose in enumerate(cameras)]
    points, depths, sines = midpoints(origins[0], rays[0], origins[1], rays[1])
    gates = [np.maximum(EPIPOLAR_GATE, 0.5 * one.axes[rows[:, side], 1]) for side, one in enumerate(seen)]
    good = (sines > MIN_SINE) & (depths.min(0) > 0)
    for projection, pixel, gate in zip(projections, pixels, gates, strict=True):
        image = points @ projection[:, :3].T + projection[:, 3]
        good &= np.linalg.norm(image[:, :2] / image[:, 2:] - pixel, axis=1) < gate
    rows, points, depths = rows[good], points[good], depths[:, good]
    if not len(rows):
        return
    conics = [one.conics[rows[:, side]] for side, one in enumerate(seen)]
    scores = conic_score(conics[0], conics[1], projections[0], projections[1], points)
    # Each ellipse may be the image of two discs of radius 1: where both views' agree is the disc's plane.
    discs = [circles_from_conics(conic, camera.matrix, 1.0) for conic in conics]
    sizes = np.stack(
        [depth / np.linalg.norm(disc[0], axis=-1).mean(1) for depth, disc in zip(depths, discs, strict=True)]
    )
    normals = [disc[1] @ pose[:3, :3] for disc, pose in zip(discs, cameras, strict=True)]
    agreement = np.einsum("nai,nbi->nab", *normals).reshape(-1, 4)
    best = agreement.argmax(1)
    each = np.arange(len(rows))
    mean = normals[0][each, best // 2] + normals[1][each, best % 2]
    for index in np.flatnonzero((scores < SAME_CONIC) & (np.abs(np.log(sizes[0] / sizes[1])) < SAME_SIZE)):
        start = np.eye(4)
        start[:3, :3] = sizes[:, index].mean() / radius * _rotation_to_normal(mean[index])
        start[:3, 3] = points[index]
        yield float(scores[index]), (int(rows[index, 0]), int(rows[index, 1])), start


def _rays(pixels: FloatArray, pose: FloatArray, camera: Camera) -> FloatArray:
    """(N, 3) unit directions in the model of the rays through (N, 2) pixels."""
    rays = np.c_[pixels, np.ones(len(pixels))] @ np.linalg.inv(camera.matrix).T @ pose[:3, :3]
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _rotation_to_normal(normal: FloatArray) -> NDArray[np.float64]:
    """(3, 3) rotation whose z axis is along `normal`."""
    z = normal / np.linalg.norm(normal)
    x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
