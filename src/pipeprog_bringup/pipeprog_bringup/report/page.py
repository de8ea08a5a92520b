"""`pipeprog report`: one HTML page, with everything in it, about one survey or several."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeprog_bringup.report import plots, render
from pipeprog_bringup.report.survey_reader import Survey, read_survey
from pipeprog_bringup.results.atomic_output import output_file
from pipeprog_bringup.results.cloud_io import read_cloud
from pipeprog_bringup.results.results_reader import UNPLANNED
from pipeprog_camera.errors import InputError

PICTURE_WIDTH = 1000
_STYLE = """
body{margin:0;background:#eef0f3;color:#1c2129;font:15px/1.5 system-ui,-apple-system,"Segoe UI",sans-serif}
main{max-width:1080px;margin:0 auto;padding:24px}
h1{font-size:26px;margin:8px 0 16px}h2{font-size:18px;margin:0 0 12px}
section{background:#fff;border-radius:10px;padding:18px 22px;margin:0 0 18px;box-shadow:0 1px 3px #0002;overflow-x:auto}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th{font-weight:600;text-align:right;color:#5a6473;border-bottom:1px solid #d9dde3;padding:5px 10px;white-space:nowrap}
td{text-align:right;padding:5px 10px;border-bottom:1px solid #eef0f3;white-space:nowrap}
th:first-child,td:first-child{text-align:left}
.bar{display:inline-block;width:160px;height:10px;background:#e4e7ec;border-radius:5px;overflow:hidden;vertical-align:middle}
.bar i{display:block;height:100%}.dot{display:inline-block;width:11px;height:11px;border-radius:50%;margin-right:8px;
border:1px solid #0003}.facts{display:flex;flex-wrap:wrap;gap:10px 34px;margin:0}.facts dt{color:#5a6473;font-size:13px}
.facts dd{margin:0;font-weight:600}.pair{display:flex;gap:14px;flex-wrap:wrap;align-items:flex-start}
.pair img{flex:1 1 420px;width:48%;min-width:0}
img,svg{max-width:100%;height:auto}.warn{color:#9a3b00;margin:12px 0 0}
@media print{body{background:#fff}section{box-shadow:none;break-inside:avoid}}
"""


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
        temporary.write_text(page(surveys, show), encoding="utf-8")
    return target


def page(surveys: Sequence[Survey], show: Callable[[float, str], None]) -> str:
    """The page as text, without any reference to a file or a host."""
    newest = surveys[-1]
    sections = [_summary(newest)]
    if len(surveys) > 1:
        show(0.1, "progress over time")
        sections.append(_section("Progress over time", plots.svg(plots.series(surveys)) + _series_table(surveys)))
    sections.append(_section("Planned and installed", _class_table(newest)))
    show(0.2, "pictures of the cloud")
    sections.append(_section("The cloud with its pipes, from two sides", _pictures(newest)))
    show(0.8, "plots")
    sections.append(_section("Seen from above: pipes and the camera's way", plots.svg(plots.plan(newest))))
    if newest.pipes:
        sections.append(_section("Radii and classes", plots.svg(plots.radii_and_classes(newest))))
    sections.append(_section("Pipes", _pipe_table(newest)))
    show(1.0, "done")
    title = f"Pipe progress: {newest.name}"
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{_STYLE}</style></head>\n'
        f"<body><main><h1>{html.escape(title)}</h1>\n" + "\n".join(sections) + "\n</main></body></html>\n"
    )


def _summary(survey: Survey) -> str:
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
    cells = "".join(f"<div><dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd></div>" for k, v in items)
    losses = "".join(f'<p class="warn">{html.escape(str(loss))}</p>' for loss in facts.get("losses", []))
    return f'<section><dl class="facts">{cells}</dl>{losses}</section>'


def _scale_text(scale: dict[str, Any]) -> str:
    source, sigma = scale.get("source"), scale.get("sigma")
    if source == "cloud":
        return "as the cloud has it"
    return f"{source} ± {100 * float(sigma):.3f} %" if sigma is not None else str(source)


def _section(title: str, body: str) -> str:
    return f"<section><h2>{html.escape(title)}</h2>{body}</section>"


def _class_table(survey: Survey) -> str:
    rows = []
    for entry in survey.classes:
        own = [pipe for pipe in survey.pipes if pipe["class"] == entry["class"]]
        planned, installed = float(entry["planned_m"]), float(entry["installed_m"])
        percent = 100 * installed / planned if planned > 0 else 0.0
        color = _css(survey.color(entry["class"]))
        bar = f'<span class="bar"><i style="width:{min(percent, 100):.1f}%;background:{color}"></i></span>'
        rows.append(
            [
                f"{_dot(color)}{html.escape(str(entry['class']))}",
                f"{1e3 * float(entry['outer_radius']):.1f}",
                str(len(own)),
                f"{planned:.2f}",
                f"{installed:.2f}",
                f"{percent:.1f}",
                bar,
            ]
        )
    others = [pipe for pipe in survey.pipes if pipe["class"] is None]
    if others:
        metres = sum(float(pipe["length"]) for pipe in others)
        rows.append([f"{_dot(_css(UNPLANNED))}no planned class", "", str(len(others)), "", f"{metres:.2f}", "", ""])
    return _table(["class", "outer radius [mm]", "pipes", "planned [m]", "installed [m]", "%", ""], rows)


def _pipe_table(survey: Survey) -> str:
    rows = [
        [
            f"{_dot(_css(survey.color(pipe['class'])))}{html.escape(str(pipe['id']))}",
            html.escape(str(pipe["class"] or "none")),
            f"{float(pipe.get('class_probability') or 0):.3f}",
            f"{1e3 * float(pipe['radius']):.2f}",
            _millimetres(pipe["radius_sigma"], 3),
            f"{float(pipe['length']):.3f}",
            f"{float(pipe.get('visible_arc_deg') or 0):.0f}",
            _millimetres(pipe["rmse"], 2),
            str(pipe.get("points", "")),
        ]
        for pipe in survey.pipes
    ]
    head = [
        "pipe",
        "class",
        "probability",
        "radius [mm]",
        "± sigma [mm]",
        "length [m]",
        "arc seen [°]",
        "rmse [mm]",
        "points",
    ]
    return _table(head, rows)


def _series_table(surveys: Sequence[Survey]) -> str:
    names = list(dict.fromkeys(str(entry["class"]) for survey in surveys for entry in survey.classes))
    rows = []
    for survey in surveys:
        installed = {str(entry["class"]): float(entry["installed_m"]) for entry in survey.classes}
        cells = [f"{installed[name]:.2f}" if name in installed else "" for name in names]
        rows.append([f"{html.escape(survey.name)} ({survey.time:%Y-%m-%d %H:%M})", *cells])
    return _table(["installed [m]", *names], rows)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of cells that are HTML already, under headings that are plain text."""
    cells = "".join(f"<th>{html.escape(text)}</th>" for text in head)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table>"


def _pictures(survey: Survey) -> str:
    pipes = [render.ColoredPipe(survey.cylinder(p), survey.color(p["class"]), str(p["id"])) for p in survey.pipes]
    file = read_cloud(survey.cloud) if survey.cloud is not None else None
    points, colors = (np.empty((0, 3)), None) if file is None else (file.cloud.points, file.colors)
    if not len(points) and not pipes:
        return "<p>There is no cloud in this run and no pipe.</p>"
    images = []
    for direction in render.two_sides(points, pipes):
        image = render.draw(points, colors, pipes, direction, PICTURE_WIDTH)
        encoded = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 6])[1]
        source = base64.b64encode(encoded.tobytes()).decode()
        images.append(f'<img alt="cloud and pipes" src="data:image/png;base64,{source}">')
    return f'<div class="pair">{"".join(images)}</div>'


def _dot(color: str) -> str:
    return f'<span class="dot" style="background:{color}"></span>'


def _css(color: render.Color) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in color)


def _millimetres(value: float | None, digits: int) -> str:
    return "" if value is None else f"{1e3 * float(value):.{digits}f}"
