# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import experiments
from benchmarks.recordings import Recording

PIPES = [
    {"true_radius": 0.0086, "radius_error_mm": 0.3, "length_error_percent": -1.0},
    {"true_radius": 0.1095, "radius_error_mm": -0.4, "length_error_percent": 3.0},
]
DONE: dict[str, Any] = {
    "commit": "a",
    "score": {"classification": {"true_positives": 2, "false_positives": 1, "false_negatives": 1}, "pipes": PIPES},
    "truth": [{"radius": 0.0086}, {"radius": 0.1095}, {"radius": 0.1095}],
    "network": {"images": 10, "images below the band": 1},
}
FAILED = {"commit": "b", "failed": "no board", "pipes": [0.0086, 0.1095, 0.1095]}


def test_a_survey_without_a_result_misses_all_pipes() -> None:
    both: list[dict[str, Any]] = [DONE, FAILED]
    assert experiments.RATES["precision"](both) == pytest.approx(2 / 3, abs=1e-3)
    assert experiments.RATES["recall"](both) == pytest.approx(2 / 6, abs=1e-3)
    assert experiments.RATES["accuracy"](both) == pytest.approx(2 / 7, abs=1e-3)
    assert experiments.RATES["F"](both) == pytest.approx(4 / 9, abs=1e-3)


def test_errors_are_of_the_pipes_found_together_and_by_radius() -> None:
    # Root mean square of 0.3 and 0.4 mm; mean of the absolute 1 and 3 %.
    assert experiments.RADIUS["radius RMSE [mm]"]([DONE, FAILED]) == pytest.approx(0.354, abs=1e-3)
    assert experiments.LENGTH["length error [%]"]([DONE]) == pytest.approx(2.0)
    assert experiments.RADIUS["radius RMSE of 8.6 mm [mm]"]([DONE]) == pytest.approx(0.3)
    assert experiments.RADIUS["radius RMSE of 57.5 mm [mm]"]([DONE]) is None


def test_means_leave_out_what_has_no_result() -> None:
    assert experiments.NETWORK["images"]([DONE, FAILED]) == 10
    assert experiments.NETWORK["sites"]([DONE, FAILED]) == "2, 1 without a result"


def test_a_network_of_images_is_counted_against_the_band(tmp_path: Path) -> None:
    excuse = '"overlap 0.900 > 0.875, in a group of no more than three"'
    rows = [f"1,1,0.90,200,{excuse}", "1,1,0.80,100,", "1,1,0.86,50,", "1,0,0.99,0,", "0,0,,,"]
    header = "chosen,registered,overlap_n,tie_points,reason"
    (tmp_path / "frames.csv").write_text("\n".join([header, *rows]) + "\n")
    ours = {"images": 3, "tie points in images": 350, "images below the band": 1, "images above the band": 1}
    assert experiments.network(tmp_path, 0.85, "ours") == ours
    assert experiments.network(tmp_path, 0.85, "paper") == ours | {experiments.UNEXPLAINED: 1}
    assert experiments.NETWORK["images below the band [%]"]([{"network": ours}, {"network": ours}]) == 33.3


def test_a_table_keeps_what_no_survey_is_kept_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(experiments, "RESULTS", tmp_path)
    monkeypatch.setattr(experiments, "RUNS", tmp_path)
    recording = Recording(tmp_path / "field.mcap", "made of nothing")
    cases = [
        experiments.Case("field", recording, method, overlap)
        for method in ("paper", "ours")
        for overlap in (0.85, 0.95)
    ]
    recording.beside("truth.json").write_text(json.dumps({"pipes": DONE["truth"]}))
    for case in cases:
        case.kept.write_text(json.dumps(DONE))
    experiments.write_tables(cases, "720p")
    for case in cases:
        case.kept.unlink()
    better = copy.deepcopy(DONE) | {"commit": "c"}
    better["score"]["pipes"] = PIPES[:1]
    cases[-1].kept.write_text(json.dumps(better))
    experiments.write_tables(cases, "720p")
    table = json.loads((tmp_path / "experiment_table_7.json").read_text())
    found = {row["overlap [%]"]: row for row in table["rows"] if row["quantity"] == "length error [%]"}
    assert (found[85]["paper's method"], found[85]["ours"]) == (2.0, 2.0)
    assert (found[95]["paper's method"], found[95]["ours"]) == (2.0, 1.0)
    # Of a pipe that the new survey has not found nothing is kept.
    thick = [
        row for row in table["rows"] if (row["overlap [%]"], row["quantity"]) == (95, "length error of 109.5 mm [%]")
    ]
    assert [(row["paper's method"], row["ours"]) for row in thick] == [(3.0, None)]
    assert (table["commits"]["paper's method"], table["commits"]["ours"]) == (["a"], ["a", "c"])

    experiments.write_tables(cases, "480p")  # other sites
    table = json.loads((tmp_path / "experiment_table_7.json").read_text())
    assert {row["overlap [%]"] for row in table["rows"] if row["ours"] is not None} == {95}
