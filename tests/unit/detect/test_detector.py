# SPDX-License-Identifier: Apache-2.0
"""The detector from cloud to classified pipes on small scenes with exact truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_detect import detector
from pipeprog_detect.cloud import octree
from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.types import Cloud, Cylinder, Pipe, View
from pipeprog_detect.verification.measured_pipe import MeasuredPipe, is_probable
from pipeprog_detect.verification.scene_context import SceneContext
from sitegen.primitives import cylinder as cylinder_of
from sitegen.site import PIPE_MATERIALS
from tests.unit.detect.pipe_and_wall import PIPE, wall_points
from tests.unit.detect.rendered_site import walk_past

CONFIG = DetectConfig()
NOISE = 2e-3
DENSITY = 40_000  # points a square metre


def boq(*radii: float) -> BillOfQuantities:
    return BillOfQuantities(tuple(PipeClass(f"{1e3 * r:g}", r, 4.0, (1.0, 0.0, 0.0), 0.01 * r) for r in radii))


BOQ = boq(0.0086, 0.0365, 0.0575)


def barrel(rng: np.random.Generator, pipe: Cylinder, arc_deg: float = 150.0) -> FloatArray:
    """Points of the side of a pipe that is seen from -y."""
    view = np.array([0.0, -1.0, 0.0])
    front = view - (view @ pipe.axis) * pipe.axis
    front /= np.linalg.norm(front)
    side = np.cross(pipe.axis, front)
    arc = np.radians(arc_deg)
    count = int(DENSITY * arc * pipe.radius * pipe.length)
    angle = rng.uniform(-0.5, 0.5, count)[:, None] * arc
    along = rng.uniform(0.0, pipe.length, count)[:, None] * pipe.axis
    return pipe.start + along + pipe.radius * (np.cos(angle) * front + np.sin(angle) * side)


def rectangle(rng: np.random.Generator, corner: FloatArray, one: FloatArray, other: FloatArray) -> FloatArray:
    """Points of a rectangle given by a corner and two edges."""
    count = int(DENSITY * np.linalg.norm(np.cross(one, other)))
    return corner + rng.uniform(0, 1, (count, 1)) * one + rng.uniform(0, 1, (count, 1)) * other


def pipe_at(x: float, y: float, radius: float, low: float = 0.1, high: float = 0.9, lean: float = 0.0) -> Cylinder:
    return Cylinder(np.array([x, y, low]), np.array([x + lean, y, high]), radius)


# A wall at y = 0, seen from -y. A thin pipe and thick ones 1.3 diameters apart, one 5 mm off the wall, one leaning.
PIPES = (
    pipe_at(0.15, -0.05, 0.0086),
    pipe_at(0.30, -0.0415, 0.0365),
    pipe_at(0.423, -0.10, 0.0575),
    pipe_at(0.573, -0.10, 0.0575, high=0.7),
    pipe_at(0.75, -0.25, 0.0365, lean=0.2),
)


@cache
def scene() -> FloatArray:
    """Wall, pipes, a box whose edges are no pipes, and stray points."""
    rng = np.random.default_rng(1)
    x, y, z = np.eye(3)
    parts = [rectangle(rng, np.zeros(3), 1.3 * x, z), rectangle(rng, np.array([0.0, -0.6, 0.0]), 1.3 * x, 0.6 * y)]
    parts += [barrel(rng, pipe) for pipe in PIPES]
    corner = np.array([1.05, -0.3, 0.2])
    parts += [rectangle(rng, corner, 0.15 * x, 0.3 * z), rectangle(rng, corner, 0.3 * y, 0.3 * z)]
    points = np.concatenate(parts)
    points += rng.normal(0.0, NOISE, points.shape)
    stray = rng.uniform([0.0, -0.6, 0.0], [1.3, 0.0, 1.0], (len(points) // 50, 3))
    return np.concatenate([points, stray])


@cache
def detected() -> tuple[Pipe, ...]:
    return tuple(detect(Cloud(scene()), BOQ, CONFIG))


def match(truth: Cylinder, pipes: tuple[Pipe, ...]) -> Pipe:
    """The one pipe whose middle lies within the truth."""
    middle = [pipe.cylinder.middle for pipe in pipes]
    along = [(point - truth.start) @ truth.axis for point in middle]
    off = [np.linalg.norm(p - truth.start - t * truth.axis) for p, t in zip(middle, along, strict=True)]
    near = [pipe for pipe, t, d in zip(pipes, along, off, strict=True) if 0 < t < truth.length and d < truth.radius]
    assert len(near) == 1
    return near[0]


@pytest.mark.parametrize("number", range(len(PIPES)))
def test_every_pipe_is_found_measured_and_classified(number: int) -> None:
    truth = PIPES[number]
    pipe = match(truth, detected())
    # The noise is a quarter of the thin pipe's radius: its width is all that tells it.
    blurred = truth.radius < 6.0 * NOISE
    assert pipe.cylinder.radius == pytest.approx(truth.radius, abs=1.6e-3 if blurred else 0.8e-3)
    assert abs(pipe.cylinder.radius - truth.radius) < 4.0 * pipe.radius_sigma
    assert pipe.cylinder.length == pytest.approx(truth.length, rel=0.03)
    assert abs(pipe.cylinder.axis @ truth.axis) > np.cos(np.radians(0.5))
    assert pipe.class_name == f"{1e3 * truth.radius:g}"


def test_walls_and_edges_are_no_pipes() -> None:
    assert len(detected()) == len(PIPES)
    assert [pipe.id for pipe in detected()] == ["p01", "p02", "p03", "p04", "p05"]


def test_the_order_of_the_points_does_not_matter() -> None:
    shuffled = scene()[np.random.default_rng(9).permutation(len(scene()))]
    for one, other in zip(detected(), detect(Cloud(shuffled), BOQ, CONFIG), strict=True):
        np.testing.assert_allclose(one.cylinder.start, other.cylinder.start, atol=5e-5)
        np.testing.assert_allclose(one.cylinder.end, other.cylinder.end, atol=5e-5)
        assert one.cylinder.radius == pytest.approx(other.cylinder.radius, abs=5e-5)


def test_far_from_the_origin_and_with_gaps_in_the_data() -> None:
    shift = np.array([448_000.0, 5_411_000.0, 120.0])
    points = np.concatenate([scene() + shift, np.full((20, 3), np.nan)])
    for one, other in zip(detected(), detect(Cloud(points), BOQ, CONFIG), strict=True):
        np.testing.assert_allclose(one.cylinder.start + shift, other.cylinder.start, atol=3e-3)
        assert one.cylinder.radius == pytest.approx(other.cylinder.radius, abs=3e-4)


def test_a_size_that_is_not_planned_is_kept_without_a_class() -> None:
    pipe = match(PIPES[2], tuple(detect(Cloud(scene()), boq(0.0086, 0.0365, 0.084), CONFIG)))
    assert pipe.class_name is None
    assert pipe.cylinder.radius == pytest.approx(PIPES[2].radius, abs=0.8e-3)


def test_pieces_behind_a_clamp_are_one_pipe() -> None:
    rng = np.random.default_rng(2)
    parts = [barrel(rng, pipe_at(0.0, 0.0, 0.0365, 0.0, 0.4)), barrel(rng, pipe_at(0.0, 0.0, 0.0365, 0.48, 1.0))]
    points = np.concatenate(parts)
    pipes = detect(Cloud(points + rng.normal(0.0, NOISE, points.shape)), BOQ, CONFIG)
    assert len(pipes) == 1
    assert pipes[0].cylinder.length == pytest.approx(1.0, rel=0.02)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((10, 3), np.nan), np.zeros((10, 2))])
def test_a_cloud_without_points_is_an_error(points: FloatArray) -> None:
    with pytest.raises(InputError, match="cloud"):
        detect(Cloud(points), BOQ, CONFIG)


def test_an_empty_room_has_no_pipes() -> None:
    rng = np.random.default_rng(3)
    wall = rectangle(rng, np.zeros(3), np.array([2.0, 0, 0]), np.array([0, 0, 1.0]))
    assert detect(Cloud(wall + rng.normal(0.0, NOISE, wall.shape)), BOQ, CONFIG) == []


def test_progress_is_reported_and_ends_at_one() -> None:
    told: list[float] = []
    detect(Cloud(scene()[::4]), BOQ, CONFIG, progress=lambda share, _: told.append(share))
    assert told == sorted(told)
    assert told[-1] == 1.0


@pytest.mark.parametrize("front_end", ["normals", "planes"])
def test_a_cloud_too_thin_to_tell_its_noise_holds_no_pipes(front_end: str) -> None:
    """A few keyframes far apart leave such a cloud: a handful of points here and there."""
    rng = np.random.default_rng(3)
    clumps = rng.uniform(0, 10, (40, 1, 3)) + rng.uniform(-0.03, 0.03, (40, 12, 3))
    assert detect(Cloud(clumps.reshape(-1, 3)), BOQ, DetectConfig(front_end=front_end)) == []


def test_a_thin_line_without_edges_of_its_own_is_dropped(pipe_views: list[View], empty_views: list[View]) -> None:
    thin = PIPE.shifted(np.array([0.12, 0.0, 0.0]))
    candidates = [
        Candidate(each, 1e-3, 100, CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0))
        for each in (PIPE, replace(thin, radius=0.0086))
    ]
    measured = [MeasuredPipe.of_cloud(each) for each in candidates]

    def judged(pipes: list[MeasuredPipe], views: list[View]) -> list[MeasuredPipe]:
        return detector._judged(pipes, views, lambda each, others: is_probable(each.cylinder, views, others))

    assert judged(measured, pipe_views) == measured[:1]
    assert judged(measured[:1], empty_views) == measured[:1]  # thick: the cloud shows it
    assert judged(measured, []) == measured


@pytest.mark.parametrize(("is_held", "stands"), [(True, False), (False, True)])
def test_what_the_cloud_does_not_resolve_needs_edges_on_both_sides(
    pipe_views: list[View], is_held: bool, stands: bool
) -> None:
    """Twice as wide as the pipe, whose one edge it has: such as two thin pipes side by side, taken for one."""
    wider = replace(PIPE.shifted(np.array([-0.02, 0.0, 0.0])), radius=PIPE.radius + 0.02)
    candidate = Candidate(wider, 1e-3, 100, CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0), radius_held=is_held)
    nowhere = octree.build(np.array([[9.0, 9.0, 9.0]]))
    around = SceneContext(nowhere, None, [], nowhere, 5e-4)
    assert len(detector._genuine([MeasuredPipe.of_cloud(candidate)], around, pipe_views)) == stands


@pytest.mark.parametrize(("scale", "found"), [(0.5, 1), (1.0, 0)])
def test_a_thick_pipe_that_stereo_misses_is_found_by_its_lines_where_it_is_narrow(scale: float, found: int) -> None:
    """14 px wide in the smaller images, 28 px in the others, where windows of stereo lie within it."""
    pipe = Cylinder(np.array([-0.4, -0.07, 0.05]), np.array([0.4, -0.07, 0.05]), 0.0365)
    blue = next(material for material in PIPE_MATERIALS if material.colour == (0.06, 0.17, 0.40))
    views = [_reduced(view, scale) for view in walk_past([cylinder_of(pipe.start, pipe.end, pipe.radius, blue)])]
    rng = np.random.default_rng(1)
    wall = rectangle(rng, np.array([-1.5, 0.0, -0.5]), np.array([3.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.5]))
    wall = wall[(np.abs(wall - pipe.middle) > [0.42, 1.0, 0.06]).any(axis=1)]
    astray = pipe.at(rng.uniform(0.0, 1.0, 400)) + rng.uniform(-0.03, 0.03, (400, 3))
    cloud = np.vstack([wall + rng.normal(0.0, 1e-3, wall.shape), astray])
    pipes = detect(Cloud(cloud), BOQ, CONFIG, views)
    assert len(pipes) == found
    for each in pipes:
        assert abs(each.cylinder.radius - pipe.radius) < 3.0 * each.radius_sigma
        assert each.cylinder.length == pytest.approx(pipe.length, abs=0.02)


def _reduced(view: View, scale: float) -> View:
    camera = view.camera.scaled(scale)
    assert view.chromaticity is not None
    image, chromaticity = (
        np.asarray(cv2.resize(each, (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.uint8)
        for each in (view.image, view.chromaticity)
    )
    return replace(view, camera=camera, image=image, chromaticity=chromaticity)


@pytest.mark.parametrize(("length", "is_seen"), [(0.4, False), (0.16, True)])
def test_a_line_that_is_dropped_in_the_end_hides_no_thin_pipe_before(
    empty_views: list[View], monkeypatch: pytest.MonkeyPatch, length: float, is_seen: bool
) -> None:
    """A piece of a pipe that does not stand for itself, or a stub, must not be known where the whole one is sought."""
    piece = replace(PIPE.cut(0.0, length).shifted(np.array([0.12, 0.0, 0.0])), radius=0.0086)
    evidence = CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
    measured = MeasuredPipe.of_cloud(Candidate(piece, 1e-3, 100, evidence))
    known: list[list[MeasuredPipe]] = []

    def finds_none(
        points: FloatArray, around: SceneContext, thickest: float, found: list[MeasuredPipe], *_: object
    ) -> list[MeasuredPipe]:
        known.append(list(found))
        return []

    monkeypatch.setattr(detector.KeyframeVerifier, "measure", lambda *_: [measured])
    monkeypatch.setattr(detector, "_genuine", lambda pipes, *_: pipes)
    monkeypatch.setattr(detector, "is_false_line", lambda *_: False)
    monkeypatch.setattr(detector, "find_thin_pipes", finds_none)
    monkeypatch.setattr(detector, "is_probable", lambda *_: is_seen)
    assert detect(Cloud(wall_points()), BOQ, CONFIG, empty_views) == []
    assert known == [[]]


def test_the_blur_of_the_views_is_that_of_thick_pipes(pipe_views: list[View]) -> None:
    def pipe(radius: float, blur: float) -> MeasuredPipe:
        cylinder = replace(PIPE, radius=radius)
        evidence = CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
        fit = ContourFit(cylinder, np.eye(3)[1:], np.eye(5), 2e-4, 0.7, 100.0, 20, (0.0, 0.0), 0.0, 0.5, blur)
        return MeasuredPipe.of_contour(Candidate(cylinder, 2e-4, 100, evidence), fit)

    thick, thin = [pipe(0.04, blur) for blur in (0.6, 0.7, 1.4)], pipe(0.0086, 2.0)
    of_cloud = replace(thick[0], fit=None)
    assert {view.blur for view in detector._with_blur(pipe_views, [*thick, thin, of_cloud])} == {0.7}
    assert detector._with_blur(pipe_views, [thin, of_cloud]) == pipe_views


@pytest.mark.parametrize(("noise", "stands"), [(0.001, True), (0.02, False)])
def test_a_pipe_of_which_others_hide_both_sides_stands_as_the_cloud_has_it(
    pipe_views: list[View], noise: float, stands: bool
) -> None:
    """What no view shows beside the others was fitted to their edges, unless the cloud resolves the same pipe."""
    hiding = [Cylinder(np.array([x, -0.08, -0.5]), np.array([x, -0.08, 0.5]), 0.09) for x in (-0.09, 0.09)]
    found = []
    for cylinder, spread in ((PIPE, noise), *((each, 0.02) for each in hiding)):
        candidate = Candidate(cylinder, 0.2 * spread, 3000, CloudEvidence(np.pi, 0.9, 0.0, spread, 0.0, 300.0))
        fit = ContourFit(cylinder, np.eye(3)[1:], np.eye(5), 2e-4, 0.6, 90.0, 20, (0.0, 0.0), 0.0, 0.5)
        found.append(MeasuredPipe.of_contour(candidate, fit))
    nothing = octree.build(np.full((8, 3), 50.0))
    genuine = detector._genuine(found, SceneContext(nothing, None, [], nothing, 1e-3), pipe_views)
    assert [each.cylinder for each in genuine] == [PIPE] * stands + hiding
