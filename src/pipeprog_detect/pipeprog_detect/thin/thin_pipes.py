# SPDX-License-Identifier: Apache-2.0
"""Thin pipes of which the cloud shows too little: proposed by lines in the keyframes, put at their depth, measured."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.silhouette.apparent_contour import views_showing
from pipeprog_detect.silhouette.chromaticity import DISPLACED
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.thin.axis_sweep import SAME_LINE, propose_parallel
from pipeprog_detect.thin.corners import is_corner
from pipeprog_detect.thin.depth_from_cloud import covers, mean_centre
from pipeprog_detect.thin.false_lines import is_bare, is_false_line
from pipeprog_detect.thin.line_fitter import LineFitter, turned
from pipeprog_detect.thin.line_triangulation import propose
from pipeprog_detect.thin.longer_in_colour import longer_in_colour
from pipeprog_detect.thin.pair_views import PairView, apart, distinct_views, pair_views, seek_edges
from pipeprog_detect.thin.parallel_directions import NEARLY_PARALLEL, PARALLEL_SIGMA, parallel_directions
from pipeprog_detect.threads import beside
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification.measured_pipe import MeasuredPipe, is_known, is_stub
from pipeprog_detect.verification.scene_context import SceneContext

# Proposals that are measured, and points of the cloud that bound their depths: a computing budget. More proposals than
# a site has thin pipes cost time only.
MOST_PROPOSED, MOST_POINTS = 40, 600_000
# A line that walls and pipes would hide along more than half of its length was put at a wrong depth or slope.
MOSTLY_SEEN = 0.5
# The axes of pipes side by side are at least two radii apart.
TOUCHING = 2.0
# Their axes are known to this [m].
AXIS_SIGMA = 1e-3
# Views that tell whether two lines are one: from three heights three each.
RIVAL_VIEWS = 9


def find_thin_pipes(
    points: NDArray[np.floating],
    around: SceneContext,
    thickest: float,
    found: Sequence[MeasuredPipe],
    views: Sequence[View],
    boq: BillOfQuantities,
    edges: dict[tuple[int, int, bool], FloatArray],
) -> list[MeasuredPipe]:
    """Pipes of radius up to `thickest` [m], beside those found, that the views show and the cloud hardly does.

    They must have a planned radius and support along their contours, whose sides must move against each other from view
    to view as a cylinder's do, where the views differ enough to tell.

    Args:
        points: of the cloud (N, 3).
        around: its walls.
        thickest: largest radius [m].
        found: the pipes of the cloud.
        views: the keyframes.
        boq: the bill of quantities.
        edges: straight edges that earlier calls found, as `pair_views` has them; new ones are added.
    """
    radii = _radii(boq, thickest)
    if not views or not radii:
        return []
    known = [measured.cylinder for measured in found]
    search = _Search(points.astype(np.float32, copy=False), around, thickest, radii, boq, known.copy())
    coloured = in_colour(views)
    if coloured:
        search.along_known_pipes(coloured, distinct_views(coloured, search.some, radii), again=views)
    seen = pair_views(views, search.some, radii, search.known, edges)
    search.along_known_pipes(views, [each.view for each in seen])
    search.by_lines(views, seen)
    if coloured:
        search.by_lines(coloured, pair_views(coloured, search.some, radii, search.known, edges), again=views)
    return longer_in_colour(search.thin, thickest, coloured, known)


def seeking_edges(
    points: NDArray[np.float32],
    thickest: float,
    views: Sequence[View],
    boq: BillOfQuantities,
    edges: dict[tuple[int, int, bool], FloatArray],
) -> AbstractContextManager[None]:
    """While the block lasts another thread seeks edges that `find_thin_pipes` would; arguments as there."""
    radii = _radii(boq, thickest)
    if not views or not radii:
        return nullcontext()
    some = _some(points)
    seen = apart(views, some)
    return beside(lambda view: seek_edges(view, some, radii, edges), [*seen, *in_colour(seen)])


def _radii(boq: BillOfQuantities, thickest: float) -> list[float]:
    return [radius for radius in boq.radii if radius < thickest]


def _some(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """As many of the points (N, 3) as depths need."""
    return np.ascontiguousarray(points[:: max(-(-len(points) // MOST_POINTS), 1)])


def in_colour(views: Sequence[View]) -> list[View]:
    """The views with their colour in place of grey, of those that have one."""
    return [coloured for coloured in (view.in_colour() for view in views) if coloured is not None]


@dataclass(frozen=True)
class _Search:
    """Thin pipes, beside the `known` cylinders, which it adds to; see `find_thin_pipes`."""

    points: NDArray[np.float32]
    around: SceneContext
    thickest: float
    radii: Sequence[float]
    boq: BillOfQuantities
    known: list[Cylinder]
    thin: list[MeasuredPipe] = field(default_factory=list)

    @cached_property
    def some(self) -> NDArray[np.float32]:
        """Points of the cloud, as many as its depths need."""
        return _some(self.points)

    def along_known_pipes(self, views: Sequence[View], swept: Sequence[View], again: Sequence[View] = ()) -> None:
        """Those along the directions of the known pipes that views show, of which the `swept` ones are looked through.

        What these are certain of is measured `again` in others.
        """
        lines = self._fitter(views, DISPLACED if again else 0.0)
        proposals = propose_parallel(swept, parallel_directions(self.known), self.radii, self.known)
        before_walls = [each for each in proposals if not self._is_no_pipe(each.cylinder, views)]
        for parallel in before_walls[:MOST_PROPOSED]:
            if not self._is_taken(parallel.cylinder, views):
                self._consider(self._told(lines.along_known_pipes(parallel, self.known), again), views)

    def by_lines(self, views: Sequence[View], seen: Sequence[PairView], again: Sequence[View] = ()) -> None:
        """Those that segment pairs propose, in any direction; they are measured `again` as well."""
        lines = self._fitter(views, DISPLACED if again else 0.0)
        for proposed in propose(seen, self.some, self.radii, MOST_PROPOSED):
            if not self._is_taken(proposed, views):
                fit = lines.measure(proposed, self.known, follow=False)
                fit = None if fit is None else lines.follow(fit, proposed.radius, self.known)
                self._consider(self._told(fit, again), views)

    def _told(self, fit: ContourFit | None, again: Sequence[View]) -> ContourFit | None:
        """The fit with what other images of it tell, if there are any."""
        return fit if fit is None or not again else self._fitter(again).again(fit, self.known)

    def _fitter(self, views: Sequence[View], displaced: float = 0.0) -> LineFitter:
        return LineFitter(views, self.points, self.radii, self.boq, displaced)

    def _is_taken(self, cylinder: Cylinder, views: Sequence[View]) -> bool:
        return is_known(cylinder, self.known) or self._is_rival(cylinder, views)

    def _is_rival(self, cylinder: Cylinder, views: Sequence[View]) -> bool:
        """Whether most views show it, or most of it, where they show a thin pipe: only one can be there.

        From one height another pipe behind it may look so, too, but not from another.
        """
        most = 0.5 * cylinder.length
        thin = [each for each in self.known if each.radius < self.thickest]
        centres = [view.centre for view in views_showing(cylinder.middle[None], views, RIVAL_VIEWS)] if thin else []
        return any(
            sum(
                covers(each, cylinder, centre, SAME_LINE, 0.0) or covers(each, cylinder, centre, TOUCHING, most)
                for centre in centres
            )
            > 0.5 * len(centres)
            for each in thin
        )

    def _is_no_pipe(self, cylinder: Cylinder, views: Sequence[View]) -> bool:
        """Whether it is a line on a wall, or looks like the one in which two walls meet."""
        centre = mean_centre(cylinder, views)
        return self.around.touches_wall(cylinder) or (centre is not None and is_corner(cylinder, centre, self.around))

    def _is_missing(self, cylinder: Cylinder, views: Sequence[View]) -> bool:
        """Whether the cloud, the walls or the known pipes would show or hide it, were it there."""
        centre = mean_centre(cylinder, views)
        return (centre is not None and is_bare(cylinder, self.points, centre)) or (
            Scene.of(cylinder, views, self.known).visible_share() < MOSTLY_SEEN
        )

    def _consider(self, fit: ContourFit | None, views: Sequence[View]) -> None:
        """Takes a fit for a pipe where nothing says that it is none."""
        if fit is None:
            return
        cylinder = fit.cylinder
        if not (
            is_stub(cylinder)
            or is_shadow(cylinder, self.known)
            or self._is_taken(cylinder, views)
            or self._is_no_pipe(cylinder, views)
            or is_false_line(cylinder, fit, self.some, self.around.planes, views, self.known)
            or self._is_missing(cylinder, views)
        ):
            self.thin.append(MeasuredPipe.of_contour(_as_candidate(fit, self.points), fit))
            self.known.append(cylinder)


def turned_parallel(
    measured: Sequence[MeasuredPipe],
    points: NDArray[np.floating],
    thickest: float,
    views: Sequence[View],
    boq: BillOfQuantities,
) -> list[MeasuredPipe]:
    """The pipes; thin ones that run nearly along several others are parallel to these where that is more probable.

    Seen from one height, the image of a thin pipe fits at a wrong slope, too, and a fit that has followed it for metres
    ends in the optimum nearest to the direction of the piece that it began with.

    Args:
        measured: all pipes.
        points: of the cloud (N, 3).
        thickest: largest radius [m].
        views: the keyframes.
        boq: the bill of quantities.
    """
    radii = _radii(boq, thickest)
    if not views or not radii:
        return list(measured)
    lines = LineFitter(views, points.astype(np.float32, copy=False), radii, boq)
    cylinders = [each.cylinder for each in measured]
    turned_ones = list(measured)
    for number, each in enumerate(measured):
        others = cylinders[:number] + cylinders[number + 1 :]
        direction = _other_direction(each.cylinder, others) if each.cylinder.radius < thickest else None
        if each.fit is None or direction is None:
            continue
        radius = min(radii, key=lambda planned: abs(planned - each.cylinder.radius))
        start = turned(replace(each.cylinder, radius=radius), direction, views)
        best = max(lines.in_direction(start, others), key=lambda fit: fit.log_odds, default=each.fit)
        if best.log_odds > each.fit.log_odds:
            turned_ones[number] = MeasuredPipe.of_contour(each.candidate, best)
    return turned_ones


def _other_direction(cylinder: Cylinder, others: Sequence[Cylinder]) -> FloatArray | None:
    """The direction (3,) that several others have and the cylinder nearly has; None without one, and if it has it."""
    near = max(parallel_directions(others), key=lambda each: abs(float(each @ cylinder.axis)), default=None)
    if near is None or not np.cos(NEARLY_PARALLEL) < abs(float(near @ cylinder.axis)) < np.cos(PARALLEL_SIGMA):
        return None
    return near


def is_shadow(cylinder: Cylinder, known: Sequence[Cylinder]) -> bool:
    """Whether it runs along a known pipe nearer than two pipes can lie: it is that one's shadow, or its edge."""
    middle = cylinder.middle[None]
    return any(
        abs(float(other.axis @ cylinder.axis)) > np.cos(NEARLY_PARALLEL)
        and 0.0 < float(other.along(middle)[0]) < other.length
        and float(other.surface_distance(middle)[0]) < cylinder.radius - AXIS_SIGMA
        for other in known
    )


def _as_candidate(fit: ContourFit, points: NDArray[np.floating]) -> Candidate:
    """A candidate for a pipe found by its lines, with what the cloud (N, 3) shows of it."""
    cylinder = fit.cylinder
    along = cylinder.along(points)
    distance = cylinder.surface_distance(points[(along > 0) & (along < cylinder.length)])
    distance = distance[np.abs(distance) < cylinder.radius]
    noise = float(np.sqrt(np.mean(distance**2))) if len(distance) else cylinder.radius
    evidence = CloudEvidence(np.pi, fit.support, 0.0, noise, 0.0, 1.0)
    return Candidate(cylinder, fit.radius_sigma, len(distance), evidence)
