# SPDX-License-Identifier: Apache-2.0
"""Goals of a survey: what names a folder, a file or a time that cannot be used is refused by name."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeprog_bringup.survey.alignment_result import note_alignment
from pipeprog_bringup.survey.goal import MAX_TIME, Site, check_goal, read_reference, read_site
from pipeprog_bringup.survey.survey_output import SurveyOutput
from pipeprog_camera.errors import InputError
from pipeprog_msgs.action import Survey
from pipeprog_msgs.msg import SfmStatus
from pipeprog_sfm.alignment.map_file import MAP_FILE, write_map
from tests.fuzz.absurd_goals import absurd_goal, is_named
from tests.unit.bringup.survey.fake_graph import MAP

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
        check_goal(name, site, 0.0, NOW)


@given(st.text(max_size=80))
def test_what_is_accepted_lies_in_the_folder_of_results(text: str) -> None:
    site = read_site(str(BOQ), "")
    try:
        goal = check_goal(text, site, 0.0, NOW)
    except InputError:
        return
    assert (Path("/results") / goal.name).resolve().parent == Path("/results")


def test_a_survey_without_a_name_is_named_by_the_time(site: Site) -> None:
    assert check_goal("", site, 60.0, NOW).name == "survey_20231114T221320Z"


@pytest.mark.parametrize("limit", [-1.0, MAX_TIME + 1, float("nan"), float("inf")])
def test_a_time_limit_that_is_none_is_refused(site: Site, limit: float) -> None:
    with pytest.raises(InputError, match="time_limit"):
        check_goal("a", site, limit, NOW)


def test_a_reference_is_a_folder_of_the_results_or_an_absolute_one(tmp_path: Path) -> None:
    (tmp_path / "monday").mkdir()
    write_map(tmp_path / "monday" / MAP_FILE, MAP)
    for text in ("monday", str(tmp_path / "monday"), f"file://{tmp_path}/monday"):
        reference = read_reference(text, tmp_path)
        assert (reference.path, reference.map.frame) == (tmp_path / "monday" / MAP_FILE, MAP.frame)


@pytest.mark.parametrize("text", ["tuesday", "../monday", "s3://monday", "./monday", "/nowhere", "a\0b", "/" * 5000])
def test_a_reference_that_holds_no_map_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "tuesday").mkdir()
    with pytest.raises(InputError, match="reference"):
        read_reference(text, tmp_path / "surveys")


@pytest.mark.parametrize(("aligned_by", "code"), [("places", Survey.Result.NONE), ("", Survey.Result.NOT_ALIGNED)])
def test_the_result_says_how_well_a_survey_is_aligned(tmp_path: Path, aligned_by: str, code: int) -> None:
    covariance = np.diag([4e-6] * 3 + [1e-8] * 3 + [1e-9]) if aligned_by else np.zeros((7, 7))
    write_map(tmp_path / MAP_FILE, replace(MAP, aligned_by=aligned_by, alignment_covariance=covariance))
    result = Survey.Result(sfm=SfmStatus(message="no place was found again"))
    note_alignment(result, tmp_path / MAP_FILE)
    assert result.error_code == code
    assert result.error_msg == ("" if aligned_by else "no place was found again")
    assert np.allclose(result.reference_covariance.reshape(6, 6), covariance[:6, :6], rtol=0.0, atol=0.0)


def test_a_survey_that_ended_before_its_last_map_is_not_aligned(tmp_path: Path) -> None:
    result = Survey.Result()
    note_alignment(result, tmp_path / MAP_FILE)
    assert result.error_code == Survey.Result.NOT_ALIGNED
    assert "ended before" in result.error_msg


def begin(goal: dict[str, Any], results: Path) -> SurveyOutput:
    """What the node does with a goal: its files, its fields, its folder."""
    site = read_site(goal["boq"], goal["board"])
    checked = check_goal(goal["survey_id"], site, goal["time_limit"], NOW)
    if goal["reference"]:
        checked = replace(checked, reference=read_reference(goal["reference"], results))
    return SurveyOutput(results, checked, record=False)


def test_a_thousand_absurd_goals_are_refused_by_name_and_write_nothing(tmp_path: Path) -> None:
    """Nothing may lie outside the results, nor in them."""
    results = tmp_path / "surveys"
    rng = random.Random(19)
    for _ in range(1000):
        goal = absurd_goal(rng)
        with pytest.raises(InputError) as refused:
            begin(goal, results)
        text = str(refused.value)
        assert is_named(goal, text), text
        assert len(text) < 5000
    assert list(tmp_path.iterdir()) == []


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
