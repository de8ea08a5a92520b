# SPDX-License-Identifier: Apache-2.0
"""The formats that a survey can be exported to, and the one way to write them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeprog_bringup.export.bcf import write_bcf
from pipeprog_bringup.export.colmap import write_colmap
from pipeprog_bringup.export.control_points import Alignment, align, load_control_points
from pipeprog_bringup.export.csv_tables import write_classes, write_pipes
from pipeprog_bringup.export.dxf import write_dxf
from pipeprog_bringup.export.glb import write_glb
from pipeprog_bringup.export.ifc import write_ifc
from pipeprog_bringup.export.laz import write_laz
from pipeprog_bringup.export.point_places import points_in_map
from pipeprog_bringup.export.survey import Site, Survey
from pipeprog_bringup.export.xlsx import write_xlsx
from pipeprog_bringup.results.atomic_output import OutputFolder, output_file
from pipeprog_bringup.results.plan_place import why_no_place_is_planned
from pipeprog_bringup.results.results_reader import read_results
from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import nearest, shown
from pipeprog_sfm.boards.board_file import BoardFile, load_board_file

Writer = Callable[[Survey, Path], None]


@dataclass(frozen=True)
class Format:
    """A format: the files that it consists of, each with its writer; a name that ends with / is that of a folder."""

    files: dict[str, Writer]


FORMATS = {
    "xlsx": Format({"survey.xlsx": write_xlsx}),
    "ifc": Format({"survey.ifc": write_ifc}),
    "bcf": Format({"issues.bcf": write_bcf}),
    "dxf": Format({"axes.dxf": write_dxf}),
    "glb": Format({"pipes.glb": write_glb}),
    "laz": Format({"cloud.laz": write_laz}),
    "colmap": Format({"colmap/": write_colmap}),
    "csv": Format({"classes.csv": write_classes, "pipes.csv": write_pipes}),
}


def site_alignment(folder: Path, points: Path, board: Path | None) -> tuple[Alignment, list[str]]:
    """Where the site's coordinates lie in the map of a results folder, and a sentence on each control point.

    Raises InputError, naming the point, where the points' places cannot be had or do not agree.
    """
    file = load_control_points(points)
    boards = load_board_file(board) if board else BoardFile()
    found = align(file, points_in_map(file.points, read_results(folder), boards))
    told = [
        f"control point {point.name}: {1e3 * residual:.1f} mm off"
        for point, residual in zip(file.points, found.residuals, strict=True)
    ]
    return found, [*told, f"a metre of the map is {found.scale:.5f} m between the control points"]


def plan_notes(folder: Path, alignment: Alignment | None = None) -> list[str]:
    """A sentence where the plan of a results folder lies elsewhere, in the coordinates that it is exported in.

    Raises InputError where the folder holds no results.
    """
    survey = Survey(read_results(folder), Site() if alignment is None else alignment.site)
    places = [survey.results.map_from_camera[:, :3, 3]]
    places += [np.array([cylinder.start, cylinder.end]) for cylinder in survey.results.cylinders]
    remedy = (
        "is it in site coordinates? Give control points with --points"
        if alignment is None
        else "are the control points in its coordinates?"
    )
    planned = [state.planned for state in survey.planned]
    return why_no_place_is_planned(planned, survey.site.place(np.concatenate(places)), remedy)


def export(
    folder: Path, names: Sequence[str], out: Path, force: bool = False, alignment: Alignment | None = None
) -> list[Path]:
    """Writes a results folder in the formats `names` into the folder `out`; returns the files.

    Coordinates are those of the map, or of the site that `alignment` leads to. Raises InputError where the folder holds
    no results, a format is not known or needs what is not installed, or a file exists and `force` is not set.
    """
    names = [name.lower() for name in names]
    for name in names:
        if name == "pdf":
            raise InputError("--to pdf: `pipeprog report DIR --pdf` writes the report for paper")
        if name not in FORMATS:
            raise InputError(
                f"--to {shown(name)}: no such format: did you mean '{nearest(name, FORMATS)}'? "
                f"There are {', '.join(FORMATS)}"
            )
    survey = Survey(read_results(folder), Site() if alignment is None else alignment.site)
    written = []
    for name in dict.fromkeys(names):
        for file, write in FORMATS[name].files.items():
            if file.endswith("/"):
                with OutputFolder(out / file, force) as stage:
                    write(survey, stage.file("."))
            else:
                with output_file(out / file, force) as temporary:
                    write(survey, temporary)
            written.append(out / file)
    return written
