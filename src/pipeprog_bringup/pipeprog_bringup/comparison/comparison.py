# SPDX-License-Identifier: Apache-2.0
"""Surveys of one site, week against week: every pipe with one id for its life, and what became of it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.results.lives import NUMBERED
from pipeprog_bringup.results.results_reader import Results
from pipeprog_camera.errors import InputError
from pipeprog_detect.coverage.changes import UNKNOWN_SIGMA, Change, KnownPipe, changes
from pipeprog_detect.coverage.places import Sight, sights
from pipeprog_detect.coverage.survey import views_of
from pipeprog_detect.types import View

# Points of the earlier cloud that are looked for in the later one; a share of them is known to 1 %.
LOOKED_FOR = 10_000
# As a pipe of this radius [m], a point is told from what lies 3 cm behind it.
POINT_RADIUS = 0.03
# Most of what stood there stands there a week later, pipes and surfaces: with less, it is another site.
SAME_SITE = 0.5


class OtherSiteError(InputError):
    """Two surveys are not of one site, or not in one frame."""


@dataclass(frozen=True)
class LifeChange:
    """A change under the id that a pipe has for its life, that of the survey which saw it first."""

    life: str
    change: Change


@dataclass(frozen=True)
class Step:
    """What changed from one survey to the next: their folders' names, and the pipes."""

    earlier: str
    later: str
    pipes: list[LifeChange]

    def grown(self, class_name: str) -> float:
        """Metres by which a class has grown: what counts now, less what was there."""
        own = [each.change for each in self.pipes if each.change.class_name == class_name]
        return sum(change.counted - change.length_before for change in own)

    def unseen(self, class_name: str) -> float:
        """Metres of a class that count although this survey has not measured them: nobody saw them to be gone."""
        own = [each.change for each in self.pipes if each.change.class_name == class_name]
        return sum(change.counted - change.length_after for change in own)


def compare(surveys: Sequence[Results]) -> list[Step]:
    """The steps from each survey to the next; `surveys` are in the order of their dates.

    A pipe that a survey has not seen is known on. Raises OtherSiteError where two are not surveys of one site, and
    InputError where they cannot be compared.
    """
    known: list[tuple[str, KnownPipe]] = [
        (str(row.get("life", row["id"])), pipe) for row, pipe in zip(surveys[0].pipes, _pipes(surveys[0]), strict=True)
    ]
    most = max((int(found[1]) for life, _ in known if (found := NUMBERED.fullmatch(life))), default=0)
    lived = {life for life, _ in known}
    steps = []
    for earlier, later in pairwise(surveys):
        views = survey_views(later)
        _check_frames(earlier, later, views)
        after = {pipe.id: pipe for pipe in _pipes(later)}
        told = changes([pipe for _, pipe in known], list(after.values()), views)
        _check_pipes(earlier, later, told)
        lives, following = [], []
        for number, change in enumerate(told):
            if change.before:
                life, old = known[number]
            else:
                most += 1
                life, old = _new_life(later, change.after[0], lived, most), after[change.after[0]]
                lived.add(life)
            lives.append(LifeChange(life, replace(change, before=(life,) if change.before else ())))
            following += [(life, after[name]) for name in change.after]
            if change.state == "not_seen":
                following.append((life, old))
        steps.append(Step(earlier.folder.resolve().name, later.folder.resolve().name, lives))
        known = following
    return steps


def survey_views(results: Results) -> list[View]:
    """The keyframes of a survey with the depths that its cloud gives them; raises InputError where it has kept none."""
    path = results.folder / "out.mcap"
    if not path.is_file() or not len(results.stamps) or results.cloud is None:
        raise InputError(
            f"{results.folder} has kept no keyframes or no cloud (out.mcap, trajectory.tum, cloud.ply), so what it has "
            "not seen cannot be told: compare results of `pipeprog replay` with their clouds"
        )
    cameras = {
        frame.stamp: cdr.read_camera_info(frame.camera_info).camera() for frame in Bag.open(path) if not frame.fault
    }
    rows = [row for row, stamp in enumerate(results.stamps.tolist()) if stamp in cameras]
    return views_of([cameras[int(results.stamps[row])] for row in rows], results.map_from_camera[rows], results.points)


