# SPDX-License-Identifier: Apache-2.0
"""`pipeprog report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeprog_bringup.commands.options import Force, Quiet
from pipeprog_bringup.commands.speech import say


def report(
    folders: Annotated[
        list[Path],
        typer.Argument(help="Results of one survey, or of several. Example: `out/monday`", metavar="DIR [DIR ...]"),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            help="The page to write (.html), or a folder for it. Example: `--out monday.html`",
            metavar="REPORT",
        ),
    ],
    force: Force = False,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Print the page to a PDF beside it, with Chromium or Chrome.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Write one HTML page: progress of each class, a 3-D view, each pipe with its photographs, plan and elevations.

    `pipeprog report out/monday --out monday.html`
    """
    from pipeprog_bringup.console import share_bar
    from pipeprog_bringup.report.page import report as write

    with share_bar("report", quiet) as show:
        target = write(folders, out, force, show, pdf)
    say(f"Report: {target}")
