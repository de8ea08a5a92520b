# SPDX-License-Identifier: Apache-2.0
"""Each acceptance criterion holds on one side of its threshold and fails on the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeprog_detect.cloud.acceptance import seen_from_inside, seen_from_outside
from pipeprog_detect.cloud.candidate import Candidate, CloudEvidence
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.product.standard_sizes import SIZES
from pipeprog_detect.types import Cylinder

NOISE = 2e-3  # of the cloud [m]
RADIUS = 0.05  # [m]
OUTSIDE = seen_from_outside(NOISE, DetectConfig())
GOOD = CloudEvidence(arc=np.radians(150.0), coverage=1.0, inside=0.0, noise=NOISE, roundness=0.0, flatness=10.0)


def candidate(
    evidence: CloudEvidence = GOOD, length: float = 1.0, sigma: float = 0.01, radius: float = RADIUS
) -> Candidate:
    """A pipe of `length` [m] with a standard deviation of the radius of `sigma` radii."""
    return Candidate(Cylinder(np.zeros(3), np.array([0.0, 0.0, length]), radius), sigma * radius, 1000, evidence)


@pytest.mark.parametrize(
    ("name", "accepted", "refused"),
    [
        ("arc", np.radians(60.1), np.radians(59.9)),
        ("coverage", 0.41, 0.39),
        ("inside", 0.14, 0.16),
        # 1.6 x 2 mm + 0.8 mm.
        ("noise", 3.99e-3, 4.01e-3),
        # 0.3 x 2 mm + 0.02 x 50 mm + 0.3 mm.
        ("roundness", 1.89e-3, 1.91e-3),
        ("flatness", 1.46, 1.44),
    ],
)
def test_evidence_is_judged_by_its_threshold(name: str, accepted: float, refused: float) -> None:
    assert OUTSIDE.accept(candidate(replace(GOOD, **{name: accepted})))
    assert not OUTSIDE.accept(candidate(replace(GOOD, **{name: refused})))


@pytest.mark.parametrize(
    ("arc_deg", "least"),
    [(150.0, 3.0 * RADIUS), (75.0, np.sqrt(2.0) * 4.0 * RADIUS)],
    ids=["half a circumference", "a strip"],
)
def test_pipe_is_longer_than_an_elbow(arc_deg: float, least: float) -> None:
    evidence = replace(GOOD, arc=np.radians(arc_deg))
    assert OUTSIDE.accept(candidate(evidence, length=1.01 * least))
    assert not OUTSIDE.accept(candidate(evidence, length=0.99 * least))


def test_pipe_is_at_least_as_long_as_set() -> None:
    assert OUTSIDE.accept(candidate(length=0.101, radius=0.025))
    assert not OUTSIDE.accept(candidate(length=0.099, radius=0.025))


def test_radius_tells_standard_sizes_apart() -> None:
    """At the limit, half of the radii lie nearer to another size than to their own; beyond, more."""
    assert OUTSIDE.accept(candidate(sigma=0.159))
    assert not OUTSIDE.accept(candidate(sigma=0.161))
    diameters = np.array(
        [SIZES[f"DN{size} steel"].outer_diameter for size in (15, 20, 25, 32, 40, 50, 65, 80, 100, 125, 150, 200)]
    )
    half_step = 0.5 * float(np.mean(np.diff(np.log(diameters))))
    assert half_step / 0.674 == pytest.approx(OUTSIDE.radius_sigma_max, rel=0.02)
    assert half_step / 2.33 == pytest.approx(OUTSIDE.vague_radius_sigma, rel=0.02)


@pytest.mark.parametrize(("sigma", "radius"), [(0.047, RADIUS), (0.01, 0.019)], ids=["vague radius", "thin pipe"])
def test_vague_radius_needs_a_quarter_of_the_circumference(sigma: float, radius: float) -> None:
    quarter, less = (replace(GOOD, arc=np.radians(arc)) for arc in (90.0, 85.0))
    assert OUTSIDE.accept(candidate(quarter, sigma=sigma, radius=radius))
    assert not OUTSIDE.accept(candidate(less, sigma=sigma, radius=radius))
    assert OUTSIDE.accept(candidate(less, sigma=0.045))


def test_relaxed_criteria_allow_rougher_surfaces_only() -> None:
    twice = OUTSIDE.relaxed(2.0)
    rough = replace(GOOD, noise=1.9 * 4e-3)
    assert twice.accept(candidate(rough))
    assert not twice.accept(candidate(replace(GOOD, noise=2.1 * 4e-3)))
    assert not twice.accept(candidate(replace(GOOD, flatness=1.44)))


def test_a_piece_is_as_long_as_it_is_wide() -> None:
    piece = OUTSIDE.of_piece()
    assert piece.accept(candidate(length=2.05 * 0.1, radius=0.1))
    assert not piece.accept(candidate(length=1.95 * 0.1, radius=0.1))
    assert piece.accept(candidate(replace(GOOD, arc=np.radians(75.0)), length=2.05 * 0.1, radius=0.1))
    assert not piece.accept(candidate(replace(GOOD, flatness=1.44), length=2.05 * 0.1, radius=0.1))


def test_a_shorter_piece_has_a_radius_that_is_known_the_better() -> None:
    short = OUTSIDE.of_short_piece()
    assert short.accept(candidate(length=1.05 * 0.1, radius=0.1, sigma=0.009))
    assert not short.accept(candidate(length=1.05 * 0.1, radius=0.1, sigma=0.011))
    assert not short.accept(candidate(length=0.95 * 0.1, radius=0.1, sigma=0.009))


def test_of_a_held_radius_only_the_surface_is_judged() -> None:
    held = replace(candidate(replace(GOOD, flatness=1.01), sigma=0.2), radius_held=True)
    assert OUTSIDE.of_held_radius().accept(held)
    assert not OUTSIDE.of_held_radius().accept(replace(held, evidence=replace(GOOD, flatness=0.99)))
    # It is not the cloud that tells the radius, however well the points fit.
    assert not OUTSIDE.accept(replace(candidate(), radius_held=True))


def test_pipe_seen_from_inside_may_be_short_but_its_radius_is_known() -> None:
    inside = seen_from_inside(NOISE, DetectConfig())
    assert inside.accept(candidate(length=0.51 * 0.3, radius=0.3))
    assert not inside.accept(candidate(length=0.49 * 0.3, radius=0.3))
    assert not inside.accept(candidate(sigma=0.021))
    # 5 % of the radius is less than twice the limit of noise.
    assert not inside.accept(candidate(replace(GOOD, noise=2.6e-3)))


def test_planes_do_not_pass_for_cylinders() -> None:
    """Simulated: two unknowns more on 30 points of a plane explain 1 % of them better by the least flatness."""
    rng = np.random.default_rng(0)
    count, draws = 30, 100_000
    rest = rng.chisquare(count - 5, draws)
    ratio = (rest + rng.chisquare(2, draws)) / rest
    assert np.mean(ratio > OUTSIDE.flatness_min) == pytest.approx(0.01, abs=0.002)
