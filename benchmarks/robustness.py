"""How the result suffers when the recording does: one factor at a time, against the same site filmed well.

    .venv/bin/python -m benchmarks.robustness [FACTOR ...]

Each row is a recording of its own through the graph; what was measured is kept in out/surveys and not measured again.
Writes results/robustness.json and docs/images/robustness.png.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.recordings import ROOT, Recording, site
from benchmarks.survey import RESULTS, RUNS, survey

SEED = 21
# Options of bags/make_site.py; the first value of each is how a good recording is made, and its plain default.
FACTORS: dict[str, tuple[str, tuple[str, ...]]] = {
    "resolution": ("--size={}", ("720p", "480p", "1080p", "4k")),
    "speed [m/s]": ("--speed={}", ("0.75", "0.2", "0.4", "1.0", "1.5")),
    "exposure [ms]": ("--exposure-ms={}", ("0", "2", "5", "10")),
    "image noise [grey levels]": ("--noise={}", ("1", "3", "6", "10")),
    "JPEG quality": ("--quality={}", ("92", "80", "60", "30")),
    "distortion left uncorrected, k1": ("--hide-distortion --distortion={},0,0,0,0", ("0", "-0.005", "-0.02", "-0.1")),
    "focal length off [%]": ("--focal-error={}", ("0", "0.2", "1.0")),
    "texture, 1 rich": ("--richness={}", ("1.0", "0.5", "0.2", "0.05")),
    "distance [m]": ("--distance={}", ("2.0", "1.0", "3.0", "3.5")),
    "rolling shutter [ms]": ("--readout-ms={}", ("0", "10", "20", "30")),
}
TITLE = "Robustness: one factor at a time, lab, 720p unless said"
PICTURE = ROOT / "docs" / "images" / "robustness.png"


def main(factors: list[str]) -> None:
    """Measure, write the rows down after each, and draw."""
    rows: list[dict[str, Any]] = []
    for factor in factors or list(FACTORS):
        option, values = FACTORS[factor]
        for value in values:
            options = () if value == values[0] else (*option.format(value).split(), "--allow-hidden")
            rows.append({"factor": factor, "value": value, **_figures(site("lab", SEED, *options))})
            (RESULTS / "robustness.json").write_text(json.dumps({"title": TITLE, "rows": rows}, indent=1) + "\n")
            print(rows[-1], flush=True)
    _draw(rows)


def _figures(recording: Recording) -> dict[str, Any]:
    """One row's figures; F is 0 where the replay ends with an error."""
    try:
        score = survey(recording, results=RUNS)["score"]
    except subprocess.CalledProcessError:
        return {"F": 0.0}
    return {
        "F": round(score["classification"]["f_measure"] or 0.0, 3),
        "radius RMSE [mm]": _rounded(score["radius"]["rmse_mm"]),
        "length error [%]": _rounded(score["length"]["mean_error_percent"]),
        "scale error [%]": _rounded(score["scale"]["error_percent"]),
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def _draw(rows: list[dict[str, Any]], picture: Path = PICTURE) -> None:
    """A panel for each factor: F as bars, radius RMSE as a line."""
    shown = [factor for factor in FACTORS if any(row["factor"] == factor for row in rows)]
    figure = Figure(figsize=(12, 2.6 * -(-len(shown) // 3)), layout="constrained")
    panels = figure.subplots(-(-len(shown) // 3), 3, squeeze=False).ravel()
    for panel, factor in zip(panels, shown, strict=False):
        group = {row["value"]: row for row in rows if row["factor"] == factor}
        values = sorted(group, key=lambda text: float(text.rstrip("pk")) * (1000 if text.endswith("k") else 1))
        panel.bar(values, [group[value]["F"] for value in values], color="0.8")
        panel.set(title=factor, ylim=(0, 1.05), ylabel="F")
        line = panel.twinx()
        line.plot(values, [group[value].get("radius RMSE [mm]") for value in values], "o-", color="C3")
        line.set_ylabel("radius RMSE [mm]", color="C3")
        line.set_ylim(bottom=0)
    for panel in panels[len(shown) :]:
        panel.set_axis_off()
    figure.savefig(picture, dpi=90)


if __name__ == "__main__":
    main(sys.argv[1:])
