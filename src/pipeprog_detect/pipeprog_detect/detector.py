"""The detector: from a metric cloud to classified pipes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.errors import InputError
from pipeprog_detect import background, classify, hypotheses, normals, octree
from pipeprog_detect.abutment import abutted
from pipeprog_detect.bill import Bill
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.hypotheses import Hypothesis
from pipeprog_detect.inside import find_concave
from pipeprog_detect.memory import Memory
from pipeprog_detect.occlusion import with_depths
from pipeprog_detect.octree import THREADS, Octree
from pipeprog_detect.outline import viewing_direction
from pipeprog_detect.pipe import Cloud, Cylinder, FloatArray, Pipe, View
from pipeprog_detect.planes import CuttingPlane, parse_planes, place_planes, section_hypotheses
from pipeprog_detect.refinement import Jury, Measured, joined
from pipeprog_detect.runs import elbows, join, near, spanning
from pipeprog_detect.support import own_outlines
from pipeprog_detect.surroundings import Surroundings
from pipeprog_detect.verify import Candidate, measure, own_points, settle, thin_start

# Neighbourhoods [m] in which the bend of a pipe is seen, for radii from 1 to 2 times as large. Fine to coarse, each on
# what the ones before have not explained: a coarse patch may span two pipes of a rack, a fine one may not. The finest
# comes last, when little is left for its many sites.
_SCALES = (0.028, 0.04, 0.056, 0.08, 0.113, 0.16, 0.02)
_POINTS_PER_SCALE = 7.0
# Stereo is rougher on pipes, curved and glossy, than on the walls that the noise is read from.
_STEREO_ON_PIPES = 2.0
# Candidates that the images judge may be so many times as rough as pipes that the cloud alone must vouch for.
_PROPOSED = 2.0
# Pipes up to this radius [m] are sought as lines of points, in neighbourhoods several times as wide.
_THICKEST_LINE = 0.02
_LINE_SCALE = 0.04
# Of the walls points so far apart [m] suffice to tell where they are.
_WALL_SPACING = 0.01

Report = Callable[[float, str], None]


def detect(
    cloud: Cloud,
    bill: Bill,
    config: DetectConfig,
    views: Sequence[View] = (),
    progress: Report | None = None,
    memory: Memory | None = None,
) -> list[Pipe]:
    """Find, measure and classify the pipes of a metric cloud.

    Points that are not finite are dropped; a cloud without any others raises InputError. `progress` is called with
    the share done (0..1) and what is being done. With the `memory` of the last map what has not changed is not
    measured again.
    """
    report = progress or _silent
    points = np.asarray(cloud.points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"the cloud's points have the shape {points.shape}: give N x 3 metres")
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise InputError(f"the cloud holds no point with finite coordinates ({len(points)} in all): check its source")
    # Far from the origin (UTM) doubles still hold micrometres, squares of them do not.
    points = points[finite]
    shift = np.round(np.median(points, axis=0))
    points = points - shift
    report(0.0, "sorting points")
    tree = octree.build(points)
    report(0.1, "estimating noise")
    sigma = normals.estimate_noise(tree)
    widest = 1.5 * max(planned.outer_radius for planned in bill.classes)
    report(0.15, "finding walls")
    walls, on_plane = background.find_planes(tree, sigma, widest)
    plain = tree.subset(on_plane)
    plain = plain.thinned(plain.level_of(_WALL_SPACING))
    tree = tree.subset(~on_plane)
    outward = None if cloud.normals is None else np.asarray(cloud.normals, float)[finite][tree.order]
    around = Surroundings(tree, outward, walls, plain, sigma)
    if config.concave:
        report(0.3, "looking for pipes seen from inside")
        bores = [radius for planned in bill.classes for radius, _ in planned.bores]
        seen = find_concave(tree, around, sigma, (0.7 * min(bores), 1.5 * max(bores)), config)
        return _product([Measured(each, each.cylinder, each.radius_sigma) for each in seen], bill, shift, config)
    planned_radii = [planned.outer_radius for planned in bill.classes]
    local_views = [replace(view, camera_from_map=_moved(view.camera_from_map, shift)) for view in views]
    judging = with_depths(local_views, points) if config.contour.enabled else []
    jury = Jury(judging, bill, config.contour, memory)
    # A cloud with normals towards cameras is stereo's, too.
    noise = _STEREO_ON_PIPES * sigma if jury.sits or outward is not None else sigma
    radius_range = (config.radius_min, widest)
    planes = [replace(plane, point=plane.point - shift) for plane in parse_planes(config.plane)] if config.plane else []
    fresh = memory.novelty.of(points + shift)[tree.order] if memory else np.ones(len(tree.points), bool)
    known = [_shifted(cylinder, -shift) for cylinder in memory.novelty.known] if memory else []
    candidates = find_candidates(
        tree, fresh, known, around, noise, radius_range, planned_radii, planes, config, jury, report
    )
    if memory:
        memory.novelty.known = [_shifted(candidate.cylinder, shift) for candidate in candidates]
    report(0.9, "measuring in the keyframes" if views else "measuring")
    measured = jury.measure(candidates, [is_pipe(each, sigma if jury.sits else noise, config) for each in candidates])
    measured = _genuine(measured, around, judging)
    report(0.95, "looking for thin pipes in the keyframes")
    measured += _genuine(jury.measure_lost(points, _THICKEST_LINE, measured), around, judging)
    measured = _abutted(joined(measured), around, judging)
    report(1.0, "done")
    return _product(measured, bill, shift, config)


def find_candidates(
    tree: Octree,
    fresh: NDArray[np.bool_],
    known: Sequence[Cylinder],
    around: Surroundings,
    sigma: float,
    radius_range: tuple[float, float],
    planned_radii: Sequence[float],
    planes: Sequence[CuttingPlane],
    config: DetectConfig,
    jury: Jury,
    report: Report,
) -> list[Candidate]:
    """Accepted cylinders of the tree's points, none sharing points with another.

    The `known` ones are measured again, and others sought among the points (N,) that are `fresh`.
    What is around them may make a corner or a hollow of them. What is too rough for the cloud alone is put to the
    images, where there are any.
    """
    free = np.ones(len(tree.points), bool)
    accepted: list[Candidate] = []

    def consider(hypothesis: Hypothesis) -> None:
        candidate = measure(tree, free, hypothesis, sigma)
        if candidate is None or around.contradict(candidate):
            return
        if is_pipe(candidate, sigma, config) or (
            is_pipe(candidate, sigma, config, _PROPOSED) and jury.vouches_for(candidate)
        ):
            accepted.append(candidate)
            cylinder = candidate.cylinder
            free[tree.near_segment(cylinder.start, cylinder.end, cylinder.radius + 3.0 * candidate.band)] = False

    for cylinder in known:
        consider(Hypothesis(cylinder, 0))
    if config.front_end == "planes":
        report(0.2, "looking for sections of pipes")
        planes = planes or place_planes(tree, sigma, radius_range)
        for hypothesis in section_hypotheses(tree, free, planes, sigma, radius_range, config.seed, config.straighten):
            consider(hypothesis)
    else:
        for hypothesis in _voted(tree, fresh, free, sigma, radius_range, planned_radii, report):
            consider(hypothesis)
    report(0.8, "measuring")
    # Where the noise hides the section only the bill tells a thin pipe from the edge of a plate.
    return [
        candidate
        for candidate in _settled(tree, accepted, sigma, config, jury)
        if jury.sits
        or not candidate.blurred
        or any(abs(candidate.cylinder.radius - radius) < 4.0 * candidate.radius_sigma for radius in planned_radii)
    ]


def _voted(
    tree: Octree,
    fresh: NDArray[np.bool_],
    free: NDArray[np.bool_],
    sigma: float,
    radius_range: tuple[float, float],
    planned_radii: Sequence[float],
    report: Report,
) -> Iterator[Hypothesis]:
    """Hypotheses of the tree's fresh points that are free at that time: bent patches, fine to coarse, then lines."""
    if not fresh.any():
        return
    scales = [scale for scale in _SCALES if scale < radius_range[1] and 2.0 * scale > radius_range[0]]
    for number, scale in enumerate(scales):
        report(0.2 + 0.5 * number / len(scales), f"looking for pipes in patches of {1e3 * scale:.0f} mm")
        rest = tree.subset(free & fresh)
        fine = rest.thinned(rest.level_of(scale / _POINTS_PER_SCALE))
        shape = normals.surfaces(fine, rest.thinned(rest.level_of(scale)), scale, sigma)
        yield from hypotheses.consensus(hypotheses.votes_of(shape, sigma, radius_range))
    report(0.7, "looking for thin pipes")
    thin = [planned for planned in planned_radii if planned < _THICKEST_LINE] or [0.5 * _THICKEST_LINE]
    rest = tree.subset(free & fresh)
    fine = rest.thinned(rest.level_of(_LINE_SCALE / _POINTS_PER_SCALE))
    shape = normals.surfaces(fine, rest.thinned(rest.level_of(0.5 * _LINE_SCALE)), _LINE_SCALE, sigma)
    for line in hypotheses.consensus(hypotheses.line_votes(shape, sigma, _THICKEST_LINE)):
        initial = thin_start(tree, free, line.cylinder, 1.2 * sigma, thin)
        if initial is not None:
            yield Hypothesis(initial, line.votes)


