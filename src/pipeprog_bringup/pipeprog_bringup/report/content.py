# SPDX-License-Identifier: Apache-2.0
"""What a report shows, gathered once: the page and the PDF have the same tables and pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from sklearn.metrics import confusion_matrix

from pipeprog_bringup.comparison.comparison import LifeChange, OtherSiteError, Step, compare
from pipeprog_bringup.report import drawings, plots, render, viewer_data
from pipeprog_bringup.report.photographs import Photograph, photographs
from pipeprog_bringup.report.summary import Summary, summary
from pipeprog_bringup.report.survey_reader import Survey
from pipeprog_bringup.results.results_reader import Color
from pipeprog_camera.errors import InputError
from pipeprog_detect.coverage.changes import Change

STILL_WIDTH = 1000  # px: the width of the page
STILL_QUALITY = 85  # of the JPEG
AROUND_PIPES = 1.0  # m of the cloud shown around the pipes
END_WORDS = {"fitting": "at a fitting", "wall": "at a wall", "out_of_view": "out of view"}  # of `state`
NO_CLASS = "-"  # in the place of a letter
HIDING_POINTS = 100_000  # of the cloud, to find what hides a pipe: one for each 25 mm of 60 m2 of wall


@dataclass(frozen=True)
class PipeRow:
    """A pipe as the report lists it: its row of pipes.json, letter and colour of its class, run, ends, photographs.

    `change`: what became of it since the survey before, empty where nothing is to be told.
    """

    row: dict[str, Any]
    letter: str
    color: Color
    run: str
    fittings: list[str]
    ends: str
    change: str
    photographs: list[Photograph]


@dataclass(frozen=True)
class Content:
    """Everything that is shown.

    Attributes:
        surveys: all, in the order of their dates; the last is shown in full.
        summary: the answer and the table of classes.
        changes: what became of each pipe since the survey before, but for those that were kept; empty for one survey.
        facts: terms and values on how the survey went.
        pipes: all pipes.
        no_photographs: why there are none, empty where there are.
        left_out: what is not counted, and why, one sentence each.
        stills: JPEG pictures of the cloud with its pipes.
        cloud: the cloud of the 3-D view.
    """

    surveys: Sequence[Survey]
    summary: Summary
    changes: list[LifeChange]
    facts: list[tuple[str, str]]
    pipes: list[PipeRow]
    no_photographs: str
    left_out: list[str]
    stills: list[bytes]
    cloud: viewer_data.Thinned

    @property
    def newest(self) -> Survey:
        """The survey that is shown in full."""
        return self.surveys[-1]

    @property
    def letters(self) -> list[str]:
        """The letter of each pipe's class."""
        return [pipe.letter for pipe in self.pipes]

    def drawings(self) -> list[tuple[str, Figure]]:
        """Names and figures of plan and elevations; none without pipes."""
        if not self.pipes:
            return []
        newest = self.newest
        return [(each.name, drawings.drawing(newest, each, self.letters)) for each in drawings.directions(newest)]

    def radii(self) -> Figure | None:
        """Measured radii and classes; None without pipes."""
        return plots.radii_and_classes(self.newest) if self.pipes else None

    def progress(self) -> Figure | None:
        """Metres over time; None for a single survey."""
        return plots.series(self.surveys) if len(self.surveys) > 1 else None


