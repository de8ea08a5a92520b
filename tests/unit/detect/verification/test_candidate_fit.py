# SPDX-License-Identifier: Apache-2.0
"""Fits with planned radii: of blurred candidates, of those of which one side is seen, and fits that stray."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.refinement.contour_fit import ContourFit
from pipeprog_detect.refinement.one_sided import SeenArc, with_radius
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View
from pipeprog_detect.verification import candidate_fit, radius_agreement
from pipeprog_detect.verification.candidate_fit import CandidateFitter
from pipeprog_detect.verification.keyframe_verifier import KeyframeVerifier
from pipeprog_detect.verification.measurement_cache import MeasurementCache
from tests.unit.detect import pipe_and_wall
from tests.unit.detect.straight_ahead import looking_along_y

PLANNED, SIGMA = 0.0086, 0.00015
PIPE = Cylinder(np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.0105)
# Hides one side of the pipe of `pipe_views` in all of them.
BEFORE = Cylinder(np.array([0.1, -0.08, -0.5]), np.array([0.08, -0.08, 0.5]), 0.09)
BLURRED = Candidate(PIPE, 0.002, 300, CloudEvidence(np.pi, 0.8, 0.0, 0.004, 0.0, 3.0))


@pytest.mark.parametrize(("sigmas", "stands"), [(0.0, True), (2.9, True), (4.5, False)])
def test_a_fit_keeps_to_the_planned_radius_that_it_was_sought_with(
    monkeypatch: pytest.MonkeyPatch, sigmas: float, stands: bool
) -> None:
    found = replace(PIPE, radius=PLANNED + sigmas * SIGMA)
    fit = ContourFit(found, np.eye(3)[1:], np.eye(5), SIGMA, 0.7, 100.0, 20, (0.0, 0.0), 0.0, 0.5)
    monkeypatch.setattr(candidate_fit, "_at_radius", lambda *_: fit)
    boq = BillOfQuantities((PipeClass("copper 17", PLANNED, 10.0, (1.0, 0.0, 1.0), 1e-4),))
    assert BLURRED.blurred
    assert (CandidateFitter(boq, MeasurementCache()).of_planned_radius(BLURRED, [], []) is fit) is stands


def _boq(*radii: float) -> BillOfQuantities:
    return BillOfQuantities(
        tuple(PipeClass(f"{1e3 * radius:.1f}", radius, 10.0, (0.0, 0.0, 1.0), 4e-4) for radius in radii)
    )


def test_of_a_pipe_that_shows_one_side_the_plan_tells_the_radius(pipe_views: list[View]) -> None:
    """A neighbour hides its other side in all views; to the cloud it is 3 mm thicker, at 2 sigma, and too rough."""
    true = pipe_and_wall.PIPE
    evidence = CloudEvidence(np.radians(130.0), 0.9, 0.0, 0.0015, 0.0, 3.0)
    rough = Candidate(replace(true, radius=true.radius + 0.003), 0.0015, 3000, evidence)
    sides = [CandidateFitter(_boq(*radii), MeasurementCache()) for radii in ((true.radius, 0.1), (true.radius, 0.041))]
    one, open_to_two = (fitter.of_visible_side(rough, [BEFORE], pipe_views) for fitter in sides)
    assert sides[0].fit(rough, [BEFORE], pipe_views) is None
    assert one is not None
    assert open_to_two is None
    assert one.cylinder.radius == pytest.approx(true.radius, abs=1e-4)
    assert np.linalg.norm(one.cylinder.from_axis(true.middle[None])[0]) < 3e-3


@pytest.mark.parametrize("share", [0.9, 1.15])
def test_a_radius_that_was_given_to_a_candidate_is_no_observation(pipe_views: list[View], share: float) -> None:
    """Of a pipe of which a neighbour hides one side: the cloud has its surface, and got the radius of another size."""
    true, other = pipe_and_wall.PIPE, share * pipe_and_wall.PIPE.radius
    evidence = CloudEvidence(np.radians(130.0), 0.9, 0.0, 0.0015, 0.0, 3.0)
    given = with_radius(Scene.of(true, pipe_views, [BEFORE]), SeenArc(evidence.arc, 0.0015), other)
    candidate = Candidate(given, 0.003, 3000, evidence, radius_held=True)
    fitter = CandidateFitter(_boq(true.radius, other), MeasurementCache())
    measured = fitter.of_visible_side(candidate, [BEFORE], pipe_views)
    assert measured is not None
    assert measured.cylinder.radius == pytest.approx(true.radius, abs=1e-4)


def test_where_the_noise_hides_the_bend_all_planned_radii_are_tried(pipe_views: list[View]) -> None:
    """A line of points in a rough cloud was given two and a half times the radius."""
    pipe = pipe_and_wall.PIPE
    classes = tuple(PipeClass(f"R{radius}", radius, 3.0, (0.0, 0.0, 1.0), 4e-4) for radius in (pipe.radius, 0.1))
    behind = np.array([0.0, pipe.radius, 0.0])
    given = Cylinder(pipe.start + behind, pipe.end + behind, 0.1)
    evidence = CloudEvidence(np.radians(70.0), 0.9, 0.0, 0.01, 0.0, 9.0)
    fitter = CandidateFitter(BillOfQuantities(classes), MeasurementCache())
    fit = fitter.fit(Candidate(given, 0.06, 900, evidence, radius_held=True), [], pipe_views)
    assert fit is not None
    assert fit.cylinder.radius == pytest.approx(pipe.radius, abs=1e-3)


@pytest.mark.parametrize(("odds", "told"), [(190.0, 0.1095), (90.0, None), (80.0, 0.1223)])
def test_the_side_that_is_seen_tells_two_planned_radii_apart(
    odds: float, told: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stereo spreads the ends of an arc: to the cloud a DN200 is 9 % thicker, at 5.4 times the scatter of its points.

    Spread by that scatter at both ends, it is at 2 sigma, and a DN225 at 0.6: e^1.9 less probable by the surface, where
    the edges make the DN225 as probable as e^87.
    """
    cylinder = Cylinder(np.zeros(3), np.array([3.0, 0.0, 0.0]), 0.1193)
    candidate = Candidate(cylinder, 1.6e-3, 50_000, CloudEvidence(np.radians(105.0), 0.96, 0.0, 1.8e-3, 6e-4, 42.0))

    def fitted(_: Candidate, known: Cylinder, *__: object) -> ContourFit:
        log_odds = odds if known.radius < 0.11 else 87.0
        return ContourFit(known, np.eye(3)[1:], np.eye(5), 2e-4, 0.6, log_odds, 20, (0.0, 0.0), 0.0, 0.5)

    monkeypatch.setattr(candidate_fit, "_of_one_side", fitted)
    monkeypatch.setattr(candidate_fit, "_with_surface", lambda _, radius, *__: replace(cylinder, radius=radius))
    fit = CandidateFitter(_boq(0.1095, 0.1223), MeasurementCache()).of_visible_side(candidate, [], [])
    assert (fit and fit.cylinder.radius) == told
    # At 3.4 sigma the surface does not allow a size.
    assert CandidateFitter(_boq(0.1035), MeasurementCache()).of_visible_side(candidate, [], []) is None


