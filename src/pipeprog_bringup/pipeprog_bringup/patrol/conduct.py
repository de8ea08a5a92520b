# SPDX-License-Identifier: Apache-2.0
"""`pipeprog patrol`: a round of the robot from PATROL.yaml, gone on with where the last one has stopped."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

from rclpy.node import Node

from pipeprog_bringup.patrol.patrol_file import read_patrol
from pipeprog_bringup.patrol.patrol_state import PatrolState
from pipeprog_bringup.patrol.round import Round
from pipeprog_bringup.patrol.survey_client import SurveyClient
from pipeprog_bringup.results.folder_lock import locked
from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import shown
from pipeprog_node.ros_context import ros_context

STATE = "patrol.json"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,15}")  # with a place's 40 letters and a number, a survey's 64


def conduct(patrol_file: Path, out: Path, report: Callable[[str], None]) -> list[str]:
    """Goes through the places that are not done yet; returns the names of those that have failed.

    Args:
        patrol_file: PATROL.yaml.
        out: folder of this round: it keeps `patrol.json`, and its name begins the names of the surveys.
        report: gets a sentence at every change.
    """
    patrol = read_patrol(patrol_file)
    name = out.resolve().name
    if not _NAME.fullmatch(name):
        raise InputError(f"--out {shown(str(out))}: it names the surveys: use up to 16 letters, digits, . - and _")
    out.mkdir(parents=True, exist_ok=True)
    try:
        lock = locked(out)
    except BlockingIOError:
        raise InputError(f"another patrol is under way in {out}: wait for it, or choose another --out") from None
    try:
        state = PatrolState(out / STATE, [place.name for place in patrol.places])
        with ros_context(), closing(SurveyClient(Node("patrol"))) as client:
            return Round(patrol, state, name, client, report).run()
    finally:
        with suppress(OSError):
            os.close(lock)
