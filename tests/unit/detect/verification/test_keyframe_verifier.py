# SPDX-License-Identifier: Apache-2.0
"""The keyframes as judges: which of them are asked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.config import ContourConfig, DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.silhouette.occlusion import with_depths
from pipeprog_detect.types import Cloud, Cylinder, View
from pipeprog_detect.verification import keyframe_verifier
from pipeprog_detect.verification.candidate_fit import CandidateFitter
from pipeprog_detect.verification.keyframe_verifier import KeyframeVerifier
from pipeprog_detect.verification.measured_pipe import MeasuredPipe
from tests.unit.detect.pipe_and_wall import PIPE, front_points, wall_points
from tests.unit.detect.straight_ahead import looking_along_y

BOQ = BillOfQuantities((PipeClass("DN65", PIPE.radius, 3.0, (0.0, 0.0, 1.0), 4e-4),))


def test_a_pipe_that_few_keyframes_of_many_show_is_verified(pipe_views: list[View]) -> None:
    """On a long walk every thirtieth part of the keyframes would show the pipe twice, and no contour in three."""
    elsewhere = [looking_along_y(20.0 + number, 1000 + number) for number in range(200)]
    views = [view for number, view in enumerate(pipe_views) for view in [view, *elsewhere[25 * number :][:25]]]
    evidence = CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
    rough = Cylinder(PIPE.start, PIPE.end, 0.042)
    candidate = Candidate(rough, 0.002, 900, evidence)
    assert KeyframeVerifier(views, BOQ).verify(candidate)
    assert not KeyframeVerifier(elsewhere, BOQ).verify(candidate)


def test_a_candidate_of_which_a_neighbour_hides_one_side_stands_beside_it(pipe_views: list[View]) -> None:
    neighbour = Cylinder(np.array([0.1, -0.08, -0.5]), np.array([0.08, -0.08, 0.5]), 0.09)
    evidence = CloudEvidence(np.radians(130.0), 0.9, 0.0, 0.0015, 0.0, 3.0)
    rough = Candidate(replace(PIPE, radius=PIPE.radius + 0.003), 0.0015, 3000, evidence)
    verifier = KeyframeVerifier(pipe_views, BOQ)
    assert verifier.verify_beside(rough, [neighbour])
    assert not verifier.verify_beside(rough, [])  # whoever shows both sides is verified by both


def test_a_blurred_candidate_whose_highlight_makes_a_contour_is_verified_at_a_planned_radius(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its fit has two thirds of the planned radius; what the cloud resolves gets no second answer."""
    highlight = ContourFit(
        replace(PIPE, radius=0.65 * PIPE.radius), np.eye(3)[1:], np.eye(5), 2e-4, 0.6, 75.0, 20, (0.0, 0.0), 0.0, 0.5
    )
    monkeypatch.setattr(CandidateFitter, "fit", lambda *_, **__: highlight)
    blurred, resolved = (
        Candidate(replace(PIPE, radius=0.04), 0.002, 900, CloudEvidence(np.pi, 0.9, 0.0, noise, 0.0, 3.0))
        for noise in (0.01, 0.001)
    )
    assert blurred.blurred
    assert KeyframeVerifier(pipe_views, BOQ).verify(blurred)
    assert not KeyframeVerifier(pipe_views, BOQ).verify(resolved)


