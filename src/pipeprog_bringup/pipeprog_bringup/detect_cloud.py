# SPDX-License-Identifier: Apache-2.0
"""`pipeprog detect`: the detector's core on a cloud from a file."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from pipeprog_bringup.results import result_files
from pipeprog_bringup.results.atomic_output import OutputFolder
from pipeprog_bringup.results.cloud_io import read_cloud
from pipeprog_bringup.results.nothing_found import why_nothing_was_found
from pipeprog_bringup.results.plan_file import write_plan
from pipeprog_bringup.results.plan_place import why_no_place_is_planned
from pipeprog_bringup.results.setting_overrides import effective
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.product.boq import BillOfQuantities, load_boq
from pipeprog_detect.product.product import Product, product_of

# The file's own metres are the scale: none was measured, so nothing is added to the pipes' sigmas.
SCALE = result_files.Scale("cloud", 0.0)
_ONE_SYSTEM = "export cloud and plan in the same coordinates"


@dataclasses.dataclass(frozen=True)
class Detection:
    """What was found in a cloud."""

    product: Product
    points: int
    dropped: int
    notes: list[str]  # sentences for the user


def detect_file(
    cloud_path: Path,
    boq_path: Path,
    out: Path,
    overrides: Sequence[str],
    force: bool,
    report: Callable[[float, str], None],
) -> Detection:
    """Detect the pipes of a cloud and write pipes.json, progress.csv, config.yaml and run.json into `out`."""
    boq = load_boq(boq_path)
    config: DetectConfig = effective(overrides, ("detect",))["detect"]
    started = time.time()
    with OutputFolder(out, force) as folder:
        report(0.0, "reading the cloud")
        file = read_cloud(cloud_path)
        read = time.time()
        pipes = detect(file.cloud, boq, config, (), report)
        timings = {"read": read - started, "detect": time.time() - read}
        product = product_of(pipes, boq, 0.0)
        notes = [*boq.notes, *why_nothing_was_found(product, file.cloud.points, boq)]
        notes += why_no_place_is_planned(boq.pipes, file.cloud.points, _ONE_SYSTEM)
        if file.dropped:
            notes.append(f"{file.dropped} points of {cloud_path} are not finite or beyond 1e8 m and were left out")
        detection = Detection(product, len(file.cloud.points), file.dropped, notes)
        _write(folder, detection, cloud_path, boq, config, timings)
    return detection


def _write(
    folder: OutputFolder,
    detection: Detection,
    cloud_path: Path,
    boq: BillOfQuantities,
    config: DetectConfig,
    timings: dict[str, float],
) -> None:
    result_files.write_pipes(folder.file("pipes.json"), detection.product, SCALE)
    if boq.pipes:
        write_plan(folder.file("plan.json"), boq.pipes)
    result_files.write_progress(folder.file("progress.csv"), detection.product)
    result_files.write_config(
        folder.file("config.yaml"), {"detect": dataclasses.asdict(config), "boq": result_files.boq_entries(boq)}
    )
    facts = {
        "command": "detect",
        "cloud": str(cloud_path.resolve()),
        "points": detection.points,
        "points_dropped": detection.dropped,
        "notes": detection.notes,
        "seeds": {"detect": config.seed},
        "timings_s": timings,
    }
    result_files.write_run(folder, facts)
