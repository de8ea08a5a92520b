# SPDX-License-Identifier: Apache-2.0
"""The answer of a report: metres installed of planned with their sigma, class by class, and what to doubt."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from string import ascii_uppercase
from typing import Any

from pipeprog_bringup.comparison.comparison import Step
from pipeprog_bringup.report.schedule import Line, Zone, lines, sentence, zones
from pipeprog_bringup.report.survey_reader import Survey
from pipeprog_bringup.results.results_reader import Color

DAY = 86_400.0  # s
# Less of the walls seen is warned of [%]: what is not seen may then hold more than a week's progress, a fifth.
LEAST_SEEN = 80.0


@dataclass(frozen=True)
class ClassRow:
    """A planned class: its letter, which stands beside its colour, and its metres; None where not known.

    `unseen`: of the installed metres, those of earlier surveys that the last one has not seen, and not seen to be gone.
    `not_seen`: planned metres that were hidden or out of view. `walls_seen`: share of the walls' area where a pipe of
    this class would have been seen [%].
    """

    name: str
    letter: str
    color: Color
    outer_radius: float
    pipes: int
    planned: float
    installed: float
    sigma: float | None
    change: float | None
    unseen: float
    not_seen: float | None
    walls_seen: float | None

    @property
    def percent(self) -> float:
        """Installed of planned [%]."""
        return _percent(self.installed, self.planned)


@dataclass(frozen=True)
class Summary:
    """What the first screen says.

    Attributes:
        planned, installed, sigma: metres of all planned classes; sigma is None where the results give none.
        change, days: metres installed since the survey before and the days between, None for a single survey.
        previous: date of the survey before.
        rows: the planned classes.
        unplanned: number of pipes of no planned class, and their metres.
        lines: the lines of the bill, where they say more than their classes.
        zones: metres by zone, where the bill has zones.
        schedule: how the metres stand against the dates of the bill, as a sentence; empty without dates.
        seen: what was not seen, as a sentence; empty where the results do not tell.
        warnings: what to doubt, one sentence each.
    """

    planned: float
    installed: float
    sigma: float | None
    change: float | None
    days: float | None
    previous: str
    rows: list[ClassRow]
    unplanned: tuple[int, float]
    lines: list[Line]
    zones: list[Zone]
    schedule: str
    seen: str
    warnings: list[str]

    @property
    def percent(self) -> float:
        """Installed of planned [%]."""
        return _percent(self.installed, self.planned)

    @property
    def sentence(self) -> str:
        """`62.1 of 101.6 m installed: 61.2 ± 0.4 %`."""
        if not self.rows:
            return "The bill of quantities has no classes: nothing is planned"
        sigma = None if self.sigma is None or self.planned <= 0 else 100 * self.sigma / self.planned
        share = with_sigma(self.percent, sigma, 1)
        return f"{metres(self.installed)} of {metres(self.planned)} m installed: {share} %"

    @property
    def since(self) -> str:
        """What changed since the survey before, empty for a single survey."""
        if self.change is None:
            return ""
        amount = f"{metres(abs(self.change))} m {'more' if self.change >= 0 else 'less'} than on {self.previous}"
        return amount if not self.days else f"{amount}: {self.change / self.days:.2f} m a day"


def summary(surveys: Sequence[Survey], step: Step | None = None, not_compared: str = "") -> Summary:
    """The answer of the last of these surveys, which are in the order of their dates.

    `step`: from the survey before, pipe by pipe, and `not_compared` why there is none. With it, what the last survey
    has not seen is still installed; without, the metres of both are compared.
    """
    newest, previous = surveys[-1], surveys[-2] if len(surveys) > 1 else None
    rows = [_row(number, newest, previous, entry, step) for number, entry in enumerate(newest.classes)]
    unplanned = [float(pipe["length"]) for pipe in newest.pipes if pipe["class"] is None]
    changes = [row.change for row in rows if row.change is not None]
    days = None if previous is None else (newest.time - previous.time).total_seconds() / DAY
    rates = {row.name: row.change / days for row in rows if row.change is not None and days}
    bill = lines(newest, rates)
    return Summary(
        planned=sum(row.planned for row in rows),
        installed=sum(row.installed for row in rows),
        sigma=_joined_sigma(rows, newest.scale.get("sigma")),
        change=sum(changes) if changes else None,
        days=days,
        previous="" if previous is None else _when(previous, newest),
        rows=rows,
        unplanned=(len(unplanned), sum(unplanned)),
        lines=bill,
        zones=zones(bill),
        schedule=sentence(bill),
        seen=_seen(newest),
        warnings=_warnings(newest, rows)
        + ([f"Metres are compared, not pipes: {not_compared}"] if not_compared else []),
    )


def letter(number: int) -> str:
    """A, B, ..., Z, AA, AB, ...: what tells a class without its colour."""
    text = ""
    number += 1
    while number:
        number, last = divmod(number - 1, len(ascii_uppercase))
        text = ascii_uppercase[last] + text
    return text


def metres(value: float) -> str:
    """Metres to the decimetre, below ten metres to the centimetre."""
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def with_sigma(value: float, sigma: float | None, digits: int) -> str:
    """A value, and its sigma with two digits, the value with as many decimals; `digits` decimals without a sigma."""
    if sigma is None:
        return f"{value:.{digits}f}"
    decimals = digits if sigma <= 0 else min(3, max(0, 1 - math.floor(math.log10(sigma))))
    return f"{value:.{decimals}f} ± {sigma:.{decimals}f}"


def _percent(installed: float, planned: float) -> float:
    return 100 * installed / planned if planned > 0 else 0.0


def _row(number: int, newest: Survey, previous: Survey | None, entry: dict[str, Any], step: Step | None) -> ClassRow:
    name, installed = str(entry["class"]), float(entry["installed_m"])
    before = None if previous is None else previous.installed.get(name)
    change = None if before is None else installed - before
    unseen = 0.0
    if step is not None:
        change, unseen = step.grown(name), step.unseen(name)
    return ClassRow(
        name=name,
        letter=letter(number),
        color=newest.color(name),
        outer_radius=float(entry["outer_radius"]),
        pipes=sum(pipe["class"] == name for pipe in newest.pipes),
        planned=float(entry["planned_m"]),
        installed=installed + unseen,
        sigma=entry.get("installed_sigma_m"),
        change=change,
        unseen=unseen,
        not_seen=_sum_of([entry], "hidden_m", "not_seen_m"),
        walls_seen=entry.get("walls_seen_percent"),
    )


def _sum_of(entries: Sequence[dict[str, Any]], *keys: str) -> float | None:
    """Sum of these fields of classes, None where one is not known."""
    values = [entry.get(key) for entry in entries for key in keys]
    return None if not values or None in values else sum(float(value or 0.0) for value in values)


def _seen(survey: Survey) -> str:
    """Metres that were not seen; where the plan has no places, how much of the walls was."""
    hidden, out_of_view = _sum_of(survey.classes, "hidden_m"), _sum_of(survey.classes, "not_seen_m")
    missing, unclear = _sum_of(survey.classes, "missing_m"), _sum_of(survey.classes, "unclear_m")
    if hidden is not None and out_of_view is not None:
        told = f"{metres(hidden + out_of_view)} m were not seen"
        if hidden + out_of_view > 0:
            told += f" ({metres(hidden)} m hidden, {metres(out_of_view)} m out of view)"
        told += f"; {metres(missing or 0.0)} m were looked for and are not there"
        return told if not unclear else f"{told}; of {metres(unclear)} m it cannot be told"
    shares = [float(share) for entry in survey.classes if (share := entry.get("walls_seen_percent")) is not None]
    if not shares or not survey.results.walls_m2:
        return ""
    range_of = f"{min(shares):.0f}" if max(shares) - min(shares) < 1 else f"{min(shares):.0f} to {max(shares):.0f}"
    return (
        f"{range_of} % of the {survey.results.walls_m2:.0f} m² of walls that were found was seen well enough; "
        "the plan has no places, so metres that were not seen cannot be told"
    )


def _when(previous: Survey, newest: Survey) -> str:
    """The day of the survey before, and the time where both are of one day."""
    is_same_day = previous.time.date() == newest.time.date()
    return f"{previous.time:%Y-%m-%d %H:%M}" if is_same_day else f"{previous.time:%Y-%m-%d}"


def _joined_sigma(rows: Sequence[ClassRow], scale_sigma: float | None) -> float | None:
    """Sigma [m] of the sum: the classes' errors are independent of each other but for that of the scale."""
    sigmas = [row.sigma for row in rows]
    if not rows or None in sigmas:
        return None
    common = [(scale_sigma or 0.0) * row.installed for row in rows]
    own = sum(max(float(sigma or 0.0) ** 2 - part**2, 0.0) for sigma, part in zip(sigmas, common, strict=True))
    return math.sqrt(own + sum(common) ** 2)


