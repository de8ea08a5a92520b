# SPDX-License-Identifier: Apache-2.0
"""Real clouds from inside sewer pipes: the nominal size that the detector tells, cloud by cloud.

    .venv/bin/python -m benchmarks.sewer FOLDER

FOLDER holds one folder a nominal diameter, named after it (`400mm_PVC_pipe/01.ply`). The planned sizes are 180, 195,
200, 340 and 400 mm. The arc counts the sectors of 5 deg in which the found pipe shows points. Scans in which none is
found show at most 165 deg of one, as a search for a cylinder of the known size tells. Prints the table and writes
results/sewer.json beside this file.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.results.cloud_io import read_cloud
from pipeprog_detect.cloud.cylinder_fit import basis
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.types import Cylinder

SIZES_MM = (180, 195, 200, 340, 400)
RESULTS = Path(__file__).parent / "results" / "sewer.json"
SURFACE = 0.01  # m from the cylinder: what the roughest of these clouds scatter
SECTORS, LEAST_POINTS = 72, 5


def main(folder: Path) -> None:
    """Detect in every cloud below `folder`."""
    boq = BillOfQuantities(
        tuple(PipeClass(f"{size}", 5e-4 * size, 10.0, (1.0, 0.0, 0.0), 5e-6 * size) for size in SIZES_MM)
    )
    rows: list[dict[str, Any]] = []
    print("cloud                                    points  told  radius mm  length m  arc deg")
    for path in sorted(folder.glob("*/*.ply")):
        nominal = int(re.findall(r"\d+", path.parent.name)[0])
        cloud = read_cloud(path).cloud
        pipes = detect(cloud, boq, DetectConfig(concave=True))
        best = max(pipes, key=lambda pipe: pipe.points, default=None)
        row: dict[str, Any] = {
            "cloud": f"{path.parent.name}/{path.stem}",
            "nominal_mm": nominal,
            "points": len(cloud.points),
            "pipes": len(pipes),
            "told": sorted({pipe.class_name for pipe in pipes if pipe.class_name is not None}),
        }
        if best is not None:
            row["radius_mm"] = round(1e3 * best.cylinder.radius, 2)
            row["sigma_mm"] = round(1e3 * best.radius_sigma, 2)
            row["length_m"] = round(best.cylinder.length, 3)
            row["arc_deg"] = round(_sectors_seen(cloud.points, best.cylinder))
        rows.append(row)
        figures = [f"{row.get(key, float('nan')):9.2f}" for key in ("radius_mm", "length_m", "arc_deg")]
        print(f"{row['cloud'][-38:]:38} {row['points']:8d} {'/'.join(row['told']) or '-':>5}", *figures, flush=True)
    right = [row for row in rows if row["told"] == [str(row["nominal_mm"])]]
    wrong = [row for row in rows if row["told"] and row not in right]
    half = [row for row in rows if row.get("arc_deg", 0) >= 180]
    summary = {
        "clouds": len(rows),
        "right": len(right),
        "wrong": len(wrong),
        "with_half_the_circumference": len(half),
        "of_these_right": len([row for row in half if row in right]),
    }
    print(summary)
    RESULTS.write_text(json.dumps({"must": 0.8, "aim": 0.95, "summary": summary, "rows": rows}, indent=1) + "\n")


def _sectors_seen(points: NDArray[np.float64], cylinder: Cylinder) -> float:
    """Part of the circumference [deg] that shows points within the barrel's length, in stretches of 5 deg."""
    offset = points - cylinder.start
    along = offset @ cylinder.axis
    u, v = basis(cylinder.axis)
    x, y = offset @ u, offset @ v
    near = (np.abs(np.hypot(x, y) - cylinder.radius) < SURFACE) & (along > 0) & (along < cylinder.length)
    sector = ((np.arctan2(y, x)[near] + np.pi) * (SECTORS / (2 * np.pi))).astype(int) % SECTORS
    return float((np.bincount(sector, minlength=SECTORS) >= LEAST_POINTS).sum() * 360.0 / SECTORS)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
