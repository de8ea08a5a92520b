# SPDX-License-Identifier: Apache-2.0
"""Writes docs/accuracy.md, docs/results/, docs/recording.md and the README's table from results/: no figure is typed.

.venv/bin/python -m benchmarks.write_accuracy
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.markdown import bullets, cell, table
from benchmarks.recordings import ROOT
from benchmarks.result_pages import pages, surveys
from benchmarks.survey import RESULTS
from benchmarks.write_recording_guide import guide

Result = dict[str, Any]

BEGIN, END = "<!-- figures: written by benchmarks.write_accuracy -->", "<!-- end of figures -->"
OVERLAP = 95  # %, at which the paper and ours are compared
FIELD, LAB = (5, 6, 7), (4,)  # tables of the experiments with the figures of each layout

# Set before the first measurement: a fifth of the paper's radius error at its resolution, twice that at a third of the
# pixels across, less than half of its length error.
GOALS = {
    "F, right class": "0.98",
    "radius RMSE, 720p [mm]": "2.0",
    "radius RMSE, 4K [mm]": "1.0",
    "radius RMSE of 8.6 mm [mm]": "1.0",
    "length error [%]": "2.0",
    "total length of a class, mean error [%]": "1.5",
    "scale error [%]": "0.1",
}

COUNTING = """## How it is counted

