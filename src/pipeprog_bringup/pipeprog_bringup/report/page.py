# SPDX-License-Identifier: Apache-2.0
"""`pipeprog report`: one HTML page, with everything in it, about one survey or several."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, StrictUndefined, Template
from sklearn.metrics import confusion_matrix

from pipeprog_bringup.report import plots, render
from pipeprog_bringup.report.survey_reader import Survey, read_survey
from pipeprog_bringup.results.atomic_output import output_file
from pipeprog_bringup.results.cloud_io import read_cloud
from pipeprog_bringup.results.results_reader import UNPLANNED
from pipeprog_camera.errors import InputError

PICTURE_WIDTH = 1000  # pixels: the width of the page, so that two beside each other stay sharp when enlarged


def report(folders: Sequence[Path], out: Path, force: bool, show: Callable[[float, str], None]) -> Path:
    """Write the page about the runs in `folders`, the newest in full; returns its file.

    `out` is an .html file, or a folder that gets a report.html. Raises InputError where a folder holds no results.
    """
    target = out / "report.html" if out.is_dir() or not out.suffix else out
    if target.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"--out {out}: the report is a page, name it .html")
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise InputError("a folder is given twice: give each survey once")
    surveys = sorted((read_survey(folder) for folder in folders), key=lambda survey: (survey.time, survey.name))
    with output_file(target, force) as temporary:
        # Halves of surrogate pairs, which JSON can hold, are no text in UTF-8.
        temporary.write_text(page(surveys, show), encoding="utf-8", errors="replace")
    return target


def page(surveys: Sequence[Survey], show: Callable[[float, str], None]) -> str:
    """The page as text, without any reference to a file or a host; page.html is its template."""
    newest = surveys[-1]
    series = None
    if len(surveys) > 1:
        show(0.1, "progress over time")
        series = _series(surveys)
    show(0.2, "pictures of the cloud")
    pictures = _pictures(newest)
    show(0.8, "plots")
    text = _template().render(
        title=f"Pipe progress: {newest.name}",
        facts=_facts(newest),
        losses=[str(loss) for loss in newest.facts.get("losses", [])],
        series=series,
        classes=[_class_row(newest, entry) for entry in newest.classes],
        unplanned=_unplanned_row(newest),
        pictures=pictures,
        plan=plots.svg(plots.plan(newest)),
        radii=plots.svg(plots.radii_and_classes(newest)) if newest.pipes else None,
        kmeans=_kmeans_matrix(newest),
        pipes=[{"points": "", **pipe, "color": _css(newest.color(pipe["class"]))} for pipe in newest.pipes],
    )
    show(1.0, "done")
    return text


def _template() -> Template:
    """page.html beside this module; what is put into it is escaped, and a name that is missing is an error."""
    source = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, keep_trailing_newline=True)
    return environment.from_string(source)


def _facts(survey: Survey) -> list[tuple[str, str]]:
    """Terms and values of the summary."""
    facts = survey.facts
    total = sum(float(pipe["length"]) for pipe in survey.pipes if pipe["class"])
    items = [
        ("Survey", f"{survey.time:%Y-%m-%d %H:%M} UTC"),
        ("Pipes", f"{len(survey.pipes)}, {sum(pipe['class'] is None for pipe in survey.pipes)} of no planned class"),
        ("Installed", f"{total:.2f} m of {sum(float(c['planned_m']) for c in survey.classes):.2f} m planned"),
        ("Scale", _scale_text(survey.scale)),
    ]
    if "frames_considered" in facts:
        items.append(("Frames", f"{facts['frames_considered']} considered, {facts.get('keyframes', '?')} keyframes"))
        items.append(("Registered", f"{facts.get('registered', '?')} keyframes"))
    elif "points" in facts:
        items.append(("Cloud", f"{facts['points']} points"))
    return items


def _scale_text(scale: dict[str, Any]) -> str:
    source, sigma = scale.get("source"), scale.get("sigma")
    if source == "cloud":
        return "as the cloud has it"
    return f"{source} ± {100 * float(sigma):.3f} %" if sigma is not None else str(source)


def _series(surveys: Sequence[Survey]) -> dict[str, Any]:
    """Plot and table of the metres installed at each survey; None in a row where the bill had no such class yet."""
    names = list(dict.fromkeys(str(entry["class"]) for survey in surveys for entry in survey.classes))
    rows = []
    for survey in surveys:
        installed = {str(entry["class"]): float(entry["installed_m"]) for entry in survey.classes}
        rows.append((survey, [installed.get(name) for name in names]))
    return {"plot": plots.svg(plots.series(surveys)), "names": names, "rows": rows}


def _class_row(survey: Survey, entry: dict[str, Any]) -> dict[str, Any]:
    planned, installed = float(entry["planned_m"]), float(entry["installed_m"])
    return {
        "name": entry["class"],
        "color": _css(survey.color(entry["class"])),
        "radius": float(entry["outer_radius"]),
        "pipes": sum(pipe["class"] == entry["class"] for pipe in survey.pipes),
        "planned": planned,
        "installed": installed,
        "percent": 100 * installed / planned if planned > 0 else 0.0,
    }


def _unplanned_row(survey: Survey) -> dict[str, Any]:
    lengths = [float(pipe["length"]) for pipe in survey.pipes if pipe["class"] is None]
    return {"color": _css(UNPLANNED), "pipes": len(lengths), "installed": sum(lengths)}


def _kmeans_matrix(survey: Survey) -> dict[str, Any] | None:
    """Pipes of each class by the posterior (rows) and by k-means (columns); None for results without k-means."""
    names = [str(entry["class"]) for entry in survey.classes]
    pipes = [pipe for pipe in survey.pipes if pipe.get("class_kmeans") in names]
    if not pipes:
        return None
    none = len(names)
    posterior = [none if pipe["class"] is None else names.index(pipe["class"]) for pipe in pipes]
    kmeans = [names.index(pipe["class_kmeans"]) for pipe in pipes]
    matrix = confusion_matrix(posterior, kmeans, labels=range(none + 1))[:, :none].tolist()
    rows = [*zip(names, matrix[:none], strict=True), ("no planned class", matrix[none])]
    return {"columns": names, "rows": rows}


def _pictures(survey: Survey) -> list[str]:
    """PNG pictures of the cloud with its pipes as base64; none where there is neither."""
    pipes = [render.ColoredPipe(survey.cylinder(p), survey.color(p["class"]), str(p["id"])) for p in survey.pipes]
    file = read_cloud(survey.cloud) if survey.cloud is not None else None
    points, colors = (np.empty((0, 3)), None) if file is None else (file.cloud.points, file.colors)
    if not len(points) and not pipes:
        return []
    pictures = []
    for direction in render.two_sides(points, pipes):
        image = render.draw(points, colors, pipes, direction, PICTURE_WIDTH)
        encoded = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 6])[1]
        pictures.append(base64.b64encode(encoded.tobytes()).decode())
    return pictures


def _css(color: render.Color) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in color)
