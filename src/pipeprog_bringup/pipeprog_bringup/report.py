"""`pipeprog report`: one HTML page, with everything in it, about one survey or several."""

from __future__ import annotations

import base64
import html
import io
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
import yaml
from numpy.typing import NDArray

from pipeprog_bringup import picture
from pipeprog_bringup.cloud_io import read_cloud
from pipeprog_bringup.output import output_file
from pipeprog_bringup.results import read_trajectory
from pipeprog_bringup.score import read_json
from pipeprog_camera.errors import InputError
from pipeprog_detect.pipe import Cylinder

mpl.use("Agg")
from matplotlib import dates
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]

UNPLANNED: picture.Color = (0.55, 0.55, 0.58)
PICTURE_WIDTH = 1000
# Stamps before this count from some other zero than 1970 (a video, a simulation).
FIRST_CLOCK = 1_000_000_000 * 10**9


@dataclass(frozen=True)
class Survey:
    """A run as its folder holds it."""

    name: str
    time: datetime
    pipes: list[dict[str, Any]]
    classes: list[dict[str, Any]]
    scale: dict[str, Any]
    facts: dict[str, Any]
    colors: dict[str, picture.Color]
    positions: FloatArray | None
    cloud: Path | None = field(default=None)

    def color(self, name: str | None) -> picture.Color:
        """Colour of a class, grey for pipes without one."""
        return self.colors.get(name or "", UNPLANNED)

    def cylinder(self, pipe: dict[str, Any]) -> Cylinder:
        """Geometry of an entry of pipes.json."""
        return Cylinder(np.array(pipe["start"], float), np.array(pipe["end"], float), float(pipe["radius"]))


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


def read_survey(folder: Path) -> Survey:
    """The results of one run; only pipes.json must be there."""
    if not folder.is_dir():
        raise InputError(f"no such folder: {folder}")
    if not (folder / "pipes.json").is_file():
        raise InputError(f"{folder} holds no pipes.json: give the --out of a replay or detect")
    content = read_json(folder / "pipes.json")
    try:
        pipes, classes = list(content["pipes"]), list(content["classes"])
        for pipe in pipes:
            values = (*pipe["start"], *pipe["end"], pipe["radius"], pipe["length"], pipe["radius_sigma"], pipe["rmse"])
            _ = [float(value) for value in values if value is not None], pipe["id"], pipe["class"]
        for entry in classes:
            _ = [float(entry[key]) for key in ("outer_radius", "planned_m", "installed_m")], entry["class"]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{folder / 'pipes.json'} is no pipes.json of pipeprog ({error}): run it again") from None
    facts = _optional_json(folder / "run.json")
    has_trajectory = (folder / "trajectory.tum").is_file()
    stamps, poses = read_trajectory(folder / "trajectory.tum") if has_trajectory else (np.empty(0), np.empty(0))
    cloud = folder / "cloud.ply" if (folder / "cloud.ply").is_file() else Path(str(facts.get("cloud", "")))
    return Survey(
        name=folder.resolve().name,
        time=_time(stamps, facts, folder),
        pipes=pipes,
        classes=classes,
        scale=content.get("scale", {}),
        facts=facts,
        colors=_colors(folder / "config.yaml", classes),
        positions=poses[:, :3, 3] if len(poses) else None,
        cloud=cloud if cloud.is_file() else None,
    )


