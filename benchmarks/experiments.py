# SPDX-License-Identifier: Apache-2.0
"""The paper's Experiments 1 to 4 on generated sites: its figures, its method to the letter, and ours.

    .venv/bin/python -m benchmarks.experiments [--methods paper ours] [--layouts lab field] [--overlaps 95]

Every survey goes through the node graph and is kept in out/surveys: a run that was interrupted goes on where it was,
the survey that was under way is done again. After each survey the tables (results/experiment_table_1.json to 7) are
written anew from all that is there; of methods and overlaps of which no survey is kept they keep what they have. The
figures (docs/images/experiment_figure_8 to 11) come last. The sites with the highest overlap come first. `--size 4k`
films as the paper did: rendering then takes some 25 minutes of one core for a lab and an hour for a field site, and
each survey several times what it takes at 720p.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure

from benchmarks import board_views
from benchmarks.cloud_accuracy import cloud_accuracy
from benchmarks.recordings import ROOT, Recording, site
from benchmarks.survey import COMMAND, RESULTS, RUNS, attempt, commit
from pipeprog_bringup.report import render
from pipeprog_bringup.report.survey_reader import read_survey
from pipeprog_bringup.results.cloud_io import read_cloud
from pipeprog_bringup.results.scoring import score_files

Known = dict[str, Any]

IMAGES = ROOT / "docs" / "images"
OVERLAPS = {"lab": (0.70, 0.75, 0.80, 0.85, 0.90, 0.95), "field": (0.75, 0.85, 0.95)}  # of the paper
# Algorithm 1 over the whole recording, slab and ellipse on planes, radii of the cloud, k-means; the defaults; and the
# paper's detection on the clouds of the latter, which tells its choice of images from the rest.
METHODS = {
    "paper": (
        "frames.policy=network",
        "detect.front_end=planes",
        "detect.contour.enabled=false",
        "detect.classifier=kmeans",
    ),
    "ours": (),
    "mixed": ("detect.front_end=planes", "detect.classifier=kmeans"),
}
TITLES = {"paper": "paper's method", "ours": "ours", "mixed": "its detection, our images"}
# At 0.75 m/s and two metres 95 % of overlap are 0.14 m, five frames a second; the paper's field survey had 355 images.
FIELD_FPS = "--fps=6"
BAND = 0.025  # default of frames.overlap_band
SMALLEST = 8.6  # mm
UNEXPLAINED = "images outside the band, without a reason"
# What is known of the paper's figures: (layout, overlap [%]) -> quantity -> value. Precision and recall of its field
# are as printed; they look swapped (docs/accuracy.md).
PAPER: dict[tuple[str, float], dict[str, float]] = {
    ("lab", 95.0): {"images": 70, "dense points": 980_000, "F": 1.0, "radius RMSE [mm]": 5.1, "length error [%]": 5.5},
    ("field", 95.0): {
        "images": 355,
        "dense points": 11_600_000,
        "precision": 0.931,
        "recall": 1.0,
        "F": 0.964,
        "radius RMSE [mm]": 5.4,
        f"radius RMSE of {SMALLEST:g} mm [mm]": 7.8,
        "length error [%]": 5.0,
    },
}


@dataclass(frozen=True)
class Case:
    """One survey: a recording, by one method, at one least overlap."""

    layout: str
    recording: Recording
    method: str
    overlap: float

    @property
    def name(self) -> str:
        """Of its folder in out/surveys."""
        return f"{self.recording.name}_{self.method}_{100 * self.overlap:.0f}"

    @property
    def kept(self) -> Path:
        """The file of what is known of it."""
        return RUNS / f"experiment_{self.name}.json"

    def known(self) -> Known | None:
        """Its figures, None where it has not been measured."""
        return json.loads(self.kept.read_text()) if self.kept.exists() else None

    def measure(self) -> None:
        """Survey, and measure network and cloud of what comes out."""
        if self.method == "mixed":
            figures = self._detected(replace(self, method="ours"))
            self.kept.write_text(json.dumps(figures, indent=1) + "\n")
            return
        figures = attempt(self.recording, (f"frames.overlap_min={self.overlap}", *METHODS[self.method]), self.name)
        if "failed" in figures:
            truth = json.loads(self.recording.beside("truth.json").read_text())
            figures["pipes"] = [pipe["radius"] for pipe in truth["pipes"]]
        else:
            figures["network"] = network(RUNS / self.name, self.overlap, self.method)
            figures["cloud"] = cloud_accuracy(self.recording, RUNS / self.name)
        self.kept.write_text(json.dumps(figures, indent=1) + "\n")

    def _detected(self, ours: Case) -> Known:
        """The figures of detection alone, by this method's settings, on the cloud of our survey."""
        if ours.known() is None:
            ours.measure()
        known = ours.known() or {}
        if "failed" in known:
            return known
        run, out = RUNS / ours.name, RUNS / self.name
        settings = [argument for text in METHODS[self.method] for argument in ("--set", text)]
        boq = self.recording.beside("boq.yaml")
        options = ["--boq", str(boq), "--out", str(out), "--force", *settings]
        with (RUNS / f"{self.name}.log").open("w") as log:
            subprocess.run([COMMAND, "detect", run / "cloud.ply", *options], check=True, stdout=log, stderr=log)
        for name in ("trajectory.tum", "frames.csv"):
            shutil.copy(run / name, out / name)
        score = score_files(out / "pipes.json", self.recording.beside("truth.json"))
        return {"commit": commit(), "versions": known["versions"], "score": score}


