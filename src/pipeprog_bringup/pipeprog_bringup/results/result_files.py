# SPDX-License-Identifier: Apache-2.0
"""The files of a results folder, which docs/files.md describes: their writers, and readers of two of them."""

from __future__ import annotations

import csv
import json
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from decimal import Decimal, InvalidOperation
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from pipeprog_bringup.results import coverage_fields
from pipeprog_bringup.results.atomic_output import OutputFolder
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.text_file import read_text
from pipeprog_camera.limits import MAX_COORDINATE, MAX_TABLE
from pipeprog_camera.outside_text import for_spreadsheet, shown
from pipeprog_detect.coverage.survey import SurveyCoverage
from pipeprog_detect.product.boq import BillLine, BillOfQuantities, PipeClass
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.pipe_runs import PipeRun
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Pipe

FRAME_COLUMNS = (
    *("stamp", "chosen", "reason", "overlap_n", "overlap_predicted", "parallax", "sharpness", "registered"),
    *("cell_overlap", "tie_points"),
)
# What a run's files come from, besides pipeprog itself.
_PACKAGES = (
    *("numpy", "scipy", "scikit-learn", "numba", "opencv-python-headless", "pycolmap"),
    *("mcap", "mcap-ros2-support", "laspy", "ros-rclpy"),
)


@dataclass(frozen=True)
class Scale:
    """Where the metres come from, and their relative standard deviation (None: not known)."""

    source: str
    sigma: float | None


@dataclass(frozen=True)
class FrameRow:
    """One frame that was considered; numbers are None where they are not known."""

    stamp: int
    chosen: bool
    reason: str
    overlap_n: float | None = None
    overlap_predicted: float | None = None
    parallax: float | None = None
    sharpness: float | None = None
    registered: bool | None = None
    cell_overlap: float | None = None
    tie_points: int | None = None


def write_pipes(
    path: Path,
    product: Product,
    scale: Scale,
    coverage: SurveyCoverage | None = None,
    lives: Mapping[str, str] | None = None,
) -> None:
    """pipes.json, one line a pipe; lengths rounded to the micrometre, far below the error of any measurement.

    `lives`: of each pipe by its id, the id for its life; known in the frame of an earlier survey.
    """
    head: dict[str, Any] = {
        "frame_id": "map",
        "scale": {"source": scale.source, "sigma": _significant(scale.sigma)},
    }
    rows = {
        "pipes": [_pipe_entry(pipe, product) for pipe in product.pipes],
        "classes": [_class_entry(entry, product) for entry in product.classes],
        "runs": [_run_entry(run) for run in product.runs],
    }
    if lives is not None:
        for row in rows["pipes"]:
            row["life"] = lives[row["id"]]
    if coverage is not None:
        head["walls_m2"] = round(coverage.walls.area, 1)
        for row, own in zip(rows["pipes"], coverage.pipes, strict=True):
            row |= coverage_fields.of_pipe(own)
        names = [entry.name for entry in product.classes]
        for row, fields in zip(rows["classes"], coverage_fields.of_classes(names, coverage), strict=True):
            row |= fields
        if coverage.planned:
            rows["planned"] = [coverage_fields.of_planned(each) for each in coverage.planned]
    parts = [json.dumps(head, allow_nan=False)[1:-1]]
    for name, entries in rows.items():
        lines = ",\n  ".join(json.dumps(entry, allow_nan=False) for entry in entries)
        parts.append(f'"{name}": [' + (f"\n  {lines}" if lines else "") + "]")
    path.write_text("{" + ",\n ".join(parts) + "}\n")


