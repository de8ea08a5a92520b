# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

from pipeprog_bringup.comparison.comparison import OtherSiteError, as_json, compare
from pipeprog_bringup.report.page import report
from pipeprog_bringup.results.results_reader import read_results
from pipeprog_camera.errors import InputError
from tests.unit.bringup.comparison.surveyed import survey
from tests.unit.detect.coverage.wall import sheet, upright


def states(*folders: Path) -> list[dict[str, str]]:
    """The state of each pipe by the id of its life, step by step."""
    steps = as_json(compare([read_results(folder) for folder in folders]))
    return [{row["id"]: row["state"] for row in step["pipes"]} for step in steps]


def test_a_pipe_has_one_id_for_its_life(tmp_path: Path) -> None:
    weeks = [
        survey(tmp_path / "a", 0, [upright(-0.6), upright(0.0), upright(1.0)]),
        survey(tmp_path / "b", 7, [upright(0.0), upright(0.3)]),
        survey(tmp_path / "c", 14, [upright(0.3), upright(0.0), upright(1.0)]),
    ]
    assert states(*weeks) == [
        {"p01": "gone", "p02": "kept", "p03": "not_seen", "p04": "new"},
        {"p02": "kept", "p03": "kept", "p04": "kept"},
    ]


def test_two_sites_are_refused_with_the_reason(tmp_path: Path) -> None:
    own = survey(tmp_path / "own", 0, [upright(0.0), upright(0.3)])
    others = {
        "their boards are A and B": survey(tmp_path / "b", 7, [upright(0.0)], boards=("B",)),
        "not surveys of one site: of 1.6 m of pipes": survey(tmp_path / "c", 7, [upright(-0.6), upright(-0.3)]),
        "of the surfaces of the first": survey(tmp_path / "d", 7, [upright(0.0)], cloud=sheet((-2.4, 2.4), 3.0)),
    }
    for reason, other in others.items():
        with pytest.raises(OtherSiteError, match=reason):
            states(own, other)
        with pytest.raises(OtherSiteError, match=reason):
            report([own, other], tmp_path / "report.html", False, lambda share, stage: None)


def test_without_a_board_or_keyframes_there_is_no_comparison(tmp_path: Path) -> None:
    own = survey(tmp_path / "own", 0, [upright(0.0)])
    with pytest.raises(InputError, match="without a board"):
        states(own, survey(tmp_path / "odometry", 7, [upright(0.0)], source="odometry"))
    bare = survey(tmp_path / "bare", 7, [upright(0.0)])
    (bare / "out.mcap").unlink()
    with pytest.raises(InputError, match="kept no keyframes"):
        states(own, bare)


def test_the_report_tells_what_has_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeprog_bringup.report.content.STILL_WIDTH", 200)
    folders = [
        survey(tmp_path / "a", 0, [upright(-0.6), upright(0.0), upright(1.0)]),
        survey(tmp_path / "b", 7, [upright(0.0), upright(0.3)]),
    ]
    page = report(folders, tmp_path / "report.html", False, lambda share, stage: None).read_text()
    assert "What has changed since 2023-11-14" in page
    for words in ("gone, its place was seen", "not seen this time", "<td>new</td>"):
        assert words in page, words
    # One of 0.8 m is gone, one is new; the one behind the curtain counts on.
    assert "2.40 of 10.0 m installed" in page
    assert "0.00 m more than on 2023-11-14" in page
    assert "0.80 m of those installed were measured earlier" in page
