# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from benchmarks.markdown import cell, rows_table
from benchmarks.recordings import ROOT
from benchmarks.robustness import FACTORS
from benchmarks.write_accuracy import documents, read_results
from benchmarks.write_recording_guide import ADVICE


def test_the_documents_say_what_the_results_say() -> None:
    texts = documents(read_results())
    assert {path.name for path in (ROOT / "docs" / "results").iterdir()} == {
        path.name for path in texts if path.parent.name == "results"
    }
    for path, text in texts.items():
        assert path.read_text() == text, f"{path}: run python -m benchmarks.write_accuracy"


def test_every_result_is_on_a_page() -> None:
    text = "".join(documents(read_results()).values())
    assert [name for name in read_results() if not name.startswith("survey_") and f"{name}.json" not in text] == []


def test_no_cell_is_python() -> None:
    for path, text in documents(read_results()).items():
        cells = [part for line in text.splitlines() if line.startswith("|") for part in line.split("|")]
        assert [part for part in cells if "{'" in part or "['" in part or part.strip() == "[]"] == [], path


def test_cells_read_as_text() -> None:
    assert [cell(value) for value in (None, [], ["200"], {"8.6": "1/1"}, 1.06026e6, 0.25)] == [
        *("-", "-", "200", "8.6: 1/1", "1060260", "0.25")
    ]
    assert rows_table([{"radius_rmse_mm": 0.1, "commit": "abc"}], without=["commit"]) == (
        "| radius RMSE [mm] |\n| --- |\n| 0.1 |\n"
    )


def test_every_factor_of_a_recording_has_its_advice() -> None:
    assert set(ADVICE) == set(FACTORS)