def write_progress(path: Path, product: Product, coverage: SurveyCoverage | None = None) -> None:
    """progress.csv: one line a class, for programs; spreadsheets of all locales read the classes.csv of the export."""
    names = [entry.name for entry in product.classes]
    seen: list[dict[str, float | None]] = [{} for _ in names]
    if coverage is not None:
        seen = coverage_fields.of_classes(names, coverage)
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        columns = ["class", "outer_radius_mm", "planned_m", "installed_m", "percent", "pipes", "installed_sigma_m"]
        told = coverage_fields.CLASS_FIELDS if coverage is not None else ()
        writer.writerow([*columns, *told])
        for entry, own in zip(product.classes, seen, strict=True):
            count = sum(pipe.class_name == entry.name for pipe in product.pipes)
            lengths = [f"{entry.planned:.3f}", f"{entry.installed:.3f}", f"{entry.percent:.1f}"]
            sigma = product.installed_sigma(entry.name)
            cells = [f"{1e3 * entry.outer_radius:.2f}", *lengths, count, f"{sigma:.4f}" if np.isfinite(sigma) else ""]
            cells += ["" if own[key] is None else f"{own[key]:g}" for key in told]
            writer.writerow([for_spreadsheet(entry.name), *cells])


def write_trajectory(path: Path, stamps: Sequence[int], translations: FloatArray, quaternions: FloatArray) -> None:
    """trajectory.tum: stamps [ns], camera positions (N, 3) [m] and orientations (N, 4) x y z w in `map`."""
    with path.open("w") as stream:
        for stamp, position, quaternion in zip(stamps, translations, quaternions, strict=True):
            numbers = " ".join(f"{value:.9f}" for value in (*position, *quaternion))
            stream.write(f"{stamp // 10**9}.{stamp % 10**9:09d} {numbers}\n")