def _settled(
    tree: Octree, accepted: list[Candidate], sigma: float, config: DetectConfig, jury: Jury
) -> list[Candidate]:
    """Pieces of one pipe joined, then each measured on what lies nearest to it, elbows and the unfounded left out.

    The pipe found first had its neighbour's points as well: once both are known they are told apart.
    """

    def settled(pieces: list[int], again: bool) -> Candidate | None:
        best = max(pieces, key=lambda piece: accepted[piece].points)
        cylinder = spanning([accepted[piece].cylinder for piece in pieces], best=pieces.index(best))
        band = accepted[best].band
        margin = cylinder.radius * cylinder.axis
        reach = 1.5 * cylinder.radius + 6.0 * band
        others = [accepted[k].cylinder for k in range(len(accepted)) if k not in pieces]
        others = [other for other in others if near(other, cylinder, reach)]
        if again and len(pieces) == 1 and not others:
            return accepted[best]
        rows = tree.near_segment(cylinder.start - margin, cylinder.end + margin, reach)
        points = own_points(tree.points[rows], cylinder, others)
        candidate = settle(points, cylinder, band, whole=again or len(pieces) > 1)
        if candidate is not None and is_pipe(candidate, sigma, config, _PROPOSED):
            return candidate
        # Where there are images, they will measure it.
        return replace(accepted[best], cylinder=cylinder) if jury.sits else None

    for again in (False, True):
        joined = join([candidate.cylinder for candidate in accepted])
        # Most of it is compiled, and lets other threads run.
        with ThreadPoolExecutor(THREADS) as pool:
            measured = list(pool.map(settled, joined, repeat(again)))
        accepted = [candidate for candidate in measured if candidate is not None]
    bends = elbows([candidate.cylinder for candidate in accepted])
    return [candidate for number, candidate in enumerate(accepted) if number not in bends]