A detection and a true pipe match one to one when their axes are less than max(radius, 20 mm) and 3 degrees apart and overlap by more than half.
A match is a true positive (TP), a true pipe without a detection is a miss (FN), a detection without a true pipe is false (FP); cylinders that the truth says to ignore count neither way.
"Right class" counts a match only when its class is the true one.
F is 2 TP / (2 TP + FP + FN), over detections of planned classes with the right class.
Radius RMSE is the root of the mean of the squared errors (the paper's Eq. 4 lacks the square); the length error is the mean of the absolute errors (Eq. 5).
The total length of a class sums all its pipes, missed ones included; errors of single pipes may cancel.
"""  # noqa: E501

FIGURES = {
    "images/experiment_figure_8.png": "Figure 8: error over the number of views of the board, circle centres corrected "
    "or not",
    "images/experiment_figure_10.png": "Figure 10: F, radius and length, over the overlap",
    "images/experiment_figure_11_ours.jpg": "Figure 11: the pipes of a generated field in their classes' colours",
    "images/robustness.png": "Robustness: F (bars) and radius error (line) as one factor of the recording is spoiled",
}


def main() -> None:
    """Write all documents, and remove pages of results that are no more."""
    texts = documents(read_results())
    for page in (ROOT / "docs" / "results").glob("*.md"):
        if page not in texts:
            page.unlink()
    for path, text in texts.items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)


def documents(results: Mapping[str, Result]) -> dict[Path, str]:
    """The text of every document that is written from the results, by its path."""
    docs = ROOT / "docs"
    readme = ROOT / "README.md"
    texts = {docs / "results" / f"{name}.md": text for name, (_, text) in pages(results).items()}
    texts[docs / "accuracy.md"] = accuracy(results)
    texts[docs / "recording.md"] = guide(results.get("robustness"))
    texts[readme] = with_table(readme.read_text(), results)
    return texts


def read_results() -> dict[str, Result]:
    """The JSON files by name, in the order of their names; those of hostile input are in docs/reliability.md."""
    files = [path for path in sorted(RESULTS.glob("*.json")) if not path.name.startswith("hostile_")]
    return {path.stem: json.loads(path.read_text()) for path in files}


def accuracy(results: Mapping[str, Result]) -> str:
    """The text of docs/accuracy.md."""
    links = [f"[{heading}](results/{name}.md)" for name, (heading, _) in pages(results).items()]
    parts = [
        "# Accuracy\n",
        _claim(results),
        headline(results),
        f"The paper's figures are at {OVERLAP} % overlap; fields and labs are the generator's, with 58 pipes of six "
        "radii and six pipes of five, 720p unless said.\n"
        "Each figure of ours has its command and its commit on one of the pages below.\n",
        "## What fails\n",
        bullets(_failures(results)),
        "## Figures\n",
        *(f"![{caption}]({path})\n\n{caption}.\n" for path, caption in FIGURES.items()),
        "## Experiments\n",
        bullets(links),
        COUNTING,
        "Written by `python -m benchmarks.write_accuracy` from the JSON files in `benchmarks/results/`.\n",
    ]
    return "\n".join(parts)


def with_table(readme: str, results: Mapping[str, Result]) -> str:
    """The README with its table of figures brought up to date."""
    before, rest = readme.split(BEGIN)
    return f"{before}{BEGIN}\n\n{headline(results)}\n{END}{rest.split(END)[1]}"


def headline(results: Mapping[str, Result]) -> str:
    """The paper, the goals, and what was measured in fields and labs."""
    known = surveys(results)
    field, lab = _at_overlap(results, FIELD), _at_overlap(results, LAB)
    four_k = next((row for row in _rows(results, "robustness") if row["value"] == "4k"), {})
    paper_field, paper_lab = field.get("paper's figure", {}), lab.get("paper's figure", {})
    ours_field, ours_lab = field.get("ours", {}), lab.get("ours", {})
    radius, thin, length = "radius RMSE [mm]", "radius RMSE of 8.6 mm [mm]", "length error [%]"
    measured = {
        "F, right class": (_two(paper_field.get("F"), paper_lab.get("F")), ours_field.get("F"), ours_lab.get("F")),
        "radius RMSE, 720p [mm]": ("-", ours_field.get(radius), ours_lab.get(radius)),
        "radius RMSE, 4K [mm]": (_two(paper_field.get(radius), paper_lab.get(radius)), None, four_k.get(radius)),
        thin: (_two(paper_field.get(thin), paper_lab.get(thin)), ours_field.get(thin), ours_lab.get(thin)),
        length: (_two(paper_field.get(length), paper_lab.get(length)), ours_field.get(length), ours_lab.get(length)),
        "total length of a class, mean error [%]": ("-", _totals(known, "field"), _totals(known, "lab")),
        "scale error [%]": ("-", _scale(known, "field"), _scale(known, "lab")),
    }
    rows = [[what, paper, GOALS[what], *map(cell, ours)] for what, (paper, *ours) in measured.items()]
    return table(["", "paper: real field / lab, 4K", "goal", "ours: generated fields", "ours: generated labs"], rows)


def _claim(results: Mapping[str, Result]) -> str:
    field = _at_overlap(results, FIELD)
    ours, paper = field.get("ours", {}), field.get("paper's figure", {})
    told = [
        f"{cell(who.get('radius RMSE [mm]'))} mm and {cell(who.get('length error [%]'))} %" for who in (ours, paper)
    ]
    return (
        f"On generated sites of 58 pipes pipeprog finds and classes pipes with F {cell(ours.get('F'))} and measures "
        f"radius and length to {told[0]}; the paper reports F {cell(paper.get('F'))}, {told[1]} on a real site, and "
        "**no real site has been measured with pipeprog yet**.\n"
    )


def _failures(results: Mapping[str, Result]) -> list[str]:
    """What a user must not expect, with what was measured."""
    field = _at_overlap(results, FIELD).get("ours", {})
    sparse = _at_overlap(results, FIELD, 75).get("ours", {})
    lost = [
        f"{row['factor']} {row['value']}: {row['right class']}"
        for row in _rows(results, "robustness")
        if len(set(row.get("right class", "none").split(" of "))) > 1
    ]
    sewer = results.get("sewer", {}).get("summary", {})
    return [
        f"Lengths of thin pipes in fields: pipes of 8.6 mm are off by {cell(field.get('length error of 8.6 mm [%]'))} "
        "% in the mean, because only a part of them is found ([field](results/experiments_field.md), "
        "[recordings](results/recordings.md)).",
        f"Few images: at 75 % overlap F falls to {cell(sparse.get('F'))} in fields "
        "([field](results/experiments_field.md)).",
        f"Hard recordings, by pipes found: {'; '.join(lost)} ([robustness](results/robustness.md), "
        "[recording](recording.md)).",
        f"Pipes seen from inside of which less than half the circumference shows: {cell(sewer.get('right'))} of "
        f"{cell(sewer.get('clouds'))} real sewer clouds are told, of those that show half and more "
        f"{cell(sewer.get('of_these_right'))} of {cell(sewer.get('with_half_the_circumference'))} "
        "([sewer](results/sewer.md)).",
    ]


def _at_overlap(results: Mapping[str, Result], tables: tuple[int, ...], overlap: int = OVERLAP) -> dict[str, Result]:
    """Values of the experiments' tables at one overlap, by whose they are and by quantity."""
    found: dict[str, Result] = {}
    for number in tables:
        for row in _rows(results, f"experiment_table_{number}"):
            if row["overlap [%]"] == overlap:
                for who, value in row.items():
                    found.setdefault(who, {})[row["quantity"]] = value
    return found


def _rows(results: Mapping[str, Result], name: str) -> list[Result]:
    rows: list[Result] = results.get(name, {}).get("rows", [])
    return rows


def _totals(known: Mapping[str, Result], layout: str) -> float | None:
    """Mean absolute error [%] of the total lengths of the classes, over the recordings of a layout."""
    classes = [entry for name, one in known.items() if layout in name for entry in one["score"]["length"]["per_class"]]
    return round(float(np.mean([abs(entry["error_percent"]) for entry in classes])), 2) if classes else None


def _scale(known: Mapping[str, Result], layout: str) -> float | None:
    """Largest absolute error [%] of the scale, over the recordings of a layout."""
    errors = [abs(one["score"]["scale"]["error_percent"]) for name, one in known.items() if layout in name]
    return round(max(errors), 4) if errors else None


def _two(field: Any, lab: Any) -> str:
    return f"{cell(field)} / {cell(lab)}"


if __name__ == "__main__":
    main()
