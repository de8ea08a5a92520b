# SPDX-License-Identifier: Apache-2.0
"""`pipeprog calibrate`."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from pipeprog_bringup.commands.options import Force, Quiet
from pipeprog_bringup.commands.speech import note, say


class Model(str, Enum):
    """Distortion models, as CameraInfo names them."""

    plumb_bob = "plumb_bob"
    equidistant = "equidistant"


def calibrate(
    film: Annotated[
        Path,
        typer.Argument(
            help="Hand-held video (mp4, mov, ...) or recording of a board, half a minute. Example: `board.mp4`",
            metavar="VIDEO|BAG",
        ),
    ],
    board: Annotated[
        Path,
        typer.Option("--board", help="The board (YAML). Example: `--board boards/a4.yaml`", metavar="BOARD.yaml"),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="The calibration to write. Example: `--out phone.yaml`", metavar="CAMERA.yaml")
    ],
    model: Annotated[
        Model,
        typer.Option(help="Distortion: plumb_bob, or equidistant for fisheye lenses. Example: `--model equidistant`"),
    ] = Model.plumb_bob,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Calibrate a camera, the read-out of its shutter included, from a film of a printed board.

    `pipeprog calibrate board.mp4 --board boards/a4.yaml --out phone.yaml`
    """
    from pipeprog_bringup.calibrate import Request, summary
    from pipeprog_bringup.calibrate import calibrate as run
    from pipeprog_bringup.console import share_bar

    with share_bar("calibrate", quiet) as report:
        found = run(Request(film, board, out, model.value, force), report)
    for line in summary(found):
        say(line)
    if not quiet:
        for sentence in found.advice():
            note(sentence)
    say(f"{found.views} images: {out}")
