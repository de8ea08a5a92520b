# SPDX-License-Identifier: Apache-2.0
"""The tables of a survey, whatever file they go into: classes, pipes, activities."""

from __future__ import annotations

from dataclasses import dataclass

from pipeprog_bringup.export.survey import BillLineRow, Survey


@dataclass(frozen=True)
class ClassRow:
    """Progress of a class [m]; `sigma` of the installed metres is None where the results do not tell it."""

    name: str
    outer_radius: float
    planned: float
    installed: float
    sigma: float | None
    pipes: int
    lines: list[BillLineRow]

    @property
    def share(self) -> float | None:
        """Installed over planned, None where nothing is planned."""
        return self.installed / self.planned if self.planned > 0.0 else None


def class_rows(survey: Survey) -> list[ClassRow]:
    """One row for each class of the bill, in its order."""
    return [
        ClassRow(
            name=str(row["class"]),
            outer_radius=float(row["outer_radius"]),
            planned=float(row["planned_m"]),
            installed=float(row["installed_m"]),
            sigma=positive(row.get("installed_sigma_m")),
            pipes=sum(pipe.class_name == row["class"] for pipe in survey.pipes),
            lines=[line for line in survey.lines if line.class_name == row["class"]],
        )
        for row in survey.results.classes
    ]


def line_lengths(survey: Survey, row: ClassRow) -> list[float | None]:
    """Installed metres of each line of a class; None where its lines are told together, by nothing told apart.

    A class of one line has the metres of the class. Those of several are told apart by their places in the plan.
    """
    if len(row.lines) == 1:
        return [row.installed]
    if not survey.planned:
        return [None] * len(row.lines)
    lengths = [0.0] * len(row.lines)
    for state in survey.planned:
        if state.planned.class_name == row.name and 0 <= state.planned.line < len(lengths):
            lengths[state.planned.line] += state.length
    return list(lengths)


def activity_shares(survey: Survey) -> dict[str, float]:
    """Installed share, 0 to 1, of each activity whose metres are known, all of them."""
    planned: dict[str, float] = {}
    installed: dict[str, float] = {}
    unknown = set()
    for row in class_rows(survey):
        for line, length in zip(row.lines, line_lengths(survey, row), strict=True):
            planned[line.activity] = planned.get(line.activity, 0.0) + line.planned
            installed[line.activity] = installed.get(line.activity, 0.0) + (length or 0.0)
            if length is None:
                unknown.add(line.activity)
    return {
        name: min(installed[name] / length, 1.0)
        for name, length in planned.items()
        if name and length > 0.0 and name not in unknown
    }


def positive(value: object) -> float | None:
    """A number above zero of pipes.json, None for anything else."""
    return float(value) if isinstance(value, int | float) and value > 0.0 else None
