from __future__ import annotations

from benchmarks.document import accuracy, read_results, with_table
from benchmarks.recordings import ROOT


def test_the_documents_say_what_the_results_say() -> None:
    results = read_results()
    assert (ROOT / "docs" / "accuracy.md").read_text() == accuracy(results)
    readme = (ROOT / "README.md").read_text()
    assert readme == with_table(readme, results)