def gather(surveys: Sequence[Survey], show: Callable[[float, str], None]) -> Content:
    """What to show about these surveys, which are in the order of their dates."""
    newest = surveys[-1]
    step, not_compared = _last_step(surveys)
    show(0.05, "cloud")
    cloud = viewer_data.thinned(newest, AROUND_PIPES)
    show(0.25, "photographs")
    colors = [newest.color(pipe["class"]) for pipe in newest.pipes]
    sparse = cloud.points[:: max(1, len(cloud.points) // HIDING_POINTS)]
    proofs, no_photographs = photographs(newest.results, sparse, colors)
    show(0.6, "pictures of the cloud")
    answer = summary(surveys, step, not_compared)
    changes = {} if step is None else {name: each for each in step.pipes for name in each.change.after}
    letters = {row.name: row.letter for row in answer.rows}
    runs, fittings = _runs(newest)
    return Content(
        surveys=surveys,
        summary=answer,
        changes=[] if step is None else [each for each in step.pipes if each.change.state != "kept"],
        facts=_facts(newest),
        pipes=[
            PipeRow(
                pipe,
                letters.get(pipe["class"], NO_CLASS),
                color,
                runs.get(pipe["id"], ""),
                fittings.get(pipe["id"], []),
                _ends(pipe),
                change_words(changes[pipe["id"]].change) if pipe["id"] in changes else "",
                own,
            )
            for pipe, color, own in zip(newest.pipes, colors, proofs, strict=True)
        ],
        no_photographs=no_photographs,
        left_out=_left_out(newest),
        stills=_stills(newest),
        cloud=cloud,
    )


def _last_step(surveys: Sequence[Survey]) -> tuple[Step | None, str]:
    """The step to the last survey, None where there is none, and why surveys cannot be compared.

    Raises OtherSiteError where surveys are not of one site.
    """
    if len(surveys) < 2:
        return None, ""
    try:
        return compare([survey.results for survey in surveys])[-1], ""
    except OtherSiteError:
        raise
    except InputError as error:
        return None, str(error)


def change_words(change: Change) -> str:
    """What became of a pipe, in words."""
    if change.state in ("longer", "shorter"):
        return f"{'longer' if change.grown > 0.0 else 'shorter'} by {abs(change.grown):.2f} m"
    return {"not_seen": "not seen this time", "gone": "gone, its place was seen", "kept": "as before"}.get(
        change.state, change.state
    )


def _facts(survey: Survey) -> list[tuple[str, str]]:
    """Terms and values on how the survey went."""
    facts = survey.facts
    items = [
        ("Survey", f"{survey.name}, {survey.time:%Y-%m-%d %H:%M} UTC"),
        ("Pipes", f"{len(survey.pipes)}, {sum(pipe['class'] is None for pipe in survey.pipes)} of no planned class"),
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


def _runs(survey: Survey) -> tuple[dict[str, str], dict[str, list[str]]]:
    """The run of each pipe that fittings connect to others, and its fittings in words; by the pipe's id."""
    runs: dict[str, str] = {}
    fittings: dict[str, list[str]] = {}
    for run in survey.results.runs:
        joints = run.get("joints", [])
        for joint in joints if isinstance(joints, list) else []:
            try:
                first, second = (str(name) for name in joint["pipes"])
                kind = str(joint["kind"])
            except (KeyError, TypeError, ValueError):
                continue
            for one, other in ((first, second), (second, first)):
                runs[one] = str(run.get("id", ""))
                fittings.setdefault(one, []).append(f"{kind} to {other}")
    return runs, fittings


def _ends(pipe: dict[str, Any]) -> str:
    """What is at the start and the end of a pipe, in words; empty where the results do not say."""
    ends = pipe.get("ends")
    states = [str(end.get("state", "")) for end in ends if isinstance(end, dict)] if isinstance(ends, list) else []
    if not states or set(states) == {"unknown"}:
        return ""
    return " and ".join(END_WORDS.get(state, state) for state in states)


def _left_out(survey: Survey) -> list[str]:
    """What is not counted, and why."""
    sentences = []
    radii = {str(entry["class"]): 1e3 * float(entry["outer_radius"]) for entry in survey.classes}
    for pipe in survey.pipes:
        if pipe["class"] is not None:
            continue
        radius = 1e3 * float(pipe["radius"])
        near = sorted(radii, key=lambda name: abs(radii[name] - radius))[:2]
        why = "two classes explain its radius" if pipe.get("ambiguous") else "no class has its radius"
        if pipe.get("ambiguous") and pipe.get("material_probability"):
            why = f"{why}, and its look does not tell which"
        nearest = ", ".join(f"{name} {radii[name]:.1f} mm" for name in near)
        sentences.append(
            f"{pipe['id']}, {float(pipe['length']):.2f} m, radius {radius:.1f} mm: {why}"
            + (f" (nearest: {nearest})" if near else "")
        )
    facts = survey.facts
    if "frames_considered" in facts and "keyframes" in facts:
        sentences.append(
            f"{facts['frames_considered'] - facts['keyframes']} of {facts['frames_considered']} frames are no "
            "keyframes: frames.csv has the reason of each"
        )
    return sentences


def _stills(survey: Survey) -> list[bytes]:
    """JPEG pictures of the cloud with its pipes from two sides; none where there is neither."""
    pipes = [render.ColoredPipe(survey.cylinder(p), survey.color(p["class"]), str(p["id"])) for p in survey.pipes]
    cloud = survey.results.cloud
    points, colors = (np.empty((0, 3)), None) if cloud is None else (cloud.cloud.points, cloud.colors)
    if not len(points) and not pipes:
        return []
    stills = []
    for direction in render.two_sides(points, pipes):
        image = render.draw(points, colors, pipes, direction, STILL_WIDTH)
        encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, STILL_QUALITY])[1]
        stills.append(encoded.tobytes())
    return stills


def kmeans_matrix(survey: Survey) -> dict[str, Any] | None:
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
