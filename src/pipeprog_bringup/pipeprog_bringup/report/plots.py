# SPDX-License-Identifier: Apache-2.0
"""Plots of the report, as SVG within the page."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from itertools import cycle

import matplotlib as mpl
import numpy as np

from pipeprog_bringup.report.survey_reader import Survey
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.outside_text import for_plot

mpl.use("Agg")
from matplotlib import dates
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure


def radii_and_classes(survey: Survey) -> Figure:
    """Metres by measured radius over the classes' bands, and each pipe's distance from its nominal radius."""
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(10, 6), height_ratios=(3, 2))
    radii = np.array([1e3 * float(pipe["radius"]) for pipe in survey.pipes])
    nominal = {str(entry["class"]): 1e3 * float(entry["outer_radius"]) for entry in survey.classes}
    _draw_radii(top, survey, radii, nominal)
    _draw_deviations(bottom, survey, radii, nominal)
    return _finished(figure)


def _draw_radii(axes: Axes, survey: Survey, radii: FloatArray, nominal: dict[str, float]) -> None:
    """Histogram of the metres by radius [mm], and the band of each class."""
    highest = 1.15 * max(radii.max(), *nominal.values()) if nominal else 1.15 * radii.max()
    for name, radius in nominal.items():
        # Tolerance of manufacture, 1 % of the diameter (EN 10255); at least 1 mm, to be visible.
        band = max(0.02 * radius, 1.0)
        axes.axvspan(radius - band, radius + band, color=survey.color(name), alpha=0.22, lw=0)
        axes.annotate(
            for_plot(name),
            (radius, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=8,
        )
    lengths = np.array([float(pipe["length"]) for pipe in survey.pipes])
    groups = [*nominal, None]
    own = [np.array([pipe["class"] == name for pipe in survey.pipes], bool) for name in groups]
    axes.hist(
        [radii[mask] for mask in own],
        np.arange(0, highest + 2, 2.0).tolist(),
        weights=[lengths[mask] for mask in own],
        stacked=True,
        color=[survey.color(name) for name in groups],
        edgecolor="#333",
        linewidth=0.5,
    )
    axes.set(xlabel="measured outer radius [mm]", ylabel="length [m]", xlim=(0, highest))


def _draw_deviations(axes: Axes, survey: Survey, radii: FloatArray, nominal: dict[str, float]) -> None:
    """Each classified pipe's radius less the nominal one of its class [mm]."""
    for number, pipe in enumerate(survey.pipes):
        if pipe["class"] not in nominal:
            continue
        deviation = radii[number] - nominal[pipe["class"]]
        sigma = 3e3 * float(pipe["radius_sigma"] or 0)
        color = [survey.color(pipe["class"])]
        axes.errorbar(number, deviation, sigma, color="#333", capsize=3, lw=1, zorder=1)
        axes.scatter(number, deviation, 40, color=color, edgecolor="#333", lw=0.6, zorder=2)
    axes.axhline(0, color="#888", lw=0.8)
    axes.set_xticks(
        range(len(survey.pipes)),
        [for_plot(pipe["id"]) for pipe in survey.pipes],
        fontsize=8,
        rotation=90 if len(survey.pipes) > 20 else 0,
    )
    axes.set(ylabel="radius - nominal [mm]\n(bars: 3 sigma)", xlim=(-0.7, len(survey.pipes) - 0.3))


def series(surveys: Sequence[Survey]) -> Figure:
    """Installed metres of each class over the surveys, with what is planned."""
    figure, axes = plt.subplots(figsize=(10, 4.2))
    times = [survey.time for survey in surveys]
    names = dict.fromkeys(str(entry["class"]) for survey in surveys for entry in survey.classes)
    # Each class has a mark of its own beside its colour.
    for name, mark in zip(names, cycle("os^Dv<>PX*"), strict=False):
        own = [next((c for c in survey.classes if str(c["class"]) == name), None) for survey in surveys]
        installed = [np.nan if entry is None else float(entry["installed_m"]) for entry in own]
        last = next(entry for entry in reversed(own) if entry is not None)
        color = surveys[-1].color(name)
        axes.plot(
            times, installed, "-", marker=mark, color=color, lw=2, ms=7, mec="#333", mew=0.6, label=for_plot(name)
        )
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


def svg(figure: Figure) -> str:
    """A figure as an SVG element, and the figure closed."""
    stream = io.StringIO()
    # A fixed salt and no date: the same results give the same page.
    with mpl.rc_context({"svg.hashsalt": "pipeprog"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    plt.close(figure)
    text = stream.getvalue()
    # Within HTML an SVG needs neither name spaces nor a description of itself.
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    return re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)
