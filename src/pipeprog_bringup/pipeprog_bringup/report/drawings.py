# SPDX-License-Identifier: Apache-2.0
"""Plan and elevations of a survey, true to scale, with labels that do not lie on each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.report.survey_reader import Survey
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.outside_text import for_plot

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

# Sizes in points, 1/72 of an inch: a drawing is as wide as a page of A4 between its borders, and at most as high.
WIDTH, HIGHEST = 720.0, 640.0
LEFT, BOTTOM, BORDER = 40.0, 34.0, 12.0
FONT = 7.5
LETTER, LINE = 0.62 * FONT, 1.25 * FONT  # of the font: mean advance of a letter, height of a line
THINNEST = 1.6  # of a drawn pipe, so that copper is seen in a drawing of 20 m
RINGS = (0.0, 7.0, 14.0, 22.0, 32.0, 44.0, 60.0, 80.0)  # distances of a label from its pipe, tried in this order
COVERED = 12.0  # what covering a pipe's drawing costs a label, as a distance
CAMERA = "#b35a00"


@dataclass(frozen=True)
class Direction:
    """How a drawing looks at the site: its name, and its right, its up and the direction to the eye in the map."""

    name: str
    right: FloatArray
    up: FloatArray

    def flat(self, points: FloatArray) -> FloatArray:
        """(N, 2) of points (N, 3) [m]."""
        return np.asarray(points @ np.stack([self.right, self.up], axis=1), np.float64)

    @property
    def towards_eye(self) -> FloatArray:
        """Unit vector (3,) to the eye."""
        return np.asarray(np.cross(self.right, self.up), np.float64)


@dataclass(frozen=True)
class Label:
    """A text at the corner (left, bottom) of its box, with the point that it names; points of the drawing."""

    text: str
    low: FloatArray
    high: FloatArray
    anchor: FloatArray


def directions(survey: Survey) -> list[Direction]:
    """Plan, and two elevations along and across the walls, from the side on which the camera was."""
    axes = np.array([cylinder.end - cylinder.start for cylinder in survey.cylinders]).reshape(-1, 3)
    # Directions that differ by a quarter turn are those of the same walls: their angle times four.
    turned = (np.hypot(*axes[:, :2].T) * np.exp(4j * np.arctan2(axes[:, 1], axes[:, 0]))).sum()
    angle = float(np.angle(turned)) / 4 if abs(turned) > 1e-9 else 0.0
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    middles = np.array([cylinder.middle for cylinder in survey.cylinders]).reshape(-1, 3)
    if len(middles) and np.ptp(middles @ along) < np.ptp(middles @ across):
        along, across = across, -along
    up = np.array([0.0, 0.0, 1.0])
    drawn = [Direction("Plan, seen from above", along, np.cross(up, along))]
    for name, right in (("Long elevation", along), ("Cross elevation", across)):
        side = np.cross(right, up)
        if survey.positions is not None and len(middles):
            right = right if (survey.positions.mean(axis=0) - middles.mean(axis=0)) @ side >= 0 else -right
        drawn.append(Direction(name, right, up))
    return drawn


def drawing(survey: Survey, direction: Direction, letters: Sequence[str]) -> Figure:
    """Pipes seen from a direction, far ones first, each with its id and the letter of its class."""
    frame = _Frame.around(survey, direction)
    figure = plt.figure(figsize=(WIDTH / 72, frame.height / 72))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, WIDTH), ylim=(0, frame.height))
    axes.axis("off")
    frame.draw_scales(axes)
    if survey.positions is not None:
        way = frame.points(survey.positions)
        axes.plot(*way.T, "-", color=CAMERA, lw=0.8, marker="o", ms=1.8, zorder=1)
        axes.plot(*way[0], ">", color=CAMERA, ms=6, zorder=1)
    shapes = []
    cylinders = survey.cylinders
    for number in np.argsort([cylinder.middle @ direction.towards_eye for cylinder in cylinders], kind="stable"):
        cylinder = cylinders[number]
        ends = frame.points(np.stack([cylinder.start, cylinder.end]))
        width = max(2 * cylinder.radius * frame.scale, THINNEST)
        style = {"facecolor": survey.color(survey.pipes[number]["class"]), "edgecolor": "#222", "lw": 0.6, "zorder": 2}
        if np.linalg.norm(ends[1] - ends[0]) > width:
            axes.add_patch(plt.Polygon(_rectangle(ends, width), **style))
        else:  # seen along its axis
            axes.add_patch(plt.Circle(ends.mean(axis=0), 0.5 * width, **style))
        shapes.append((number, ends, width))
    texts = [for_plot(f"{pipe['id']} {own}") for pipe, own in zip(survey.pipes, letters, strict=True)]
    for label in place_labels([(texts[n], ends, width) for n, ends, width in shapes], (WIDTH, frame.height)):
        middle = 0.5 * (label.low + label.high)
        nearest = np.clip(label.anchor, label.low, label.high)
        if np.linalg.norm(nearest - label.anchor) > 0.5 * LINE:
            axes.plot(*np.stack([label.anchor, nearest]).T, color="#222", lw=0.5, zorder=3)
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.6}
        axes.text(*middle, label.text, fontsize=FONT, ha="center", va="center", zorder=4, bbox=box)
    return figure


def place_labels(shapes: Sequence[tuple[str, FloatArray, float]], size: tuple[float, float]) -> list[Label]:
    """Labels for shapes, each with its text, the ends (2, 2) of its axis and its width; their boxes do not overlap.

    A label stands as near to its shape as there is room; one for which there is none is left out.
    """
    corners = [_rectangle(ends, width) for _, ends, width in shapes]
    boxes = np.array([[corner.min(0), corner.max(0)] for corner in corners]).reshape(-1, 2, 2)
    placed: list[Label] = []
    taken: FloatArray = np.empty((0, 2, 2))
    # Short pipes have the fewest places.
    for number in np.argsort([np.linalg.norm(ends[1] - ends[0]) for _, ends, _ in shapes], kind="stable"):
        text, ends, width = shapes[number]
        half = 0.5 * np.array([LETTER * len(text) + 2, LINE])
        anchors, middles, distances = _candidates(ends, width, half)
        low, high = middles - half, middles + half
        fits = ((low >= 2) & (high <= np.array(size) - 2)).all(axis=1)
        fits &= ~_overlapping(low, high, taken).any(axis=1)
        if not fits.any():
            continue
        others = np.delete(boxes, number, axis=0)
        cost = distances + COVERED * _overlapping(low, high, others).sum(axis=1)
        best = int(np.where(fits, cost, np.inf).argmin())
        placed.append(Label(text, low[best], high[best], anchors[best]))
        taken = np.concatenate([taken, [[low[best], high[best]]]])
    return placed


def _candidates(ends: FloatArray, width: float, half: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Places for a label of a shape: points (C, 2) of its axis, middles (C, 2) of the box, distances (C,)."""
    shares = np.array([0.5, 0.35, 0.65, 0.2, 0.8, 0.05, 0.95])
    axis = ends[0] + shares[:, None] * (ends[1] - ends[0])
    angles = np.radians(np.arange(0.0, 360.0, 30.0) + 90.0)
    unit = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    away = np.array([(half * np.abs(unit)).sum(axis=1) + 0.5 * width + ring for ring in RINGS])  # (rings, angles)
    middles = axis[:, None, None] + away[..., None] * unit
    anchors = np.broadcast_to(axis[:, None, None], middles.shape)
    distances = np.broadcast_to(np.array(RINGS)[:, None], middles.shape[:3]) + 4 * np.abs(shares - 0.5)[:, None, None]
    return anchors.reshape(-1, 2), middles.reshape(-1, 2), distances.ravel()


