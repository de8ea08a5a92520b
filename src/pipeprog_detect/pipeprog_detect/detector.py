"""The detector: from a metric cloud to classified pipes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_detect.candidate_search import THICKEST_LINE, Report, Search, is_pipe
from pipeprog_detect.cloud import local_shape, octree, plane_segmentation
from pipeprog_detect.cloud.cutting_planes import parse_planes
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.interior_search import find_concave
from pipeprog_detect.product import classification
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.silhouette.apparent_contour import viewing_direction
from pipeprog_detect.silhouette.edge_support import own_contours
from pipeprog_detect.silhouette.occlusion import with_depths
from pipeprog_detect.thin.thin_pipes import find_thin_pipes
from pipeprog_detect.types import Cloud, Pipe, View
from pipeprog_detect.verification.keyframe_verifier import KeyframeVerifier
from pipeprog_detect.verification.measured_pipe import MeasuredPipe, joined
from pipeprog_detect.verification.measurement_cache import MeasurementCache
from pipeprog_detect.verification.scene_context import SceneContext
from pipeprog_detect.verification.wall_ends import with_ends_on_walls

# Stereo is rougher on pipes, curved and glossy, than on the walls that the noise is read from.
_STEREO_ON_PIPES = 2.0
# Of the walls points so far apart [m] suffice to tell where they are.
_WALL_SPACING = 0.01


def detect(
    cloud: Cloud,
    boq: BillOfQuantities,
    config: DetectConfig,
    views: Sequence[View] = (),
    progress: Report | None = None,
    memory: MeasurementCache | None = None,
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
    sigma = local_shape.estimate_noise(tree)
    widest = 1.5 * max(planned.outer_radius for planned in boq.classes)
    report(0.15, "finding walls")
    walls, on_plane = plane_segmentation.find_planes(tree, sigma, widest)
    plain = tree.subset(on_plane)
    plain = plain.thinned(plain.level_of(_WALL_SPACING))
    tree = tree.subset(~on_plane)
    outward = None if cloud.normals is None else np.asarray(cloud.normals, float)[finite][tree.order]
    around = SceneContext(tree, outward, walls, plain, sigma)
    if config.concave:
        report(0.3, "looking for pipes seen from inside")
        bores = [radius for planned in boq.classes for radius, _ in planned.bores]
        seen = find_concave(tree, around, sigma, (0.7 * min(bores), 1.5 * max(bores)), config)
        return _product([MeasuredPipe(each, each.cylinder, each.radius_sigma) for each in seen], boq, shift, config)
    planned_radii = [planned.outer_radius for planned in boq.classes]
    local_views = [replace(view, camera_from_map=_moved(view.camera_from_map, shift)) for view in views]
    judging = with_depths(local_views, points) if config.contour.enabled else []
    verifier = KeyframeVerifier(judging, boq, memory)
    # A cloud with normals towards cameras is stereo's, too.
    noise = _STEREO_ON_PIPES * sigma if verifier.has_views or outward is not None else sigma
    radius_range = (config.radius_min, widest)
    planes = [replace(plane, point=plane.point - shift) for plane in parse_planes(config.plane)] if config.plane else []
    fresh = memory.novelty.of(points + shift)[tree.order] if memory else np.ones(len(tree.points), bool)
    known = [cylinder.shifted(-shift) for cylinder in memory.novelty.known] if memory else []
    search = Search(tree, around, noise, radius_range, planned_radii, config, verifier, report)
    candidates = search.candidates(fresh, known, planes)
    if memory:
        memory.novelty.known = [candidate.cylinder.shifted(shift) for candidate in candidates]
    report(0.9, "measuring in the keyframes" if views else "measuring")
    measured = verifier.measure(
        candidates, [is_pipe(each, sigma if verifier.has_views else noise, config) for each in candidates]
    )
    measured = _genuine(measured, around, judging)
    report(0.95, "looking for thin pipes in the keyframes")
    edges = memory.edges if memory else {}
    lost = find_thin_pipes(points, THICKEST_LINE, measured, judging, boq, edges)
    measured += _genuine(lost, around, judging)
    measured = _abutted(joined(measured), around, judging)
    report(1.0, "done")
    return _product(measured, boq, shift, config)


def _genuine(measured: Sequence[MeasuredPipe], around: SceneContext, views: Sequence[View]) -> list[MeasuredPipe]:
    """Those that stand before the walls and whose outlines are no others', as far as there are views to tell."""
    if not views:
        return list(measured)
    clear = [
        each
        for each in measured
        if not around.is_embedded(each.cylinder, each.radius_sigma, viewing_direction(each.cylinder, views))
    ]
    own = own_contours([each.cylinder for each in clear], views)
    return [each for each, is_own in zip(clear, own, strict=True) if is_own]


def _abutted(measured: Sequence[MeasuredPipe], around: SceneContext, views: Sequence[View]) -> list[MeasuredPipe]:
    """The pipes as long as the walls that they run into allow, as far as there are views to tell."""
    if not views:
        return list(measured)
    cylinders = [each.cylinder for each in measured]

    def one(number: int) -> MeasuredPipe:
        others = cylinders[:number] + cylinders[number + 1 :]
        each = measured[number]
        return replace(each, cylinder=with_ends_on_walls(each.cylinder, each.rims, around, views, others))

    return [one(number) for number in range(len(measured))]


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
    )


def _numbered(pipes: list[Pipe]) -> list[Pipe]:
    """Pipes with ids p01, p02, ..., sorted by place so that the order of their discovery does not show."""
    order = sorted(pipes, key=lambda pipe: tuple(np.round(pipe.cylinder.middle, 3)))
    width = max(2, len(str(len(order))))
    return [replace(pipe, id=f"p{number:0{width}d}") for number, pipe in enumerate(order, start=1)]


def _silent(share: float, what: str) -> None:
    """No progress wanted."""