def _warnings(survey: Survey, rows: Sequence[ClassRow]) -> list[str]:
    facts, source = survey.facts, survey.scale.get("source")
    warnings = [str(loss) for loss in facts.get("losses", [])]
    keyframes, registered = facts.get("keyframes"), facts.get("registered")
    if keyframes and registered is not None and registered < keyframes:
        warnings.append(
            f"{keyframes - registered} of {keyframes} keyframes have no place in the map: what only they show is "
            "not measured"
        )
    unseen = sum(row.unseen for row in rows)
    if unseen > 0.005:
        warnings.append(
            f"{metres(unseen)} m of those installed were measured earlier and were not in view this time: they count on"
        )
    thin = [row for row in rows if row.walls_seen is not None and row.walls_seen < LEAST_SEEN]
    if thin:
        told = ", ".join(f"{row.name} ({row.walls_seen:.0f} % of the walls)" for row in thin)
        warnings.append(f"Thin coverage: pipes would have been seen on a part of the walls only: {told}")
    in_bag, considered = facts.get("frames_in_bag"), facts.get("frames_considered")
    if in_bag and considered is not None and considered < in_bag:
        warnings.append(f"The survey stopped early: {considered} of {in_bag} images were worked off")
    if source == "odometry":
        warnings.append("The scale comes from odometry alone: put up a target board to check it")
    if source == "cloud":
        warnings.append("The scale is the cloud's own: nothing here has checked it")
    if rows and not any(row.installed for row in rows):
        warnings.append("No planned class was found: is it the bill of quantities of this site, its radii in mm?")
    over = [f"{row.name} ({row.percent:.0f} %)" for row in rows if row.percent > 100]
    if over:
        warnings.append(f"More is installed than planned of {', '.join(over)}: check the bill of quantities")
    unplanned = sum(float(pipe["length"]) for pipe in survey.pipes if pipe["class"] is None)
    if unplanned:
        warnings.append(f"{metres(unplanned)} m of pipe are of no planned class and are not counted")
    return warnings