def _genuine(measured: Sequence[Measured], around: Surroundings, views: Sequence[View]) -> list[Measured]:
    """Those that stand before the walls and whose outlines are no others', as far as there are views to tell."""
    if not views:
        return list(measured)
    clear = [
        each
        for each in measured
        if not around.bury(each.cylinder, each.radius_sigma, viewing_direction(each.cylinder, views))
    ]
    own = own_outlines([each.cylinder for each in clear], views)
    return [each for each, is_own in zip(clear, own, strict=True) if is_own]


def _abutted(measured: Sequence[Measured], around: Surroundings, views: Sequence[View]) -> list[Measured]:
    """The pipes as long as the walls that they run into allow, as far as there are views to tell."""
    if not views:
        return list(measured)
    cylinders = [each.cylinder for each in measured]

    def one(number: int) -> Measured:
        others = cylinders[:number] + cylinders[number + 1 :]
        each = measured[number]
        return replace(each, cylinder=abutted(each.cylinder, each.rims, around.planes, around.walls, views, others))

    return [one(number) for number in range(len(measured))]


def is_pipe(candidate: Candidate, sigma: float, config: DetectConfig, roughness: float = 1.0) -> bool:
    """Whether the evidence makes a pipe of a cylinder whose surface may be `roughness` times as rough as usual."""
    evidence, cylinder = candidate.evidence, candidate.cylinder
    # The smaller the arc, the more surfaces that are no pipe fit it: its length has to make up for that.
    slender = 3.0 if evidence.arc > np.radians(80.0) else 6.0
    # A thin pipe stands clear of what is behind it and shows its half; a strip of a surface does not.
    vague = candidate.radius_sigma > 0.05 * cylinder.radius or cylinder.radius < _THICKEST_LINE
    return (
        cylinder.length >= max(slender * cylinder.radius, config.length_min)
        and candidate.radius_sigma < 0.15 * cylinder.radius
        and evidence.arc >= np.radians(max(config.arc_min_deg, 90.0) if vague else config.arc_min_deg)
        and evidence.coverage > 0.4
        and evidence.inside < 0.15
        and evidence.noise < roughness * (1.6 * sigma + 8e-4)
        and evidence.roundness < roughness * (0.3 * sigma + 0.02 * cylinder.radius + 3e-4)
        and evidence.flatness > 1.3
    )


