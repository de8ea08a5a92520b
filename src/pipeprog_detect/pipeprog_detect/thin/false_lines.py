# SPDX-License-Identifier: Apache-2.0
"""Lines that look like thin pipes and are none: edges of faces, steps of the light, shadows and strips of light."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.plane_segmentation import Plane
from pipeprog_detect.refinement.axial_evidence import STEP_AT
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.silhouette.apparent_contour import ContourSamples
from pipeprog_detect.silhouette.edge_support import COMMON
from pipeprog_detect.silhouette.scene import SPACING, Scene
from pipeprog_detect.thin.depth_from_cloud import is_edge_of_face, seen_along
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.candidate_fit import CONVINCING
from pipeprog_detect.verification.measured_pipe import DECISIVE

# A step between two surfaces is one edge: beside it texture alone changes the light, on average by less than this share
# of the step. A pipe differs from what is behind it on both sides; two surfaces of which one is as bright as the pipe
# would have to agree with it to this share.
ONE_STEP = 1.0 / 8.0
# Towards the edge between two faces light falls off over some millimetres (ambient occlusion), which adds to the change
# beside the step if it goes on in the direction of the step: twice the share then. A pipe mostly differs from what lies
# on both sides in the same direction.
ONE_STAIR = 2.0 * ONE_STEP
# A step of the light all along a side is found as its edge. Where the edges decisively speak against a side, its step
# is that of a coarse texture, which happens to be brighter or darker beside the other side's edge: by 0.15 to 0.19 of
# that edge's step on 5 m of the upper edge of a wall, as two robots saw it. Twice the share then.
UNSEEN_STEP = 2.0 * ONE_STEP
# A coarse texture steps as well. A step that is an edge of a pipe is more than this many times what the texture right
# beside it steps by: both are means over few stretches, and such means of one texture differ by a half.
AS_TEXTURE = 2.0
# Positions of the contour's samples over which texture averages out while what is behind a pipe stays the same.
STRETCH = 20
# Spacing of the samples along which texture is compared [px], and number of samples (100 px) whose mean follows what is
# no texture: light that falls off, and the pipe's own shading.
TEXTURE_SPACING, SLOW = 4, 25
# Beside the contour texture is looked at behind the blur of its edge [px].
BESIDE_EDGE = 3.0
# Samples along a line that one speck of texture takes: what `SPACING` averages.
SPECK = SPACING // TEXTURE_SPACING
# Correlation of the texture of two places on one surface, half of which tells one surface from two; it is taken as no
# less than this where shadows that cross both places hide it. And standard deviations that make a difference sure.
SAME_SURFACE, SURELY = 0.5, 2.0
# Where stereo shows what is seen within this distance beside a thin pipe [m], it shows the pipe: in stretches of this
# length [m], with these numbers of points around and on it that are more than stray ones. Along less than this share of
# the length is no pipe: of 82 thin pipes of eleven generated fields the least is shown along 0.23 of its length, and
# along 0.17 of what is first found of it (of 34, with other depth maps, 0.22 and 0.17); edges at a wrong depth are
# along 0.07 at the most, pieces of them along 0.12.
AROUND, SHOWN_IN, SHOWN_AROUND, SHOWN_ON = 0.15, 0.1, 10, 2
LEAST_SHOWN = 0.12


def is_false_line(
    cylinder: Cylinder,
    fit: ContourFit | None,
    points: NDArray[np.float32],
    walls: Sequence[Plane],
    views: Sequence[View],
    others: Sequence[Cylinder],
) -> bool:
    """Whether a thin cylinder is the edge of a face in the cloud (N, 3), one step of the light, or a strip of it.

    What its `fit` shows to be round is no face's edge and no strip; a line of which one side is hardly seen is told to
    be round by what is not its own. `walls`: planes of the cloud, whose faces have no edge where they go on.
    """
    scene = Scene.of(cylinder, views, others)
    if is_one_step(scene):
        return True
    if fit is not None and fit.is_round:
        return False
    return is_edge_of_face(cylinder, points, views, walls, others) or is_strip_of_light(scene)


def is_bare(cylinder: Cylinder, points: NDArray[np.float32], centre: FloatArray) -> bool:
    """Whether the cloud (N, 3) shows what `centre` sees beside and behind a thin cylinder and hardly the cylinder.

    Its edges are another thing's then, at another depth.
    """
    count = max(round(cylinder.length / SHOWN_IN), 1)

    def shown(along: NDArray[np.floating], least: int) -> NDArray[np.bool_]:
        """The stretches (count,) in which as many points lie, of which the position (M,) [m] is given."""
        stretch = np.floor(along / cylinder.length * count).astype(np.int64)
        return np.bincount(stretch[(stretch >= 0) & (stretch < count)], minlength=count) >= least

    _, place, aside, _ = seen_along(cylinder, points, centre, (-AROUND, np.inf))
    around = shown(place[np.abs(aside) < AROUND], SHOWN_AROUND)
    low = np.minimum(cylinder.start, cylinder.end) - 2.0 * cylinder.radius
    high = np.maximum(cylinder.start, cylinder.end) + 2.0 * cylinder.radius
    near = points[((points > low) & (points < high)).all(axis=1)]
    on_it = np.linalg.norm(cylinder.from_axis(near), axis=1) < 2.0 * cylinder.radius
    own = shown(cylinder.along(near)[on_it], SHOWN_ON)
    return bool(2 * around.sum() > count and own[around].mean() < LEAST_SHOWN)


def is_one_step(scene: Scene) -> bool:
    """Whether the light steps on one side of the contour alone, of which the other side is hardly seen."""
    support = scene.support()
    odds = float(support.log_odds().sum(axis=0).min())
    # Of a short line in few views half of a side's edges are there by chance as well.
    if support.weaker_share >= CONVINCING and odds > DECISIVE:
        return False
    samples = scene.samples()
    if not np.bincount(samples.side, minlength=2).all():
        return False
    steps = _steps(scene, samples, 0.0)
    size = np.abs(steps).sum(axis=0)
    weaker, stronger = np.argsort(size)
    texture = AS_TEXTURE * np.abs(_steps(scene, samples, BESIDE_EDGE)).sum(axis=0)[weaker]
    if steps.sum(axis=0).prod() < 0.0:
        return bool(size[weaker] < max(ONE_STAIR * size[stronger], texture))
    least = UNSEEN_STEP if odds < -DECISIVE else ONE_STEP
    return bool(size[weaker] < max(least * size[stronger], texture) and odds < DECISIVE)


def _steps(scene: Scene, samples: ContourSamples, beside: float) -> FloatArray:
    """The mean step of the light `beside` the contour [px], outwards, of each stretch and side (S, 2).

    A pipe that goes on before something else may turn from darker to brighter: each stretch has steps of its own. They
    add up to those of a side.
    """
    light = scene.light(samples, STEP_AT + beside, SPACING)
    stretch = samples.positions()[1] // STRETCH
    cell, count = 2 * stretch + samples.side, 2 * (int(stretch.max()) + 1)
    sums = np.bincount(cell, light[:, 0] - light[:, 1], count).reshape(-1, 2)
    return np.asarray(sums / np.bincount(samples.side, minlength=2), np.float64)


def is_strip_of_light(scene: Scene) -> bool:
    """Whether the texture beside a thin cylinder surely goes on within it, as in a shadow or between two of them.

    A pipe hides the surface behind it: its own light has nothing to do with that of the surface. Light and shadow leave
    the texture as it is: within the strip and beside it, it agrees as it does at the same distance farther out.
    """
    samples = scene.samples(spacing=TEXTURE_SPACING)
    if not len(samples):
        return False
    within, beyond = np.zeros((2, 3)), np.zeros((2, 3))
    for view in np.unique(samples.view):
        for side in (0, 1):
            line = samples.select((samples.view == view) & (samples.side == side))
            if len(line) < SLOW:
                continue
            line = line.select(np.argsort(line.along))
            half = float(np.median(line.half_width))
            places = np.array([-half, BESIDE_EDGE, BESIDE_EDGE + half + BESIDE_EDGE])
            light = scene.light(line, np.add.outer(places, [-0.5, 0.0, 0.5]).ravel(), TEXTURE_SPACING)
            light = light.reshape(len(line), 3, 3).mean(axis=2)
            texture = light - uniform_filter1d(light, SLOW, axis=0, mode="nearest")
            inner, beside, outer = texture.T
            within[side] += inner @ beside, inner @ inner, beside @ beside
            beyond[side] += beside @ outer, beside @ beside, outer @ outer
    same = max(_correlation(beyond.sum(axis=0)), SAME_SURFACE)
    positions = len(samples.positions()[0])
    seen = len(samples) / (2.0 * positions)  # views of one position
    independent = max(positions * seen / (1.0 + COMMON * max(seen - 1.0, 0.0)) / SPECK, 1.0)
    goes_on = max(_correlation(side) for side in within)
    return bool(goes_on - 0.5 * same > SURELY / np.sqrt(independent))


def _correlation(sums: NDArray[np.float64]) -> float:
    """The correlation of two signals of which the product and the squares are summed (3,); 0 where there is none."""
    product, one, other = sums
    return float(product / np.sqrt(one * other)) if one > 0.0 and other > 0.0 else 0.0
