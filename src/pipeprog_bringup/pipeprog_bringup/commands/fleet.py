# SPDX-License-Identifier: Apache-2.0
"""`pipeprog fleet`."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from pipeprog_bringup.commands.options import Set
from pipeprog_bringup.commands.speech import note, say


def fleet(
    recordings: Annotated[
        list[str],
        typer.Argument(
            help="Files, folders, globs, addresses such as s3://..., or a fleet.yaml. Example: `night/`",
            metavar="RECORDINGS",
        ),
    ],
    out: Annotated[
        str,
        typer.Option(
            "--out", help="Folder or address for the results. Example: `--out s3://site/results`", metavar="URI"
        ),
    ],
    boq: Annotated[
        str,
        typer.Option(
            "--boq",
            help="Bill of quantities: the planned classes. Example: `--boq plan.xlsx`",
            metavar="BOQ.yaml|csv|xlsx",
        ),
    ] = "",
    board: Annotated[
        str,
        typer.Option(
            "--board", help="Target boards (YAML): the scale. Example: `--board boards/a4.yaml`", metavar="BOARD.yaml"
        ),
    ] = "",
    overrides: Set = None,
    scheduler: Annotated[
        str,
        typer.Option(
            "--scheduler",
            help="A Dask cluster; without, this machine. Example: `--scheduler tcp://head:8786`",
            metavar="tcp://HOST:8786",
        ),
    ] = "",
    cores: Annotated[
        int, typer.Option("--cores", help="Cores for each survey. Example: `--cores 4`", min=1, metavar="C")
    ] = 2,
) -> None:
    """Survey many recordings at once; what has its results already is left as it is.

    `pipeprog fleet night/ --boq BOQ.yaml --board BOARD.yaml --out results`
    """
    from pipeprog_camera.errors import InputError

    try:
        from pipeprog_bringup.survey_fleet import Request, survey_fleet
    except ModuleNotFoundError as error:
        raise InputError(
            f"pipeprog fleet needs packages that are not installed (there is no {error.name}): "
            "`pip install pipeprog[fleet]`, or in the repository `make setup FLEET=1`"
        ) from None
    from pipeprog_bringup.console import FleetDisplay
    from pipeprog_bringup.playback.node_processes import require_ros

    if not scheduler:
        require_ros()
    request = Request(recordings, out, boq, board, overrides or (), scheduler, cores)
    try:
        with FleetDisplay() as display:
            surveyed = survey_fleet(request, display)
    except KeyboardInterrupt:
        note("Interrupted: what is done stays; the same command goes on with the rest.")
        sys.exit(130)
    without = [row for row in surveyed.rows if row.survey is None]
    say(f"{len(surveyed.rows) - len(without)} of {len(surveyed.rows)} recordings surveyed: {surveyed.page}")
    if without:
        raise InputError(f"{len(without)} of {len(surveyed.rows)} recordings have no results: {surveyed.page} says why")
