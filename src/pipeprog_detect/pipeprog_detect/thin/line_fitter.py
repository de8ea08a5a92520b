# SPDX-License-Identifier: Apache-2.0
"""A proposed thin pipe measured in the keyframes: its axis, depth and radius by its contour, and whether it is one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.acceptance import VAGUEST
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.product.classification import is_planned
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.refinement.contour_refinement import Start, refine
from pipeprog_detect.refinement.extension import HIDDEN, where_seen
from pipeprog_detect.silhouette.apparent_contour import ViewArrays
from pipeprog_detect.silhouette.chromaticity import DISPLACED
from pipeprog_detect.silhouette.scene import Scene, viewing_direction
from pipeprog_detect.thin.axis_sweep import Proposal
from pipeprog_detect.thin.depth_from_cloud import DEPTH_REACH, at_cloud_depth, mean_centre
from pipeprog_detect.thin.line_triangulation import DEPTH_SIGMA
from pipeprog_detect.thin.parallel_directions import LEAST_PARALLEL, NEARLY_PARALLEL, PARALLEL_SIGMA
from pipeprog_detect.threads import mapped
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.candidate_fit import CONVINCING, MANUFACTURE, REACH

# Without support by the cloud, this support of the contour is required, and half of it on each side separately: the
# edge of a duct, whose faces differ in brightness, is one side, with texture for the other.
LINES_CONVINCING = (0.6, 0.3)
# What runs parallel to known pipes has other evidence beside its contour, as a candidate of the cloud has.
PARALLEL_CONVINCING = (CONVINCING, 0.5 * CONVINCING)
# Standard deviation of the distance of a pipe found by its lines [m]: its width tells a twentieth, the cloud more.
LINE_DEPTH_SIGMA = 0.03
# Standard deviations, or radii if these are more (a contour is that far from the axis), by which the depth of a fit may
# differ from what was expected.
DEPTH_KEPT = 3.0
# Standard deviation of a slope to which a fit is held [rad]: a tenth of that of parallel pipes, so that the search
# keeps to it. From its middle the ends of six metres are then 2 mm aside: its axis is known to this [m].
DIRECTION_HELD, HELD_AXIS = 0.1 * PARALLEL_SIGMA, 2e-3


@dataclass(frozen=True)
class LineFitter:
    """Fits proposals in the views.

    Attributes:
        views: the keyframes.
        points: of the cloud (N, 3), m.
        radii: planned ones of thin pipes, m.
        boq: the bill of quantities.
        displaced: by which edges in these images are off what they are edges of [px].
    """

    views: Sequence[View]
    points: NDArray[np.float32]
    radii: Sequence[float]
    boq: BillOfQuantities
    displaced: float = 0.0

    def along_known_pipes(self, proposal: Proposal, known: Sequence[Cylinder]) -> ContourFit | None:
        """The whole of a pipe of which the direction is known; None where its contour is not seen.

        A proposal may go on along the next pipe, which lies at another depth: the part that is seen counts then, if it
        is most of the proposal, which was put at its depth.
        """
        fit = self._at_its_depth(proposal, known)
        if fit is None:
            return None
        part = where_seen(fit.cylinder, Scene.of(fit.cylinder, self.views, known).support())
        if not HIDDEN < fit.cylinder.length - part.length < 0.5 * fit.cylinder.length:
            return fit
        alone = self._parallel(part, proposal.depth_sigma, known)
        return fit if alone is None or alone.log_odds < fit.log_odds else alone

    def _at_its_depth(self, proposal: Proposal, known: Sequence[Cylinder]) -> ContourFit | None:
        """The accepted fit of a proposal, at the depth at which the views show it.

        Views from one height leave its depth open: then it is sought with the radius held, since a thicker pipe farther
        away looks the same, from where the cloud has it, too, and the most probable fit counts.
        """
        start, depth_sigma = proposal.cylinder, proposal.depth_sigma
        if depth_sigma <= DEPTH_SIGMA * start.radius:
            return self._parallel(start, depth_sigma, known)
        centre = mean_centre(start, self.views)
        at_depth = None if centre is None else at_cloud_depth(start, self.points, centre, False)
        rough = [(start, min(depth_sigma, DEPTH_REACH))] + ([] if at_depth is None else [(at_depth, LINE_DEPTH_SIGMA)])
        error = self._metres(self.displaced, start)
        starts = [
            Start(each, each.radius, True, sigma, PARALLEL_SIGMA, radius_fixed=True, radius_error=error)
            for each, sigma in rough
        ]
        located = mapped(lambda each: self._refined(each, known), starts)
        # The known direction is evidence once: the fit has drawn the axis from it as far as the views did.
        again = [
            turned(replace(fit.cylinder, radius=start.radius), start.axis, self.views)
            for fit in located
            if fit is not None
        ]
        fits = mapped(lambda each: self._parallel(each, LINE_DEPTH_SIGMA, known), again)
        seen = [fit for fit in fits if fit is not None and _keeps_depth(fit.cylinder, rough, centre)]
        return max(seen, key=lambda fit: fit.log_odds, default=None)

    def _parallel(self, start: Cylinder, depth_sigma: float, known: Sequence[Cylinder]) -> ContourFit | None:
        """The accepted fit of a pipe that is parallel to known ones.

        A shadow along it is taken for one of its sides where no planned radius results: then its own one is held.
        """
        starts = [
            Start(start, start.radius, True, depth_sigma, PARALLEL_SIGMA, radius_fixed=fixed) for fixed in (False, True)
        ]
        fits = (self._refined(each, known) for each in starts)
        good = (fit for fit in fits if fit is not None and self._accepts(fit, known, PARALLEL_CONVINCING))
        return next(good, None)

    def again(self, fit: ContourFit, known: Sequence[Cylinder]) -> ContourFit | None:
        """A fit in other images, with what these views tell of it; None where they tell that it is no planned pipe.

        Both tell its axis and radius, the more probable fit how long it is. Both sides must be seen here to tell that
        it is none: a shadow's edge is taken for a side as well, but seldom all along.
        """
        deep, slope = np.sqrt(np.diag(fit.covariance)[[1, 3]]).tolist()  # away from the views
        here = self._refined(Start(fit.cylinder, HELD_AXIS, True, deep, slope), known)
        if here is None:
            return fit
        if self._accepts(here, known, PARALLEL_CONVINCING):
            return _of_both(fit, here)
        weaker = Scene.of(here.cylinder, self.views, known).own_support().weaker_share
        # Shadows and highlights within a blur of an edge move it by about as much as mixed pixels do in colour.
        shaded = replace(here, radius_sigma=float(np.hypot(here.radius_sigma, self._metres(DISPLACED, here.cylinder))))
        return fit if self._has_planned_radius(shaded) or min(here.support, weaker) < CONVINCING else None

    def in_direction(self, start: Cylinder, known: Sequence[Cylinder]) -> list[ContourFit]:
        """The accepted fits of a whole pipe: in the direction of `start`, and, from there, near this direction."""
        held = self._refined(Start(start, start.radius, True, LINE_DEPTH_SIGMA, DIRECTION_HELD), known)
        if held is None:
            return []
        near = self._refined(Start(held.cylinder, HELD_AXIS, True, 0.0, PARALLEL_SIGMA), known)
        fits = [held] if near is None else [held, near]
        return [fit for fit in fits if self._accepts(fit, known, PARALLEL_CONVINCING)]

    def follow(self, piece: ContourFit, radius: float, known: Sequence[Cylinder]) -> ContourFit | None:
        """The whole of a pipe of the given radius [m] of which a piece was found.

        Its depth, which lines seen from one height leave open, is that of the cloud's points before the wall. Where the
        whole has no contour of a pipe, the piece stands if the cloud has it at its depth.
        """
        slope_known_to = float(np.sqrt(piece.covariance[3, 3]))
        start, slope_sigma = aligned(replace(piece.cylinder, radius=radius), known, self.views, slope_known_to)
        centre = mean_centre(start, self.views)
        at_depth = None if centre is None else at_cloud_depth(start, self.points, centre, not np.isfinite(slope_sigma))
        depth_sigma = LINE_DEPTH_SIGMA if at_depth is None else DEPTH_SIGMA * radius
        whole = self.measure(at_depth or start, known, depth_sigma, slope_sigma)
        if whole is None and at_depth and _keeps_depth(piece.cylinder, [(at_depth, LINE_DEPTH_SIGMA)], centre):
            return piece
        return whole

    def measure(
        self,
        proposed: Cylinder,
        known: Sequence[Cylinder],
        depth_sigma: float = LINE_DEPTH_SIGMA,
        slope_sigma: float = np.inf,
        follow: bool = True,
    ) -> ContourFit | None:
        """The fit where it has the contour of a pipe and a planned radius; None otherwise."""
        start = Start(proposed, proposed.radius, True, depth_sigma, slope_sigma)
        fit = self._refined(start, known, follow)
        return fit if fit is not None and self._accepts(fit, known, LINES_CONVINCING) else None

    def _refined(self, start: Start, known: Sequence[Cylinder], follow: bool = True) -> ContourFit | None:
        """`refine`, with what the edges of these images are off in the standard deviations of radius and depth.

        Where they are off otherwise from above than from below, the depth is by that over the spread of the sights.
        """
        fit = refine(start, self.views, known, self.radii, follow)
        if fit is None or not self.displaced:
            return fit
        error = self._metres(self.displaced, fit.cylinder)
        spread = max(_spread_of_sights(fit.cylinder, self.views), error / LINE_DEPTH_SIGMA)
        covariance = fit.covariance.copy()
        covariance[1, 1] += (error / spread) ** 2
        covariance[4, 4] += error**2
        return replace(fit, covariance=covariance, radius_sigma=float(np.sqrt(covariance[4, 4])))

    def _metres(self, pixels: float, cylinder: Cylinder) -> float:
        """What a length in these images [px] is at the distance of a cylinder [m]."""
        return pixels / float(np.median(ViewArrays.of(self.views).pixels_per_metre(cylinder.middle)))

    def _accepts(self, fit: ContourFit, known: Sequence[Cylinder], least: tuple[float, float]) -> bool:
        """Whether the fit has a planned radius, the contour of a pipe on both sides, and moves as a cylinder's does.

        Its radius is what tells it from the rods of hangers: it keeps to the planned one within three sigma.

        `least`: support required of the contour, and of each of its sides by edges that are no known pipe's.
        """
        return (
            fit.support >= least[0]
            and fit.radius_sigma < VAGUEST * fit.cylinder.radius
            and self._has_planned_radius(fit)
            and Scene.of(fit.cylinder, self.views, known).own_support().weaker_share >= least[1]
            and not fit.is_flat
        )

    def _has_planned_radius(self, fit: ContourFit) -> bool:
        return is_planned(fit.cylinder.radius, fit.radius_sigma, self.boq) and any(
            abs(fit.cylinder.radius - planned) < np.hypot(REACH * fit.radius_sigma, MANUFACTURE * planned)
            for planned in self.radii
        )


def _spread_of_sights(cylinder: Cylinder, views: Sequence[View]) -> float:
    """Standard deviation [rad] of the directions, around its axis, from which the views look at a cylinder.

    Of all views where none shows its middle, as `viewing_direction` has it.
    """
    arrays = ViewArrays.of(views)
    showing = arrays.showing(cylinder.middle[None])
    away = cylinder.from_axis(arrays.centres[showing] if showing.any() else arrays.centres)
    sideways = away @ _sideways(cylinder, views)
    return float(np.std(sideways / np.linalg.norm(away, axis=1)))


def _of_both(earlier: ContourFit, here: ContourFit) -> ContourFit:
    """The more probable of two fits of a pipe, on the axis of the one `here`, which began with the `earlier` one.

    Its radius is the mean of theirs by their sigmas.
    """
    weights = 1.0 / np.array([earlier.radius_sigma, here.radius_sigma]) ** 2
    radius = float(np.average([earlier.cylinder.radius, here.cylinder.radius], weights=weights))
    probable = max(earlier, here, key=lambda fit: fit.log_odds)
    axis = here.on(here.cylinder.cut_like(probable.cylinder))
    cylinder, sigma = replace(axis.cylinder, radius=radius), float(1.0 / np.sqrt(weights.sum()))
    scale = np.diag([1.0, 1.0, 1.0, 1.0, sigma / here.radius_sigma])
    covariance = scale @ axis.covariance @ scale
    return replace(probable, cylinder=cylinder, across=axis.across, covariance=covariance, radius_sigma=sigma)


def _keeps_depth(cylinder: Cylinder, expected: Sequence[tuple[Cylinder, float]], centre: FloatArray | None) -> bool:
    """Whether a cylinder is as far from `centre` as one of those expected, each with a standard deviation [m]."""
    if centre is None:
        return True
    far, *others = (
        float(np.linalg.norm(each.from_axis(centre[None]))) for each in (cylinder, *(one for one, _ in expected))
    )
    return any(
        abs(other - far) < DEPTH_KEPT * max(sigma, one.radius)
        for other, (one, sigma) in zip(others, expected, strict=True)
    )


def aligned(
    proposed: Cylinder, known: Sequence[Cylinder], views: Sequence[View], slope_known_to: float
) -> tuple[Cylinder, float]:
    """The cylinder turned parallel to the known ones of nearly its direction, and their standard deviation [rad].

    Its image stays. Seen from one height alone, a level pipe may as well slope towards the cameras: known pipes tell
    the slope, if they differ from it by less than three of its standard deviations, `slope_known_to` [rad]. With fewer
    than `LEAST_PARALLEL` of them the cylinder is returned as it is, with infinity.
    """
    across = _sideways(proposed, views)
    towards = np.cross(across, proposed.axis)
    axes = np.array([other.axis * np.sign(other.axis @ proposed.axis) for other in known]).reshape(-1, 3)
    steepest = max(np.tan(NEARLY_PARALLEL), 3.0 * slope_known_to)
    slope = np.abs(axes @ towards) / (axes @ proposed.axis)
    axes = axes[(np.abs(axes @ across) < np.sin(NEARLY_PARALLEL)) & (slope < steepest)]
    if len(axes) < LEAST_PARALLEL:
        return proposed, np.inf
    direction = np.median(axes, axis=0)
    spread = float(np.median(np.linalg.norm(axes - direction, axis=1)))
    return turned(proposed, direction, views), max(spread, PARALLEL_SIGMA)


def turned(cylinder: Cylinder, direction: FloatArray, views: Sequence[View]) -> Cylinder:
    """The cylinder turned towards the cameras or away from them until it runs along `direction` (3,); its image stays.

    Its middle and its length stay as well.
    """
    across = _sideways(cylinder, views)
    along = direction - (direction @ across) * across
    half = 0.5 * cylinder.length * along / np.linalg.norm(along)
    return Cylinder(cylinder.middle - half, cylinder.middle + half, cylinder.radius)


def _sideways(cylinder: Cylinder, views: Sequence[View]) -> FloatArray:
    """Unit vector (3,) across the axis and across the lines of sight to it."""
    across = np.cross(cylinder.axis, viewing_direction(cylinder, views))
    return np.asarray(across / np.linalg.norm(across), np.float64)
