"""The paper's Tables 1 and 2: images, tie points and dense points that each least overlap leads to.

    .venv/bin/python -m benchmarks.overlap [lab|field[:SEED[:OPTION...]]|BAG.mcap ...] [--overlap 0.85] [--policy ...]

Replays a generated lab (Table 1) and field (Table 2) by Algorithm 1 (frames.policy=network) and as a stream, once for
each overlap. The paper's column holds what is known of it; its video is another one, so the counts show a trend, not a
target. A replay whose figures are in out/overlap already is left out.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.recordings import ROOT, Recording, made, named
from benchmarks.survey import RESULTS, measure

OVERLAPS = {"lab": (0.70, 0.75, 0.80, 0.85, 0.90, 0.95), "field": (0.75, 0.85, 0.95)}
SEED = 11
FPS = 30  # as the paper's video: a recording of few frames leaves Algorithm 1 no choice
TABLE = {"lab": "Table 1", "field": "Table 2"}
# Images and dense points, where they are known.
PAPER = {("lab", 0.95): (70, 980_000), ("field", 0.95): (355, 11_600_000)}
KEPT = ROOT / "out" / "overlap"
BAND = 0.025  # default of frames.overlap_band


def main() -> None:
    """Measure what is asked for, print the tables and write results/overlap.json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sites", nargs="*", default=["lab", "field"])
    parser.add_argument("--overlap", type=float, action="append", help="instead of the paper's")
    parser.add_argument("--policy", choices=["network", "stream"], action="append", help="instead of both")
    arguments = parser.parse_args()
    rows = []
    for site in arguments.sites:
        recording = named(f"{site}:{SEED}:fps={FPS}" if site in OVERLAPS else site)
        layout = "field" if recording.name.startswith("field") else "lab"
        for overlap in arguments.overlap or OVERLAPS[layout]:
            images, dense = PAPER.get((layout, overlap), (None, None))
            for policy in arguments.policy or ["network", "stream"]:
                rows.append(
                    {
                        "table": TABLE[layout],
                        "recording": recording.name,
                        "overlap": overlap,
                        "policy": policy,
                        "paper's images": images,
                        "paper's dense points": dense,
                        **figures_of(recording, overlap, policy),
                    }
                )
    columns = list(dict.fromkeys(key for row in rows for key in row))
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    for row in rows:
        print("| " + " | ".join("-" if row.get(key) is None else str(row[key]) for key in columns) + " |")
    command = " ".join(["python -m benchmarks.overlap", *sys.argv[1:]])
    title = "Images, tie points and dense points for each overlap"
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "overlap.json").write_text(
        json.dumps({"title": title, "command": command, "rows": rows}, indent=1) + "\n"
    )


def figures_of(recording: Recording, overlap: float, policy: str) -> dict[str, Any]:
    """What one replay made, from out/overlap where it is known; `images` is None where there is no cloud."""
    out = KEPT / f"{recording.name}_{policy}_{round(1000 * overlap)}"
    kept = out.with_suffix(".json")
    if not kept.exists():
        KEPT.mkdir(parents=True, exist_ok=True)
        try:
            measure(made(recording), [f"frames.policy={policy}", f"frames.overlap_min={overlap}"], out)
            figures = network_of(out, overlap)
        except subprocess.CalledProcessError:  # too few images for a cloud: a result, too
            figures = {"images": None}
        kept.write_text(json.dumps(figures) + "\n")
    known: dict[str, Any] = json.loads(kept.read_text())
    return known


def network_of(out: Path, overlap_min: float) -> dict[str, Any]:
    """What the network of images is like, from the results of a replay."""
    with (out / "frames.csv").open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["chosen"] == "1" and row["registered"] == "1"]
    overlaps = [float(row["overlap_n"]) for row in rows]
    with (out / "cloud.ply").open("rb") as cloud:
        head = cloud.read(1000).decode("ascii", "replace")
    return {
        "images": len(rows),
        "tie points in images": sum(int(row["tie_points"]) for row in rows),
        "dense points": int(head.split("element vertex ")[1].split()[0]),
        "below the band": sum(overlap < overlap_min for overlap in overlaps),
        "above the band": sum(overlap > overlap_min + BAND for overlap in overlaps),
    }


if __name__ == "__main__":
    main()