def as_json(steps: Sequence[Step]) -> list[dict[str, Any]]:
    """The steps as `pipeprog compare --json` prints them."""
    return [
        {
            "earlier": step.earlier,
            "later": step.later,
            "pipes": [
                {
                    "id": each.life,
                    "state": each.change.state,
                    "class": each.change.class_name or None,
                    "ids": list(each.change.after),
                    "before_m": round(each.change.length_before, 3),
                    "after_m": round(each.change.length_after, 3),
                    "counted_m": round(each.change.counted, 3),
                    "grown_m": round(each.change.grown, 3),
                }
                for each in step.pipes
            ],
        }
        for step in steps
    ]


def _new_life(survey: Results, name: str, lived: Collection[str], number: int) -> str:
    """The life of a pipe that is new: the one that its survey has given it, where no other pipe has it."""
    given = next((row.get("life") for row in survey.pipes if row["id"] == name), None)
    return str(given) if given is not None and given not in lived else f"p{number:02d}"


def _pipes(results: Results) -> list[KnownPipe]:
    return [
        KnownPipe(str(row["id"]), cylinder, str(row["class"] or ""), _end_sigmas(row))
        for row, cylinder in zip(results.pipes, results.cylinders, strict=True)
    ]


def _end_sigmas(row: dict[str, Any]) -> tuple[float, float]:
    """Standard deviations [m] of both ends of a row of pipes.json; UNKNOWN_SIGMA for those that it does not tell."""
    given = [end.get("sigma") for end in row.get("ends", [])]
    start, end = (UNKNOWN_SIGMA if sigma is None else float(sigma) for sigma in [*given, None, None][:2])
    return start, end


def _check_frames(earlier: Results, later: Results, views: Sequence[View]) -> None:
    """Raises InputError where nothing puts two surveys into one frame, OtherSiteError where they do not agree in it."""
    pair = f"{earlier.folder} and {later.folder}"
    is_aligned = earlier.frame is not None and earlier.frame == later.frame
    if not is_aligned:
        _check_boards(earlier, later)
    points = earlier.points[:: max(1, len(earlier.points) // LOOKED_FOR)]
    told = sights(points, np.full(len(points), POINT_RADIUS), views)
    there, through = int((told == Sight.OPEN).sum()), int((told == Sight.EMPTY).sum())
    if there < SAME_SITE * (there + through):
        raise OtherSiteError(
            f"{pair} are not surveys of one site, or their boards hang elsewhere: of the surfaces of the first that "
            f"the second has in view, it sees {100 * there / (there + through):.0f} % where they were"
        )


def _check_boards(earlier: Results, later: Results) -> None:
    """Raises InputError where two surveys that were not aligned have not measured the same boards either."""
    pair = f"{earlier.folder} and {later.folder}"
    for results in (earlier, later):
        if "board" not in str(results.scale.get("source", "")):
            raise InputError(
                f"{pair} cannot be compared: {results.folder} was measured without a board, so its frame is its own: "
                "replay it with --reference, or hang up the same board at each survey"
            )
    boards = [sorted(map(str, each.config.get("boards") or [])) for each in (earlier, later)]
    if boards[0] and boards[1] and boards[0] != boards[1]:
        raise OtherSiteError(
            f"{pair} are not surveys of one site: their boards are {', '.join(boards[0])} and {', '.join(boards[1])}"
        )


def _check_pipes(earlier: Results, later: Results, told: Sequence[Change]) -> None:
    """Raises OtherSiteError where most of the pipes are gone although their places were seen."""
    gone = sum(change.length_before for change in told if change.state == "gone")
    found = sum(change.length_before for change in told if change.before and change.after)
    if found < SAME_SITE * (gone + found):
        raise OtherSiteError(
            f"{earlier.folder} and {later.folder} are not surveys of one site: of {gone + found:.1f} m of pipes of the "
            f"first whose places the second has seen, it has {found:.1f} m"
        )
