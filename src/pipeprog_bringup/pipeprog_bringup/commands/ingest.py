# SPDX-License-Identifier: Apache-2.0
"""`pipeprog ingest`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from pipeprog_bringup.commands.options import Force, Quiet
from pipeprog_bringup.commands.speech import note, say


def ingest(
    video: Annotated[
        Path,
        typer.Argument(
            help="Video (mp4, mov, ...), folder of JPEG pictures, of Stray Scanner or Polycam, or .r3d of Record3D. "
            "Example: `walk.mp4`",
            metavar="VIDEO",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="The recording to write. Example: `--out walk.mcap`", metavar="BAG.mcap")
    ],
    camera: Annotated[
        Path | None,
        typer.Option(
            "--camera",
            help="Calibration of a video, as `pipeprog calibrate` writes it. Example: `--camera phone.yaml`",
            metavar="CAMERA.yaml",
        ),
    ] = None,
    quality: Annotated[int, typer.Option(min=50, max=100, help="JPEG quality. Example: `--quality 90`")] = 95,
    start: Annotated[
        float, typer.Option("--start", help="First second of the video to take. Example: `--start 3`", metavar="S")
    ] = 0.0,
    end: Annotated[
        float, typer.Option("--end", help="Last second of the video to take. Example: `--end 60`", metavar="S")
    ] = math.inf,
    fps: Annotated[
        float | None,
        typer.Option("--fps", help="Images a second at most; without, all. Example: `--fps 10`", metavar="N"),
    ] = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Make a recording of a video and its camera's calibration, or of a scan.

    `pipeprog ingest walk.mp4 --camera CAMERA.yaml --out walk.mcap`
    """
    from pipeprog_bringup.console import share_bar
    from pipeprog_bringup.footage.shot import Excerpt
    from pipeprog_bringup.ingest import Request
    from pipeprog_bringup.ingest import ingest as run

    request = Request(video, camera, out, Excerpt(start, end, fps), quality, force)

    with share_bar("ingest", quiet) as report:
        ingested = run(request, report)
    if not quiet:
        for sentence in ingested.notes:
            note(sentence)
    say(f"{ingested.frames} frames of {ingested.seconds:.1f} s, {out.stat().st_size / 1e6:.1f} MB: {out}")