def write_frames(path: Path, rows: Iterable[FrameRow]) -> None:
    """frames.csv: every frame considered, in the order of the recording; the stamp in ns."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(FRAME_COLUMNS)
        for row in rows:
            numbers = (row.overlap_n, row.overlap_predicted, row.parallax, row.sharpness)
            cells = ["" if value is None or not np.isfinite(value) else f"{value:.4f}" for value in numbers]
            registered = "" if row.registered is None else int(row.registered)
            cell_overlap = "" if row.cell_overlap is None else f"{row.cell_overlap:.4f}"
            tie_points = "" if row.tie_points is None else row.tie_points
            writer.writerow(
                [row.stamp, int(row.chosen), for_spreadsheet(row.reason), *cells, registered, cell_overlap, tie_points]
            )


def write_config(path: Path, config: dict[str, Any]) -> None:
    """config.yaml: the settings in force."""
    path.write_text(yaml.safe_dump(config, sort_keys=False, allow_unicode=True), encoding="utf-8")


def write_run(folder: OutputFolder, facts: dict[str, Any]) -> None:
    """run.json, the last file that is written: command, input, timings, versions, and the list of all files."""
    path = folder.file("run.json")
    versions = {"python": platform.python_version(), "pipeprog": package_version("pipeprog")}
    versions.update({name: package_version(name) for name in _PACKAGES})
    names = sorted({*folder.names(), path.name})
    finished = datetime.now(timezone.utc).isoformat(timespec="seconds")
    content = {**facts, "finished": finished, "versions": versions, "files": names}
    path.write_text(json.dumps(content, indent=1) + "\n")


def boq_entries(boq: BillOfQuantities) -> list[dict[str, Any]]:
    """The bill of quantities as config.yaml holds it."""
    return [
        {
            "name": planned.name,
            "outer_radius_mm": round(1e3 * planned.outer_radius, 6),
            "planned_length_m": planned.planned_length,
            "color": "#" + "".join(f"{round(255 * part):02x}" for part in planned.color),
            **({"lines": [_line_entry(line) for line in planned.lines]} if _has_details(planned) else {}),
        }
        for planned in boq.classes
    ]


def _has_details(planned: PipeClass) -> bool:
    """Whether the lines of a class say more than the class itself."""
    return len(planned.lines) > 1 or any(len(_line_entry(line)) > 2 for line in planned.lines)


def _line_entry(line: BillLine) -> dict[str, Any]:
    """A line of the bill by the keys of BOQ.yaml, without what is not given."""
    details = {key: getattr(line, key) for key in ("material", "system", "zone", "activity", "start", "finish")}
    given = {key: text for key, text in details.items() if text}
    return {"name": line.name, "planned_length_m": line.planned_length, **given}


def package_version(name: str) -> str | None:
    """Version of an installed package, None where it is not installed as one."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def read_trajectory(path: Path) -> tuple[NDArray[np.int64], FloatArray]:
    """Stamps (N,) [ns] and poses map_from_camera (N, 4, 4) of a trajectory.tum; raises InputError where it is none."""
    from scipy.spatial.transform import Rotation

    stamps, rows = [], []
    for number, line in enumerate(read_text(path, MAX_TABLE).splitlines(), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            stamps.append(_nanoseconds(words[0]))
            rows.append([float(word) for word in words[1:]])
        except (ValueError, OverflowError, InvalidOperation):
            rows.append([])
        if len(rows[-1]) != 7 or not (np.abs(rows[-1]) <= MAX_COORDINATE).all() or np.linalg.norm(rows[-1][3:]) < 0.5:
            raise InputError(f"{path}, line {number}: {shown(line.strip())} is not `t tx ty tz qx qy qz qw`")
    values = np.asarray(rows, float).reshape(-1, 7)
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    if len(values):
        poses[:, :3, :3] = Rotation.from_quat(values[:, 3:]).as_matrix()
        poses[:, :3, 3] = values[:, :3]
    return np.asarray(stamps, np.int64), poses


def _nanoseconds(text: str) -> int:
    """Seconds, as text, in nanoseconds; ValueError where these have no 64 bits, before 1e999999 is written out."""
    if not abs(float(text)) < 2**63 / 1e9:
        raise ValueError(text)
    return int(Decimal(text) * 10**9)


def read_frame_stamps(path: Path) -> NDArray[np.int64]:
    """Stamps (N,) [ns] of the frames in a frames.csv; raises InputError where it is none."""
    try:
        return np.array(
            [int(row["stamp"]) for row in csv.DictReader(read_text(path, MAX_TABLE).splitlines())], np.int64
        )
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise InputError(f"{path} is no frames.csv ({error}): run `pipeprog replay` again") from None


def _pipe_entry(pipe: Pipe, product: Product) -> dict[str, Any]:
    return {
        "id": pipe.id,
        "start": [round(float(value), 6) for value in pipe.cylinder.start],
        "end": [round(float(value), 6) for value in pipe.cylinder.end],
        "radius": round(pipe.cylinder.radius, 6),
        "radius_sigma": _significant(pipe.radius_sigma),
        "length": round(pipe.cylinder.length, 6),
        "class": pipe.class_name,
        "class_probability": round(pipe.class_probability, 4),
        "class_kmeans": pipe.class_kmeans,
        "ambiguous": pipe.class_name is None and pipe.class_probability > 0.0,
        "visible_arc_deg": round(float(np.degrees(pipe.visible_arc)), 1),
        "rmse": _significant(pipe.rmse),
        "points": int(pipe.points),
        "length_sigma": _significant(product.length_sigma(pipe)),
        "ends": [{"state": end.state, "sigma": _significant(end.sigma)} for end in pipe.ends],
        **(_material_fields(pipe) if pipe.material_probability > 0.0 else {}),
    }


def _material_fields(pipe: Pipe) -> dict[str, Any]:
    return {"material": pipe.material or None, "material_probability": round(pipe.material_probability, 4)}


def _class_entry(entry: ClassProgress, product: Product) -> dict[str, Any]:
    return {
        "class": entry.name,
        "outer_radius": round(entry.outer_radius, 6),
        "planned_m": round(entry.planned, 6),
        "installed_m": round(entry.installed, 6),
        "percent": round(entry.percent, 2),
        "installed_sigma_m": _significant(product.installed_sigma(entry.name)),
    }


def _run_entry(run: PipeRun) -> dict[str, Any]:
    return {
        "id": run.id,
        "pipes": list(run.pipes),
        "barrel_length": round(run.barrel, 6),
        "centre_line_length": round(run.centre_line, 6),
        "joints": [
            {
                "kind": joint.kind,
                "pipes": list(joint.pipes),
                "angle_deg": round(float(np.degrees(joint.angle)), 1),
                "length": round(joint.length, 6),
                "miss": _significant(joint.miss),
            }
            for joint in run.joints
        ],
    }


def _significant(value: float | None) -> float | None:
    """Four significant digits, None for what is not a number."""
    return None if value is None or not np.isfinite(value) else float(f"{value:.4g}")
