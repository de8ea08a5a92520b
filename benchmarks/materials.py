# SPDX-License-Identifier: Apache-2.0
"""Materials told by their look: on generated racks of new seeds, and on racks that another renderer has made.

    .venv/bin/python -m benchmarks.materials [--sites 100] [--racks FOLDER]

Each barrel is one of the bill's two or three materials of its radius, the others drawn at random out of all. Wrong is
what is told wrongly where `cannot tell` is allowed, as in a survey; right is how often the likeliest of the bill's
materials is the true one. FOLDER holds racks as NAME.json (width, height, f, pipes with start, end, radius, material,
circles of the board, poses map_from_camera) and their images NAME_0.jpg, NAME_1.jpg, ... Writes results/materials.json.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from benchmarks.survey import RESULTS, commit
from benchmarks.train_materials import generated, looks_of_pipes
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_detect.look.colour_view import NO_CIRCLES, BoardCircles, ColourImage
from pipeprog_detect.look.look_features import NAMES
from pipeprog_detect.look.material_model import material_probabilities
from pipeprog_detect.plan.materials import MATERIALS
from pipeprog_detect.product.boq import BillLine, BillOfQuantities, PipeClass
from pipeprog_detect.product.classification import classified_by_look
from pipeprog_detect.types import Cylinder, Pipe, View

FIRST_SEED = 100_000  # none of these is among those that the model was trained on
BILLS = 10  # drawn for each barrel
RADIUS = 0.05  # m, of all classes of the bills
_BY_BOARD = NAMES.index("by board")
Look = tuple[str, FloatArray]  # the true material and the features


def main(
    sites: Annotated[int, typer.Option(help="generated racks")] = 100,
    racks: Annotated[Path | None, typer.Option(help="racks of another renderer")] = None,
) -> None:
    """Print the rows and write results/materials.json."""
    seeds = range(FIRST_SEED, FIRST_SEED + sites)
    looks = {"generated": [(MATERIALS[kind], features) for seed in seeds for kind, features in generated(seed)]}
    if racks is not None:
        looks["path-traced"] = [look for path in sorted(racks.glob("*.json")) for look in looks_of_rack(path)]
    rows = []
    for renderer, found in looks.items():
        for board in (True, False):
            own = [look for look in found if bool(look[1][_BY_BOARD]) == board]
            for count in (2, 3):
                rows.append({"renderer": renderer, "board": "yes" if board else "no", **measured(own, count)})
                print(rows[-1])
    result = {
        "title": "Materials of pipes of one radius, told by their look",
        "command": ".venv/bin/python -m benchmarks.materials --racks FOLDER",
        "findings": {
            "right, at least [%]": min(row["right [%]"] for row in rows),
            "wrong where `cannot tell` is allowed, at most [%]": max(row["told wrongly [%]"] for row in rows),
        },
        "rows": rows,
        "commits": [commit()],
    }
    (RESULTS / "materials.json").write_text(json.dumps(result, indent=1) + "\n")


def measured(looks: Sequence[Look], count: int) -> dict[str, Any]:
    """Counts over bills with this number of materials a radius, the true one among them."""
    rng = np.random.default_rng(count)
    tally: Counter[str] = Counter()
    for material, features in looks:
        shares = material_probabilities(features)
        for _ in range(BILLS):
            others = [str(one) for one in rng.choice([m for m in MATERIALS if m != material], count - 1, replace=False)]
            best = max((material, *others), key=lambda one: shares[one])
            told = classified_by_look(_pipe(), _bill((material, *others)), shares).material
            tally["right"] += best == material
            tally["wrong"] += told not in ("", material)
            tally["open"] += told == ""
    total = BILLS * len(looks)
    return {
        "materials a radius": count,
        "barrels": len(looks),
        "bills": total,
        "right [%]": round(100 * tally["right"] / total, 1),
        "told wrongly [%]": round(100 * tally["wrong"] / total, 2),
        "cannot tell [%]": round(100 * tally["open"] / total, 1),
    }


def looks_of_rack(path: Path) -> list[Look]:
    """Looks of a rack of another renderer, by the board and without it."""
    rack = json.loads(path.read_text())
    width, height, focal = rack["width"], rack["height"], rack["f"]
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    blank = np.zeros((height, width), np.uint8)
    views = [
        View(number, blank, camera, np.linalg.inv(np.array(pose, float))) for number, pose in enumerate(rack["poses"])
    ]
    images = [cv2.imread(str(path.with_name(f"{path.stem}_{view.stamp}.jpg"))) for view in views]
    pictures = [ColourImage(np.asarray(image, np.uint8)) for image in images]
    pipes = [Cylinder(np.array(row["start"]), np.array(row["end"]), row["radius"]) for row in rack["pipes"]]
    circles = BoardCircles(np.array(rack["circles"], float), np.full(len(rack["circles"]), rack["circle_radius"]))
    return [
        (str(rack["pipes"][number]["material"]), features)
        for told in (circles, NO_CIRCLES)
        for number, features in looks_of_pipes(pipes, views, pictures, told)
    ]


def _pipe() -> Pipe:
    return Pipe("", Cylinder(np.zeros(3), np.array([0.0, 0.0, 1.0]), RADIUS), 1e-4, None, 0.5, 2.0, 1e-3, 100)


def _bill(materials: Sequence[str]) -> BillOfQuantities:
    return BillOfQuantities(
        tuple(
            PipeClass(one, RADIUS, 1.0, (1.0, 0.0, 0.0), 5e-4, None, (BillLine(one, 1.0, material=one),))
            for one in materials
        )
    )


if __name__ == "__main__":
    typer.run(main)