def test_a_contour_that_one_candidate_contradicts_may_be_that_of_the_next(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rough cloud has several fits of one pipe, of 32 to 37 mm; hardly seen, it is 36.5 mm."""
    contour = ContourFit(PIPE, np.eye(3)[1:], np.eye(5), 2e-4, 0.49, 10.0, 20, (0.0, 0.0), 0.0, 0.5)
    monkeypatch.setattr(CandidateFitter, "fit", lambda *_, **__: contour)
    evidence = CloudEvidence(np.pi, 0.9, 0.0, 1.8e-3, 0.0, 3.0)
    thin, right = (Candidate(replace(PIPE, radius=share * PIPE.radius), 5e-4, 900, evidence) for share in (0.9, 0.99))
    verifier = KeyframeVerifier(pipe_views, BOQ)
    assert not verifier.verify(thin)
    monkeypatch.setattr(CandidateFitter, "fit", lambda *_, **__: pytest.fail("measured twice"))
    assert verifier.verify(right)
    assert not verifier.verify(thin)


@pytest.mark.parametrize(("support", "share"), [(0.39, 0.99), (0.6, 0.92)])
def test_a_contour_that_is_hardly_seen_does_not_overrule_the_planned_radius_of_the_cloud(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch, support: float, share: float
) -> None:
    """Of a pipe in a rack, whose contour got an edge of its neighbour, 8 % too thin."""
    thin = replace(PIPE, radius=0.92 * PIPE.radius)
    contour = ContourFit(thin, np.eye(3)[1:], np.eye(5), 2e-4, support, 75.0, 20, (0.0, 0.0), 0.0, 0.5)
    monkeypatch.setattr(CandidateFitter, "fit", lambda *_, **__: contour)
    monkeypatch.setattr(CandidateFitter, "near_planned", lambda *_: contour)
    monkeypatch.setattr(CandidateFitter, "of_planned_radius", lambda *_: None)  # nor is another one seen
    cloud = Candidate(
        replace(PIPE, radius=0.99 * PIPE.radius), 3e-4, 900, CloudEvidence(np.pi, 0.9, 0.0, 1e-3, 0.0, 300.0)
    )
    measured = KeyframeVerifier(pipe_views, BOQ).measure([cloud], [True])
    assert [each.cylinder.radius for each in measured] == [share * PIPE.radius]


@pytest.mark.parametrize(("in_cloud", "share"), [(1.0, 1.0), (0.99, 0.964), (0.93, 0.964)])
def test_a_contour_of_no_planned_size_gives_way_to_the_planned_one_that_the_cloud_has(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch, in_cloud: float, share: float
) -> None:
    """A shadow along a pipe made its contour 3.6 % too thin; a cloud nearer than 3 sigma, or as thin, says nothing."""
    thin = replace(PIPE, radius=0.964 * PIPE.radius)
    contour = ContourFit(thin, np.eye(3)[1:], np.eye(5), 1e-4, 1.0, 80.0, 20, (0.0, 0.0), 0.0, 0.5)
    monkeypatch.setattr(CandidateFitter, "fit", lambda *_, **__: contour)
    monkeypatch.setattr(CandidateFitter, "near_planned", lambda *_: contour)
    evidence = CloudEvidence(np.pi, 0.9, 0.0, 3e-4, 0.0, 300.0)
    cloud = Candidate(replace(PIPE, radius=in_cloud * PIPE.radius), 2e-4, 900, evidence)
    [measured] = KeyframeVerifier(pipe_views, BOQ).measure([cloud], [True])
    assert measured.cylinder.radius == share * PIPE.radius


def test_the_keyframes_measure_a_pipe_unless_contours_are_disabled(pipe_views: list[View]) -> None:
    points = np.concatenate([wall_points(), front_points(PIPE)])
    points = points + np.random.default_rng(3).normal(0.0, 1e-3, points.shape)
    disabled = DetectConfig(contour=ContourConfig(enabled=False))
    cloud_alone = detect(Cloud(points), BOQ, DetectConfig())
    without, measured = (detect(Cloud(points), BOQ, config, pipe_views) for config in (disabled, DetectConfig()))
    assert len(cloud_alone) == len(without) == len(measured) == 1
    assert without[0].cylinder.radius == cloud_alone[0].cylinder.radius
    assert measured[0].cylinder.radius != cloud_alone[0].cylinder.radius


def beside(offset: float, radius: float) -> Cylinder:
    """A cylinder whose axis lies `offset` [m] beside that of the pipe, as the cameras see it."""
    across = np.cross(PIPE.axis, [0.0, 1.0, 0.0])
    return Cylinder(PIPE.start + offset * across, PIPE.end + offset * across, radius)


def measured_radius(candidate: Cylinder, noise: float, other: float, views: list[View]) -> float:
    """Radius [m] of what the views make of a rough candidate where that of the pipe and another one are planned."""
    boq = BillOfQuantities((*BOQ.classes, PipeClass("other", other, 3.0, (1.0, 0.0, 0.0), 4e-4)))
    rough = Candidate(candidate, 1e-3, 900, CloudEvidence(np.pi, 0.9, 0.0, noise, 0.0, 300.0))
    found = KeyframeVerifier(views, boq).measure([rough], [False])
    return found[0].cylinder.radius


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_an_edge_before_which_nothing_is_seen_is_no_limb(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch, side: float
) -> None:
    """A shadow on the wall had become a limb: a DN65 of two fields was a DN100."""
    cloud = np.concatenate([wall_points(), front_points(PIPE)])
    views = with_depths(pipe_views, cloud)
    wide = ContourFit(beside(side * 0.024, 0.064), np.eye(3)[1:], np.eye(5), 2e-4, 0.8, 75.0, 20, (0.0, 0.0), 0.0, 0.5)
    monkeypatch.setattr(CandidateFitter, "fit", lambda *_, **__: wide)
    assert measured_radius(beside(side * 0.01, 0.05), 0.005, 0.064, views) == pytest.approx(PIPE.radius, abs=5e-4)
    assert measured_radius(beside(side * 0.01, 0.05), 0.005, 0.064, pipe_views) == 0.064  # without what the cloud shows


@pytest.mark.parametrize(("support", "log_odds", "right"), [(0.3, 10.0, True), (0.3, 1e6, False), (0.6, 10.0, False)])
def test_a_contour_that_is_hardly_seen_gives_way_to_a_planned_one_that_is(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch, support: float, log_odds: float, right: bool
) -> None:
    """The cloud of a DN225 lay 17 mm beside it, farther than a contour is sought: an edge on it made it a DN200."""
    edge = ContourFit(beside(0.01, 0.046), np.eye(3)[1:], np.eye(5), 2e-4, support, log_odds, 20, (0.0, 0.0), 0.0, 0.5)
    monkeypatch.setattr(CandidateFitter, "fit", lambda *_, **__: edge)
    expected = PIPE.radius if right else 0.046
    assert measured_radius(beside(0.012, PIPE.radius), 0.003, 0.046, pipe_views) == pytest.approx(expected, abs=5e-4)


@pytest.mark.parametrize(("least", "stands"), [(0.3, True), (0.5, False)])
def test_a_piece_stands_where_the_keyframes_show_it_longer(pipe_views: list[View], least: float, stands: bool) -> None:
    piece = Candidate(PIPE.cut(0.1, 0.2), 5e-4, 900, CloudEvidence(np.pi, 0.9, 0.0, 1e-3, 0.0, 300.0))
    assert KeyframeVerifier(pipe_views, BOQ).verify(piece, least) is stands


@pytest.mark.parametrize(("length", "density"), [(0.105, 1), (0.06, 4)])
def test_a_pipe_of_which_the_cloud_shows_a_piece_is_measured_whole(
    pipe_views: list[View], length: float, density: int
) -> None:
    """Stereo sees nothing on a smooth white pipe but a stretch beside a lamp, 2.6 or 1.5 radii long; elbows have more.

    Of the shorter one the cloud knows the radius to a hundredth.
    """
    config = DetectConfig(length_min=0.05)
    points = np.concatenate([wall_points(), *[front_points(PIPE.cut(0.1, 0.1 + length))] * density])
    points = points + np.random.default_rng(3).normal(0.0, 5e-4, points.shape)
    assert detect(Cloud(points), BOQ, config) == []
    found = detect(Cloud(points), BOQ, config, pipe_views)
    assert len(found) == 1
    assert found[0].cylinder.length == pytest.approx(PIPE.length, abs=4e-3)
    assert found[0].cylinder.radius == pytest.approx(PIPE.radius, abs=5e-4)


@pytest.mark.parametrize(("is_seen", "aside", "parts"), [(True, 0.15, 0), (False, 0.15, 1), (True, 0.0, 1)])
def test_a_part_without_a_contour_is_none_where_that_of_the_whole_is_seen(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch, is_seen: bool, aside: float, parts: int
) -> None:
    """`aside` [m]: of the part from where the keyframes show a pipe; beside that they show the wall."""
    place = PIPE.shifted(np.array([aside, 0.0, 0.0]))
    fit = ContourFit(place, np.eye(3)[1:], np.eye(5), 2e-4, 0.6, 75.0, 20, (0.0, 0.0), 0.0, 0.5)
    candidate = Candidate(place, 2e-4, 900, CloudEvidence(np.pi, 0.9, 0.0, 5e-4, 0.0, 3.0))
    monkeypatch.setattr(keyframe_verifier, "free_stretches", lambda *_: [(0.3, PIPE.length)])
    monkeypatch.setattr(KeyframeVerifier, "measured", lambda _, part, *__: MeasuredPipe.of_cloud(part))
    whole = MeasuredPipe(candidate, place, 2e-4, fit=fit if is_seen else None)
    assert len(KeyframeVerifier(pipe_views, BOQ)._pieces(whole, [], True)) == parts


@pytest.mark.parametrize(
    ("outer", "inner", "share", "stands"),
    [(-30.0, 100.0, 0.6, 1), (70.0, 100.0, 0.6, 1), (95.0, 100.0, 0.6, 0), (-30.0, 5.0, 0.6, 0), (70.0, 100.0, 0.4, 0)],
)
def test_of_two_pipes_in_one_place_the_edges_tell_which(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch, outer: float, inner: float, share: float, stands: int
) -> None:
    """Pipes of several radii in line look like a thicker one in the cloud, which has most points."""
    told = {0.09: (0.5, outer), PIPE.radius: (share, inner)}

    def measured(self: KeyframeVerifier, candidate: Candidate, others: list[Cylinder], trusted: bool) -> MeasuredPipe:
        cylinder = candidate.cylinder
        fit = ContourFit(cylinder, np.eye(3)[1:], np.eye(5), 2e-4, *told[cylinder.radius], 20, (0.0, 0.0), 0.0, 0.5)
        return MeasuredPipe.of_contour(candidate, fit)

    monkeypatch.setattr(KeyframeVerifier, "measured", measured)
    monkeypatch.setattr(KeyframeVerifier, "_pieces", lambda self, whole, *_: [whole])
    evidence = CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
    candidates = [Candidate(PIPE, 2e-4, 500, evidence), Candidate(replace(PIPE, radius=0.09), 2e-4, 5000, evidence)]
    found = KeyframeVerifier(pipe_views, BOQ).measure(candidates, [True, True])
    assert [each.cylinder.radius for each in found] == [(0.09, PIPE.radius)[stands]]


@pytest.mark.parametrize(("beyond", "radii"), [(0.0, [PIPE.radius]), (0.6, [PIPE.radius, 0.09])])
def test_what_is_left_of_a_refuted_pipe_may_be_one_in_line(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch, beyond: float, radii: list[float]
) -> None:
    """The cloud makes one of a pipe and a thicker one behind its end; `beyond` [m]: how far that goes on."""

    def measured(self: KeyframeVerifier, candidate: Candidate, others: list[Cylinder], trusted: bool) -> MeasuredPipe:
        cylinder, odds = candidate.cylinder, 100.0 if candidate.cylinder.radius == PIPE.radius else -30.0
        fit = ContourFit(cylinder, np.eye(3)[1:], np.eye(5), 2e-4, 0.6, odds, 20, (0.0, 0.0), 0.0, 0.5)
        return MeasuredPipe.of_contour(candidate, fit if odds > 0.0 else replace(fit, support=0.5))

    monkeypatch.setattr(KeyframeVerifier, "measured", measured)
    monkeypatch.setattr(KeyframeVerifier, "_pieces", lambda self, whole, *_: [whole])
    evidence = CloudEvidence(np.pi, 0.9, 0.0, 0.003, 0.0, 3.0)
    both = replace(PIPE.cut(0.0, PIPE.length + beyond), radius=0.09)
    candidates = [Candidate(both, 2e-4, 5000, evidence), Candidate(PIPE, 2e-4, 500, evidence)]
    found = KeyframeVerifier(pipe_views, BOQ).measure(candidates, [True, True])
    assert [each.cylinder.radius for each in found] == radii
    assert [each.cylinder.length for each in found] == pytest.approx([PIPE.length, beyond][: len(radii)])