@pytest.mark.parametrize(("odds", "told"), [(31.0, None), (40.0, None), (15.0, 0.1095)])
def test_a_radius_of_which_little_is_seen_is_a_rival_of_others(
    odds: float, told: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A DN100 became a DN65: its own fit had support along less than half, and nearly the same odds."""
    cylinder = Cylinder(np.zeros(3), np.array([3.0, 0.0, 0.0]), 0.116)
    candidate = Candidate(cylinder, 2.7e-3, 2000, CloudEvidence(np.radians(80.0), 0.96, 0.0, 5e-3, 6e-4, 3.0))
    assert not radius_agreement.is_resolved(candidate)

    def fitted(_: Candidate, known: Cylinder, *__: object) -> ContourFit:
        support, log_odds = (0.55, 32.0) if known.radius < 0.11 else (0.4, odds)
        return ContourFit(known, np.eye(3)[1:], np.eye(5), 2e-4, support, log_odds, 20, (0.0, 0.0), 0.0, 0.5)

    monkeypatch.setattr(candidate_fit, "_of_one_side", fitted)
    monkeypatch.setattr(candidate_fit, "_with_surface", lambda _, radius, *__: replace(cylinder, radius=radius))
    fit = CandidateFitter(_boq(0.1095, 0.1223), MeasurementCache()).of_visible_side(candidate, [], [])
    assert (fit and fit.cylinder.radius) == told


@pytest.mark.parametrize(("arc", "told"), [(70.0, None), (140.0, 0.1095)])
def test_an_arc_tells_less_of_where_the_axis_lies_across_it(
    arc: float, told: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A DN225 under a ceiling became a DN200, since its edge lies 8 mm beside where the surface expects it, not 5 mm.

    Of 70 deg both are within two standard deviations, and the DN225 is nearer to what the cloud has.
    """
    cylinder = Cylinder(np.zeros(3), np.array([3.5, 0.0, 0.0]), 0.128)
    sigma = 2.2e-3 / (1.0 - np.cos(np.radians(35.0)))  # of the radius, as for 70 deg
    evidence = CloudEvidence(np.radians(arc), 0.98, 0.0, 2.2e-3, 3e-4, 11.0)
    candidate = Candidate(cylinder, 2.1e-3, 50_000, evidence)
    monkeypatch.setattr(Candidate, "arc_sigma", sigma)

    def fitted(_: Candidate, known: Cylinder, *__: object) -> ContourFit:
        aside, log_odds = (0.005, 172.0) if known.radius < 0.11 else (0.008, 170.0)
        found = known.shifted(np.array([0.0, 0.0, aside]))
        return ContourFit(found, np.eye(3)[1:], np.eye(5), 2e-4, 0.9, log_odds, 20, (0.0, 0.0), 0.0, 0.5)

    monkeypatch.setattr(candidate_fit, "_sigma", lambda _: 2.2e-3)
    monkeypatch.setattr(candidate_fit, "_of_one_side", fitted)
    monkeypatch.setattr(candidate_fit, "_with_surface", lambda _, radius, *__: replace(cylinder, radius=radius))
    fit = CandidateFitter(_boq(0.1095, 0.1223), MeasurementCache()).of_visible_side(candidate, [], [])
    assert (fit and fit.cylinder.radius) == told


@pytest.mark.parametrize(("thicker", "sigma"), [(0.003, 2e-4), (0.0012, 1.5e-4), (0.0005, 4e-3)])
def test_of_one_side_the_planned_radius_near_it_is_measured(
    pipe_views: list[View], thicker: float, sigma: float
) -> None:
    """Wrong radii that are told well, one of a class but beyond 1 %, and one not told: what would tell it is hidden."""
    true = pipe_and_wall.PIPE
    evidence = CloudEvidence(np.radians(130.0), 0.9, 0.0, 0.0015, 0.0, 3.0)
    rough = Candidate(replace(true, radius=true.radius + 0.006), 0.0015, 3000, evidence)
    wrong = replace(true, radius=true.radius + thicker)
    fit = ContourFit(wrong, np.eye(3)[1:], np.eye(5), sigma, 1.0, 100.0, 20, (0.0, 0.0), 0.0, 0.5)
    fitter = CandidateFitter(_boq(true.radius), MeasurementCache())
    measured = fitter.near_planned(rough, fit, [BEFORE], pipe_views)
    assert measured is not None
    assert measured is not fit
    assert measured.cylinder.radius == pytest.approx(true.radius, abs=1e-4)


def test_the_radius_that_one_side_does_not_tell_is_the_one_that_the_cloud_allows(pipe_views: list[View]) -> None:
    """The fit is 12 mm too thin at 1.2 sigma, with its visible surface in place, nearer a thinner size of the plan."""
    true = pipe_and_wall.PIPE
    evidence = CloudEvidence(np.radians(130.0), 0.9, 0.0, 0.0015, 0.0, 3.0)
    rough = Candidate(replace(true, radius=true.radius + 0.003), 0.0015, 3000, evidence)
    scene, seen = Scene.of(true, pipe_views, [BEFORE]), SeenArc(evidence.arc, 0.0015)
    thin = with_radius(scene, seen, 0.92 * true.radius)
    fit = ContourFit(thin, np.eye(3)[1:], np.eye(5), 0.01, 1.0, 100.0, 20, (0.0, 0.0), 0.0, 0.5)
    boq = _boq(true.radius, 0.9 * true.radius)
    measured = CandidateFitter(boq, MeasurementCache()).near_planned(rough, fit, [BEFORE], pipe_views)
    assert measured is not None
    assert measured.cylinder.radius == pytest.approx(true.radius, abs=1e-4)


@pytest.mark.parametrize(("noise", "is_tried"), [(0.0009, False), (0.0040, True)])
def test_a_planned_radius_that_the_cloud_excludes_is_not_taken(
    monkeypatch: pytest.MonkeyPatch, noise: float, is_tried: bool
) -> None:
    """A DN225 (122.3 mm) between neighbours: one contour ends in 116.1 mm, and a DN200 has one as well supported."""
    evidence = CloudEvidence(np.radians(155.0), 1.0, 0.0, noise, 0.0004, 800.0)
    resolved = Candidate(replace(PIPE, radius=0.1224), 0.00046, 30_000, evidence)
    own, other = (
        ContourFit(
            replace(PIPE, radius=radius), np.eye(3)[1:], np.eye(5), 2e-4, support, 150.0, 20, (0.0, 0.0), 0.0, 0.5
        )
        for radius, support in ((0.1161, 0.76), (0.1095, 0.62))
    )
    monkeypatch.setattr(
        candidate_fit, "_at_radius", lambda _, radius, *__: other if radius == other.cylinder.radius else None
    )
    monkeypatch.setattr(candidate_fit, "_of_one_side", lambda *_: None)
    fitter = CandidateFitter(_boq(0.1095, 0.1223), MeasurementCache())
    taken = fitter.near_planned(resolved, own, [], [looking_along_y(0.0, 0)])
    assert taken is (other if is_tried else own)


@pytest.mark.parametrize(
    ("arc", "planned", "is_taken"), [(85.0, 0.0365, True), (125.0, 0.0365, False), (85.0, 0.0549, False)]
)
def test_a_small_arc_does_not_exclude_thinner_radii(
    monkeypatch: pytest.MonkeyPatch, arc: float, planned: float, is_taken: bool
) -> None:
    """A pipe of which a tray hides one side: stereo makes what is left of it too flat, by 6 of its sigmas."""
    evidence = CloudEvidence(np.radians(arc), 0.9, 0.0, 0.001, 0.0, 20.0)
    flat = Candidate(replace(PIPE, radius=0.0457), 0.00153, 20_000, evidence)
    between = replace(PIPE, radius=planned + 0.07 * (0.0457 - planned))
    own, one_side = (
        ContourFit(cylinder, np.eye(3)[1:], np.eye(5), 3e-4, support, 90.0, 20, (0.0, 0.0), 0.0, 0.5)
        for cylinder, support in ((between, 0.5), (replace(PIPE, radius=planned), 0.53))
    )
    monkeypatch.setattr(candidate_fit, "_at_radius", lambda *_: None)
    monkeypatch.setattr(candidate_fit, "_with_surface", lambda *_: one_side.cylinder)
    monkeypatch.setattr(candidate_fit, "_of_one_side", lambda *_: one_side)
    fitter = CandidateFitter(_boq(planned), MeasurementCache())
    taken = fitter.near_planned(flat, replace(own, radius_sigma=0.01), [], [looking_along_y(0.0, 0)])
    assert (taken is one_side) is is_taken


@pytest.mark.parametrize(("arc", "support", "stands"), [(115.0, 0.6, True), (115.0, 0.4, False), (125.0, 0.4, True)])
def test_of_a_pipe_in_a_rack_one_side_suffices(
    monkeypatch: pytest.MonkeyPatch, arc: float, support: float, stands: bool
) -> None:
    """Its other side is hidden, and the cloud has it 6 mm too thick: along 115 deg it may be the edge of a box."""
    evidence = CloudEvidence(np.radians(arc), 0.98, 0.0, 0.0027, 0.0, 11.0)
    rough = Candidate(replace(PIPE, radius=0.0634), 0.00275, 30_000, evidence)
    fit = ContourFit(
        replace(PIPE, radius=0.0575), np.eye(3)[1:], np.eye(5), 2e-4, support, 90.0, 20, (0.0, 0.0), 0.0, 0.5
    )
    monkeypatch.setattr(CandidateFitter, "fit", lambda *_, **__: None)
    monkeypatch.setattr(candidate_fit, "_of_one_side", lambda *_: fit)
    monkeypatch.setattr(candidate_fit, "_with_surface", lambda *_: fit.cylinder)
    verifier = KeyframeVerifier([looking_along_y(0.0, 0)], _boq(0.0575))
    assert [each.cylinder for each in verifier.measure([rough], [False])] == [fit.cylinder] * stands


@pytest.mark.parametrize(("found", "stands"), [(0.0682, True), (0.0575, False)])
def test_of_an_arc_that_led_to_no_planned_radius_one_side_is_tried(
    monkeypatch: pytest.MonkeyPatch, found: float, stands: bool
) -> None:
    """A DN100 under a ceiling, of which stereo spreads the ends of 115 deg: 19 % too thick, at 2.97 times its sigma.

    Its own edges were not within the search from there; where they are found, they are what tells.
    """
    evidence = CloudEvidence(np.radians(115.0), 0.98, 0.0, 0.00166, 0.0, 26.0)
    rough = Candidate(replace(PIPE, radius=0.0685), 0.00094, 30_000, evidence)
    free, one_side = (
        ContourFit(
            replace(PIPE, radius=radius), np.eye(3)[1:], np.eye(5), 2e-4, support, 90.0, 20, (0.0, 0.0), 0.0, 0.5
        )
        for radius, support in ((found, 0.55), (0.0575, 0.78))
    )
    monkeypatch.setattr(CandidateFitter, "fit", lambda *_, **__: free)
    monkeypatch.setattr(candidate_fit, "_at_radius", lambda *_: None)
    monkeypatch.setattr(candidate_fit, "_of_one_side", lambda *_: one_side)
    monkeypatch.setattr(candidate_fit, "_with_surface", lambda *_: one_side.cylinder)
    measured = KeyframeVerifier([looking_along_y(0.0, 0)], _boq(0.0575)).measure([rough], [False])
    assert [each.fit is one_side for each in measured] == [stands]


@pytest.mark.parametrize(("noise", "stands"), [(0.0004, True), (0.004, False)])
def test_one_side_verifies_what_the_cloud_resolves(monkeypatch: pytest.MonkeyPatch, noise: float, stands: bool) -> None:
    """A DN200 between two elbows at the lower border of the images: 75 deg of arc, and its upper side."""
    arc = CloudEvidence(np.radians(75.0), 1.0, 0.02, noise, 0.0002, 188.0)
    candidate = Candidate(replace(PIPE, radius=0.1119), 0.0012, 3000, arc)
    found = replace(PIPE, radius=0.1095)
    fit = ContourFit(found, np.eye(3)[1:], np.eye(5), 2e-4, 0.6, 90.0, 20, (0.0, 0.0), 0.0, 0.5)
    monkeypatch.setattr(CandidateFitter, "fit", lambda *_, **__: None)
    monkeypatch.setattr(candidate_fit, "_of_one_side", lambda *_: fit)
    monkeypatch.setattr(candidate_fit, "_with_surface", lambda *_: found)
    assert KeyframeVerifier([looking_along_y(0.0, 0)], _boq(0.1095)).verify(candidate) is stands


def test_a_fit_out_of_the_candidates_reach_gives_way_to_a_planned_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two pipes of a rack 8 cm apart: the outer edge of one and that of the other make a thick pipe."""
    rough = Candidate(replace(PIPE, radius=0.0436), 0.0023, 15000, CloudEvidence(2.6, 0.9, 0.0, 0.0032, 0.0, 3.0))
    both, own = (
        ContourFit(
            replace(PIPE, radius=radius), np.eye(3)[1:], np.eye(5), 2e-4, support, 100.0, 20, (0.0, 0.0), 0.0, 0.5
        )
        for radius, support in ((0.0559, 0.85), (0.0367, 1.0))
    )
    boq = _boq(0.0365, 0.0559)
    assert CandidateFitter(boq, MeasurementCache()).strays(rough, both)
    assert not CandidateFitter(boq, MeasurementCache()).strays(rough, own)
    monkeypatch.setattr(CandidateFitter, "fit", lambda *_, **__: both)
    monkeypatch.setattr(candidate_fit, "_at_radius", lambda *_: own)
    camera = looking_along_y(0.0, 0)
    measured = KeyframeVerifier([camera], boq).measure([rough], [False])
    assert [each.cylinder.radius for each in measured] == [own.cylinder.radius]


@pytest.mark.parametrize("is_near", [True, False])
def test_a_planned_radius_is_tried_near_the_contour_of_one_that_is_none(
    monkeypatch: pytest.MonkeyPatch, is_near: bool
) -> None:
    """A DN65 in a cable tray: to the cloud, which has the tray as well, it is 10 mm too thick, more than 3 sigma."""
    evidence = CloudEvidence(np.radians(125.0), 0.98, 0.0, 0.0019, 0.0, 11.0)
    rough = Candidate(replace(PIPE, radius=0.0471), 0.0032, 9000, evidence)
    free, planned = (
        ContourFit(replace(PIPE, radius=radius), np.eye(3)[1:], np.eye(5), 2e-4, 1.0, odds, 11, (0.0, 0.0), 0.0, 0.5)
        for radius, odds in ((0.0389, 157.0), (0.0365, 169.0))
    )

    def at_radius(cylinder: Cylinder, *_: object) -> ContourFit | None:
        return planned if is_near and cylinder is free.cylinder else None

    monkeypatch.setattr(CandidateFitter, "fit", lambda *_, **__: free)
    monkeypatch.setattr(candidate_fit, "_at_radius", at_radius)
    monkeypatch.setattr(candidate_fit, "_of_one_side", lambda *_: None)
    monkeypatch.setattr(candidate_fit, "_with_surface", lambda *_: free.cylinder)
    measured = KeyframeVerifier([looking_along_y(0.0, 0)], _boq(0.0365)).measure([rough], [False])
    assert [each.fit for each in measured] == [planned] * is_near
