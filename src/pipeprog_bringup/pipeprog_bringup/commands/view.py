# SPDX-License-Identifier: Apache-2.0
"""`pipeprog view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeprog_bringup.commands.options import Force
from pipeprog_bringup.commands.speech import say


def view(
    folder: Annotated[Path, typer.Argument(help="Results of a survey. Example: `out/monday`", metavar="DIR")],
    image: Annotated[
        Path | None,
        typer.Option(
            "--image", help="Write a picture; this needs no display. Example: `--image site.png`", metavar="FILE.png"
        ),
    ] = None,
    mesh: Annotated[
        Path | None,
        typer.Option(
            "--mesh",
            help="Write the pipes as meshes for CAD and viewers. Example: `--mesh pipes.glb`",
            metavar="FILE.glb|ply|obj",
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Show cloud, pipes and cameras in a window; with --image or --mesh write a file and open none.

    `pipeprog view out/monday`
    """
    from pipeprog_bringup.view import display

    if image is not None:
        display.write_image(folder, image, force)
        say(f"Picture: {image}")
    if mesh is not None:
        display.write_mesh(folder, mesh, force)
        say(f"Meshes of the pipes: {mesh}")
    if image is None and mesh is None:
        display.show(folder)
