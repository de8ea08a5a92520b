# SPDX-License-Identifier: Apache-2.0
"""Goals of a survey: what names a folder, a file or a time that cannot be used is refused by name."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeprog_bringup.survey.goal import MAX_TIME, Site, check_goal, read_site
from pipeprog_camera.errors import InputError

BAGS = Path(__file__).parents[4] / "bags"
BOQ, BOARD = BAGS / "demo.boq.yaml", BAGS / "demo.board.yaml"
NOW = 1_700_000_000_000_000_000  # ns, 2023-11-14 22:13:20 UTC


@pytest.fixture(scope="module")
def site() -> Site:
    return read_site(str(BOQ), str(BOARD))


@pytest.mark.parametrize(
    "name", ["../up", "/etc", "a/b", ".hidden", "..", "a\0b", "a\nb", "x" * 65, "-rf", "é", "file:///tmp/a", " "]
)
def test_a_name_that_is_no_plain_folder_is_refused(site: Site, name: str) -> None:
    with pytest.raises(InputError, match="survey_id"):
        check_goal(name, site, "", 0.0, NOW)


@given(st.text(max_size=80))
def test_what_is_accepted_lies_in_the_folder_of_results(text: str) -> None:
    site = read_site(str(BOQ), "")
    try:
        goal = check_goal(text, site, "", 0.0, NOW)
    except InputError:
        return
    assert (Path("/results") / goal.name).resolve().parent == Path("/results")


def test_a_survey_without_a_name_is_named_by_the_time(site: Site) -> None:
    assert check_goal("", site, "", 60.0, NOW).name == "survey_20231114T221320Z"


@pytest.mark.parametrize("limit", [-1.0, MAX_TIME + 1, float("nan"), float("inf")])
def test_a_time_limit_that_is_none_is_refused(site: Site, limit: float) -> None:
    with pytest.raises(InputError, match="time_limit"):
        check_goal("a", site, "", limit, NOW)


def test_a_reference_is_refused_until_surveys_can_be_aligned(site: Site) -> None:
    with pytest.raises(InputError, match="reference"):
        check_goal("a", site, "last_week", 0.0, NOW)


@pytest.mark.parametrize(
    ("boq", "board", "word"),
    [
        ("", "", "no boq"),
        ("s3://bucket/boq.yaml", "", "on this machine"),
        ("/nowhere/boq.yaml", "", "boq.yaml"),
        (str(BOQ), "http://host/board.yaml", "on this machine"),
        (str(BOQ), str(BOQ), "boq.yaml"),
        ("a\0b", "", "on this machine"),
        ("x" * 5000, "", "on this machine"),
    ],
)
def test_files_that_cannot_be_read_are_refused_by_name(boq: str, board: str, word: str) -> None:
    with pytest.raises(InputError, match=word):
        read_site(boq, board)