def _overlapping(low: FloatArray, high: FloatArray, boxes: FloatArray) -> NDArray[np.bool_]:
    """(C, B) whether boxes with these corners (C, 2) overlap others (B, 2, 2)."""
    return np.asarray(((low[:, None] < boxes[None, :, 1]) & (high[:, None] > boxes[None, :, 0])).all(axis=2))


def _rectangle(ends: FloatArray, width: float) -> FloatArray:
    """Corners (4, 2) of a drawn pipe; one that is seen along its axis is a square."""
    along = ends[1] - ends[0]
    length = float(np.linalg.norm(along))
    unit = along / length if length > 1e-9 else np.array([1.0, 0.0])
    middle, half = 0.5 * (ends[0] + ends[1]), 0.5 * max(length, width) * unit
    aside = 0.5 * width * np.array([-unit[1], unit[0]])
    return np.array([middle - half - aside, middle + half - aside, middle + half + aside, middle - half + aside])


@dataclass(frozen=True)
class _Frame:
    """Where metres lie in a drawing: points of it = (metres - low) * scale + corner."""

    direction: Direction
    low: FloatArray
    high: FloatArray
    scale: float

    @classmethod
    def around(cls, survey: Survey, direction: Direction) -> _Frame:
        """The frame that shows all pipes and cameras."""
        parts = [np.stack([cylinder.start, cylinder.end]) for cylinder in survey.cylinders]
        if survey.positions is not None:
            parts.append(survey.positions)
        flat = direction.flat(np.concatenate(parts)) if parts else np.zeros((1, 2))
        low, high = flat.min(axis=0) - 0.3, flat.max(axis=0) + 0.3
        room = np.array([WIDTH - LEFT - BORDER, HIGHEST - BOTTOM - BORDER])
        return cls(direction, low, high, float((room / (high - low)).min()))

    @property
    def height(self) -> float:
        """Of the drawing."""
        return BOTTOM + BORDER + max(self.scale * float(self.high[1] - self.low[1]), 80.0)

    def points(self, places: FloatArray) -> FloatArray:
        """Points (N, 2) of the drawing for places (N, 3) of the map."""
        return (self.direction.flat(places) - self.low) * self.scale + [LEFT, BOTTOM]

    def draw_scales(self, axes: plt.Axes) -> None:
        """Lines and figures of the metres, at a step that leaves 40 points between them."""
        step = next((s for s in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0) if s * self.scale > 40), 1000.0)
        top = self.height - BORDER
        for axis in (0, 1):
            first = np.ceil(self.low[axis] / step) * step
            for value in np.arange(first, self.high[axis] + 1e-9, step):
                place = (value - self.low[axis]) * self.scale + (LEFT, BOTTOM)[axis]
                if axis == 0:
                    axes.plot([place, place], [BOTTOM, top], color="#dde1e7", lw=0.6, zorder=0)
                    axes.text(place, BOTTOM - 11, f"{round(float(value), 1) + 0.0:g}", fontsize=FONT, ha="center")
                else:
                    axes.plot([LEFT, WIDTH - BORDER], [place, place], color="#dde1e7", lw=0.6, zorder=0)
                    axes.text(
                        LEFT - 4, place, f"{round(float(value), 1) + 0.0:g}", fontsize=FONT, ha="right", va="center"
                    )
        axes.text(LEFT, 6, "metres", fontsize=FONT)
