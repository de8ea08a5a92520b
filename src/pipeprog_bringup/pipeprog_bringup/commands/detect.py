# SPDX-License-Identifier: Apache-2.0
"""`pipeprog detect`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeprog_bringup.commands.options import AsJson, Boq, Force, Out, Quiet, Set
from pipeprog_bringup.commands.speech import note, say, say_results, say_sizes


def detect(
    cloud: Annotated[
        Path,
        typer.Argument(
            help="Metric point cloud: ply, pcd, las, laz, e57, xyz, txt, csv, pts. Example: `scan.las`", metavar="CLOUD"
        ),
    ],
    boq: Boq,
    out: Out,
    force: Force = False,
    overrides: Set = None,
    plane: Annotated[
        str | None,
        typer.Option(
            "--plane",
            help="Only the pipes that a plane cuts: through three points, or a line on a keyframe of the survey whose "
            "cloud.ply it is (keyframes count from 1, as in trajectory.tum). Example: `--plane '0,0,1 1,0,1 0,1,1'`",
            metavar="'X,Y,Z X,Y,Z X,Y,Z' | KEYFRAME:U1,V1,U2,V2",
        ),
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Find and classify the pipes of a metric point cloud.

    `pipeprog detect scan.las --boq BOQ.yaml --out out/scan`
    """
    from pipeprog_bringup.console import print_progress, share_bar
    from pipeprog_bringup.detect_cloud import detect_file
    from pipeprog_bringup.plane_from_keyframe import as_points

    cut = [] if plane is None else ["detect.front_end=planes", f"detect.plane={as_points(plane, cloud.parent)}"]
    with share_bar("detect", quiet) as report:
        detection = detect_file(cloud, boq, out, [*cut, *(overrides or [])], force, report)
    if not quiet:
        for sentence in detection.notes:
            note(sentence)
    if as_json:
        say_results(out)
        return
    print_progress(detection.product)
    say(f"{len(detection.product.pipes)} pipes in {detection.points} points: {out / 'pipes.json'}")
    say_sizes(out)
