"""Writes docs/accuracy.md and the README's table from the JSON files in results/: no figure there is typed.

.venv/bin/python -m benchmarks.document
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from benchmarks.recordings import ROOT
from benchmarks.survey import RESULTS

Survey = dict[str, Any]

BEGIN, END = "<!-- figures: written by benchmarks.document -->", "<!-- end of figures -->"
WORTH_TELLING_MM = 1.0  # a radius further off is named with its pipe
WORTH_TELLING_PERCENT = 3.0  # and so is a length

HEAD = """# Accuracy, as measured

Written by `python -m benchmarks.document` from the JSON files in `benchmarks/results/`; each names its command, its
commit and the versions it ran with.

A detection and a true pipe match one to one when their axes are less than max(radius, 20 mm) and 3 degrees apart and
overlap by more than half.
A match is a true positive (TP), a true pipe without a detection is a miss (FN), a detection without a true pipe is
false (FP); cylinders that the truth says to ignore count neither way.
"Right class" counts a match only when its class is the true one.
F is 2 TP / (2 TP + FP + FN), over detections of planned classes with the right class.
Radius RMSE has the square that the paper's Eq. 4 lacks; the length error is the mean of the absolute errors (Eq. 5).
The paper's Table 5 gives its best field result as precision 93.1 % and recall 100 %, but its text says that 4 of 58
pipes were not identified; 54/58 = 93.1 %, so the two look swapped. F is 96.4 % either way.

All recordings are rendered: no real site has been measured yet.
"""


def main() -> None:
    """Write both documents."""
    results = read_results()
    (ROOT / "docs" / "accuracy.md").write_text(accuracy(results))
    readme = ROOT / "README.md"
    readme.write_text(with_table(readme.read_text(), results))


def read_results() -> dict[str, Survey]:
    """The JSON files by name, in the order of their names."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(RESULTS.glob("*.json"))}


def accuracy(results: dict[str, Survey]) -> str:
    """The text of docs/accuracy.md."""
    surveys = _surveys(results)
    parts = [HEAD, "## Recordings through the graph\n", _survey_table(surveys, list(COLUMNS))]
    parts += ["What the recordings are, and the commands:\n", _list(_commands(surveys))]
    parts += ["What fell short:\n", _list(_shortfalls(surveys))]
    for name, result in results.items():
        if "rows" in result:
            title = result.get("title", name.replace("_", " ").capitalize())
            note = f"`{result.get('command', f'python -m benchmarks.{name}')}`\n"
            parts += [f"## {title}\n", note, _rows_table(result["rows"])]
    return "\n".join(parts)


def with_table(readme: str, results: dict[str, Survey]) -> str:
    """The README with its table of figures brought up to date."""
    before, rest = readme.split(BEGIN)
    after = rest.split(END)[1]
    return f"{before}{BEGIN}\n\n{_survey_table(_surveys(results), BRIEF)}\n{END}{after}"


def _surveys(results: dict[str, Survey]) -> dict[str, Survey]:
    return {name.removeprefix("survey_"): result for name, result in results.items() if name.startswith("survey_")}


def _false(survey: Survey) -> str:
    return " / ".join(str(survey["score"][kind]["false_positives"]) for kind in ("planned", "detection"))


def _right(survey: Survey) -> str:
    score = survey["score"]
    return f"{score['classification']['true_positives']} of {len(score['pipes']) + len(score['missed'])}"


def _chi_square(survey: Survey) -> float:
    """Mean square of radius errors over their stated sigmas: 1 where the sigmas are true."""
    pipes, sigmas = survey["score"]["pipes"], survey["radius_sigmas"]
    return float(np.mean([(1e-3 * pipe["radius_error_mm"] / sigmas[pipe["id"]]) ** 2 for pipe in pipes]))


COLUMNS: dict[str, Callable[[Survey], str]] = {
    "right class": _right,
    "false: planned / all": _false,
    "F": lambda survey: f"{survey['score']['classification']['f_measure']:.3f}",
    "radius RMSE": lambda survey: f"{survey['score']['radius']['rmse_mm']:.2f} mm",
    "length error": lambda survey: f"{survey['score']['length']['mean_error_percent']:.2f} %",
    "scale error": lambda survey: f"{survey['score']['scale']['error_percent']:+.4f} %",
    "cameras, rigid": lambda survey: f"{survey['score']['trajectory']['rms_rigid_mm']:.2f} mm",
    "chi2 of radius": lambda survey: f"{_chi_square(survey):.2f}",
    "wall / CPU time": lambda survey: f"{survey['wall_s']:.0f} / {survey['cpu_s']:.0f} s",
}
BRIEF = ("right class", "false: planned / all", "radius RMSE", "length error", "scale error", "wall / CPU time")


def _survey_table(surveys: dict[str, Survey], columns: Sequence[str]) -> str:
    rows = [[f"`{name}`", *(COLUMNS[column](survey) for column in columns)] for name, survey in surveys.items()]
    return _table(["recording", *columns], rows)


def _commands(surveys: dict[str, Survey]) -> Iterable[str]:
    for name, survey in surveys.items():
        made = f"`{survey['made_by']}`; " if survey["made_by"] else ""
        yield f"`{name}`: {made}`{survey['command']}` at commit {survey['commit']}"


def _shortfalls(surveys: dict[str, Survey]) -> Iterable[str]:
    """Every miss, every false detection and every pipe that is far off, in words."""
    for name, survey in surveys.items():
        score = survey["score"]
        faults = [f"pipe {pipe} missed" for pipe in score["missed"]]
        faults += [f"false detection {pipe}" for pipe in score["false"]]
        for pipe in score["pipes"]:
            what = f"pipe {pipe['truth']} ({1e3 * pipe['true_radius']:g} mm)"
            if abs(pipe["radius_error_mm"]) > WORTH_TELLING_MM:
                faults.append(f"{what} {pipe['radius_error_mm']:+.1f} mm in radius")
            if abs(pipe["length_error_percent"]) > WORTH_TELLING_PERCENT:
                faults.append(f"{what} {pipe['length_error_percent']:+.1f} % in length")
        if faults:
            yield f"`{name}`: {'; '.join(faults)}"


def _rows_table(rows: Sequence[dict[str, Any]]) -> str:
    head = list(dict.fromkeys(key for row in rows for key in row))
    return _table([key.replace("_", " ") for key in head], [[_cell(row.get(key)) for key in head] for row in rows])


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _list(items: Iterable[str]) -> str:
    return "".join(f"- {item}\n" for item in items) or "- nothing\n"


if __name__ == "__main__":
    main()