def page(surveys: Sequence[Survey], show: Callable[[float, str], None]) -> str:
    """The page as text, without any reference to a file or a host."""
    newest = surveys[-1]
    sections = [_summary(newest)]
    if len(surveys) > 1:
        show(0.1, "progress over time")
        sections.append(_section("Progress over time", _svg(_plot_series(surveys)) + _series_table(surveys)))
    sections.append(_section("Planned and installed", _class_table(newest)))
    show(0.2, "pictures of the cloud")
    sections.append(_section("The cloud with its pipes, from two sides", _pictures(newest)))
    show(0.8, "plots")
    sections.append(_section("Seen from above: pipes and the camera's way", _svg(_plot_plan(newest))))
    if newest.pipes:
        sections.append(_section("Radii and classes", _svg(_plot_radii(newest))))
    sections.append(_section("Pipes", _pipe_table(newest)))
    show(1.0, "done")
    title = f"Pipe progress: {newest.name}"
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{_STYLE}</style></head>\n'
        f"<body><main><h1>{html.escape(title)}</h1>\n" + "\n".join(sections) + "\n</main></body></html>\n"
    )


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
    pipes = [picture.ColoredPipe(survey.cylinder(p), survey.color(p["class"]), str(p["id"])) for p in survey.pipes]
    file = read_cloud(survey.cloud) if survey.cloud is not None else None
    points, colors = (np.empty((0, 3)), None) if file is None else (file.cloud.points, file.colors)
    if not len(points) and not pipes:
        return "<p>There is no cloud in this run and no pipe.</p>"
    images = []
    for direction in picture.two_sides(points, pipes):
        image = picture.draw(points, colors, pipes, direction, PICTURE_WIDTH)
        encoded = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 6])[1]
        source = base64.b64encode(encoded.tobytes()).decode()
        images.append(f'<img alt="cloud and pipes" src="data:image/png;base64,{source}">')
    return f'<div class="pair">{"".join(images)}</div>'


def _plot_plan(survey: Survey) -> Figure:
    figure, axes = plt.subplots(figsize=(10, 5.5))
    for pipe in survey.pipes:
        cylinder = survey.cylinder(pipe)
        color = survey.color(pipe["class"])
        x, y = np.array([cylinder.start, cylinder.end])[:, :2].T
        if np.hypot(*np.diff([x, y])) < cylinder.radius:
            axes.add_patch(plt.Circle((x.mean(), y.mean()), cylinder.radius, facecolor=color, edgecolor="#333", lw=0.8))
        else:
            axes.plot(x, y, color="#333", lw=4.6, solid_capstyle="butt")
            axes.plot(x, y, color=color, lw=3.4, solid_capstyle="butt")
        axes.annotate(str(pipe["id"]), (x.mean(), y.mean()), (4, 5), textcoords="offset points", fontsize=8)
    if survey.positions is not None:
        x, y = survey.positions[:, :2].T
        axes.plot(x, y, "-", color="#d9822b", lw=1.2, marker="o", ms=3, label="camera")
        axes.plot(x[0], y[0], ">", color="#d9822b", ms=9, label="start")
        axes.legend(frameon=False, fontsize=9)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x [m]", ylabel="y [m]")
    return _finished(figure)