def main() -> None:
    """Survey what has not been surveyed; write tables and figures after each."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.experiments",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--size", default="720p", choices=["480p", "720p", "1080p", "4k"])
    parser.add_argument("--lab-seeds", type=int, nargs="*", default=[1, 2, 3])
    parser.add_argument("--field-seeds", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--methods", nargs="*", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--layouts", nargs="*", choices=list(OVERLAPS), default=list(OVERLAPS))
    parser.add_argument("--overlaps", type=int, nargs="*", help="percent, of the paper's; without, all")
    arguments = parser.parse_args()
    recordings = {
        "lab": [site("lab", seed, f"--size={arguments.size}") for seed in arguments.lab_seeds],
        "field": [site("field", seed, f"--size={arguments.size}", FIELD_FPS) for seed in arguments.field_seeds],
    }
    cases = [
        Case(layout, recording, method, overlap)
        for layout, overlaps in OVERLAPS.items()
        for overlap in reversed(overlaps)
        for method in METHODS
        for recording in recordings[layout]
    ]
    due = [
        case
        for case in cases
        if case.method in arguments.methods
        and case.layout in arguments.layouts
        and (arguments.overlaps is None or round(100 * case.overlap) in arguments.overlaps)
    ]
    for number, case in enumerate(due, 1):
        print(f"[{number} of {len(due)}] {case.name}", flush=True)
        if case.known() is None:
            case.measure()
            write_tables(cases, arguments.size)
    write_tables(cases, arguments.size)
    _equal_counts(due)
    write_tables(cases, arguments.size)
    draw(cases)
    runs = [
        (RUNS / case.name, case.recording)
        for case in due
        if (case.layout, case.method, case.overlap) == ("lab", "ours", OVERLAPS["lab"][-1])
        and "score" in (case.known() or {})
    ]
    if runs:
        board_views.main(runs)


def network(out: Path, overlap_min: float, method: str) -> dict[str, int]:
    """What the network of images is like, from the results of a replay."""
    with (out / "frames.csv").open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["chosen"] == "1" and row["registered"] == "1"]
    below = [row for row in rows if float(row["overlap_n"]) < overlap_min]
    above = [row for row in rows if float(row["overlap_n"]) > overlap_min + BAND]
    known = {
        "images": len(rows),
        "tie points in images": sum(int(row["tie_points"]) for row in rows),
        "images below the band": len(below),
        "images above the band": len(above),
    }
    if method == "paper":  # Algorithm 1 says of every image that it leaves outside the band why
        known[UNEXPLAINED] = sum(not row["reason"].startswith("overlap") for row in below + above)
    return known


def _equal_counts(cases: Sequence[Case]) -> None:
    """Experiment 2 with equal counts: every cloud thinned to what the sparsest of its recording and method has."""
    groups = {(case.recording, case.method) for case in cases}
    for group in sorted(groups, key=lambda pair: (pair[0].name, pair[1])):
        members = [case for case in cases if (case.recording, case.method) == group]
        known = {case: figures for case in members if "cloud" in (figures := case.known() or {})}
        least = min((figures["cloud"]["points"] for figures in known.values()), default=0)
        for case, figures in known.items():
            if figures.get("equal", {}).get("points") != least:
                print(f"{case.name}: {least} points of its cloud", flush=True)
                figures["equal"] = cloud_accuracy(case.recording, RUNS / case.name, least)
                case.kept.write_text(json.dumps(figures, indent=1) + "\n")


Quantity = Callable[[Sequence[Known]], float | str | None]


def _mean(*path: str, digits: int = 0) -> Quantity:
    """The mean over surveys of one of their figures."""

    def mean(surveys: Sequence[Known]) -> float | None:
        values = []
        for survey in surveys:
            value: Any = survey
            for key in path:
                value = value.get(key, {})
            if value != {}:
                values.append(value)
        return round(float(np.mean(values)), digits) if values else None

    return mean


def _counts(surveys: Sequence[Known]) -> tuple[int, int, int]:
    """True positives (with the right class), false ones among planned classes, misses; a failure misses all."""
    true = false = missed = 0
    for survey in surveys:
        if "failed" in survey:
            missed += len(survey["pipes"])
        else:
            counts = survey["score"]["classification"]
            true += counts["true_positives"]
            false += counts["false_positives"]
            missed += counts["false_negatives"]
    return true, false, missed


def _rate(numerator: Callable[[int, int, int], tuple[float, float]]) -> Quantity:
    def rate(surveys: Sequence[Known]) -> float | None:
        part, whole = numerator(*_counts(surveys))
        return round(part / whole, 3) if whole else None

    return rate


def _errors(kind: str, radius_mm: float | None = None) -> Quantity:
    """RMS of radius errors [mm] or mean of absolute length errors [%], over the pipes of all surveys together."""

    def errors(surveys: Sequence[Known]) -> float | None:
        values = [
            pipe[kind]
            for survey in surveys
            if "score" in survey
            for pipe in survey["score"]["pipes"]
            if radius_mm is None or abs(1e3 * pipe["true_radius"] - radius_mm) < 0.05
        ]
        if not values:
            return None
        squares = kind == "radius_error_mm"
        return round(float(np.sqrt(np.mean(np.square(values))) if squares else np.mean(np.abs(values))), 3)

    return errors


def _found(radius_mm: float) -> Quantity:
    def found(surveys: Sequence[Known]) -> str:
        hit = total = 0
        for survey in surveys:
            radii = survey.get("pipes") or [pipe["radius"] for pipe in survey["truth"]]
            total += sum(abs(1e3 * radius - radius_mm) < 0.05 for radius in radii)
            matched = survey["score"]["pipes"] if "score" in survey else []
            hit += sum(abs(1e3 * pipe["true_radius"] - radius_mm) < 0.05 for pipe in matched)
        return f"{hit} of {total}"

    return found


def _below_band(surveys: Sequence[Known]) -> float | None:
    """Share of the images of all surveys together."""
    networks = [survey["network"] for survey in surveys if "network" in survey]
    images = sum(known["images"] for known in networks)
    return round(100 * sum(known["images below the band"] for known in networks) / images, 1) if images else None


def _how_many(surveys: Sequence[Known]) -> str:
    failed = sum("failed" in survey for survey in surveys)
    return f"{len(surveys)}" + (f", {failed} without a result" if failed else "")


NETWORK: dict[str, Quantity] = {
    "sites": _how_many,
    "images": _mean("network", "images"),
    "tie points in images": _mean("network", "tie points in images"),
    "dense points": _mean("cloud", "points"),
    "images below the band": _mean("network", "images below the band", digits=1),
    "images below the band [%]": _below_band,
    "images above the band": _mean("network", "images above the band", digits=1),
    UNEXPLAINED: _mean("network", UNEXPLAINED, digits=1),
}
CLOUD: dict[str, Quantity] = {
    "sites": _how_many,
    "median distance [mm]": _mean("cloud", "median [mm]", digits=3),
    "RMS distance [mm]": _mean("cloud", "RMS [mm]", digits=2),
    "within 10 mm [%]": _mean("cloud", "within 10 mm [%]", digits=2),
    "pipes covered [%]": _mean("cloud", "pipe surface with a point within 5 mm [%]", digits=1),
    "equal counts: points": _mean("equal", "measured"),
    "equal counts: median distance [mm]": _mean("equal", "median [mm]", digits=3),
    "equal counts: RMS distance [mm]": _mean("equal", "RMS [mm]", digits=2),
    "equal counts: pipes covered [%]": _mean("equal", "pipe surface with a point within 5 mm [%]", digits=1),
}
RATES: dict[str, Quantity] = {
    "precision": _rate(lambda true, false, missed: (true, true + false)),
    "recall": _rate(lambda true, false, missed: (true, true + missed)),
    "accuracy": _rate(lambda true, false, missed: (true, true + false + missed)),
    "F": _rate(lambda true, false, missed: (2 * true, 2 * true + false + missed)),
}
RADII = (8.6, 36.5, 57.5, 84.1, 109.5, 122.3)  # mm
RADIUS: dict[str, Quantity] = {
    "radius RMSE [mm]": _errors("radius_error_mm"),
    **{f"radius RMSE of {radius:g} mm [mm]": _errors("radius_error_mm", radius) for radius in RADII},
}
LENGTH: dict[str, Quantity] = {
    "length error [%]": _errors("length_error_percent"),
    **{f"length error of {radius:g} mm [%]": _errors("length_error_percent", radius) for radius in RADII},
}
TABLES: dict[int, tuple[str, str, dict[str, Quantity]]] = {
    1: ("Table 1: images and points, lab", "lab", NETWORK),
    2: ("Table 2: images and points, field", "field", NETWORK),
    3: ("Table 3: clouds against the true surfaces, lab", "lab", CLOUD),
    4: ("Table 4: found, radius and length, lab", "lab", {"sites": _how_many, **RATES, **RADIUS, **LENGTH}),
    5: (
        "Table 5: found, field",
        "field",
        {"sites": _how_many, **RATES, **{f"found of {radius:g} mm": _found(radius) for radius in RADII}},
    ),
    6: ("Table 6: radius, field", "field", RADIUS),
    7: ("Table 7: length, field", "field", LENGTH),
}


def write_tables(cases: Sequence[Case], size: str) -> None:
    """All tables from what is known of the cases, and from the tables as they are where nothing is known of a case."""
    for number, (title, layout, quantities) in TABLES.items():
        surveys = {(case.method, case.overlap): _surveys(cases, case) for case in cases if case.layout == layout}
        everything = [survey for known in surveys.values() for survey in known]
        if not everything:
            continue
        of_what = {
            "title": f"{title} ({size})",
            "command": "make experiments",
            "size": size,
            "recordings": sorted({case.recording.made_by for case in cases if case.layout == layout}),
            "settings": {method: list(settings) for method, settings in METHODS.items()},
        }
        target = RESULTS / f"experiment_table_{number}.json"
        earlier = json.loads(target.read_text()) if target.exists() else {}
        if any(earlier.get(key) != value for key, value in of_what.items()):
            earlier = {}  # of other sites
        content = of_what | {
            "commits": {TITLES[method]: _commits(method, surveys, earlier) for method in METHODS},
            "versions": next((survey["versions"] for survey in everything if "versions" in survey), None),
            "rows": _rows(layout, quantities, surveys, earlier),
        }
        target.write_text(json.dumps(content, indent=1) + "\n")


def _surveys(cases: Sequence[Case], like: Case) -> list[Known]:
    """What is known of all recordings, surveyed as that case is."""
    alike = [
        case for case in cases if (case.layout, case.method, case.overlap) == (like.layout, like.method, like.overlap)
    ]
    known = []
    for case in alike:
        if (figures := case.known()) is not None:
            if "score" in figures:
                figures["truth"] = json.loads(case.recording.beside("truth.json").read_text())["pipes"]
            known.append(figures)
    return known


Surveys = dict[tuple[str, float], list[Known]]  # by method and overlap


def _commits(method: str, surveys: Surveys, earlier: Known) -> list[str]:
    """Of a method's surveys; where nothing is known at one of its overlaps, those of the earlier table as well."""
    own = [known for (each, _), known in surveys.items() if each == method]
    commits = {survey["commit"] for known in own for survey in known}
    if not all(own):
        commits |= set(earlier.get("commits", {}).get(TITLES[method], []))
    return sorted(commits)


