# SPDX-License-Identifier: Apache-2.0
"""`pipeprog export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeprog_bringup.commands.options import Force
from pipeprog_bringup.commands.speech import note, say


def export(
    folder: Annotated[Path, typer.Argument(help="Results of a survey. Example: `out/monday`", metavar="DIR")],
    to: Annotated[
        list[str],
        typer.Option(
            "--to",
            help="Format; may be repeated: xlsx, csv, ifc, bcf, dxf, glb, laz, colmap. Example: `--to xlsx --to ifc`",
            metavar="FORMAT",
            autocompletion=lambda: ["xlsx", "csv", "ifc", "bcf", "dxf", "glb", "laz", "colmap"],
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="Folder for the files; without, DIR/export. Example: `--out handover`", metavar="FOLDER"
        ),
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option(
            "--points",
            help="Control points (YAML): the site's coordinates. Example: `--points points.yaml`",
            metavar="POINTS.yaml",
        ),
    ] = None,
    board: Annotated[
        Path | None,
        typer.Option(
            "--board",
            help="Boards whose circles are control points. Example: `--board boards/a4.yaml`",
            metavar="BOARD.yaml",
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Write the results for other programs.

    `pipeprog export out/monday --to xlsx --to csv`
    """
    from pipeprog_bringup.export.formats import export as write
    from pipeprog_bringup.export.formats import plan_notes, site_alignment

    alignment, told = (None, []) if points is None else site_alignment(folder, points, board)
    for sentence in told:
        say(sentence)
    if alignment and alignment.warning:
        note(alignment.warning)
    for path in write(folder, to, out or folder / "export", force, alignment):
        say(f"Written: {path}")
    for sentence in plan_notes(folder, alignment):
        note(sentence)
