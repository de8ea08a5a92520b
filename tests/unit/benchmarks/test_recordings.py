# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from benchmarks.markdown import measured_rows
from benchmarks.recordings import DEMO, one_recording
from benchmarks.survey import score_figures


def test_command_line_names_one_recording() -> None:
    assert one_recording("live_latency", "what it does", []) == (DEMO, "demo", "python -m benchmarks.live_latency demo")
    assert one_recording("stage_cost", None, ["demo", "--name", "cold"])[1:] == (
        "cold",
        "python -m benchmarks.stage_cost demo",
    )


def test_figures_of_a_score_are_plain_values() -> None:
    score = {
        "classification": {"f_measure": 1.0, "true_positives": 2, "false_positives": 0},
        "pipes": [{"id": "p01"}, {"id": "p02"}],
        "missed": ["3"],
        "radius": {"rmse_mm": 0.12345, "per_class": [{"radius_mm": 8.6}]},
        "length": {"mean_error_percent": None, "per_class": []},
        "scale": {"error_percent": -0.004},
    }
    rows = {row["what"]: row["measured"] for row in measured_rows({"replay": {"score": score_figures(score)}})}
    assert rows["replay: score: right class"] == "2 of 3"
    assert rows["replay: score: radius RMSE [mm]"] == 0.123
    assert not any(isinstance(value, list | dict) for value in rows.values())
