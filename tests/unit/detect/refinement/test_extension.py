# SPDX-License-Identifier: Apache-2.0
"""A pipe of which a piece is known is followed in the images to its ends, and no farther."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.refinement import extension
from pipeprog_detect.refinement.axial_evidence import (
    BRIGHTER,
    DARKER,
    NO_EDGE,
    AxialEvidence,
    _log_odds,
    axial_evidence,
)
from pipeprog_detect.refinement.contour_adjustment import adjusted
from pipeprog_detect.refinement.contour_refinement import Start, refine
from pipeprog_detect.refinement.extension import extended, without_bend
from pipeprog_detect.silhouette.apparent_contour import ContourSamples
from pipeprog_detect.silhouette.edge_support import support_profile
from pipeprog_detect.silhouette.occlusion import with_depths
from pipeprog_detect.silhouette.scene import Scene
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.pipe_and_wall import PIPE, front_points, wall_points

END_TOLERANCE = 2e-3  # half a pixel
SAMPLES_TOLERANCE = 0.03  # the contour alone tells an end to two samples of 6 px


@pytest.mark.parametrize("piece", [(0.0, 0.16), (0.12, 0.28), (0.24, 0.4)])
def test_a_short_cylinder_is_extended_to_the_whole_pipe(pipe_views: list[View], piece: tuple[float, float]) -> None:
    low, high = (PIPE.start + place * PIPE.axis for place in piece)
    fit = refine(Start(Cylinder(low, high, PIPE.radius), 0.002), pipe_views, [])
    assert fit is not None
    assert (fit.cylinder.start - PIPE.start) @ PIPE.axis == pytest.approx(0.0, abs=END_TOLERANCE)
    assert (fit.cylinder.end - PIPE.end) @ PIPE.axis == pytest.approx(0.0, abs=END_TOLERANCE)
    assert fit.cylinder.radius == pytest.approx(PIPE.radius, abs=0.5e-3)
    short = refine(Start(Cylinder(low, high, PIPE.radius), 0.002), pipe_views, [], follow=False)
    assert short is not None
    assert short.cylinder.length < 0.2


@pytest.mark.parametrize("length", [0.05, 0.06])
@pytest.mark.parametrize("place", [0.0, 0.1, 0.2, 0.3])
def test_a_cylinder_too_short_for_a_direction_is_extended_along_the_edges_ahead(
    pipe_views: list[View], length: float, place: float
) -> None:
    random = np.random.default_rng(0)
    views = [
        replace(view, image=np.clip(view.image + 16.0 * random.standard_normal(view.image.shape), 0, 255).astype("u1"))
        for view in pipe_views
    ]
    low = PIPE.start + place * PIPE.axis
    fit = refine(Start(Cylinder(low, low + length * PIPE.axis, PIPE.radius), 0.002), views, [])
    assert fit is not None
    assert fit.cylinder.length == pytest.approx(PIPE.length, abs=2.0 * END_TOLERANCE)


@pytest.mark.parametrize(
    ("sideways", "away", "is_sought"),
    [(1e-4, 1e-4, False), (1e-2, 1e-4, True), (1e-4, 1e-2, False)],  # m
)
def test_the_direction_is_sought_where_it_would_move_the_contour(
    pipe_views: list[View], sideways: float, away: float, is_sought: bool
) -> None:
    """One view hardly shows a step away from it: the contour lies where it is sought, however far the pipe may be."""
    middle = pipe_views[len(pipe_views) // 2]
    known = adjusted(Scene.of(PIPE, [middle, middle], []), np.eye(5), np.zeros(5))
    assert known is not None
    covariance = np.diag([sideways, away, sideways, away, 1e-4]) ** 2
    turned = extension._turned(replace(known, covariance=covariance), np.eye(5))
    assert (turned is not None) == is_sought


@pytest.mark.parametrize("seen", [0.05, 0.1])
def test_a_stub_is_not_cut_to_less_than_its_width(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch, seen: float
) -> None:
    """Of a contour of little contrast one position alone may show edges more often than texture does."""
    stub = adjusted(Scene.of(PIPE.cut(0.1, 0.3), pipe_views, []), np.eye(5), np.zeros(5))
    assert stub is not None
    monkeypatch.setattr(extension, "where_seen", lambda *_: PIPE.cut(0.2, 0.2 + seen))
    cut = without_bend(replace(stub, share=0.4), PIPE.cut(0.1, 0.3), np.eye(5))
    assert cut.cylinder.length == pytest.approx(seen if seen > 2.0 * PIPE.radius else 0.2, abs=1e-5)


def test_a_whole_pipe_and_one_that_is_not_there_do_not_grow(pipe_views: list[View], empty_views: list[View]) -> None:
    for views in (pipe_views, empty_views):
        same = extended(Scene.of(PIPE, views, []))
        assert same.length == pytest.approx(PIPE.length, abs=1e-9)


def test_what_hides_a_pipe_does_not_end_it(pipe_views: list[View]) -> None:
    """A rod, known to cross before the pipe, leaves a gap in what is seen of it."""
    known = Cylinder(PIPE.start, PIPE.start + 0.16 * PIPE.axis, PIPE.radius)
    crossing = PIPE.start + 0.24 * PIPE.axis + np.array([0.0, -0.15, 0.0])
    rod = Cylinder(crossing - np.array([0.4, 0.0, 0.0]), crossing + np.array([0.4, 0.0, 0.0]), 0.03)
    scene = Scene.of(known, pipe_views, [rod])
    twice = extended(replace(scene, cylinder=extended(scene)))
    assert (twice.end - PIPE.end) @ PIPE.axis == pytest.approx(0.0, abs=SAMPLES_TOLERANCE)


def test_a_pipe_without_holes_does_not_grow_where_the_views_see_through(pipe_views: list[View]) -> None:
    """Something in line with it has the contour that the images show beyond."""
    surface, known = front_points(PIPE.cut(0.0, 0.32)), PIPE.cut(0.0, 0.28)
    views = with_depths(pipe_views, np.concatenate([wall_points(), surface]))
    whole = with_depths(pipe_views, np.concatenate([wall_points(), front_points(PIPE)]))
    assert extended(Scene.of(known, whole, [])).length > 0.37
    assert 0.28 <= extended(Scene.of(known, views, [])).length < 0.32 + PIPE.radius


@pytest.mark.parametrize(
    ("gap", "by_chance", "goes_on"),
    [(0.06, 0.0, True), (0.16, 0.0, False), (0.16, 0.5, False), (0.16, 12.0, True)],
)
def test_an_edge_by_chance_does_not_close_a_gap(gap: float, by_chance: float, goes_on: bool) -> None:
    """The next pipe in line begins beyond a `gap` [m] in whose middle an edge has these log odds; a clamp is 6 cm."""
    along: FloatArray = np.arange(0.01, 1.0, 0.02).astype(np.float64)
    odds: FloatArray = np.where(along < gap, -3.0, 8.0).astype(np.float64)
    odds[int(0.5 * gap / 0.02)] = by_chance or -3.0
    further = extension._further(AxialEvidence(along, odds, np.full_like(along, 15.0)), extension.CLAMP)
    assert further == pytest.approx(1.0 if goes_on else 0.0)


def test_the_odds_turn_where_the_pipe_ends(pipe_views: list[View]) -> None:
    short = Cylinder(PIPE.start, PIPE.end - 0.1 * PIPE.axis, PIPE.radius)
    evidence = axial_evidence(Scene.of(short, pipe_views, []), True, 0.25)
    assert evidence is not None
    step = evidence.along[1] - evidence.along[0]
    assert evidence.log_odds[(evidence.along > 0) & (evidence.along < 0.1 - step)].min() > 0
    assert evidence.log_odds[evidence.along > 0.1 + step].sum() < 0


def test_no_evidence_without_a_pipe(empty_views: list[View]) -> None:
    assert axial_evidence(Scene.of(PIPE, empty_views, []), True, 0.2) is None


def _odds_of(view: IntArray, along: FloatArray, seen: IntArray, chance: float) -> FloatArray:
    """The log odds (B,) of what samples of both sides show at positions `along` (N,); the negative ones are known."""
    count = len(view)
    nothing = np.zeros(2 * count)
    samples = ContourSamples(
        np.tile(view, 2),
        np.repeat([0, 1], count),
        np.zeros((2 * count, 2)),
        np.zeros((2 * count, 2)),
        np.tile(along, 2),
        nothing,
        nothing,
        nothing,
        np.zeros((2 * count, 5)),
    )
    seen = np.tile(seen, 2)
    on = support_profile(samples, seen != NO_EDGE)
    odds = _log_odds(samples, seen, on, on.along < 0, chance)
    assert odds is not None
    return odds


PLACES = 0.01 * (np.arange(-20, 20) + 0.5)  # m


def test_a_view_that_never_shows_the_pipe_says_little_by_not_showing_it_farther_out() -> None:
    """Its pose is off by a pixel, say: it ends no pipe. One that has shown the pipe does."""
    inner, outer = PLACES[PLACES < 0], PLACES[PLACES > 0]
    shows = np.where(np.arange(len(inner)) % 5 == 0, NO_EDGE, BRIGHTER)
    one = np.concatenate([np.zeros(20, int)] * 2), np.concatenate([inner, outer])
    ended = _odds_of(*one, np.concatenate([shows, np.full(20, NO_EDGE)]), 0.2)[20:].sum()
    strange = _odds_of(np.repeat([0, 1], 20), one[1], np.concatenate([shows, np.full(20, NO_EDGE)]), 0.2)[20:].sum()
    assert ended < -10.0
    assert -4.0 < strange < 0.0


def test_edges_that_are_brighter_and_darker_by_turns_are_texture() -> None:
    """A thin pipe shows edges as often as the wall's texture does; all along it they are of one kind."""
    view = np.repeat(np.arange(3), len(PLACES))
    along = np.tile(PLACES, 3)
    edge = np.where(np.arange(len(along)) % 3 == 0, NO_EDGE, BRIGHTER)
    turns = np.where((along > 0) & (edge == BRIGHTER) & (np.arange(len(along)) % 2 == 0), DARKER, edge)
    chance = 0.5
    assert _odds_of(view, along, edge, chance)[20:].sum() > 10.0
    assert _odds_of(view, along, turns, chance)[20:].sum() < -2.0


@pytest.mark.parametrize("known_rate", [0.67, 1.0])
def test_a_pipe_goes_on_where_what_is_behind_it_changes(known_rate: float) -> None:
    """It is brighter than a wall and darker than the white pipe that follows; where it ends there are few edges."""
    random = np.random.default_rng(0)
    view = np.repeat(np.arange(5), len(PLACES))
    along = np.tile(PLACES, 5)
    shows = random.random(len(along)) < np.where(along < 0, known_rate, 0.75)
    changes = np.where(shows, np.where(along < 0, BRIGHTER, DARKER), NO_EDGE)
    chance = 0.2
    assert _odds_of(view, along, changes, chance)[20:].sum() > 10.0
    texture = random.random(len(along)) < chance
    kinds = np.where(random.random(len(along)) < 0.5, BRIGHTER, DARKER)
    ends = np.where(np.where(along < 0, shows, texture), np.where(along < 0, BRIGHTER, kinds), NO_EDGE)
    assert _odds_of(view, along, ends, chance)[20:].sum() < -5.0
