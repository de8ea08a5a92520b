# SPDX-License-Identifier: Apache-2.0
"""Scale bars: two discs of one size, put up a measured distance apart.

Discs have no layout that tells which ellipse shows which of them, so the views decide: two ellipses match when the
poses triangulate their centres and when their cones share one plane conic; the disc of a match is then looked for in
all other views. Of the discs found, the two are the scale bar whose ratio of size to distance is that of the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.boards.board_file import ScaleBar
from pipeprog_sfm.boards.board_triangulation import place_circle
from pipeprog_sfm.boards.conic import circles_from_conics, conic_score
from pipeprog_sfm.boards.ellipses import ImageEllipses
from pipeprog_sfm.boards.placed_board import PlacedBoard, PosedCamera
from pipeprog_sfm.boards.rays import MIN_SINE, midpoints

SAME_CONIC = 0.1  # conic score up to which two ellipses may show one disc; see conic_score
# Distance, px, of the triangulated centre from the ellipses' centres: the larger of 3 px, which poses may err by, and
# half the semi-minor axis, since the centre of an ellipse is not the image of the disc's centre.
EPIPOLAR_GATE_PX = 3.0
EPIPOLAR_GATE_AXIS = 0.5
SAME_SIZE = 0.1  # of a disc's radius, between views and against the file: exposure makes bright discs larger
MIN_VIEWS = 3  # images of a disc: two ellipses may match by chance, a third one does not
START_IMAGES = 20  # images that start a match, spread over all
PARTNER_IMAGES = 4  # images that each of them is paired with, near to far


class ScaleBarError(Exception):
    """The scale bar gives no scale; the text says why."""


def find_scale_bar(
    bar: ScaleBar, ellipses: Mapping[int, ImageEllipses], posed: PosedCamera
) -> tuple[PlacedBoard, PlacedBoard]:
    """The two discs of a scale bar in the model, in the order of `ScaleBar.discs`, each a board of one circle.

    Args:
        bar: the scale bar.
        ellipses: ellipses of the images that belong to no board, by stamp.
        posed: camera and poses.

    Raises:
        ScaleBarError: no two discs fit the scale bar, or more than one pair does.
    """
    found = _discs(bar, ellipses, posed)
    ratio = bar.circle_radius / bar.length
    fitting = []
    for one, two in combinations(found, 2):
        gap = np.linalg.norm(one.model_from_board[:3, 3] - two.model_from_board[:3, 3])
        radii = np.array([bar.circle_radius / one.scale, bar.circle_radius / two.scale])
        if (np.abs(radii / gap / ratio - 1.0) < SAME_SIZE).all():
            fitting.append((one, two))
    if len(fitting) != 1:
        what = "no two of them have" if not fitting else f"{len(fitting)} pairs of them have"
        raise ScaleBarError(
            f"{bar.name}: {len(found)} discs were seen from {MIN_VIEWS} sides or more, and {what} the size and "
            "distance of the file: film both discs from several sides, and keep other bright discs out of view"
        )
    one, two = (replace(place, board=disc) for disc, place in zip(bar.discs, fitting[0], strict=True))
    return one, two


def _discs(bar: ScaleBar, ellipses: Mapping[int, ImageEllipses], posed: PosedCamera) -> list[PlacedBoard]:
    """Discs that at least three images agree on, each as a board of one circle."""
    claimed: set[tuple[float, ...]] = set()
    found = []
    for members, start in _matches(ellipses, posed, bar.circle_radius):
        if any(member in claimed for member in members):
            continue
        place = place_circle(bar.discs[0], start, posed, ellipses)
        if len(place.views) >= MIN_VIEWS:
            claimed |= {(view.stamp, *centre) for view in place.views for centre in view.seen.ellipse_centres}
            found.append(place)
    return found


def _matches(
    ellipses: Mapping[int, ImageEllipses], posed: PosedCamera, radius: float
) -> Iterator[tuple[list[tuple[float, ...]], FloatArray]]:
    """Pairs of ellipses (stamp and centre) that may show one disc, and its (4, 4) model_from_disc; best first."""
    stamps = [stamp for stamp in sorted(ellipses) if stamp in posed.poses and len(ellipses[stamp])]
    scores, matches = [], []
    for pair in _image_pairs(stamps, posed):
        for score, rows, start in _pair_matches(pair, ellipses, posed, radius):
            scores.append(score)
            matches.append(
                ([(stamp, *ellipses[stamp].centres[row]) for stamp, row in zip(pair, rows, strict=True)], start)
            )
    for index in np.argsort(scores, kind="stable"):
        yield matches[index]


def _image_pairs(stamps: Sequence[int], posed: PosedCamera) -> Iterator[tuple[int, int]]:
    """Stamps of images to look for matches in: each start image with partners from near to far."""
    if len(stamps) < MIN_VIEWS:
        return
    places = np.array([posed.centre(stamp) for stamp in stamps])
    for first in np.unique(np.linspace(0, len(stamps) - 1, START_IMAGES).astype(int)):
        others = np.argsort(np.linalg.norm(places - places[first], axis=1), kind="stable")[1:]
        for second in others[np.unique(np.linspace(0, len(others) - 1, PARTNER_IMAGES).astype(int))]:
            yield stamps[first], stamps[int(second)]


def _pair_matches(
    stamps: tuple[int, int], ellipses: Mapping[int, ImageEllipses], posed: PosedCamera, radius: float
) -> Iterator[tuple[float, tuple[int, int], FloatArray]]:
    """Conic score, rows of the two ellipses and model_from_disc of each possible match in two images."""
    matrix = posed.camera.matrix
    seen = [ellipses[stamp] for stamp in stamps]
    cameras = [posed.poses[stamp] for stamp in stamps]
    projections = [matrix @ pose[:3] for pose in cameras]
    all_rows = np.stack(np.meshgrid(*(np.arange(len(one)) for one in seen), indexing="ij"), -1).reshape(-1, 2)
    rows, points, depths = _triangulated(all_rows, seen, [posed.centre(stamp) for stamp in stamps], projections)
    if not len(rows):
        return
    conics = [one.conics[rows[:, side]] for side, one in enumerate(seen)]
    scores = conic_score(conics[0], conics[1], projections[0], projections[1], points)
    # Each ellipse may be the image of two discs of radius 1: the disc is where the normals of both views agree best.
    discs = [circles_from_conics(conic, matrix, 1.0) for conic in conics]
    sizes = np.stack(
        [depth / np.linalg.norm(disc[0], axis=-1).mean(1) for depth, disc in zip(depths, discs, strict=True)]
    )
    normals = [disc[1] @ pose[:3, :3] for disc, pose in zip(discs, cameras, strict=True)]
    best = np.einsum("nai,nbi->nab", *normals).reshape(-1, 4).argmax(1)
    each = np.arange(len(rows))
    mean = normals[0][each, best // 2] + normals[1][each, best % 2]
    for index in np.flatnonzero((scores < SAME_CONIC) & (np.abs(np.log(sizes[0] / sizes[1])) < SAME_SIZE)):
        start = np.eye(4)
        start[:3, :3] = sizes[:, index].mean() / radius * _rotation_to_normal(mean[index])
        start[:3, 3] = points[index]
        yield float(scores[index]), (int(rows[index, 0]), int(rows[index, 1])), start


def _triangulated(
    rows: NDArray[np.intp],
    seen: Sequence[ImageEllipses],
    origins: Sequence[FloatArray],
    projections: Sequence[FloatArray],
) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Those pairs (N, 2) of ellipses of two images whose rays meet; the points (N, 3) and their depths (2, N)."""
    pixels = [one.centres[rows[:, side]] for side, one in enumerate(seen)]
    rays = [_rays(pixels[side], projection) for side, projection in enumerate(projections)]
    points, depths, sines = midpoints(origins[0], rays[0], origins[1], rays[1])
    gates = [
        np.maximum(EPIPOLAR_GATE_PX, EPIPOLAR_GATE_AXIS * one.axes[rows[:, side], 1]) for side, one in enumerate(seen)
    ]
    good = (sines > MIN_SINE) & (depths.min(0) > 0)
    for projection, pixel, gate in zip(projections, pixels, gates, strict=True):
        image = points @ projection[:, :3].T + projection[:, 3]
        good &= np.linalg.norm(image[:, :2] / image[:, 2:] - pixel, axis=1) < gate
    return rows[good], points[good], depths[:, good]


def _rays(pixels: FloatArray, projection: FloatArray) -> FloatArray:
    """(N, 3) unit directions in the model of the rays through (N, 2) pixels, by the (3, 4) projection matrix."""
    rays = np.c_[pixels, np.ones(len(pixels))] @ np.linalg.inv(projection[:, :3]).T
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _rotation_to_normal(normal: FloatArray) -> NDArray[np.float64]:
    """(3, 3) rotation whose z axis is along `normal`."""
    z = normal / np.linalg.norm(normal)
    x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
