# SPDX-License-Identifier: Apache-2.0
"""`pipeprog simulate-patrol`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeprog_bringup.commands.options import Board, Boq, Set
from pipeprog_bringup.commands.speech import say


def simulate_patrol(
    bags: Annotated[
        list[Path],
        typer.Argument(
            help="Recordings of a robot, one for each survey; the later ones are compared with the first. "
            "Example: `monday.mcap tuesday.mcap`",
            metavar="BAG...",
        ),
    ],
    boq: Boq,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            help="Folder in which each survey gets a folder of its recording's name. Example: `--out surveys`",
            metavar="DIR",
        ),
    ],
    board: Board = None,
    rig: Annotated[
        bool, typer.Option("--rig", help="Use all cameras of a robot; /tf_static says where they are mounted.")
    ] = False,
    rate: Annotated[
        float, typer.Option("--rate", help="Walk at R times real time. Example: `--rate 0.5`", metavar="R")
    ] = 1.0,
    overrides: Set = None,
) -> None:
    """Try a patrol without a robot: recordings go live through the graph, and its action surveys them.

    `pipeprog simulate-patrol monday.mcap tuesday.mcap --boq BOQ.yaml --board BOARD.yaml --out surveys`
    """
    from pipeprog_bringup.playback.node_processes import require_ros

    require_ros()
    from pipeprog_bringup.simulated_patrol import Request
    from pipeprog_bringup.simulated_patrol import simulate_patrol as run
    from pipeprog_camera.errors import InputError

    results = run(Request(bags, boq, out, board, rate, rig, overrides or ()), say)
    folders = [found.folder for found in results.values() if found.succeeded]
    if len(folders) > 1:
        say(f"`pipeprog compare {' '.join(folders)}` tells what has changed")
    failed = [name for name, found in results.items() if not found.succeeded]
    if failed:
        raise InputError(f"{len(failed)} recordings gave no pipes: {', '.join(failed)}")