def _rows(layout: str, quantities: dict[str, Quantity], surveys: Surveys, earlier: Known) -> list[dict[str, Any]]:
    """The rows of a table; what no survey is known of is as in the `earlier` one."""
    before = {(row["overlap [%]"], row["quantity"]): row for row in earlier.get("rows", [])}
    rows = []
    for overlap in OVERLAPS[layout]:
        percent = round(100 * overlap)
        for name, quantity in quantities.items():
            paper = PAPER.get((layout, 100 * overlap), {}).get(name)
            kept = before.get((percent, name), {})
            values = {
                title: quantity(known) if (known := surveys.get((method, overlap))) else kept.get(title)
                for method, title in TITLES.items()
            }
            if paper is not None or any(value is not None for value in values.values()):
                rows.append({"overlap [%]": percent, "quantity": name, "paper's figure": paper} | values)
    return rows


def draw(cases: Sequence[Case]) -> None:
    """Figures 9 and 10 from the tables, and Figure 11 of the first field; Figure 8 is board_views'."""
    IMAGES.mkdir(exist_ok=True)
    figure = Figure(figsize=(11, 3), layout="constrained")
    names = ("median distance [mm]", "RMS distance [mm]", "pipes covered [%]", "equal counts: pipes covered [%]")
    for panel, name in zip(figure.subplots(1, 4), names, strict=True):
        _lines(panel, 3, name)
    figure.axes[0].legend()
    figure.savefig(IMAGES / "experiment_figure_9.png", dpi=80)

    figure = Figure(figsize=(11, 5.5), layout="constrained")
    tables = {"lab": (4, 4, 4), "field": (5, 6, 7)}
    shown = ("F", "radius RMSE [mm]", "length error [%]")
    for row, (layout, numbers) in zip(figure.subplots(2, 3), tables.items(), strict=True):
        for panel, number, name in zip(row, numbers, shown, strict=True):
            _lines(panel, number, name)
            panel.set_title(layout)
    figure.axes[0].legend()
    figure.savefig(IMAGES / "experiment_figure_10.png", dpi=80)

    for case in cases:
        done = (
            case.method != "mixed"
            and (case.layout, case.overlap) == ("field", OVERLAPS["field"][-1])
            and "score" in (case.known() or {})
        )
        target = IMAGES / f"experiment_figure_11_{case.method}.jpg"
        if done and case.recording == next(other.recording for other in cases if other.layout == "field"):
            cv2.imwrite(str(target), _pipes(RUNS / case.name)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


def _lines(panel: Any, number: int, name: str) -> None:
    """A quantity of a table over the overlap: of all methods, and the paper's figures where they are known."""
    table = json.loads((RESULTS / f"experiment_table_{number}.json").read_text())
    rows = [row for row in table["rows"] if row["quantity"] == name]
    styles = [(title, f"C{index}o-") for index, title in enumerate(TITLES.values())]
    for column, style in (*styles, ("paper's figure", "k*")):
        points = [(float(row["overlap [%]"]), float(row[column])) for row in rows if row[column] is not None]
        if points:
            panel.plot(*np.transpose(points), style, label=column)
    panel.set(xlabel="least overlap [%]", ylabel=name)
    panel.set_ylim(bottom=0)


def _pipes(run: Path) -> Any:
    """The pipes of a run in the colours of their classes, before the cloud: an image (H, W, 3) RGB."""
    results = read_survey(run)
    pipes = [render.ColoredPipe(results.cylinder(p), results.color(p["class"]), str(p["id"])) for p in results.pipes]
    file = read_cloud(run / "cloud.ply")
    direction = render.two_sides(file.cloud.points, pipes)[0]
    return render.draw(file.cloud.points, file.colors, pipes, direction, 900)


if __name__ == "__main__":
    main()
