from __future__ import annotations

from benchmarks.document import accuracy, read_results, with_table
from benchmarks.guide import ADVICE, guide
from benchmarks.recordings import ROOT
from benchmarks.robustness import FACTORS


def test_the_documents_say_what_the_results_say() -> None:
    results = read_results()
    assert (ROOT / "docs" / "accuracy.md").read_text() == accuracy(results)
    assert (ROOT / "docs" / "recording.md").read_text() == guide(results.get("robustness"))
    readme = (ROOT / "README.md").read_text()
    assert readme == with_table(readme, results)


def test_every_factor_of_a_recording_has_its_advice() -> None:
    assert set(ADVICE) == set(FACTORS)