def _plot_radii(survey: Survey) -> Figure:
    """Metres by measured radius over the classes' bands, and each pipe's distance from its nominal radius."""
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(10, 6), height_ratios=(3, 2))
    radii = np.array([1e3 * float(pipe["radius"]) for pipe in survey.pipes])
    lengths = np.array([float(pipe["length"]) for pipe in survey.pipes])
    nominal = {str(entry["class"]): 1e3 * float(entry["outer_radius"]) for entry in survey.classes}
    highest = 1.15 * max(radii.max(), *nominal.values()) if nominal else 1.15 * radii.max()
    bins = np.arange(0, highest + 2, 2.0)
    for name, radius in nominal.items():
        # 1 % of the diameter is what manufacture may deviate (EN 10255); a millimetre is the least that shows.
        band = max(0.02 * radius, 1.0)
        top.axvspan(radius - band, radius + band, color=survey.color(name), alpha=0.22, lw=0)
        top.annotate(
            name,
            (radius, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=8,
        )
    groups = [*nominal, None]
    own = [np.array([pipe["class"] == name for pipe in survey.pipes], bool) for name in groups]
    top.hist(
        [radii[mask] for mask in own],
        bins,
        weights=[lengths[mask] for mask in own],
        stacked=True,
        color=[survey.color(name) for name in groups],
        edgecolor="#333",
        linewidth=0.5,
    )
    top.set(xlabel="measured outer radius [mm]", ylabel="length [m]", xlim=(0, highest))
    for number, pipe in enumerate(survey.pipes):
        if pipe["class"] not in nominal:
            continue
        sigma = 3e3 * float(pipe["radius_sigma"] or 0)
        bottom.errorbar(number, radii[number] - nominal[pipe["class"]], sigma, color="#333", capsize=3, lw=1, zorder=1)
        bottom.scatter(
            number,
            radii[number] - nominal[pipe["class"]],
            40,
            color=[survey.color(pipe["class"])],
            edgecolor="#333",
            lw=0.6,
            zorder=2,
        )
    bottom.axhline(0, color="#888", lw=0.8)
    bottom.set_xticks(
        range(len(survey.pipes)),
        [str(pipe["id"]) for pipe in survey.pipes],
        fontsize=8,
        rotation=90 if len(survey.pipes) > 20 else 0,
    )
    bottom.set(ylabel="radius - nominal [mm]\n(bars: 3 sigma)", xlim=(-0.7, len(survey.pipes) - 0.3))
    return _finished(figure)


def _plot_series(surveys: Sequence[Survey]) -> Figure:
    figure, axes = plt.subplots(figsize=(10, 4.2))
    times = [survey.time for survey in surveys]
    names = dict.fromkeys(str(entry["class"]) for survey in surveys for entry in survey.classes)
    for name in names:
        own = [next((c for c in survey.classes if str(c["class"]) == name), None) for survey in surveys]
        installed = [np.nan if entry is None else float(entry["installed_m"]) for entry in own]
        last = next(entry for entry in reversed(own) if entry is not None)
        color = surveys[-1].color(name)
        axes.plot(times, installed, "-o", color=color, lw=2, ms=6, mec="#333", mew=0.6, label=name)
        axes.axhline(float(last["planned_m"]), color=color, lw=1, ls=":")
    axes.set(ylabel="installed [m] (dotted: planned)")
    axes.set_ylim(bottom=0)
    axes.xaxis.set_major_formatter(dates.ConciseDateFormatter(axes.xaxis.get_major_locator()))
    axes.legend(frameon=False, fontsize=9, ncols=3)
    return _finished(figure)


def _finished(figure: Figure) -> Figure:
    for axes in figure.axes:
        axes.grid(True, color="#e4e7ec", lw=0.7)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return figure


def _svg(figure: Figure) -> str:
    stream = io.StringIO()
    # A fixed salt and no date: the same results give the same page.
    with mpl.rc_context({"svg.hashsalt": "pipeprog"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    plt.close(figure)
    text = stream.getvalue()
    # Within HTML an SVG needs neither name spaces nor a description of itself.
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    return re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)


def _dot(color: str) -> str:
    return f'<span class="dot" style="background:{color}"></span>'


def _css(color: picture.Color) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in color)


def _millimetres(value: float | None, digits: int) -> str:
    return "" if value is None else f"{1e3 * float(value):.{digits}f}"


def _time(stamps: NDArray, facts: dict[str, Any], folder: Path) -> datetime:
    """When the survey was taken; for recordings without a clock, when it was worked out."""
    if len(stamps) and stamps[0] > FIRST_CLOCK:
        return datetime.fromtimestamp(stamps[0] * 1e-9, timezone.utc)
    try:
        return datetime.fromisoformat(str(facts["finished"])).astimezone(timezone.utc)
    except (KeyError, ValueError):
        return datetime.fromtimestamp((folder / "pipes.json").stat().st_mtime, timezone.utc)


def _colors(config: Path, classes: Sequence[dict[str, Any]]) -> dict[str, picture.Color]:
    """Colour of each class as config.yaml has it; without that, colours that can be told apart."""
    palette = plt.get_cmap("tab10").colors
    colors = {str(entry["class"]): tuple(palette[i % 10]) for i, entry in enumerate(classes)}
    try:
        for entry in yaml.safe_load(config.read_text())["boq"]:
            text = str(entry["color"]).lstrip("#")
            colors[str(entry["name"])] = tuple(int(text[i : i + 2], 16) / 255 for i in (0, 2, 4))
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError):
        pass
    return colors


def _optional_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
