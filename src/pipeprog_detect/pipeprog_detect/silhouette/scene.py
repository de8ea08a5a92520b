# SPDX-License-Identifier: Apache-2.0
"""A scene: a cylinder, its views and what may hide it; samples its apparent contour and finds limb edges there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import (
    ContourSamples,
    ViewArrays,
    contour_samples,
    parts_by_view,
)
from pipeprog_detect.silhouette.edge_support import SupportProfile, hits, support_profile
from pipeprog_detect.silhouette.light_sampling import light_across
from pipeprog_detect.silhouette.limb_edges import (
    INWARD,
    TRIAL_STEP,
    WINDOW_OF_HALF_WIDTH,
    LimbEdges,
    Profiles,
    least_cost,
    limb_edges,
)
from pipeprog_detect.silhouette.occlusion import on_contours, visible
from pipeprog_detect.types import Cylinder, View

# Length of contour [px] that makes one measurement: the mean over it averages texture, the line stays straight within.
SPACING = 12
# Where a limited number of samples is wanted, this many times as many are tried: a pipe of which others hide three
# quarters still gives half of them or more.
MOSTLY_HIDDEN = 4
# The limb model's window outside the pipe, where the next thing may begin: this width [px], and three blurs.
OUTWARD, OUTWARD_OF_BLUR = 1.5, 3.0
# Distance of the light's samples across the contour [px]: half of what an image resolves.
STEP = 0.5
# Blur of a sharp image, and the ones that are tried [px]. In squares: a pixel (0.29), linear interpolation between
# pixels (0.41) and a lens whose image of a point is about a pixel wide (0.33).
SHARP = 0.6
BLURS = np.array([0.4, 0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.45, 1.75, 2.1, 2.5])
# The blur is measured within this distance of the predicted contour [px], on about this many samples.
BLUR_REACH, BLUR_SAMPLES = 0.8, 600
# A sample shows a clear edge where the limb model leaves less than this share of what a smooth profile leaves. At least
# four such samples measure the blur of one line (a view's one side), and three lines that of the images.
CLEAR, LEAST_CLEAR, LEAST_LINES = 0.4, 4, 3
# The measured blur is rounded to steps of 2 %, a tenth of what tells it from the next one tried, so that the models of
# one pipe serve for others.
BLUR_STEP = 0.02
# Surfaces only soften an edge: of all lines' blurs the lowest tenth is that of the images.
SHARPEST = 0.1
# On a thin pipe edges count within this share of its half-width, and at least within a blur of the contour [px].
THIN_REACH, LEAST_REACH = 0.3, 0.6
# Distance from the predicted contour within which its support is counted [px].
SUPPORT_REACH = 1.5


@dataclass(frozen=True)
class Scene:
    """A cylinder in its views, what may hide it, and what is known of the views.

    Attributes:
        cylinder: as it is known so far.
        views: V keyframes.
        others: further cylinders, which may hide this one.
        basis: (2, 3) unit vectors across the axis, of which a step is made: sideways as the views see it, and away from
            them.
        view_offset: (V,) shift of the whole pipe in each view towards side 0, which an error of its pose makes [px].
        blur: of the images [px].
    """

    cylinder: Cylinder
    views: Sequence[View]
    others: Sequence[Cylinder]
    basis: FloatArray
    view_offset: FloatArray
    blur: float

    @classmethod
    def of(cls, cylinder: Cylinder, views: Sequence[View], others: Sequence[Cylinder]) -> Scene:
        """The scene of a cylinder before its contour is measured: views with true poses, sharp as far as is known."""
        basis = frame(cylinder, viewing_direction(cylinder, views))
        blur = float(np.median([SHARP if view.blur is None else view.blur for view in views]))
        return cls(cylinder, views, others, basis, np.zeros(len(views)), blur)

    def turned_to(self, cylinder: Cylinder) -> Scene:
        """The scene of another cylinder, with its basis."""
        return replace(self, cylinder=cylinder, basis=frame(cylinder, viewing_direction(cylinder, self.views)))

    def moved(self, step: FloatArray) -> Scene:
        """The scene of the cylinder after a step (5,): offsets of its start and end along the basis, and of its radius.

        All in metres, as the columns of the samples' Jacobian.
        """
        start, end = self.cylinder.start + step[0:2] @ self.basis, self.cylinder.end + step[2:4] @ self.basis
        return replace(self, cylinder=Cylinder(start, end, float(self.cylinder.radius + step[4])))

    def within(self, reach: float) -> float:
        """`reach` [px], but less on a thin pipe, whose two contour lines and highlight lie within some pixels."""
        gains = ViewArrays.of(self.views).pixels_per_metre(self.cylinder.middle)
        reach = min(reach, max(THIN_REACH * self.cylinder.radius * float(np.median(gains)), LEAST_REACH))
        return TRIAL_STEP * round(reach / TRIAL_STEP)

    def samples(self, spacing: int = SPACING, margin: float = 4.0, limit: int | None = None) -> ContourSamples:
        """Samples of the cylinder's contour, about `spacing` [px] apart, that nothing hides; `limit` at the most."""
        samples = contour_samples(self.cylinder, self.views, self.basis, spacing, margin)
        if limit is not None:
            samples = samples.thinned(MOSTLY_HIDDEN * limit)
        samples = samples.select(visible(samples, self.cylinder, self.views, self.others))
        return samples if limit is None else samples.thinned(limit)

    def visible_share(self) -> float:
        """Share (0 to 1) of the positions along the cylinder, within the images, at which nothing hides its contour."""
        samples = contour_samples(self.cylinder, self.views, self.basis, SPACING)
        along, position = samples.positions()
        seen = visible(samples, self.cylinder, self.views, self.others)
        return len(np.unique(position[seen])) / max(len(along), 1)

    def edges(self, reach: float, spacing: int = SPACING, limit: int | None = None) -> tuple[ContourSamples, LimbEdges]:
        """Visible samples, `limit` at the most, and the limb edges within `reach` [px] of them.

        The edges' offsets are from the predicted contour; they are sought about where the views' offsets put it.
        """
        samples, offsets, values = self._profiles(reach, spacing, limit)
        edges = limb_edges(values, offsets, samples.half_width, self.blur, reach)
        return samples, edges.displaced(self.shift_of(samples))

    def support(self, reach: float = SUPPORT_REACH, spacing: int = SPACING, limit: int | None = None) -> SupportProfile:
        """Support of the contour by the edges within `reach` [px] of it."""
        samples, edges = self.edges(reach, spacing, limit)
        return support_profile(samples, hits(edges, self.shift_of(samples)))

    def own_edges(
        self, reach: float, spacing: int = SPACING, limit: int | None = None
    ) -> tuple[ContourSamples, LimbEdges]:
        """The same without the samples on a contour of the others: an edge there may be either's."""
        samples, edges = self.edges(reach, spacing, limit)
        own = ~on_contours(samples, self.views, self.others)
        return samples.select(own), edges.select(own)

    def own_support(self) -> SupportProfile:
        """Support of the contour by edges that are none of the others'."""
        samples, edges = self.own_edges(SUPPORT_REACH)
        return support_profile(samples, hits(edges, self.shift_of(samples)))

    def shift_of(self, samples: ContourSamples) -> FloatArray:
        """Outward displacement (N,) [px] of samples by their views' offsets."""
        return samples.sideways() * self.view_offset[samples.view]

    def light(self, samples: ContourSamples, offsets: FloatArray, lines: int) -> NDArray[np.float32]:
        """Light (N, Q), 0 to 255, along the samples' normals at `offsets` (Q,) [px], the mean of `lines` parallels.

        Samples outside the image repeat its border.
        """
        result = np.empty((len(samples), len(offsets)), np.float32)
        for index, part in parts_by_view(samples, len(self.views)):
            view, pixel, across = self.views[index], samples.pixel[part], samples.normal[part]
            along = np.stack([-across[:, 1], across[:, 0]], axis=1)
            if view.rolled is not None:
                pixel, across, along = view.rolled.shown_beside(pixel, (across, along), samples.depth[part])
            result[part] = light_across(view.image, pixel, across, along, offsets, lines)
        return result

    def wide_profiles(self, samples: ContourSamples, furthest: float) -> Profiles:
        """The light at samples up to `furthest` [px] from them, as far as it belongs to one side of the pipe."""
        furthest = min(float(samples.half_width.max()) * WINDOW_OF_HALF_WIDTH, furthest)
        spacing = float(np.clip(np.median(samples.half_width) / 16.0, 0.25, 1.0))
        offsets = np.arange(-np.ceil(furthest / spacing) - 2, np.ceil(furthest / spacing) + 3) * spacing
        return Profiles(offsets, self.light(samples, offsets, SPACING // 2))

    def measured_blur(self) -> float:
        """The blur [px] by which the limb model explains the contour best; that of the views where it is not seen."""
        samples, offsets, values = replace(self, blur=1.0)._profiles(BLUR_REACH, SPACING, BLUR_SAMPLES)
        if not len(samples):
            return self.blur
        trials = np.arange(-BLUR_REACH, BLUR_REACH + 0.1, 0.2, dtype=float)
        tried = [least_cost(values, offsets, samples.half_width, float(blur), trials) for blur in BLURS]
        cost = np.log(np.stack([limb for limb, _ in tried]) / tried[0][1] + 1e-4)
        clear = cost.min(axis=0) < np.log(CLEAR)
        line = 2 * samples.view + samples.side
        best = []
        for one in np.unique(line[clear]):
            members = clear & (line == one)
            if members.sum() >= LEAST_CLEAR:
                best.append(_lowest(np.log(BLURS), cost[:, members].sum(axis=1)))
        if len(best) < LEAST_LINES:
            return self.blur
        return float(np.exp(BLUR_STEP * np.round(np.quantile(best, SHARPEST) / BLUR_STEP)))

    def _profiles(
        self, reach: float, spacing: int, limit: int | None
    ) -> tuple[ContourSamples, FloatArray, NDArray[np.float32]]:
        """Visible samples, offsets (Q,) [px] and light (N, Q) there, from where the views' offsets put the contour."""
        samples = self.samples(spacing, INWARD, limit)
        inward = INWARD
        if len(samples):
            inward = min(INWARD, WINDOW_OF_HALF_WIDTH * float(np.median(samples.half_width)))
        outward = OUTWARD + OUTWARD_OF_BLUR * self.blur
        first = -TRIAL_STEP * round((inward + reach) / TRIAL_STEP)  # few different ones, whose models serve again
        offsets = np.arange(first, outward + 0.5 * STEP, STEP, dtype=float)
        pixel = samples.pixel + self.shift_of(samples)[:, None] * samples.normal
        values = self.light(replace(samples, pixel=pixel), offsets, spacing)
        return samples, offsets, values


def frame(cylinder: Cylinder, towards: FloatArray) -> FloatArray:
    """Two unit vectors (2, 3) across the axis: sideways as seen along `towards`, and away from the viewer."""
    axis = cylinder.axis
    depth = towards - axis * (axis @ towards)
    norm = float(np.linalg.norm(depth))
    if norm < 1e-6:
        depth = np.eye(3)[np.argmin(np.abs(axis))]
        depth = depth - axis * (axis @ depth)
        norm = float(np.linalg.norm(depth))
    depth = depth / norm
    return np.stack([np.cross(axis, depth), depth])


def viewing_direction(cylinder: Cylinder, views: Sequence[View]) -> FloatArray:
    """Mean unit vector (3,) to the cylinder's middle from the cameras that show it; from all where none does.

    What is known worst is the distance from those that look at it: a step along another direction moves the images.
    """
    arrays = ViewArrays.of(views)
    showing = arrays.showing(cylinder.middle[None])
    directions = cylinder.middle - (arrays.centres[showing] if showing.any() else arrays.centres)
    return np.asarray((directions / np.linalg.norm(directions, axis=1)[:, None]).mean(axis=0), np.float64)


def _lowest(x: FloatArray, cost: FloatArray) -> float:
    """Where the parabola through the least of cost (T,) at x (T,) and its neighbours is lowest."""
    middle = int(np.clip(np.argmin(cost), 1, len(x) - 2))
    square, slope, _ = np.polyfit(x[middle - 1 : middle + 2], cost[middle - 1 : middle + 2], 2)
    return float(np.clip(-0.5 * slope / square, x[0], x[-1])) if square > 0 else float(x[np.argmin(cost)])
