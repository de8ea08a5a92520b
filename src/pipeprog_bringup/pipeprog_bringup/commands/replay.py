# SPDX-License-Identifier: Apache-2.0
"""`pipeprog replay`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeprog_bringup.commands.options import (
    AsJson,
    Board,
    Boq,
    CameraInfoTopic,
    Force,
    ImageTopic,
    ImuTopic,
    OdometryTopic,
    Out,
    Quiet,
    Set,
)
from pipeprog_bringup.commands.speech import note, say, say_results, say_sizes


def replay(
    bag: Annotated[
        Path,
        typer.Argument(
            help="Recording: an .mcap, .db3 or .bag file or a rosbag2 folder. Example: `bags/demo.mcap`", metavar="BAG"
        ),
    ],
    boq: Boq,
    out: Out,
    board: Board = None,
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate",
            help="Play at R times real time; without, as fast as the nodes take it. Example: `--rate 1`",
            metavar="R",
        ),
    ] = None,
    overrides: Set = None,
    force: Force = False,
    image_topic: ImageTopic = None,
    camera_info_topic: CameraInfoTopic = None,
    rig: Annotated[
        bool, typer.Option("--rig", help="Use all cameras of a robot; /tf_static says where they are mounted.")
    ] = False,
    odometry_topic: OdometryTopic = None,
    imu_topic: ImuTopic = None,
    progress: Annotated[
        Path | None,
        typer.Option(
            "--progress",
            help="Keep a file at where the replay stands, for programs. Example: `--progress state.json`",
            metavar="FILE.json",
        ),
    ] = None,
    no_cloud: Annotated[
        bool, typer.Option("--no-cloud", help="Write no cloud.ply and cloud.las, the largest files but for out.mcap.")
    ] = False,
    reference: Annotated[
        Path | None,
        typer.Option(
            "--reference",
            help="Results of an earlier survey of the site, in whose frame these are to lie. "
            "Example: `--reference out/monday`",
            metavar="DIR",
        ),
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Run the node graph on a recording: keyframes, metric map, classified pipes, progress.

    `pipeprog replay BAG.mcap --boq BOQ.yaml --board BOARD.yaml --out out/monday`
    """
    from pipeprog_bringup.playback.node_processes import require_ros

    require_ros()
    from pipeprog_bringup.console import print_progress, replay_bars
    from pipeprog_bringup.playback.state_file import state_file
    from pipeprog_bringup.replay import Request
    from pipeprog_bringup.replay import replay as run

    request = Request(
        bag,
        boq,
        out,
        board,
        rate,
        overrides or (),
        force,
        image_topic,
        camera_info_topic,
        odometry_topic,
        imu_topic,
        not no_cloud,
        reference,
        rig,
    )
    with replay_bars(quiet) as show, state_file(progress, show) as report:
        outcome = run(request, report, (lambda _: None) if quiet else note)
    if not quiet:
        for sentence in outcome.notes + outcome.losses:
            note(sentence)
    if as_json:
        say_results(out)
        return
    print_progress(outcome.product)
    say(
        f"{outcome.frames} frames considered, {outcome.registered} of {outcome.keyframes} keyframes registered, "
        f"{len(outcome.product.pipes)} pipes: {out / 'pipes.json'}"
    )
    say_sizes(out)
