# SPDX-License-Identifier: Apache-2.0
"""`pipeprog patrol`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeprog_bringup.commands.speech import say


def patrol(
    patrol_file: Annotated[
        Path,
        typer.Argument(
            help="Places, and the commands that move the robot. Example: `site.patrol.yaml`", metavar="PATROL.yaml"
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            help="Folder of this round; the same one goes on where it has stopped. Example: `--out rounds/monday`",
            metavar="DIR",
        ),
    ],
) -> None:
    """Drive a robot from place to place and survey each: the graph with the node survey must run.

    `pipeprog patrol site.patrol.yaml --out rounds/monday`
    """
    from pipeprog_bringup.playback.node_processes import require_ros

    require_ros()
    from pipeprog_bringup.patrol.conduct import STATE, conduct
    from pipeprog_camera.errors import InputError

    failed = conduct(patrol_file, out, say)
    if failed:
        raise InputError(
            f"{len(failed)} places have no survey ({', '.join(failed)}): {out / STATE} says why; "
            "the same command goes on with them"
        )
