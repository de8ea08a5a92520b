"""The paper's experiments on the generator's sites: the paper's figures, its method to the letter, and ours.

    .venv/bin/python -m benchmarks.experiments [--size 720p] [--lab-seeds 1 2 3] [--field-seeds 1 2]

Every survey goes through the node graph and is kept in out/surveys: an interrupted run goes on where it was. Writes the
tables as results/experiment_*.json and the figures as docs/images/experiment_*.png. At 4K, as in the paper, a lab takes
about half an hour to render and a field site more than an hour; 720p takes a ninth of that.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks import board_views
from benchmarks.cloud_accuracy import cloud_accuracy
from benchmarks.recordings import ROOT, Recording, site
from benchmarks.survey import RESULTS, RUNS, survey

Survey = dict[str, Any]

OVERLAPS = {"lab": (0.70, 0.75, 0.80, 0.85, 0.90, 0.95), "field": (0.75, 0.85, 0.95)}  # of the paper
METHODS = {
    "paper's method": (
        "frames.policy=network",
        "detect.front_end=planes",
        "detect.contour.enabled=false",
    ),
    "ours": (),
}
# Its best field result (95 % overlap, 58 pipes): F, radius RMSE [mm] and that of 8.6 mm pipes, length error [%].
PAPER = {"lab": (1.0, 5.1, None, 5.5), "field": (0.964, 5.4, 7.8, 5.0)}
SMALLEST = 0.0086  # m


def main() -> None:
    """Run all experiments."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.experiments", description=__doc__)
    parser.add_argument("--size", default="4k", choices=["480p", "720p", "1080p", "4k"])
    parser.add_argument("--lab-seeds", type=int, nargs="*", default=[1, 2, 3])
    parser.add_argument("--field-seeds", type=int, nargs="*", default=[1, 2])
    arguments = parser.parse_args()
    options = [f"--size={arguments.size}"]
    labs = [site("lab", seed, *options) for seed in arguments.lab_seeds]
    fields = [site("field", seed, *options, "--fps=3") for seed in arguments.field_seeds]
    for recording in labs[:1]:
        survey(recording, name=recording.name, results=RUNS)
        board_views.main(RUNS / recording.name, recording.beside("truth.json"), recording.beside("board.yaml"))
    for layout, recordings in (("lab", labs), ("field", fields)):
        if recordings:
            _sweep(layout, recordings, arguments.size)


def _sweep(layout: str, recordings: Sequence[Recording], size: str) -> None:
    """Experiments 2 to 4 on the recordings of one layout, all overlaps and methods."""
    detection, radii, clouds = [_paper_row(layout)], [], []
    equal = None
    for method, settings in METHODS.items():
        for overlap in OVERLAPS[layout]:
            surveys = []
            for recording in recordings:
                name = f"{recording.name}_{method.split()[0]}_{100 * overlap:.0f}"
                surveys.append(survey(recording, (f"frames.overlap_min={overlap}", *settings), name, RUNS))
                if method == "ours":
                    figures = cloud_accuracy(recording, RUNS / name)
                    # The variant of equal counts: as many points as the first, sparsest overlap has.
                    equal = equal or figures["points"]
                    same = cloud_accuracy(recording, RUNS / name, min(equal, figures["points"]))
                    clouds.append(
                        {
                            "recording": recording.name,
                            "overlap [%]": 100 * overlap,
                            **figures,
                            "median of equal counts [mm]": same["median [mm]"],
                        }
                    )
            head = {"method": method, "overlap [%]": 100 * overlap}
            detection.append({**head, **_detection(surveys)})
            radii += [{**head, **row} for row in _by_class(surveys)]
            _write(layout, size, detection, radii, clouds)
    _draw(layout, detection, radii)


def _paper_row(layout: str) -> dict[str, Any]:
    f_measure, radius, smallest, length = PAPER[layout]
    return {
        "method": "paper's figures",
        "overlap [%]": 95.0,
        "F": f_measure,
        "radius RMSE [mm]": radius,
        "of 8.6 mm pipes [mm]": smallest,
        "length error [%]": length,
    }


