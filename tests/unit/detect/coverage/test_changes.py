# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeprog_detect.coverage.changes import Change, KnownPipe, changes
from pipeprog_detect.coverage.survey import views_of
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.coverage.wall import CAMERA, poses, upright, wall_and_curtain


@pytest.fixture(scope="module")
def views() -> list[View]:
    return views_of([CAMERA] * 9, poses(), wall_and_curtain())


def known(name: str, cylinder: Cylinder, class_name: str = "DN") -> KnownPipe:
    return KnownPipe(name, cylinder, class_name, (0.002, 0.002))


def by_pipe(told: list[Change]) -> dict[str, str]:
    return {(each.before or each.after)[0]: each.state for each in told}


def test_two_stages_of_a_site(views: list[View]) -> None:
    before = [
        known("kept", upright(0.0)),
        known("longer", upright(-0.3).cut(0.0, 0.5)),
        known("shorter", upright(0.3)),
        known("gone", upright(-0.6)),
        known("hidden", upright(1.0)),
        known("out of view", upright(4.0)),
    ]
    after = [
        known("a", upright(0.004)),
        known("b", upright(-0.3)),
        known("c", upright(0.3).cut(0.0, 0.5)),
        known("added", upright(-0.9)),
    ]
    told = changes(before, after, views)
    assert by_pipe(told) == {
        **{name: name for name in ("kept", "longer", "shorter", "gone")},
        "hidden": "not_seen",
        "out of view": "not_seen",
        "added": "new",
    }
    counted = {(each.before or each.after)[0]: each.counted for each in told}
    assert counted["gone"] == 0.0
    assert counted["hidden"] == pytest.approx(0.8), "nobody has seen it to be gone"
    assert counted["shorter"] == pytest.approx(0.5)
    grown = {(each.before or each.after)[0]: each.grown for each in told}
    assert grown["gone"] == pytest.approx(-0.8)
    assert grown["added"] == pytest.approx(0.8)
    assert grown["longer"] == pytest.approx(0.3)
    assert grown["shorter"] == pytest.approx(-0.3, abs=0.03), "it is looked at every two centimetres"
    assert [grown[name] for name in ("kept", "hidden", "out of view")] == [0.0, 0.0, 0.0]


def test_a_hidden_end_that_is_measured_elsewhere_has_not_grown(views: list[View]) -> None:
    whole = upright(-0.3)
    before = KnownPipe("old", whole.cut(0.06, 0.5), "DN", (0.03, 0.002))
    after = KnownPipe("new", whole, "DN", (0.03, 0.002))
    (told,) = changes([before], [after], views)
    assert told.state == "longer"
    assert told.length_after - told.length_before == pytest.approx(0.36)
    assert told.grown == pytest.approx(0.3)


def test_a_neighbour_of_another_class_or_direction_is_another_pipe(views: list[View]) -> None:
    pipe = known("old", upright(0.0))
    turned = Cylinder(pipe.cylinder.start, pipe.cylinder.end + np.array([0.06, 0.0, 0.0]), 0.05)
    for other in (known("x", upright(0.07)), replace(pipe, id="x", class_name="DN2"), known("x", turned)):
        assert by_pipe(changes([pipe], [other], views)) == {"old": "gone", "x": "new"}


def test_a_pipe_in_pieces_is_one(views: list[View]) -> None:
    whole = upright(0.3)
    pieces = [known("a", whole.cut(0.0, 0.4)), known("b", whole.cut(0.42, 0.8))]
    (told,) = changes([known("old", whole)], pieces, views)
    assert told.after == ("a", "b")
    assert told.state == "kept"


@pytest.mark.parametrize(("grown", "state"), [(0.2, "longer"), (0.02, "kept")])
def test_an_end_that_has_moved_tells_whatever_is_known_of_the_other(
    views: list[View], grown: float, state: str
) -> None:
    """The foot of a pipe behind a box may be anywhere; its top is measured."""
    old, now = upright(0.3).cut(0.0, 0.5), upright(0.3).cut(0.0, 0.5 + grown)
    before = replace(known("old", old), end_sigmas=(0.7, 0.003))
    for after in (
        replace(known("a", now), end_sigmas=(0.1, 0.003)),
        replace(known("a", Cylinder(now.end, now.start, now.radius)), end_sigmas=(0.003, 0.1)),
    ):
        (told,) = changes([before], [after], views)
        assert told.state == state


def test_the_part_that_is_hidden_now_counts_on(views: list[View]) -> None:
    across = Cylinder(np.array([0.0, 1.9, 0.0]), np.array([1.2, 1.9, 0.0]), 0.05)
    (told,) = changes([known("old", across)], [known("a", across.cut(0.0, 0.65))], views)
    assert told.state in ("kept", "shorter")
    assert told.counted > 0.9
