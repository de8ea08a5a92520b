"""The paper's Tables 1 and 2: images, tie points and dense points that each least overlap leads to.

    .venv/bin/python -m benchmarks.overlap [lab|field[:SEED[:OPTION...]]|BAG.mcap ...] [--overlap 0.85] [--policy ...]

Replays a generated lab (Table 1) and field (Table 2) by Algorithm 1 (frames.policy=network) and as a stream, once for
each overlap. The paper's column holds what is known of it; its video is another one, so the counts show a trend, not a
target. What results/ has already is not measured again.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
from pathlib import Path
from typing import Any

from benchmarks.recordings import ROOT, made, named
from benchmarks.survey import RESULTS, measure

OVERLAPS = {"lab": (0.70, 0.75, 0.80, 0.85, 0.90, 0.95), "field": (0.75, 0.85, 0.95)}
SEED = 11
FPS = 30  # as the paper's video: a recording of few frames leaves Algorithm 1 no choice
TABLE = {"lab": "Table 1", "field": "Table 2"}
# Images and dense points, where they are known.
PAPER = {("lab", 0.95): (70, 980_000), ("field", 0.95): (355, 11_600_000)}
BAND = 0.025  # default of frames.overlap_band


def main() -> None:
    """Measure what is asked for and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sites", nargs="*", default=["lab", "field"])
    parser.add_argument("--overlap", type=float, action="append", help="instead of the paper's")
    parser.add_argument("--policy", choices=["network", "stream"], action="append", help="instead of both")
    arguments = parser.parse_args()
    for site in arguments.sites:
        recording = named(f"{site}:{SEED}:fps={FPS}" if site in OVERLAPS else site)
        layout = "field" if recording.name.startswith("field") else "lab"
        rows = []
        for overlap in arguments.overlap or OVERLAPS[layout]:
            for policy in arguments.policy or ["network", "stream"]:
                name = f"overlap_{recording.name}_{policy}_{round(1000 * overlap)}"
                kept = RESULTS / f"{name}.json"
                if not kept.exists():
                    overrides = [f"frames.policy={policy}", f"frames.overlap_min={overlap}"]
                    out = ROOT / "out" / "overlap" / name
                    try:
                        figures = measure(made(recording), overrides, out) | network_of(out, overlap)
                    except subprocess.CalledProcessError as error:  # too few images for a cloud: a result, too
                        figures = {"failed": " ".join(error.cmd[1:]).replace(f"{ROOT}/", "")}
                    RESULTS.mkdir(parents=True, exist_ok=True)
                    kept.write_text(json.dumps(figures, indent=1) + "\n")
                rows.append((overlap, policy, json.loads(kept.read_text())))
        print(table(layout, recording.name, rows))


def network_of(out: Path, overlap_min: float) -> dict[str, Any]:
    """What the network of images is like, from the results of a replay."""
    with (out / "frames.csv").open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["chosen"] == "1" and row["registered"] == "1"]
    overlaps = [float(row["overlap_n"]) for row in rows]
    with (out / "cloud.ply").open("rb") as cloud:
        head = cloud.read(1000).decode("ascii", "replace")
    return {
        "overlap_min": overlap_min,
        "images": len(rows),
        "tie_points_in_images": sum(int(row["tie_points"]) for row in rows),
        "dense_points": int(head.split("element vertex ")[1].split()[0]),
        "below_the_band": sum(overlap < overlap_min for overlap in overlaps),
        "above_the_band": sum(overlap > overlap_min + BAND for overlap in overlaps),
        "outside_with_reason": sum(row["reason"].startswith("overlap ") for row in rows),
    }


def table(layout: str, name: str, rows: list[tuple[float, str, dict[str, Any]]]) -> str:
    """The table of one site."""
    lines = [
        f"{TABLE[layout]}: {name}",
        "| overlap | policy | images | paper | tie points in images | dense points | paper | below band | above band |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for overlap, policy, figures in rows:
        images, dense = PAPER.get((layout, overlap), (None, None))
        if "failed" in figures:
            lines.append(f"| {overlap:.0%} | {policy} | no cloud | {images or '-'} | - | - | {dense or '-'} | - | - |")
            continue
        lines.append(
            f"| {overlap:.0%} | {policy} | {figures['images']} | {images or '-'} | {figures['tie_points_in_images']} | "
            f"{figures['dense_points']} | {dense or '-'} | {figures['below_the_band']} | {figures['above_the_band']} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
