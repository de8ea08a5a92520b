# SPDX-License-Identifier: Apache-2.0
"""The detector: from a metric cloud to classified pipes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_detect.candidate_search import Report, Search
from pipeprog_detect.cloud import local_shape, octree, plane_segmentation
from pipeprog_detect.cloud.acceptance import THICKEST_LINE, seen_from_inside, seen_from_outside
from pipeprog_detect.cloud.candidate import Candidate
from pipeprog_detect.cloud.cutting_planes import parse_planes
from pipeprog_detect.cloud.octree import Octree
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.interior_search import find_concave
from pipeprog_detect.product import classification
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.silhouette.occlusion import STEREO_WINDOW, with_depths
from pipeprog_detect.silhouette.scene import Scene, viewing_direction
from pipeprog_detect.thin.false_lines import is_false_line, is_one_step
from pipeprog_detect.thin.hangers import is_hanger
from pipeprog_detect.thin.longer_in_colour import longer_in_colour
from pipeprog_detect.thin.thin_pipes import find_thin_pipes, in_colour, seeking_edges, turned_parallel
from pipeprog_detect.threads import mapped
from pipeprog_detect.types import Cloud, Cylinder, Pipe, View
from pipeprog_detect.verification.end_states import ends_in_cloud, ends_in_views
from pipeprog_detect.verification.grown_ends import with_grown_ends
from pipeprog_detect.verification.keyframe_verifier import KeyframeVerifier
from pipeprog_detect.verification.measured_pipe import (
    MeasuredPipe,
    is_probable,
    is_shown,
    is_stub,
    joined,
    lacks_a_side,
    own_contours,
)
from pipeprog_detect.verification.measurement_cache import MeasurementCache
from pipeprog_detect.verification.open_ends import with_open_ends
from pipeprog_detect.verification.parallel_to_wall import parallel_to_wall
from pipeprog_detect.verification.parted_by_walls import parted_by_walls
from pipeprog_detect.verification.scene_context import SceneContext
from pipeprog_detect.verification.wall_ends import with_ends_on_walls

# Stereo is twice as rough on pipes, curved and glossy, as on the walls that the noise is read from.
_STEREO_ON_PIPES = 2.0
# Points of walls are thinned to cells of this size [m]: they tell where the wall is, not how rough.
_WALL_SPACING = 0.01
# Pipes up to 1.5 times as thick as the thickest planned one are looked for: a wrong size on site is to be seen.
_THICKEST = 1.5
# A camera in a sewer may be in a pipe that is thinner than planned, too, by up to 30 %.
_THINNEST_BORE = 0.7


@dataclass(frozen=True)
class PreparedCloud:
    """A cloud whose planes are known, in a frame near it.

    Attributes:
        shift: origin (3,) of the frame in the cloud's own one [m]: far from the origin (UTM) doubles still hold
            micrometres, squares of them do not.
        points: all points with finite coordinates (N, 3) [m].
        tree: those on no plane.
        around: walls and free space, with the normals of the tree's points.
        sigma: standard deviation of the points across surfaces [m].
    """

    shift: FloatArray
    points: FloatArray
    tree: Octree
    around: SceneContext
    sigma: float


def detect(
    cloud: Cloud,
    boq: BillOfQuantities,
    config: DetectConfig,
    views: Sequence[View] = (),
    progress: Report | None = None,
    memory: MeasurementCache | None = None,
    boards: FloatArray | None = None,
) -> list[Pipe]:
    """The pipes of a metric cloud: found, measured and classified, in the cloud's frame, sorted by place.

    Args:
        cloud: points that are not finite are left out.
        boq: the planned classes.
        config: the settings.
        views: keyframes of the same frame; candidates are verified and measured in them.
        progress: called with the share done (0..1) and what is being done.
        memory: what is known from the last map of this survey: what has not changed is not measured again. It is
            brought up to this map.
        boards: points (M, 3) of the boards' faces in the cloud's frame: what they hide from a view is not missing.

    Raises:
        InputError: no point is finite, or the points are no N x 3 array.
    """
    report = progress or _silent
    prepared = _prepare(cloud, _THICKEST * max(planned.outer_radius for planned in boq.classes), report)
    if config.concave:
        measured = detect_inside(prepared, boq, config, report)
    else:
        measured = detect_outside(prepared, boq, config, views, report, memory, boards)
    report(1.0, "done")
    return _product(measured, boq, prepared.shift, config)


def _prepare(cloud: Cloud, widest: float, report: Report) -> PreparedCloud:
    """The cloud sorted, with its noise and its planes, none of which is a strip of a pipe of radius `widest` [m]."""
    points = np.asarray(cloud.points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"the cloud's points have the shape {points.shape}: give N x 3 metres")
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise InputError(f"the cloud holds no point with finite coordinates ({len(points)} in all): check its source")
    points = points[finite]
    shift = np.round(np.median(points, axis=0))
    points = points - shift
    report(0.0, "sorting points")
    tree = octree.build(points)
    report(0.1, "estimating noise")
    sigma = local_shape.estimate_noise(tree)
    report(0.15, "finding walls")
    walls, on_plane = plane_segmentation.find_planes(tree, sigma, widest)
    plain = tree.subset(on_plane)
    plain = plain.thinned(plain.level_of(_WALL_SPACING))
    tree = tree.subset(~on_plane)
    outward = None if cloud.normals is None else np.asarray(cloud.normals, float)[finite][tree.order]
    return PreparedCloud(shift, points, tree, SceneContext(tree, outward, walls, plain, sigma), sigma)


def detect_inside(
    prepared: PreparedCloud, boq: BillOfQuantities, config: DetectConfig, report: Report
) -> list[MeasuredPipe]:
    """The pipes that a camera within them sees: the cloud alone is judged."""
    report(0.3, "looking for pipes seen from inside")
    bores = [radius for planned in boq.classes for radius, _ in planned.bores]
    radius_range = (_THINNEST_BORE * min(bores), _THICKEST * max(bores))
    criteria = seen_from_inside(prepared.sigma, config)
    found = find_concave(prepared.tree, prepared.around, criteria, radius_range, config.seed)
    return [_with_ends_in_cloud(MeasuredPipe.of_cloud(each)) for each in found]


def detect_outside(
    prepared: PreparedCloud,
    boq: BillOfQuantities,
    config: DetectConfig,
    views: Sequence[View],
    report: Report,
    memory: MeasurementCache | None,
    boards: FloatArray | None,
) -> list[MeasuredPipe]:
    """The pipes of a room: candidates of the cloud, verified and measured in the views, and thin ones of the views."""
    shift, around = prepared.shift, prepared.around
    local_views = [replace(view, camera_from_map=_moved(view.camera_from_map, shift)) for view in views]
    faces = None if boards is None else boards - shift
    judging = with_depths(local_views, prepared.points, faces) if config.contour.enabled else []
    verifier = KeyframeVerifier(judging, boq, memory)
    points = (prepared.points if judging else prepared.points[:0]).astype(np.float32)  # for what is judged in the views
    thickest = max(THICKEST_LINE, _radius_in_window(judging))
    edges = memory.edges if memory else {}
    with seeking_edges(points, thickest, judging, boq, edges):
        candidates = _candidates(prepared, boq, config, verifier, report, memory)
        report(0.9, "measuring in the keyframes" if views else "measuring")
        # With keyframes the cloud is trusted alone only where a pipe is as smooth in it as the walls are.
        noise = prepared.sigma if verifier.has_views else _noise_on_pipes(prepared, verifier)
        criteria = seen_from_outside(noise, config)
        measured = verifier.measure(candidates, [criteria.accept(each) for each in candidates])
        measured = parted_by_walls(measured, around, judging, verifier)
    judging, coloured = _with_blur(judging, measured), in_colour(judging)

    def is_genuine(each: MeasuredPipe, others: Sequence[Cylinder]) -> bool:
        return not is_false_line(each.cylinder, each.fit, points, around.planes, judging, others)

    def is_told(
        each: MeasuredPipe,
        others: Sequence[Cylinder],
        tells: Callable[[Cylinder, Sequence[View], Sequence[Cylinder]], bool],
    ) -> bool:
        """Whether grey or colour tells something of a pipe."""
        return any(tells(each.cylinder, shown, others) for shown in (judging, coloured) if shown)

    def is_supported(each: MeasuredPipe, others: Sequence[Cylinder]) -> bool:
        return is_told(each, others, is_probable)

    def stays(each: MeasuredPipe, others: Sequence[Cylinder]) -> bool:
        """Whether edges support it and are two.

        What another pipe hides wherever it was seen is that pipe at another depth, found when a piece of it was known.
        """
        return is_told(each, others, is_shown) and is_told(
            each, others, lambda *scene: not is_one_step(Scene.of(*scene))
        )

    measured = _judged(_genuine(measured, around, judging), judging, is_genuine)
    # What is dropped in the end hides no whole pipe now, nor does a stub of one.
    measured = _judged(
        measured, judging, lambda each, others: not is_stub(each.cylinder) and is_supported(each, others)
    )
    report(0.95, "looking for thin pipes in the keyframes")
    measured = longer_in_colour(measured, THICKEST_LINE, coloured)
    lost = find_thin_pipes(points, around, thickest, measured, judging, boq, edges)
    measured += _genuine(lost, around, judging)
    measured = turned_parallel(measured, points, THICKEST_LINE, judging, boq)
    measured = _judged([parallel_to_wall(each, around) for each in measured], judging, is_supported)
    # Ends on either side of what hides a pipe may be expected beyond each other: then both pieces are of one pipe.
    whole = with_open_ends(joined(measured, judging, context=around), around, judging)
    whole = joined(whole, judging, overlapping=True, context=around)
    whole = _judged(whole, judging, stays)
    ended = _abutted(with_grown_ends(whole, judging), around, judging, coloured)
    standing = [each for each in ended if not is_hanger(each, prepared.points, around.planes)]
    return [each for each in standing if each.cylinder.length >= config.length_min]


def _candidates(
    prepared: PreparedCloud,
    boq: BillOfQuantities,
    config: DetectConfig,
    verifier: KeyframeVerifier,
    report: Report,
    memory: MeasurementCache | None,
) -> list[Candidate]:
    """The candidates of the cloud; of a map that follows another one, those of the last map and of what is new."""
    tree, shift = prepared.tree, prepared.shift
    planned = list(boq.radii)
    radius_range = (config.radius_min, _THICKEST * max(planned))
    criteria = seen_from_outside(_noise_on_pipes(prepared, verifier), config)
    search = Search(tree, prepared.around, criteria, radius_range, planned, config, verifier, report)
    planes = [replace(plane, point=plane.point - shift) for plane in parse_planes(config.plane)] if config.plane else []
    if memory is None:
        return search.candidates(np.ones(len(tree.points), bool), [], planes)
    fresh = memory.novelty.fresh(prepared.points + shift)[tree.order]
    candidates = search.candidates(fresh, [cylinder.shifted(-shift) for cylinder in memory.novelty.known], planes)
    memory.novelty.remember([candidate.cylinder.shifted(shift) for candidate in candidates])
    return candidates


def _noise_on_pipes(prepared: PreparedCloud, verifier: KeyframeVerifier) -> float:
    """Standard deviation [m] of the points on pipes; a cloud with keyframes, or with normals, is one of stereo."""
    stereo = verifier.has_views or prepared.around.outward is not None
    return _STEREO_ON_PIPES * prepared.sigma if stereo else prepared.sigma


def _with_blur(views: Sequence[View], measured: Sequence[MeasuredPipe]) -> list[View]:
    """The views with the blur that the contours of thick pipes show: on a thin one it is not told from the width."""
    blurs = [each.fit.blur for each in measured if each.fit is not None and each.cylinder.radius >= THICKEST_LINE]
    return [replace(view, blur=float(np.median(blurs))) for view in views] if blurs else list(views)


def _radius_in_window(views: Sequence[View]) -> float:
    """Radius [m] of a pipe as wide as a window of stereo in the median view, at the median depth; 0 if not known.

    Of a narrower pipe the cloud may show something else at another depth, such as what it reflects. In keyframes larger
    than stereo's images fewer pipes are that narrow.
    """
    radii = [
        0.5 * STEREO_WINDOW * float(np.median(view.nearest[np.isfinite(view.nearest)])) / view.camera.fx
        for view in views
        if view.nearest is not None and np.isfinite(view.nearest).any()
    ]
    return float(np.median(radii)) if radii else 0.0


def _genuine(measured: Sequence[MeasuredPipe], around: SceneContext, views: Sequence[View]) -> list[MeasuredPipe]:
    """Those that stand before the walls and whose outlines are no others', as far as there are views to tell.

    A pipe of which others hide both sides has no outlines of its own; it stands where the cloud tells the same of it.
    One of which the cloud does not resolve the section has those of a pipe on both sides, wherever nothing hides them:
    two thin pipes side by side look like a thicker one in the cloud.
    """
    if not views:
        return list(measured)

    def is_clear(each: MeasuredPipe) -> bool:
        seen = each.cylinder, each.radius_sigma, viewing_direction(each.cylinder, views)
        return not (around.is_covered(*seen) or around.is_embedded(*seen))

    clear = [each for each in measured if is_clear(each)]
    own = own_contours([each.cylinder for each in clear], views)
    kept = [each for each, is_own in zip(clear, own, strict=True) if is_own or each.is_as_in_cloud]
    cylinders = [each.cylinder for each in kept]
    return [
        each
        for number, each in enumerate(kept)
        if not (
            each.candidate.radius_held
            and lacks_a_side(each.cylinder, views, cylinders[:number] + cylinders[number + 1 :])
        )
    ]


def _judged(
    measured: list[MeasuredPipe],
    views: Sequence[View],
    stands: Callable[[MeasuredPipe, Sequence[Cylinder]], bool],
) -> list[MeasuredPipe]:
    """Those that stand beside the others, as far as there are views to tell: thicker ones do by the cloud alone."""
    if not views:
        return measured
    cylinders = [each.cylinder for each in measured]

    def one(number: int) -> bool:
        is_thick = cylinders[number].radius >= THICKEST_LINE
        return is_thick or stands(measured[number], cylinders[:number] + cylinders[number + 1 :])

    kept = mapped(one, range(len(measured)))
    return [each for each, is_kept in zip(measured, kept, strict=True) if is_kept]


def _abutted(
    measured: Sequence[MeasuredPipe], around: SceneContext, views: Sequence[View], coloured: Sequence[View]
) -> list[MeasuredPipe]:
    """The pipes as long as the walls that they run into allow, as far as there are views to tell, with their ends.

    Colour may know an end of a thin pipe that grey leaves open.
    """
    if not views:
        return [_with_ends_in_cloud(each) for each in measured]
    cylinders = [each.cylinder for each in measured]

    def one(number: int) -> MeasuredPipe:
        others = cylinders[:number] + cylinders[number + 1 :]
        each = measured[number]
        cylinder = with_ends_on_walls(each.cylinder, each.rims, around, views, others)
        shown = [coloured] if coloured and cylinder.radius < THICKEST_LINE else []
        known = [ends_in_views(cylinder, around, those, others) for those in (views, *shown)]
        start, end = (min(told, key=lambda end: end.sigma) for told in zip(*known, strict=True))
        return replace(each, cylinder=cylinder, ends=(start, end))

    return mapped(one, range(len(measured)))


def _with_ends_in_cloud(measured: MeasuredPipe) -> MeasuredPipe:
    return replace(measured, ends=ends_in_cloud(measured.cylinder, measured.candidate.points))


def _moved(camera_from_map: FloatArray, shift: FloatArray) -> FloatArray:
    """The pose for a map whose origin is moved to `shift` (3,)."""
    pose = camera_from_map.copy()
    pose[:3, 3] += pose[:3, :3] @ shift
    return pose


def _product(
    measured: Sequence[MeasuredPipe], boq: BillOfQuantities, shift: FloatArray, config: DetectConfig
) -> list[Pipe]:
    """The classified pipes in the frame that the cloud came in."""
    pipes = _numbered([_pipe(each, boq, shift, config.concave) for each in measured])
    pipes = classification.with_kmeans(pipes, boq)
    return classification.named_by_kmeans(pipes, boq, config.concave) if config.classifier == "kmeans" else pipes


def _pipe(measured: MeasuredPipe, boq: BillOfQuantities, shift: FloatArray, concave: bool) -> Pipe:
    candidate, cylinder, sigma = measured.candidate, measured.cylinder, measured.radius_sigma
    verdict = classification.classify(cylinder.radius, sigma, boq, concave)
    return Pipe(
        "",
        cylinder.shifted(shift),
        sigma,
        verdict.name,
        verdict.probability,
        candidate.evidence.arc,
        candidate.evidence.noise,
        candidate.points,
        ends=measured.ends,
    )


def _numbered(pipes: list[Pipe]) -> list[Pipe]:
    """Pipes with ids p01, p02, ..., sorted by place so that the order of their discovery does not show."""
    order = sorted(pipes, key=lambda pipe: tuple(np.round(pipe.cylinder.middle, 3)))
    width = max(2, len(str(len(order))))
    return [replace(pipe, id=f"p{number:0{width}d}") for number, pipe in enumerate(order, start=1)]


def _silent(share: float, what: str) -> None:
    """No progress wanted."""
