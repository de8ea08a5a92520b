# SPDX-License-Identifier: Apache-2.0
"""What became of each pipe from one night to the next: generated labs, each filmed again after a day of work.

    .venv/bin/python -m benchmarks.two_nights [--seeds 51 52 53]

The second night has a pipe more, one less and one longer, other light and clutter, and no board; it is replayed with
the first one's results as --reference, and `pipeprog compare` is held against both truths.
Writes results/two_nights.json.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.recordings import Recording, made, site
from benchmarks.survey import COMMAND, RESULTS, RUNS, commit
from pipeprog_bringup.results.scoring import score_files

SEEDS = (51, 52, 53)
SAME_PLACE = 0.001  # m; what stays has the very same start


def surveyed(recording: Recording, first: Recording, reference: Path | None) -> Path:
    """The results of a replay with the plan and board of the first night; replayed once."""
    out = RUNS / f"nights_{recording.name}"
    if not (out / "run.json").exists():
        files = ["--boq", str(first.beside("boq.yaml")), "--board", str(first.beside("board.yaml"))]
        given = ["--reference", str(reference)] if reference else []
        arguments = [str(COMMAND), "replay", str(made(recording).bag), *files, *given, "--out", str(out), "--force"]
        subprocess.run(arguments, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return out


def what_was_done(before: Sequence[dict[str, Any]], after: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """True pipes of both nights: `first` and `second`, their numbers or None, their state and the metres grown."""
    told = []
    left = list(range(len(after)))
    for number, pipe in enumerate(before):
        same = [
            n
            for n in left
            if after[n]["radius"] == pipe["radius"] and np.allclose(after[n]["start"], pipe["start"], atol=SAME_PLACE)
        ]
        if not same:
            told.append({"first": number, "second": None, "state": "gone", "grown": 0.0})
            continue
        left.remove(same[0])
        grown = after[same[0]]["length"] - pipe["length"]
        state = "longer" if grown > SAME_PLACE else "kept"
        told.append({"first": number, "second": same[0], "state": state, "grown": grown})
    return told + [{"first": None, "second": number, "state": "new", "grown": 0.0} for number in left]


def compared(seed: int) -> list[dict[str, Any]]:
    """One row a true pipe: what was done with it, and what `pipeprog compare` says."""
    nights = site("lab", seed), site("lab", seed, "--second-night")
    for night in nights:
        made(night)
    first = surveyed(nights[0], nights[0], None)
    second = surveyed(nights[1], nights[0], first)
    printed = subprocess.run([COMMAND, "compare", str(first), str(second), "--json"], check=True, capture_output=True)
    told = json.loads(printed.stdout)[0]["pipes"]
    truths = [json.loads(night.beside("truth.json").read_text())["pipes"] for night in nights]
    found = [_found(folder, night) for folder, night in zip((first, second), nights, strict=True)]
    lives = {row["id"]: row.get("life", row["id"]) for row in json.loads((first / "pipes.json").read_text())["pipes"]}
    rows = []
    for true in what_was_done(*truths):
        ids = [None if true[key] is None else found[k].get(true[key]) for k, key in enumerate(("first", "second"))]
        life = lives.get(ids[0]) if ids[0] else None
        row = next((r for r in told if (life and r["id"] == life) or (ids[1] and ids[1] in r["ids"])), None)
        grown = None if row is None or true["state"] != "longer" else row["grown_m"] - true["grown"]
        rows.append(
            {
                "site": nights[0].name,
                "pipe": f"{1000 * truths[0 if ids[0] or true['second'] is None else 1][_number(true)]['radius']:g} mm",
                "true": true["state"],
                "told": row["state"] if row else "not measured",
                "grown by, error [mm]": None if grown is None else round(1000 * grown, 1),
            }
        )
    matched = {row["id"] for row in told if row["state"] != "new"} - set(lives.values())
    assert not matched, f"lives of no pipe of the first night: {matched}"
    return rows


def _number(true: dict[str, Any]) -> int:
    return int(true["first"] if true["first"] is not None else true["second"])


def _found(folder: Path, night: Recording) -> dict[int, str]:
    """Ids of the pipes found, by the number of the true pipe."""
    score = score_files(folder / "pipes.json", night.beside("truth.json"))
    return {int(pipe["truth"]): str(pipe["id"]) for pipe in score["pipes"]}


def main() -> None:
    """Measure the sites and write the result."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.two_nights", description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    seeds = parser.parse_args().seeds
    rows = [row for seed in seeds for row in compared(seed)]
    figures = {
        "title": "Two nights of a site: what became of each pipe",
        "command": f"python -m benchmarks.two_nights --seeds {' '.join(map(str, seeds))}",
        "commit": commit(),
        "right": f"{sum(row['true'] == row['told'] for row in rows)} of {len(rows)}",
        "rows": rows,
    }
    (RESULTS / "two_nights.json").write_text(json.dumps(figures, indent=1) + "\n")
    for row in rows:
        print(row)
    print(figures["right"])


if __name__ == "__main__":
    main()
