# SPDX-License-Identifier: Apache-2.0
"""`pipeprog check`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeprog_bringup.commands.options import AsJson, Board, CameraInfoTopic, ImageTopic, ImuTopic, OdometryTopic
from pipeprog_bringup.commands.speech import fail, note, say, say_json


def check(
    bag: Annotated[
        Path,
        typer.Argument(
            help="Recording: an .mcap, .db3 or .bag file or a rosbag2 folder. Example: `bags/demo.mcap`", metavar="BAG"
        ),
    ],
    boq: Annotated[
        Path | None,
        typer.Option(
            "--boq",
            help="Bill of quantities to check, too. Example: `--boq plan.xlsx`",
            metavar="BOQ.yaml|csv|xlsx|ifc",
        ),
    ] = None,
    board: Board = None,
    image_topic: ImageTopic = None,
    camera_info_topic: CameraInfoTopic = None,
    odometry_topic: OdometryTopic = None,
    imu_topic: ImuTopic = None,
    as_json: AsJson = False,
) -> None:
    """Tell in seconds what a survey of a recording will lack; exit status 1 where it could give no result.

    `pipeprog check BAG.mcap --boq BOQ.yaml --board BOARD.yaml`
    """
    from pipeprog_bringup.recording.bag import Bag
    from pipeprog_bringup.recording_check import check as look
    from pipeprog_bringup.recording_check import recording_size
    from pipeprog_detect.product.boq import load_boq
    from pipeprog_sfm.boards.board_file import BoardFile, load_board_file

    recording = Bag.open(bag, image_topic, camera_info_topic, odometry_topic, imu_topic)
    board_file = load_board_file(board) if board else BoardFile()
    findings = look(recording, board_file, recording_size(bag))
    if boq:
        plan = load_boq(boq)
        findings.facts["classes"] = {one.name: round(1e3 * one.outer_radius, 2) for one in plan.classes}
        findings.notes.extend(plan.notes)
    if as_json:
        say_json({"facts": findings.facts, "faults": findings.faults, "notes": findings.notes})
    else:
        for name, value in findings.facts.items():
            say(f"{name.replace('_', ' ')}: {_words(value)}")
        for sentence in findings.notes:
            note(sentence)
        for sentence in findings.faults:
            fail(sentence)
        if not findings.faults and not findings.notes:
            say("nothing is lacking")
    if findings.faults:
        raise typer.Exit(1)


def _words(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {each}" for name, each in value.items()) or "none"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return "unknown" if value is None else str(value)