def _detection(surveys: Sequence[Survey]) -> dict[str, Any]:
    """Images used, precision, recall, accuracy, F and errors over all recordings together."""
    counts = np.sum(
        [
            [
                survey["score"]["classification"][kind]
                for kind in ("true_positives", "false_positives", "false_negatives")
            ]
            for survey in surveys
        ],
        axis=0,
    )
    true, false, missed = (int(count) for count in counts)
    pipes = [pipe for survey in surveys for pipe in survey["score"]["pipes"]]
    smallest = [pipe["radius_error_mm"] for pipe in pipes if pipe["true_radius"] == SMALLEST]
    return {
        "images": sum(survey["keyframes"] for survey in surveys),
        "precision": round(true / max(true + false, 1), 3),
        "recall": round(true / (true + missed), 3),
        "accuracy": round(true / (true + false + missed), 3),
        "F": round(2 * true / (2 * true + false + missed), 3),
        "radius RMSE [mm]": _rms([pipe["radius_error_mm"] for pipe in pipes]),
        "of 8.6 mm pipes [mm]": _rms(smallest),
        "length error [%]": round(float(np.mean([abs(pipe["length_error_percent"]) for pipe in pipes])), 2),
    }


def _by_class(surveys: Sequence[Survey]) -> list[dict[str, Any]]:
    """Radius RMSE and length error of each true radius."""
    groups: defaultdict[float, list[dict[str, Any]]] = defaultdict(list)
    for one in surveys:
        for pipe in one["score"]["pipes"]:
            groups[pipe["true_radius"]].append(pipe)
    return [
        {
            "radius [mm]": 1e3 * radius,
            "pipes": len(pipes),
            "radius RMSE [mm]": _rms([pipe["radius_error_mm"] for pipe in pipes]),
            "length error [%]": round(float(np.mean([abs(pipe["length_error_percent"]) for pipe in pipes])), 2),
        }
        for radius, pipes in sorted(groups.items())
    ]


def _rms(errors: Sequence[float]) -> float | None:
    return round(float(np.sqrt(np.mean(np.square(errors)))), 3) if errors else None


def _write(layout: str, size: str, *tables: list[dict[str, Any]]) -> None:
    what = {"detection": "found, radius and length", "classes": "by class", "cloud": "clouds against the true surface"}
    for (name, title), rows in zip(what.items(), tables, strict=True):
        content = {
            "title": f"Experiments on the {layout}, {size}: {title}",
            "command": "make experiments",
            "rows": rows,
        }
        (RESULTS / f"experiment_{layout}_{name}.json").write_text(json.dumps(content, indent=1) + "\n")


def _draw(layout: str, detection: list[dict[str, Any]], radii: list[dict[str, Any]]) -> None:
    """F and errors over the overlap, and the radius error by class at the highest."""
    figure = Figure(figsize=(12, 3.4), layout="constrained")
    panels = figure.subplots(1, 4)
    for panel, quantity in zip(panels, ("F", "radius RMSE [mm]", "length error [%]"), strict=False):
        for method in ("paper's figures", *METHODS):
            rows = [row for row in detection if row["method"] == method]
            panel.plot([row["overlap [%]"] for row in rows], [row[quantity] for row in rows], "o-", label=method)
        panel.set(xlabel="overlap [%]", ylabel=quantity)
        panel.set_ylim(bottom=0)
    panels[0].legend()
    for number, method in enumerate(METHODS):
        rows = [row for row in radii if row["method"] == method and row["overlap [%]"] == 100 * OVERLAPS[layout][-1]]
        places = np.arange(len(rows)) + 0.4 * number
        panels[3].bar(places, [row["radius RMSE [mm]"] for row in rows], 0.4, label=method, color=f"C{number + 1}")
        panels[3].set_xticks(places, [f"{row['radius [mm]']:g}" for row in rows])
    panels[3].set(xlabel="true radius [mm]", ylabel="radius RMSE [mm] at the highest overlap")
    figure.savefig(ROOT / "docs" / "images" / f"experiment_{layout}.png", dpi=90)


if __name__ == "__main__":
    main()