def _shifted(cylinder: Cylinder, by: FloatArray) -> Cylinder:
    return Cylinder(cylinder.start + by, cylinder.end + by, cylinder.radius)


def _moved(camera_from_map: FloatArray, shift: FloatArray) -> FloatArray:
    """The pose for a map whose origin is moved to `shift` (3,)."""
    pose = camera_from_map.copy()
    pose[:3, 3] += pose[:3, :3] @ shift
    return pose


def _product(measured: Sequence[Measured], bill: Bill, shift: FloatArray, config: DetectConfig) -> list[Pipe]:
    """The classified pipes in the frame that the cloud came in."""
    pipes = _numbered([_pipe(each, bill, shift, config.concave) for each in measured])
    return classify.reclassified(pipes, bill, config.concave) if config.classifier == "kmeans" else pipes


def _pipe(measured: Measured, bill: Bill, shift: FloatArray, concave: bool) -> Pipe:
    candidate, cylinder, sigma = measured.candidate, measured.cylinder, measured.radius_sigma
    verdict = classify.classify(cylinder.radius, sigma, bill, concave)
    return Pipe(
        "",
        _shifted(cylinder, shift),
        sigma,
        verdict.name,
        verdict.probability,
        candidate.evidence.arc,
        candidate.evidence.noise,
        candidate.points,
    )


def _numbered(pipes: list[Pipe]) -> list[Pipe]:
    """Pipes with ids p01, p02, ..., sorted by place so that the order of their discovery does not show."""
    order = sorted(pipes, key=lambda pipe: tuple(np.round(0.5 * (pipe.cylinder.start + pipe.cylinder.end), 3)))
    width = max(2, len(str(len(order))))
    return [replace(pipe, id=f"p{number:0{width}d}") for number, pipe in enumerate(order, start=1)]


def _silent(share: float, what: str) -> None:
    """No progress wanted."""
